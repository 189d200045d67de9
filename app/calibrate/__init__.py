"""The calibration wizard: what holds, measure, look at the residual, accept or repeat."""
