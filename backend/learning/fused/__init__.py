"""Learned fusion: from the probes of one gripping to how far any point lies within the support."""
