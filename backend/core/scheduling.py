"""Scheduling of threads: priorities, announced blocking sections, and postponed repaints.

Real-time priority is used if the system allows it. A blocking section announces a wait for a disk
or a lock, which a watchdog would otherwise report as a stalled thread.
"""

from __future__ import annotations

import ctypes
import os
import platform
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass


def set_realtime_priority(priority: int) -> bool:
    """Set SCHED_FIFO ``priority`` (0: no change) for the calling thread; return True if granted.

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
    """Set SCHED_RR ``priority`` for the calling thread and the threads it starts in the block.

    Yields True if granted. The former priority is restored at the end. 0, or a system without
    SCHED_RR: nothing changes.
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


# Request of processor time at a time; the system's default is 1 to 3 ms, its least 0.1 ms
SLICE_NS = 100_000
# Number of the system call sched_setattr, and struct sched_attr: size, policy, flags, niceness,
# real-time priority, run time (the slice of a normal thread), deadline, period
SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
SCHED_ATTR = struct.Struct("<IIQiIQQQ")


def request_short_slices() -> bool:
    """Request processor time in short slices for the calling thread; return True if granted.

    A thread that uses less than its share then runs soon after it wakes. Threads that it starts
    inherit the request. Every user has the right to it. It has an effect from Linux 6.12 on.
    """
    call = SCHED_SETATTR.get(platform.machine()) if sys.platform == "linux" else None
    if call is None or os.sched_getscheduler(0) != os.SCHED_OTHER:
        return False
    niceness = os.getpriority(os.PRIO_PROCESS, 0)
    request = SCHED_ATTR.pack(SCHED_ATTR.size, os.SCHED_OTHER, 0, niceness, 0, SLICE_NS, 0, 0)
    return bool(ctypes.CDLL(None).syscall(call, 0, request, 0) == 0)


NICENESS, RAISED_NICENESS = 10, -10


def lower_priority() -> None:
    """Raise the niceness of this process to at least ``NICENESS``."""
    if os.name == "posix":
        os.nice(max(0, NICENESS - os.nice(0)))


@contextmanager
def raised_priority() -> Iterator[bool]:
    """Set ``RAISED_NICENESS`` for the calling thread and the threads it starts in the block.

    Real-time priority would keep whole processors from work of the system such as serial ports.
    Yields True if granted. The former niceness is restored at the end. Linux only; ordinary users
    need ``nice`` in limits.conf.
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
    """Asks the GUI to postpone repaints while a decision is computed; expires by itself.

    A decision consists of about a hundred short library calls that release the interpreter lock. A
    repaint holds the lock for up to 1 ms each time, so that 6 ms become 40 ms.
    """

    def __init__(self, now_s: Callable[[], float] = time.perf_counter) -> None:
        self._now_s, self._until_s = now_s, float("-inf")

    @property
    def on(self) -> bool:
        """True while repaints shall be postponed."""
        return self._now_s() < self._until_s

    def begin(self, longest_s: float) -> None:
        """Start the hold; it expires after ``longest_s``."""
        self._until_s = self._now_s() + longest_s

    def end(self) -> None:
        """End the hold."""
        self._until_s = float("-inf")


DISK_TIMEOUT_S = 60.0  # longest time to write an episode, to a network disk too
LOCK_TIMEOUT_S = 30.0  # another thread may copy a catalogue or wait for a disk


@dataclass(frozen=True, slots=True)
class BlockingSection:
    """Activity of a thread, and its latest end (``time.monotonic``)."""

    what: str
    until_s: float


_SECTIONS: dict[int, BlockingSection] = {}  # outermost section by native thread id


@contextmanager
def blocking_section(what: str, limit_s: float) -> Iterator[None]:
    """Announce that this thread does ``what`` ("sets the scene") for ``limit_s`` at most."""
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
    """Return the announced section of the thread with this native id."""
    return _SECTIONS.get(number)


class SharedLock:
    """A re-entrant lock held during disk writes; waiting for it is a blocking section."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            with blocking_section("waits for another thread", LOCK_TIMEOUT_S):
                self._lock.acquire()

    def __exit__(self, *_: object) -> None:
        self._lock.release()
