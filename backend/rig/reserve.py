"""Room on a disk for one file that may have to be written when there is none left.

The room is a file without a name: whatever death gives it back, and the file that is written into
it appears complete or not at all. Linux, on file systems that know such files; elsewhere nothing is
reserved and a file is written like any other.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from backend.core.files import sync_folder, write_atomically


class Reserve:
    """At most one room at a time; not thread-safe."""

    def __init__(self) -> None:
        self._descriptor: int | None = None
        self._folder: Path | None = None

    def take(self, folder: Path, size: int) -> bool:
        """Reserve ``size`` bytes in ``folder`` in place of what was reserved; whether it could."""
        self.give_back()
        if not hasattr(os, "O_TMPFILE"):
            return False
        try:
            descriptor = os.open(folder, os.O_TMPFILE | os.O_RDWR, 0o644)
        except OSError:
            return False
        try:
            os.posix_fallocate(descriptor, 0, size)
        except OSError:
            os.close(descriptor)
            return False
        self._descriptor, self._folder = descriptor, folder
        return True

    def give_back(self) -> None:
        """Let go of what was reserved."""
        descriptor, self._descriptor = self._descriptor, None
        if descriptor is not None:
            os.close(descriptor)

    def write(self, path: Path, content: bytes) -> None:
        """Make ``content`` the new file ``path``, in the reserved room if it is in its folder.

        Raises ``OSError``. What was reserved is used up.
        """
        if self._descriptor is None or self._folder != path.parent:
            write_atomically(path, content)
            return
        try:
            _fill(self._descriptor, content)
            _name(self._descriptor, path)
        finally:
            self.give_back()
        sync_folder(path.parent)

    def __del__(self) -> None:
        with suppress(OSError):
            self.give_back()


def _fill(descriptor: int, content: bytes) -> None:
    left = memoryview(content)
    while left:
        left = left[os.write(descriptor, left) :]
    os.ftruncate(descriptor, len(content))
    os.fsync(descriptor)


def _name(descriptor: int, path: Path) -> None:
    """Give the unnamed file its name; raises ``FileExistsError`` where that is taken."""
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        # With a folder given the system follows the link to the file itself.
        os.link(f"/proc/self/fd/{descriptor}", path.name, dst_dir_fd=folder, follow_symlinks=True)
    finally:
        os.close(folder)
