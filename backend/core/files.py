"""Files that are either complete or not there."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

NOTHING_TO_SYNC = frozenset({errno.EINVAL, errno.ENOTSUP})
"""What a file system says of a folder that it keeps in no form that could be synced (FAT)."""


def sync_folder(folder: Path) -> None:
    """Make renames in ``folder`` durable (a no-op where folders cannot be synced).

    Raises ``OSError`` where the disk refuses for any other reason.
    """
    if os.name != "posix":
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NOTHING_TO_SYNC:
            raise
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Make ``folder`` durable with all folders above it that are missing: what is in them stays."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for made in reversed(missing):
        made.mkdir(exist_ok=True)
        sync_folder(made.parent)


def write_atomically(path: Path, content: bytes) -> None:
    """Write ``content`` to ``path``: temporary name, fsync, rename, fsync of the folder.

    If the disk refuses, ``path`` stays as it was and nothing else stays.
    """
    make_folder(path.parent)
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink()
        raise
    sync_folder(path.parent)
