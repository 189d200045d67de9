"""Scheduling of threads: priorities, announced blocking sections, and postponed repaints.

Real-time priority is used where the system allows it. A watchdog would take a thread that waits for
a disk or a lock for a stalled one; a blocking section announces the wait.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType


def set_realtime_priority(priority: int) -> bool:
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
def round_robin_priority(priority: int) -> Iterator[bool]:
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


NICENESS, RAISED_NICENESS = 10, -10


def lower_priority() -> None:
    """Bring this process to ``NICENESS``; one that stands further back already stays there."""
    if os.name == "posix":
        os.nice(max(0, NICENESS - os.nice(0)))


@contextmanager
def raised_priority() -> Iterator[bool]:
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
        os.setpriority(os.PRIO_PROCESS, 0, min(RAISED_NICENESS, before))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


class RepaintHold:
    """Asked for by whoever decides, heeded by whoever draws; it ends by itself.

    A decision is some hundred short library calls, each of which lets go of the interpreter. A
    window that draws meanwhile keeps it for up to a millisecond each time: 6 ms become 40.
    """

    def __init__(self, now_s: Callable[[], float] = time.perf_counter) -> None:
        self._now_s, self._until_s = now_s, float("-inf")

    @property
    def on(self) -> bool:
        """Whether a decision is due now."""
        return self._now_s() < self._until_s

    def begin(self, longest_s: float) -> None:
        """Ask for quiet from now on, for ``longest_s`` at most."""
        self._until_s = self._now_s() + longest_s

    def end(self) -> None:
        """End it: the decision is made."""
        self._until_s = float("-inf")


DISK_TIMEOUT_S = 60.0  # longest time to write an episode, to a network disk too
LOCK_TIMEOUT_S = 30.0  # another thread may copy a catalogue or wait for a disk


@dataclass(frozen=True, slots=True)
class BlockingSection:
    """``what`` a thread does, and until when (``time.monotonic``) nobody need wonder."""

    what: str
    until_s: float


_SECTIONS: dict[int, BlockingSection] = {}  # outermost section by native thread id


@contextmanager
def blocking_section(what: str, limit_s: float) -> Iterator[None]:
    """Say that this thread does ``what`` (*sets the scene*), which takes ``limit_s`` at most."""
    number = threading.get_native_id()
    if number in _SECTIONS:
        yield
        return
    _SECTIONS[number] = BlockingSection(what, time.monotonic() + limit_s)
    try:
        yield
    finally:
        del _SECTIONS[number]


def blocking_section_of(number: int) -> BlockingSection | None:
    """Return what the thread with this number of the system says that it does."""
    return _SECTIONS.get(number)


class SharedLock:
    """A re-entrant lock that is held while a disk is written: who has to wait for it says so."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            with blocking_section("waits for another thread", LOCK_TIMEOUT_S):
                self._lock.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lock.release()
