"""Bytes to messages and back for every wire of the bench: no input or output, no clock.

Units change here and nowhere else: above this layer are mm, rad, N, N·m, s and degrees Celsius.
"""
