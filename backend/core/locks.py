"""A locked file: one holder at a time, and the system frees it at any death."""

from __future__ import annotations

import os
import sys
from pathlib import Path

_FAR_BYTE = 1 << 20
"""Windows locks bytes against reading as well: this one is far behind the text."""


def lock_file(path: Path) -> int:
    """Lock ``path`` (made if need be) until the returned descriptor is closed.

    Raises ``BlockingIOError`` if it is locked already.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        _lock(descriptor)
    except OSError as error:
        os.close(descriptor)
        raise BlockingIOError(f"{path} is locked") from error
    return descriptor


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, _FAR_BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        os.lseek(descriptor, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
