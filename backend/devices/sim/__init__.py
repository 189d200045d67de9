"""The simulated bench served as devices."""
