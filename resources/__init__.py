"""Data files that ship with Touchdown: pieces, benches, icons, trained models."""
