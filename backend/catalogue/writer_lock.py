"""One writer per dataset: a locked file that says who it is. The system frees it at any death."""

from __future__ import annotations

import getpass
import json
import os
import socket
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from backend.core.faults import InputError

NAME = "writer.lock"
_FAR_BYTE = 1 << 20
"""Windows locks bytes against reading as well: this one is far behind the text."""


@dataclass(frozen=True, slots=True)
class Writer:
    """Who writes: a person's name, process, computer, and since when (UTC)."""

    person: str
    pid: int
    host: str
    since: str

    def __str__(self) -> str:
        return f"{self.person} (process {self.pid} on {self.host}, since {self.since})"


class DatasetInUseError(InputError):
    """Another process (or another part of this one) writes the dataset; ``holder`` says who."""

    def __init__(self, folder: Path, holder: Writer | None) -> None:
        who = "another program" if holder is None else str(holder)
        super().__init__(
            f"The dataset is being written by {who}.",
            str(folder),
            "Close it there, or open it here for reading only.",
        )
        self.holder = holder


class WriterLock:
    """The right to write a dataset, from ``take`` until ``release``."""

    def __init__(self, folder: Path, descriptor: int) -> None:
        self._path, self._descriptor = folder / NAME, descriptor

    @classmethod
    def take(cls, folder: Path, person: str = "") -> Self:
        """Lock ``folder`` for ``person``; raises ``DatasetInUseError`` naming the holder."""
        try:
            descriptor = lock_file(folder / NAME)
        except BlockingIOError:
            raise DatasetInUseError(folder, holder(folder)) from None
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        me = Writer(person or _account(), os.getpid(), socket.gethostname(), now)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, json.dumps(asdict(me)).encode("utf-8"))
        return cls(folder, descriptor)

    def release(self) -> None:
        """Give the right back. The file stays: removing it would let two writers in."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)


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


def holder(folder: Path) -> Writer | None:
    """Return who wrote the lock last, or None if nobody says so."""
    try:
        return Writer(**json.loads((folder / NAME).read_text("utf-8")))
    except (OSError, ValueError, TypeError):
        return None


def _account() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError, ImportError):
        return "someone"


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        os.lseek(descriptor, _FAR_BYTE, os.SEEK_SET)
        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        os.lseek(descriptor, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
