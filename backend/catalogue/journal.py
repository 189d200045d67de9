"""The label operations once more, as lines of JSON: ``labels/<site>.jsonl``.

A line is appended after the commit. If that fails (disk full) nothing is lost: the catalogue has
the operation, and the next append writes what is missing first.
"""

from __future__ import annotations

import json
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

from backend.catalogue.chain import canonical
from backend.catalogue.operations import read_operations
from backend.catalogue.values import Operation
from backend.core.files import make_folder, sync_folder

TAIL_BYTES = 65_536
FIELDS = tuple(field.name for field in fields(Operation))


class Journal:
    """The journals of one dataset, one file per site."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, int] = {}

    def path(self, site: str) -> Path:
        """Return the journal of ``site``."""
        return self.folder / f"{site}.jsonl"

    def catch_up(self, connection: sqlite3.Connection, site: str) -> int:
        """Append what the catalogue has and the journal of ``site`` has not; returns how many.

        A torn last line is cut off first. Raises ``OSError`` if the disk refuses.
        """
        path = self.path(site)
        last = self._written.get(site)
        if last is None:
            last = _mend(path)
        missing = read_operations(connection, "site = ? AND seq > ?", (site, last))
        if missing:
            # Unknown until written: a failure half-way makes the next call look again.
            self._written.pop(site, None)
            _append(path, missing)
        self._written[site] = missing[-1].seq if missing else last
        return len(missing)


def read_journal(path: Path) -> Iterator[Operation]:
    """Yield the operations of a journal; a torn last line is passed over.

    Raises ``ValueError`` naming the line for any other damage.
    """
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        if not line.endswith(b"\n"):
            return
        try:
            yield Operation(**json.loads(line))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path.name}, line {number}: {error}") from error


def _append(path: Path, operations: list[Operation]) -> None:
    is_new = not path.exists()
    if is_new:
        make_folder(path.parent)
    lines = b"".join(canonical(_as_line(operation)) + b"\n" for operation in operations)
    with path.open("ab") as file:
        file.write(lines)
        file.flush()
        os.fsync(file.fileno())
    if is_new:
        sync_folder(path.parent)


def _as_line(operation: Operation) -> dict[str, object]:
    # Not ``asdict``: it copies the body of a bulk operation value by value.
    return {name: getattr(operation, name) for name in FIELDS}


def _mend(path: Path) -> int:
    """Cut a torn last line off; return the last sequence number in the file (0 if none)."""
    if not path.exists():
        return 0
    start, tail = tail_of(path)
    end = tail.rfind(b"\n") + 1
    if end < len(tail):
        os.truncate(path, start + end)
    line = tail[tail.rfind(b"\n", 0, max(end - 1, 0)) + 1 : end]
    try:
        return int(json.loads(line)["seq"]) if line else 0
    except (ValueError, TypeError, KeyError):
        return _last_readable(path)


def tail_of(path: Path) -> tuple[int, bytes]:
    """Return the end of a file with its last whole line at least, and where that begins."""
    size, length = path.stat().st_size, TAIL_BYTES
    with path.open("rb") as file:
        while True:
            start = max(0, size - length)
            file.seek(start)
            tail = file.read()
            if not start or tail.count(b"\n") >= 2:
                return start, tail
            length *= 4


def _last_readable(path: Path) -> int:
    last = 0
    try:
        for operation in read_journal(path):
            last = operation.seq
    except ValueError:
        return last
    return last
