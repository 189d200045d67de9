"""Handing data on: exports in formats that others read, and imports from them."""
