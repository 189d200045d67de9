"""A file for HDF5 on a disk that may fill up: HDF5 must be able to close, or it ends the process.

What the disk refuses is kept in memory until the file is closed, and told to whoever asks.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Self


class PatientFile:
    """A new file that takes every write; ``check`` raises the ``OSError`` of the first refused one.

    Whoever writes much asks often: from the first refusal on all is kept in memory.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._at = self._end = 0
        self._late: list[tuple[int, bytes]] = []
        self._refused: OSError | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def check(self) -> None:
        """Raise what the disk refused, if it refused anything."""
        if self._refused is not None:
            raise self._refused

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the place of the next read or write, and return it."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        """Return the place of the next read or write."""
        return self._at

    def write(self, content: bytes | memoryview) -> int:
        """Write all of ``content``, to the disk or else to memory."""
        data, done = bytes(content), 0
        try:
            self.check()
            self._file.seek(self._at)
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError as error:
            self._refused = error
            self._late.append((self._at + done, data[done:]))
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes, fewer at the end."""
        count = min(size, max(self._end - self._at, 0))
        self._file.seek(self._at)
        found = bytearray(self._file.read(count) or b"").ljust(count, b"\0")
        for place, data in self._late:
            first, last = max(place, self._at), min(place + len(data), self._at + count)
            if first < last:
                found[first - self._at : last - self._at] = data[first - place : last - place]
        self._at += count
        return bytes(found)

    def truncate(self, size: int) -> int:
        """Cut or lengthen the file."""
        try:
            self.check()
            self._file.truncate(size)
        except OSError as error:
            self._refused = error
        self._end = size
        return size

    def flush(self) -> None:
        """Do nothing: writes go to the disk at once."""
