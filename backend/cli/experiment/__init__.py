"""Verb ``experiment``."""
