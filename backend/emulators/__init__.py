"""Devices that speak the real protocols over real sockets and terminals, to rehearse drivers on.

Emulator and driver share ``backend.wire`` and nothing else.
"""
