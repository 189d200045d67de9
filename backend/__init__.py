"""Touchdown without a screen. Packages import each other downwards only, from sensor to action."""
