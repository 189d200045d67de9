"""Touchdown without a screen: sensor, episode, patch, belief, stability, action."""
