"""How far work in bulk steps back behind the bench and its operator, and a bench steps forward."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

NICENESS, FORWARD = 10, -10


def step_back() -> None:
    """Bring this process to ``NICENESS``; one that stands further back already stays there."""
    if os.name == "posix":
        os.nice(max(0, NICENESS - os.nice(0)))


@contextmanager
def stepping_forward() -> Iterator[bool]:
    """Bring the calling thread, and those that it starts meanwhile, to ``FORWARD``.

    Not to real-time priority: whole processors would be kept from the system's own work, such as
    handing on what serial ports received. Yields whether it was given; the calling thread is where
    it was in the end. Linux only; ordinary users need ``nice`` in limits.conf.
    """
    if sys.platform != "linux":
        yield False
        return
    before = os.getpriority(os.PRIO_PROCESS, 0)
    try:
        os.setpriority(os.PRIO_PROCESS, 0, min(FORWARD, before))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)
