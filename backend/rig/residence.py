"""Memory and parent of the real-time process."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
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


CURRENT, FUTURE, ON_FAULT = 1, 2, 4
"""Of ``mlockall`` in Linux. Pages are kept from their first use on: stacks that are never filled
would take 200 MB."""


def lock_memory() -> bool:
    """Keep all memory of this process, also what it asks for later; return whether it is kept.

    Linux only. Ordinary users need ``memlock unlimited`` in limits.conf: under a limit, memory that
    is asked for later would be refused, which ends a process.
    """
    if sys.platform != "linux":
        return False
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY and os.geteuid() != 0:
        return False
    # For a superuser without that right the system refuses by itself what is over the limit.
    refused: int = ctypes.CDLL(None).mlockall(CURRENT | FUTURE | ON_FAULT)
    return not refused
