"""Whether a sensor has become slow, by when its samples come (reliability S6).

Counted from one arrival to another, never up to now: whatever held samples up, an adapter that
collects them or a computer that was busy, the arrival that ends the wait brings them all.
"""

from __future__ import annotations

from collections import deque
from itertools import pairwise
from typing import Protocol, runtime_checkable

SLOW_SHARE, WELL_SHARE = 0.5, 0.6
"""Slow below this share of the usual rate, until it is above the other."""
WINDOW_S = 0.05
LEAST_PERIODS = 6
"""So many samples are due in the window at least: single losses do not make a sensor slow."""
APART = 1.5
"""Quiet for so many periods after an arrival: nothing more waited behind it."""
WAIT_S, WAIT_PERIODS = 0.021, 5.0
"""A longer wait than adapters make (16 ms), and than this many periods, says nothing of a rate."""


@runtime_checkable
class TellsSlow(Protocol):
    """A sensor that knows by itself since when it has been slow."""

    @property
    def slow_since_s(self) -> float | None:
        """Bench time; None while it is not slow."""


class Arrivals:
    """Of one connection, to a sensor with the usual period ``period_s``."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._window_s = max(WINDOW_S, LEAST_PERIODS * period_s)
        self._came: deque[tuple[float, int]] = deque()
        self._total = 0
        self._judged = True
        self.slow_since_s: float | None = None
        """When it began to be slow; None while it is not."""

    def note(self, now_s: float, count: int) -> None:
        """Take ``count`` samples that came at ``now_s``."""
        self.look(now_s)
        self._total += count
        self._came.append((now_s, self._total))
        self._judged = False
        if self.slow_since_s is not None and self._share() >= WELL_SHARE:
            self.slow_since_s = None

    def look(self, now_s: float) -> None:
        """Judge up to the newest arrival, once nothing more waited behind it at ``now_s``."""
        if self._judged or now_s - self._came[-1][0] <= APART * self._period_s:
            return
        self._judged = True
        if self.slow_since_s is None and self._share() < SLOW_SHARE and not self._held_up():
            self.slow_since_s = self._came[0][0]

    def _held_up(self) -> bool:
        """Whether somebody waited long: what ends the wait may still be on its way."""
        longest_s = max(b[0] - a[0] for a, b in pairwise(self._came))
        return longest_s > max(WAIT_S, WAIT_PERIODS * self._period_s)

    def _share(self) -> float:
        """Return the rate over the window up to the newest arrival, as a share of the usual one.

        1.0 as long as there is no window.
        """
        came, (last_s, last) = self._came, self._came[-1]
        while len(came) > 1 and came[1][0] <= last_s - self._window_s:
            came.popleft()
        first_s, first = came[0]
        if last_s - first_s < self._window_s:
            return 1.0
        return (last - first) * self._period_s / (last_s - first_s)
