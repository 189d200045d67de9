"""Drivers of the tactile cameras."""
