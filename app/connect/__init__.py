"""Connecting a lab's devices from the window, and the limits of the bench."""
