"""Checks of this computer and of a bench."""
