"""Waiting for threads that own a wire: on a condition, never for a time."""

import threading
import time


def until(condition, limit_s=60.0):
    """Wait on an event that nobody sets: no test depends on how fast the machine is."""
    end, never = time.monotonic() + limit_s, threading.Event()
    while not condition():
        assert time.monotonic() < end, "it did not come in time"
        never.wait(0.005)
