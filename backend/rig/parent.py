"""Whether the process that started this one is about to be no more, before its pipes tell.

A killed process closes its files only once it is given a processor to die on: on a busy computer
that took more than 100 ms. The system knows at once: the signal stands in ``/proc``, which can be
asked in a few microseconds (Linux; elsewhere the pipe and the number of the parent have to do).
"""

from __future__ import annotations

import os
import signal
from contextlib import suppress
from pathlib import Path

EXITING = 0x4
"""Of the flags of a process: it is dying (PF_EXITING)."""
KILLED = 1 << (signal.SIGKILL - 1) if os.name == "posix" else 0
"""Of its waiting signals. Threads of a process that dies of any other one get it too."""
STATE, FLAGS, SIGNALS = 0, 6, 28
"""Fields after the name."""


class Parent:
    """Made while it lives; ``gone`` may be asked in every round."""

    def __init__(self) -> None:
        self._number = os.getppid()
        self._descriptor: int | None = None
        with suppress(OSError):
            self._descriptor = os.open(Path("/proc") / str(self._number) / "stat", os.O_RDONLY)

    def gone(self) -> bool:
        """Return whether it is dead, or cannot live on."""
        if os.getppid() != self._number:
            return True
        if self._descriptor is None:
            return False
        try:
            return dying(os.pread(self._descriptor, 1024, 0))
        except ProcessLookupError:
            return True

    def close(self) -> None:
        """Ask no more."""
        if self._descriptor is not None:
            os.close(self._descriptor)
            self._descriptor = None


def dying(line: bytes) -> bool:
    """Read a line of ``/proc/<pid>/stat``; the name in it may hold anything, brackets included."""
    fields = line.rpartition(b") ")[2].split()
    if len(fields) <= SIGNALS:
        return False
    over = fields[STATE] in (b"Z", b"X")
    return over or bool(int(fields[FLAGS]) & EXITING) or bool(int(fields[SIGNALS]) & KILLED)
