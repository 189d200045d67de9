"""Real-time priority for threads with deadlines, where the system allows it."""

from __future__ import annotations

import os


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
