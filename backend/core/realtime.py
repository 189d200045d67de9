"""Real-time priority for threads with deadlines, where the system allows it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


def prefer(priority: int) -> bool:
    """Ask for SCHED_FIFO ``priority`` (0: leave it) for the calling thread; return whether given.

    Linux only; ordinary users need ``rtprio`` in limits.conf.
    """
    if priority <= 0 or not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        return False
    return True


@contextmanager
def taking_turns(priority: int) -> Iterator[bool]:
    """Give the calling thread, and those that it starts meanwhile, SCHED_RR ``priority``.

    They take turns, as threads that share an interpreter have to. Yields whether it was given; the
    calling thread has its own again in the end. 0, or a system without it: nothing changes.
    """
    if priority <= 0 or not hasattr(os, "sched_setscheduler"):
        yield False
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)
