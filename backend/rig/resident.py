"""Memory of the rig that is never moved to a disk: no cycle of the stream waits for a page."""

from __future__ import annotations

import ctypes
import os
import sys

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
