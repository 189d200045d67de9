"""Reusable Qt widgets. They show plain values and know no device, file or run."""
