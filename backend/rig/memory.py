"""Memory shared by backend and real-time process.

Holds control words, sample rings and one state. Neither side waits for the other: a record has its
number in front and behind, and a reader accepts it only if both match. Each part has one writer.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.devices import TRACE_NAMES

PREFIX = "touchdown-rig-"
FILE = "memory"
WORDS = 16
# Index of each control word; LEASE is seconds of the bench clock, all others are counts.
BACKEND_BEAT, RIG_BEAT, STOPS, LEASE, STATE, WRENCH, POSES, ROUNDS, NOTES = range(9)
STATE_BYTES = 16_384
NOTE_BYTES: Final = 480
NOTES_KEPT = 1024
CHANNELS = {WRENCH: 6, POSES: 3, ROUNDS: len(TRACE_NAMES)}
# More than 5 s of 1 kHz samples, 3.5 ms cycles and 4 ms rounds.
CAPACITY = {WRENCH: 8192, POSES: 2048, ROUNDS: 2048}


class Ring:
    """Ring of records: number, time, values, number. ``count`` is the writer's control word."""

    def __init__(self, cells: FloatArray, words: NDArray[np.int64], word: int) -> None:
        self._cells, self._numbers = cells, cells.view(np.int64)
        self._words, self._word = words, word
        self.capacity = len(cells)

    @property
    def count(self) -> int:
        """Number of records written so far."""
        return int(self._words[self._word])

    def put(self, t_s: FloatArray, values: FloatArray) -> None:
        """Append stamps (n,) and values (n, channels); keeps the newest if they do not fit."""
        t_s, values = t_s[-self.capacity :], values[-self.capacity :]
        first, done = self.count, 0
        for rows in self._rows(first, first + len(t_s)):
            part = slice(done, done + rows.stop - rows.start)
            numbers = np.arange(first + part.start, first + part.stop)
            # Both numbers first: a concurrent reader detects the change.
            self._numbers[rows, -1] = self._numbers[rows, 0] = -1
            self._cells[rows, 1], self._cells[rows, 2:-1] = t_s[part], values[part]
            self._numbers[rows, -1] = numbers
            self._numbers[rows, 0] = numbers
            done = part.stop
        self._words[self._word] = first + len(t_s)

    def since(self, cursor: int) -> tuple[FloatArray, FloatArray, int]:
        """Return complete stamps (n,), values (n, channels) after ``cursor``, the next cursor."""
        count = self.count
        first = min(max(cursor, count - self.capacity), count)
        before, cells, behind = [], [], []
        for rows in self._rows(first, count):
            before.append(self._numbers[rows, 0].copy())
            cells.append(self._cells[rows].copy())
            behind.append(self._numbers[rows, -1].copy())
        if not cells:
            return np.empty(0), np.empty((0, self._cells.shape[1] - 3)), count
        numbers, kept = np.arange(first, count), np.concatenate(cells)
        whole = (np.concatenate(before) == numbers) & (np.concatenate(behind) == numbers)
        return kept[whole, 1], kept[whole, 2:-1], count

    def _rows(self, first: int, end: int) -> list[slice]:
        """Return the slices of the records from ``first`` to ``end``, at most one turn of the ring.
        Slices are several times faster than an index array.
        """
        begin = first % self.capacity
        fits = min(end - first, self.capacity - begin)
        rest = end - first - fits
        parts = (slice(begin, begin + fits), slice(0, rest))
        return [rows for rows in parts if rows.stop > rows.start]


class SharedMemory:
    """Created by the backend with ``make``, opened by the rig with ``attach``."""

    def __init__(self, pages: mmap.mmap) -> None:
        self._pages = pages
        self._words = np.frombuffer(pages, np.int64, WORDS)
        self._lease = self._words[LEASE : LEASE + 1].view(np.float64)
        offset = 8 * WORDS
        self._state = np.frombuffer(pages, np.uint8, STATE_BYTES, offset)
        offset += STATE_BYTES
        rings = {}
        for word, channels in CHANNELS.items():
            shape = (CAPACITY[word], channels + 3)
            cells = np.frombuffer(pages, np.float64, shape[0] * shape[1], offset).reshape(shape)
            rings[word] = Ring(cells, self._words, word)
            offset += cells.nbytes
        self.wrench, self.poses, self.rounds = rings[WRENCH], rings[POSES], rings[ROUNDS]
        self._notes = np.frombuffer(pages, NOTE, NOTES_KEPT, offset)

    def count(self, word: int) -> int:
        """Return a control word that counts heartbeats, STOP requests or states."""
        return int(self._words[word])

    @property
    def lease_until_s(self) -> float:
        """Bench time until which motion is permitted, s."""
        return float(self._lease[0])

    def beat(self, word: int) -> None:
        """Increment a control word of which this side is the only writer."""
        self._words[word] += 1

    def permit(self, until_s: float) -> None:
        """Set the bench time until which motion is permitted, s."""
        self._lease[0] = until_s

    def show(self, state: dict[str, Any]) -> None:
        """Replace the state of the rig; raises ``ValueError`` if it is too long."""
        content = json.dumps(state, separators=(",", ":")).encode()
        if len(content) > STATE_BYTES - 24:
            raise ValueError(f"a state of {len(content)} bytes is too long")
        number = int(self._words[STATE]) + 1
        ends = self._state.view(np.int64)
        ends[-1] = ends[0] = -1
        ends[1] = len(content)
        self._state[16 : 16 + len(content)] = np.frombuffer(content, np.uint8)
        ends[-1] = number
        ends[0] = number
        self._words[STATE] = number

    def seen(self) -> dict[str, Any] | None:
        """Return the newest state, None before the first or while it is being written."""
        ends = self._state.view(np.int64)
        number = int(ends[0])
        if number <= 0:
            return None
        size = int(ends[1])
        content = self._state[16 : 16 + size].tobytes()
        if int(ends[-1]) != number or int(ends[0]) != number:
            return None
        try:
            found = json.loads(content)
        except (ValueError, RecursionError):
            return None
        return found if isinstance(found, dict) else None

    def note(self, t_s: float, text: str) -> None:
        """Append a line to the flight recorder; a line that is too long is cut."""
        number = int(self._words[NOTES])
        content = text.encode()[:NOTE_BYTES].ljust(NOTE_BYTES)
        self._notes[number % NOTES_KEPT] = (number, t_s, content, number)
        self._words[NOTES] = number + 1

    def notes(self) -> list[tuple[float, str]]:
        """Return the kept lines with their times, oldest first."""
        count = int(self._words[NOTES])
        kept = [(n, self._notes[n % NOTES_KEPT]) for n in range(max(0, count - NOTES_KEPT), count)]
        whole = [row for n, row in kept if row["first"] == row["last"] == n]
        lines = [(float(row["t_s"]), bytes(row["text"])) for row in whole]
        return [(t_s, text.decode(errors="replace").rstrip()) for t_s, text in lines]


NOTE = np.dtype(
    [("first", np.int64), ("t_s", np.float64), ("text", f"S{NOTE_BYTES}"), ("last", np.int64)]
)
SIZE = (
    8 * WORDS
    + STATE_BYTES
    + sum(8 * CAPACITY[word] * (channels + 3) for word, channels in CHANNELS.items())
    + NOTES_KEPT * NOTE.itemsize
)


def make() -> tuple[SharedMemory, Path]:
    """Return new memory and its file for this user only; ``drop`` the file once attached."""
    for found in _folder().glob(f"{PREFIX}*-*"):
        # Left by a program that was killed while it started.
        number = found.name.removeprefix(PREFIX).split("-")[0]
        if number.isdecimal() and not _alive(int(number)):
            shutil.rmtree(found, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-", dir=_folder()))
    path = folder / FILE
    with path.open("w+b") as file:
        file.truncate(SIZE)
        memory = SharedMemory(mmap.mmap(file.fileno(), SIZE))
    memory.permit(-math.inf)
    return memory, path


def attach(path: Path) -> SharedMemory:
    """Return the memory in the file ``path``; raises ``OSError``."""
    with path.open("r+b") as file:
        return SharedMemory(mmap.mmap(file.fileno(), SIZE))


def drop(path: Path) -> None:
    """Delete the file; attached processes keep the memory."""
    shutil.rmtree(path.parent, ignore_errors=True)


def _folder() -> Path:
    """Return the folder of memory files, in memory if the system has such a folder."""
    shared = Path("/dev/shm")  # noqa: S108 - a folder of our own is made in it
    usable = shared.is_dir() and os.access(shared, os.W_OK)
    return shared if usable else Path(tempfile.gettempdir())


def _alive(number: int) -> bool:
    if os.name != "posix":
        return True
    try:
        os.kill(number, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
