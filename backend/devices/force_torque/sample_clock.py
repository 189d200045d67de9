"""Time stamps of samples, from the arrival of packets."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import FloatArray

CHUNK_S = 0.25
"""Of so many seconds of samples only the promptest arrival is kept."""
CHUNKS = 40
FIT_S = 2.0
"""Before there are so many seconds the sensor's nominal period holds."""
MOST_OFF = 0.1
"""The period of a sensor is not farther from its nominal one than this share."""
LATE_FOR_S = 0.5
"""Arrivals that are late for so long, evenly, follow samples that nobody counted as missing."""

EARLY_S = 0.1
"""What comes so much before its time follows a count that has leapt: the line begins anew."""

LEAST_LATE = 20
"""Fewer late samples than these say nothing."""
SLOW_FOR_S, LEAST_SLOW = 0.1, 4
"""So long, and with so many samples, the pace of what is ever later tells that it is another."""
OTHER_RATE = 1.5
"""Samples that come this much slower are those of a sensor that was set to another rate."""


@dataclass(slots=True)
class _Late:
    """Since when nothing arrived in time: first arrival and number, and the least delay."""

    first_s: float
    first_number: int
    least_s: float


class SampleClock:
    """Of one connection; ``late_s``: a delay up to this is the way of the wire, and no loss."""

    def __init__(self, period_s: float, late_s: float) -> None:
        self._nominal_s, self._late_s = period_s, max(late_s, 3.0 * period_s)
        self._usual_s = period_s
        self._period_s, self._offset_s = period_s, 0.0
        self._chunks: deque[tuple[int, float]] = deque(maxlen=CHUNKS)
        self._chunk = -1
        self._late: _Late | None = None

    @property
    def period_s(self) -> float:
        """The period of the sensor as fitted, or the nominal one."""
        return self._period_s

    def taken_s(self, numbers: FloatArray) -> FloatArray:
        """Return when the samples (n,) with these numbers were taken."""
        return np.asarray(self._offset_s + self._period_s * numbers)

    def feed(self, arrival_s: float, number: int) -> int:
        """Take the newest sample of a read; return how many must be missing that nobody counted."""
        if not self._chunks:
            self._offset_s = arrival_s - self._period_s * number
        self._keep(arrival_s, number)
        delay_s = arrival_s - self._taken_s(number)
        if delay_s < 0.0:
            self._offset_s += delay_s
        if delay_s < -EARLY_S:
            self._chunks.clear()
            self._chunks.append((number, arrival_s))
        if delay_s <= self._late_s:
            self._late = None
            return 0
        return self._step(arrival_s, number, delay_s)

    def _taken_s(self, number: int) -> float:
        return self._offset_s + self._period_s * number

    def _keep(self, arrival_s: float, number: int) -> None:
        """Keep the promptest arrival of each chunk; fit anew when one is whole."""
        chunk = int(number * self._nominal_s / CHUNK_S)
        if chunk != self._chunk:
            if self._chunks:
                self._fit()
            self._chunk = chunk
            self._chunks.append((number, arrival_s))
        elif arrival_s - self._period_s * number < self._kept_s():
            self._chunks[-1] = (number, arrival_s)

    def _kept_s(self) -> float:
        number, arrival_s = self._chunks[-1]
        return arrival_s - self._period_s * number

    def _fit(self) -> None:
        """Lay the line under all arrivals that is nearest to them: one edge of their hull."""
        numbers, arrivals_s = map(np.array, zip(*self._chunks, strict=True))
        if (numbers[-1] - numbers[0]) * self._nominal_s >= FIT_S:
            fitted_s = _edge(numbers, arrivals_s)
            if OTHER_RATE * fitted_s < self._nominal_s:
                # It was slow for a while, and is no longer: the line begins anew.
                self._nominal_s = self._period_s = self._usual_s
                self._offset_s = float(arrivals_s[-1] - self._usual_s * numbers[-1])
                self._chunks.clear()
                return
            most_s = MOST_OFF * self._nominal_s
            self._period_s = float(
                np.clip(fitted_s, self._nominal_s - most_s, self._nominal_s + most_s)
            )
        self._offset_s = float((arrivals_s - self._period_s * numbers).min())

    def _step(self, arrival_s: float, number: int, delay_s: float) -> int:
        """Move the line once nothing came in time for long: what was lost is a gap in time."""
        late = self._late
        if late is None:
            self._late = _Late(arrival_s, number, delay_s)
            return 0
        late.least_s = min(late.least_s, delay_s)
        span_s = self._period_s * (number - late.first_number)
        waited_s = arrival_s - late.first_s
        if waited_s >= SLOW_FOR_S and number - late.first_number >= LEAST_SLOW:
            told_s = waited_s / (number - late.first_number)
            if told_s > OTHER_RATE * self._nominal_s:
                self._begin(arrival_s, number, told_s)
                return 0
        drained = span_s < 0.5 * LATE_FOR_S and number - late.first_number < LEAST_LATE
        if waited_s < LATE_FOR_S or drained:
            return 0
        self._late = None
        self._chunks.clear()
        self._offset_s += late.least_s
        self._chunks.append((number, self._taken_s(number)))
        return round(late.least_s / self._period_s)

    def _begin(self, arrival_s: float, number: int, period_s: float) -> None:
        """Begin the line anew, with another period."""
        self._late = None
        self._chunks.clear()
        self._nominal_s = self._period_s = period_s
        self._offset_s = arrival_s - period_s * number
        self._chunks.append((number, arrival_s))


def _edge(numbers: FloatArray, arrivals_s: FloatArray) -> float:
    """Return the slope of the lower hull where it passes under the mean of ``numbers``."""
    hull: list[int] = []
    for i in range(len(numbers)):
        while len(hull) > 1 and _above(numbers, arrivals_s, (hull[-2], hull[-1], i)):
            hull.pop()
        hull.append(i)
    right = next(k for k in range(1, len(hull)) if numbers[hull[k]] >= numbers.mean())
    a, b = hull[right - 1], hull[right]
    return float((arrivals_s[b] - arrivals_s[a]) / (numbers[b] - numbers[a]))


def _above(numbers: FloatArray, arrivals_s: FloatArray, three: tuple[int, int, int]) -> bool:
    """Whether the middle one is on or above the line through the other two."""
    a, b, c = three
    left = (arrivals_s[b] - arrivals_s[a]) * (numbers[c] - numbers[a])
    right = (arrivals_s[c] - arrivals_s[a]) * (numbers[b] - numbers[a])
    return bool(left >= right)
