"""A disk that loses power: what may be on it at any instant of a recorded run.

``Disk`` follows the operations that ``disk_trace.c`` wrote down. What was synchronised is there
for good. Of everything else any part may be there or not: of the data of each file every piece of
4 KiB by itself (one of them torn), of each folder the operations on its entries up to any of them,
for a folder's journal is in order. An entry is durable once its folder was synchronised, not with
its file: that is what POSIX promises, and less than what ext4 does.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

PAGE = 4096
NO_CHANCE = random.Random(0)
HEAD = struct.Struct("<cQqIIQ")


@dataclass(frozen=True, slots=True)
class Done:
    """One operation: Open, Truncating open, Write, Length, Sync, Rename, Unlink or Make folder."""

    kind: str
    inode: int
    offset: int
    path: str
    other: str
    data: bytes


def read_log(path: Path) -> list[Done]:
    """Return the operations in their order."""
    raw, at, found = path.read_bytes(), 0, []
    while at < len(raw):
        kind, inode, offset, a, b, size = HEAD.unpack_from(raw, at)
        at += HEAD.size
        texts = raw[at : at + a].decode(), raw[at + a : at + a + b].decode()
        at += a + b
        found.append(Done(kind.decode(), inode, offset, *texts, raw[at : at + size]))
        at += size
    return found


@dataclass(frozen=True, slots=True)
class Part:
    """Share of the data not synchronised that survives: all, nothing, or a random part."""

    data: float
    entries: float
    seed: int = 0


@dataclass(slots=True)
class _File:
    """Durable content, and what was done since: (offset, data), or (length, None)."""

    durable: bytes = b""
    pending: list[tuple[int, bytes | None]] = field(default_factory=list)

    def content(self, share: float, rng: random.Random) -> bytes:
        """Return a possible content."""
        if share == 0.0:
            return self.durable
        found = bytearray(self.durable)
        pieces = self.pending if share == 1.0 else list(_pieces(self.pending))
        torn = rng.randrange(len(pieces)) if pieces and 0.0 < share < 1.0 else -1
        for number, (offset, data) in enumerate(pieces):
            if not (share == 1.0 or rng.random() < share):
                continue
            if data is None:
                found[:] = found[:offset].ljust(offset, b"\0")
                continue
            kept = data[: len(data) // 2] if number == torn else data
            found.extend(bytes(max(0, offset + len(kept) - len(found))))
            found[offset : offset + len(kept)] = kept
        return bytes(found)


def _pieces(pending: list[tuple[int, bytes | None]]) -> Iterator[tuple[int, bytes | None]]:
    for offset, data in pending:
        if data is None:
            yield offset, None
            continue
        at = 0
        while at < len(data):
            size = PAGE - (offset + at) % PAGE
            yield offset + at, data[at : at + size]
            at += size


@dataclass(slots=True)
class _Folder:
    """Entries by name (inode, or path of a folder), and changes since: (name taken, name, what)."""

    durable: dict[str, int | str] = field(default_factory=dict)
    pending: list[tuple[str, str, int | str | None]] = field(default_factory=list)

    def entries(self, share: float, rng: random.Random) -> dict[str, int | str]:
        """Return possible entries."""
        found, count = dict(self.durable), len(self.pending)
        kept = count if share == 1.0 else 0 if share == 0.0 else rng.randint(0, count)
        for taken, name, what in self.pending[:kept]:
            found.pop(taken, None)
            if what is not None:
                found[name] = what
        return found


class Disk:
    """A disk below ``root`` (which is there from the beginning), operation by operation."""

    def __init__(self, root: Path) -> None:
        self._root = str(root)
        self._files: dict[int, _File] = {}
        self._folders: dict[str, _Folder] = {self._root: _Folder()}

    def do(self, done: Done) -> None:
        """Apply one operation."""
        if done.kind in "OT":
            self._open(done)
        elif done.kind in "WL":
            data = done.data if done.kind == "W" else None
            self._files[done.inode].pending.append((done.offset, data))
        elif done.kind == "S":
            self._sync(done)
        elif done.kind == "M":
            self._folders[done.path] = _Folder()
            self._change(done.path, "", done.path)
        elif done.kind == "U":
            self._change(done.path, done.path, None)
        else:
            what = self._now(done.path)
            if _parent(done.path) == _parent(done.other):
                self._change(done.other, done.path, what)
            else:
                self._change(done.other, "", what)
                self._change(done.path, done.path, None)

    def states(self, part: Part) -> dict[str, bytes]:
        """Return the files that may exist after a power loss now, by path."""
        rng, found = random.Random(part.seed), dict[str, bytes]()
        waiting = [self._root]
        while waiting:
            folder = waiting.pop()
            for name, what in self._folders[folder].entries(part.entries, rng).items():
                if isinstance(what, str):
                    waiting.append(what)
                else:
                    found[f"{folder}/{name}"] = self._files[what].content(part.data, rng)
        return found

    def _open(self, done: Done) -> None:
        if self._now(done.path) != done.inode:
            # A new file: an inode may have been that of a file that is gone.
            self._files[done.inode] = _File()
            self._change(done.path, "", done.inode)
        elif done.kind == "T":
            self._files[done.inode].pending.append((0, None))

    def _sync(self, done: Done) -> None:
        if done.path in self._folders:
            folder = self._folders[done.path]
            folder.durable, folder.pending = folder.entries(1.0, NO_CHANCE), []
        else:
            file = self._files[done.inode]
            file.durable, file.pending = file.content(1.0, NO_CHANCE), []

    def _now(self, path: str) -> int | str | None:
        return self._folders[_parent(path)].entries(1.0, NO_CHANCE).get(_name(path))

    def _change(self, path: str, taken: str, what: int | str | None) -> None:
        change = (_name(taken), _name(path), what)
        self._folders[_parent(path)].pending.append(change)


def _parent(path: str) -> str:
    return path.rpartition("/")[0]


def _name(path: str) -> str:
    return path.rpartition("/")[2]
