"""Timing of the real-time loop."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import FloatArray

LOOK_S = 0.002
LEAST = 5
"""With fewer stamps nothing is told of a sensor."""

Newest = Callable[[], float]
"""Stamp of the newest sample, s; NaN before the first."""
Since = Callable[[float], FloatArray]
"""Stamps (n,) of all samples after a time, s."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Of one sensor: ``rate_hz``; in ms the 99 % limit of an interval's distance from the usual
    one, the longest interval, and how old a sample is when it comes (median, 99 %). NaN: too few.
    """

    name: str
    samples: int
    rate_hz: float
    spread_ms: float
    gap_ms: float
    age_ms: float
    late_ms: float


def timing_of(name: str, stamps_s: FloatArray, ages_s: FloatArray) -> Timing:
    """Return the timing of ``stamps_s`` (n,) that were ``ages_s`` (m,) old when they came."""
    if len(stamps_s) < LEAST or len(ages_s) < LEAST:
        return Timing(name, len(stamps_s), *(5 * (math.nan,)))
    steps_ms = 1e3 * np.diff(stamps_s)
    usual_ms = float(np.median(steps_ms))
    return Timing(
        name,
        len(stamps_s),
        1e3 * len(steps_ms) / float(steps_ms.sum()),
        float(np.percentile(np.abs(steps_ms - usual_ms), 99)),
        float(steps_ms.max()),
        1e3 * float(np.median(ages_s)),
        1e3 * float(np.percentile(ages_s, 99)),
    )


def watch(
    sensors: Mapping[str, tuple[Newest, Since]],
    now_s: Callable[[], float],
    wait: Callable[[float], object],
    for_s: float,
) -> list[Timing]:
    """Watch all sensors for a time; ``wait`` lets seconds pass."""
    begun_s = now_s()
    seen_s = {name: newest() for name, (newest, _) in sensors.items()}
    ages_s: dict[str, list[float]] = {name: [] for name in sensors}
    while now_s() - begun_s < for_s:
        wait(LOOK_S)
        for name, (newest, _) in sensors.items():
            stamp_s = newest()
            if stamp_s != seen_s[name] and math.isfinite(stamp_s):
                seen_s[name] = stamp_s
                ages_s[name].append(now_s() - stamp_s)
    return [
        timing_of(name, since(begun_s), np.array(ages_s[name]))
        for name, (_, since) in sensors.items()
    ]
