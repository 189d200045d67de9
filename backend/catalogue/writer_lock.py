"""One writer per dataset: a locked file that says who it is. The system frees it at any death."""

from __future__ import annotations

import getpass
import json
import os
import socket
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from backend.core.faults import InputError
from backend.core.locks import lock_file

NAME = "writer.lock"


@dataclass(frozen=True, slots=True)
class Writer:
    """Who writes: a person's name, process, computer, and since when (UTC)."""

    person: str
    pid: int
    host: str
    since: str

    def __str__(self) -> str:
        return f"{self.person} (process {self.pid} on {self.host}, since {self.since})"


class NotWritableError(InputError):
    """The dataset cannot be opened to write, but to look at."""


class ReadOnlyFolderError(NotWritableError):
    """The folder of the dataset cannot be written at all."""

    def __init__(self, folder: Path, error: OSError) -> None:
        super().__init__(
            f"The dataset cannot be written: {error.strerror or error}.",
            str(folder),
            "Make its folder and disk writable, or copy it to a disk that is; looking, verifying "
            "and exporting do without.",
        )


class DatasetInUseError(NotWritableError):
    """Another process (or another part of this one) writes the dataset; ``holder`` says who."""

    def __init__(self, folder: Path, holder: Writer | None) -> None:
        who = "another program" if holder is None else str(holder)
        super().__init__(
            f"The dataset is being written by {who}.",
            str(folder),
            "Close it there first; `touchdown dataset status` looks without writing.",
        )
        self.holder = holder


class WriterLock:
    """The right to write a dataset, from ``take`` until ``release``."""

    def __init__(self, folder: Path, descriptor: int) -> None:
        self._path, self._descriptor = folder / NAME, descriptor

    @classmethod
    def take(cls, folder: Path, person: str = "") -> Self:
        """Lock ``folder`` for ``person``.

        Raises ``DatasetInUseError`` naming the holder, or ``ReadOnlyFolderError``.
        """
        try:
            descriptor = lock_file(folder / NAME)
        except BlockingIOError:
            raise DatasetInUseError(folder, holder(folder)) from None
        except OSError as error:
            raise ReadOnlyFolderError(folder, error) from error
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")
        me = Writer(person or _account(), os.getpid(), socket.gethostname(), now)
        os.ftruncate(descriptor, 0)
        os.write(descriptor, json.dumps(asdict(me)).encode("utf-8"))
        return cls(folder, descriptor)

    def release(self) -> None:
        """Give the right back. The file stays: removing it would let two writers in."""
        os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)


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
