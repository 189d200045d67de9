"""What a thread says that it is doing, where that may keep it waiting for long.

Whoever watches a thread takes one that waits without a word for one that stands still.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import TracebackType

DISK_S = 60.0
"""A disk, also one of another computer, has written an episode by then or never will."""
LOCK_S = 30.0
"""Another thread may be copying a whole catalogue, or wait for a disk."""


@dataclass(frozen=True, slots=True)
class Doing:
    """``what`` a thread does, and until when (``time.monotonic``) nobody need wonder."""

    what: str
    until_s: float


_NOW: dict[int, Doing] = {}
"""By the number that the system gave the thread; the outermost, which holds the others."""


@contextmanager
def doing(what: str, limit_s: float) -> Iterator[None]:
    """Say that this thread does ``what`` (*sets the scene*), which takes ``limit_s`` at most."""
    number = threading.get_native_id()
    if number in _NOW:
        yield
        return
    _NOW[number] = Doing(what, time.monotonic() + limit_s)
    try:
        yield
    finally:
        del _NOW[number]


def done_by(number: int) -> Doing | None:
    """Return what the thread with this number of the system says that it does."""
    return _NOW.get(number)


class SharedLock:
    """A re-entrant lock that is held while a disk is written: who has to wait for it says so."""

    def __init__(self) -> None:
        self._lock = threading.RLock()

    def __enter__(self) -> None:
        if not self._lock.acquire(blocking=False):
            with doing("waits for another thread", LOCK_S):
                self._lock.acquire()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._lock.release()
