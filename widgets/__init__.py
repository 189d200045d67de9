"""Views of values, with no knowledge of the machinery behind them."""
