"""Bounded sample buffers between producers and readers.

The newest sample wins, and every loss is counted.
"""

from __future__ import annotations

import math
import threading
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Generic, Self, TypeVar

import numpy as np

from touchdown.backend.core.faults import StaleSampleError
from touchdown.backend.core.values import FINGERS, Finger, FloatArray, TactileFrame

T = TypeVar("T")
# Capacity of a bench: 7.7 s of images per finger (44 MB each) and 60 s of 1 kHz samples
FRAME_CAPACITY, SAMPLE_CAPACITY = 192, 60_000


class Stream(Generic[T]):
    """Keeps the newest ``capacity`` items for one writer and any number of readers."""

    def __init__(self, name: str, capacity: int) -> None:
        self.name = name
        self._items: deque[tuple[float, T]] = deque(maxlen=capacity)
        self._count = 0
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of items ever put (the cursor of the newest item)."""
        return self._count

    def put(self, t_s: float, item: T) -> None:
        """Append ``item`` stamped ``t_s``; the oldest item is overwritten when full."""
        with self._lock:
            self._items.append((t_s, item))
            self._count += 1

    def newest(self) -> T | None:
        """Return the newest item regardless of its age, for display only."""
        with self._lock:
            return self._items[-1][1] if self._items else None

    def since(self, cursor: int) -> tuple[list[T], int, int]:
        """Return (items after ``cursor``, new cursor, number of lost items)."""
        with self._lock:
            wanted = self._count - cursor
            kept = min(max(wanted, 0), len(self._items))
            first = len(self._items) - kept
            items = [self._items[first + i][1] for i in range(kept)]
            return items, self._count, max(wanted, 0) - kept

    def between(self, start_s: float, end_s: float) -> list[T]:
        """Return the kept items stamped ``start_s <= t <= end_s`` in order of time."""
        with self._lock:
            items = list(self._items)
        return [item for t_s, item in items if start_s <= t_s <= end_s]

    def clear(self) -> None:
        """Remove the items; the count is kept, so that readers notice."""
        with self._lock:
            self._items.clear()


@dataclass(frozen=True, slots=True)
class Samples:
    """A run of numeric samples: ``t_s`` (n,), ``values`` (n, channels), and the reader's cursor."""

    t_s: FloatArray
    values: FloatArray
    cursor: int
    lost: int


class SampleStream:
    """A ring buffer of numeric samples (force/torque at 1 kHz, poses)."""

    def __init__(self, name: str, channels: int, capacity: int) -> None:
        self.name: str = name
        self.channels: int = channels
        self.capacity: int = capacity
        self._t_s = np.zeros(capacity)
        self._values = np.zeros((capacity, channels))
        self._count = 0
        self._start = 0
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of samples ever put."""
        return self._count

    def put(self, t_s: FloatArray, values: FloatArray) -> None:
        """Append a block: ``t_s`` (n,) ascending, ``values`` (n, channels), n <= capacity."""
        with self._lock:
            begin = self._count % self.capacity
            fits = min(len(t_s), self.capacity - begin)
            # Slices, the rest from the front: an index array takes several times as long.
            for ring, block in ((self._t_s, t_s), (self._values, values)):
                ring[begin : begin + fits] = block[:fits]
                if fits < len(block):
                    ring[: len(block) - fits] = block[fits:]
            self._count += len(t_s)

    def since(self, cursor: int) -> Samples:
        """Return a copy of the samples after ``cursor``."""
        with self._lock:
            oldest = max(self._start, self._count - self.capacity)
            first = max(cursor, oldest)
            return self._copy(first, self._count, lost=first - min(cursor, first))

    def window(self, start_s: float, end_s: float) -> Samples:
        """Return a copy of the kept samples stamped ``start_s <= t <= end_s``."""
        with self._lock:
            # Searched in place; copying a full ring takes milliseconds.
            kept = range(max(self._start, self._count - self.capacity), self._count)
            first = kept.start + bisect_left(kept, start_s, key=self._stamp)
            end = kept.start + bisect_right(kept, end_s, key=self._stamp)
            return self._copy(first, max(first, end), lost=0)

    def latest(self, now_s: float, max_age_s: float) -> tuple[float, FloatArray]:
        """Return (t_s, values) of the newest sample; raises ``StaleSampleError``."""
        with self._lock:
            if self._count == self._start:
                raise StaleSampleError(f"{self.name}: no sample yet")
            i = (self._count - 1) % self.capacity
            t_s, values = float(self._t_s[i]), self._values[i].copy()
        if not now_s - t_s <= max_age_s:
            age_ms = 1e3 * (now_s - t_s)
            raise StaleSampleError(f"{self.name}: newest sample is {age_ms:.0f} ms old")
        if not np.isfinite(values).all():
            raise StaleSampleError(f"{self.name}: newest sample is not a finite number")
        return t_s, values

    def clear(self) -> None:
        """Remove the samples; the count is kept, so that readers notice."""
        with self._lock:
            self._start = self._count

    def _stamp(self, number: int) -> float:
        return float(self._t_s[number % self.capacity])

    def _copy(self, first: int, end: int, *, lost: int) -> Samples:
        """Copy the samples ``first`` to ``end``, at most ``capacity``."""
        begin = first % self.capacity
        fits = min(end - first, self.capacity - begin)
        t_s, values = (
            np.concatenate((ring[begin : begin + fits], ring[: end - first - fits]))
            for ring in (self._t_s, self._values)
        )
        return Samples(t_s, values, self._count, lost)


@dataclass(frozen=True, slots=True)
class RawStreams:
    """Outputs of the devices: frames per finger, untared wrench samples, arm positions.

    ``commands``: commanded positions; empty if the arm does not report them. Successive scenes may
    share them.
    """

    frames: Mapping[Finger, Stream[TactileFrame]]
    samples: SampleStream
    poses: SampleStream
    commands: SampleStream = field(default_factory=lambda: SampleStream("arm_command", 3, 1))

    @classmethod
    def new(cls) -> Self:
        """Return empty streams."""
        return cls(
            {finger: Stream(f"tactile_{finger}", FRAME_CAPACITY) for finger in FINGERS},
            SampleStream("force_torque", 6, SAMPLE_CAPACITY),
            SampleStream("arm", 3, SAMPLE_CAPACITY),
            SampleStream("arm_command", 3, SAMPLE_CAPACITY),
        )

    def clear(self) -> None:
        """Remove the samples of a former scene, whose clock started at zero too."""
        for frames in self.frames.values():
            frames.clear()
        self.samples.clear()
        self.poses.clear()
        self.commands.clear()


class Decimator:
    """Reduces a sample rate by taking the first sample of each period."""

    def __init__(self) -> None:
        self._period: int | None = None

    def takes(self, t_s: float, rate_hz: float) -> bool:
        """Return True if the sample stamped ``t_s`` belongs to the reduced rate ``rate_hz``."""
        # A stamp on the border of two periods belongs to the later one.
        period = math.floor(t_s * rate_hz + 1e-6)
        taken, self._period = period != self._period, period
        return taken
