"""Pace of emulated devices."""

from __future__ import annotations

import math

from touchdown.backend.emulation.disturbances import RateLimiter
from touchdown.backend.emulation.fault_plan import Faults

MOST_DUE = 200
"""Samples sent at once after a pause; older ones are lost, as in the buffer of an adapter."""


class Pace:
    """Counts the samples of one stream; not begun, or ended, nothing is due."""

    def __init__(self) -> None:
        self._start_s: float | None = None
        self._period_s = 1.0
        self._sent = 0
        self._thinned = RateLimiter()
        self.faults: Faults | None = None
        """Of the sensor: the kind ``slow`` makes fewer samples due, which it numbers as usual."""

    @property
    def running(self) -> bool:
        """Whether samples go out of themselves."""
        return self._start_s is not None

    def begin(self, now_s: float, period_s: float) -> None:
        """Start anew: the first sample is due now."""
        self._start_s, self._period_s, self._sent = now_s, period_s, 0

    def end(self) -> None:
        """No more samples."""
        self._start_s = None

    def due(self, now_s: float) -> tuple[int, list[float]]:
        """Return how many samples were lost, and the times of those due up to now."""
        if self._start_s is None:
            return 0, []
        end = math.floor((now_s - self._start_s) / self._period_s + 1e-6) + 1
        late = max(0, end - self._sent - MOST_DUE)
        first, self._sent = self._sent + late, max(end, self._sent)
        times_s = [self._start_s + k * self._period_s for k in range(first, end)]
        return late, [t_s for t_s in times_s if self._taken(t_s)]

    def _taken(self, t_s: float) -> bool:
        slow = None if self.faults is None else self.faults.find("slow", t_s)
        return slow is None or slow.hz is None or self._thinned.takes(t_s, slow.hz)
