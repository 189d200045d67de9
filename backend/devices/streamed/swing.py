"""Tells an unstable contact from a press: the force swings at a rate that the loop delay sets."""

from __future__ import annotations

import math
from collections import deque

TURNS = 4
APART_N = 1.0
WINDOW_DELAYS = 10.0


class SwingDetector:
    """Counts turning points of a force more than ``APART_N`` apart within ten loop delays."""

    def __init__(self, delay_s: float) -> None:
        self._window_s = WINDOW_DELAYS * delay_s
        self._turns: deque[float] = deque(maxlen=TURNS)
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self._turns.clear()
        self._rising: bool | None = None
        self._low_n, self._high_n = math.inf, -math.inf

    def feed(self, t_s: float, force_n: float) -> bool:
        """Take the force at ``t_s``; return whether it swings."""
        self._low_n, self._high_n = min(self._low_n, force_n), max(self._high_n, force_n)
        fallen = self._high_n - force_n > APART_N
        risen = force_n - self._low_n > APART_N
        if fallen and self._rising is not False:
            self._turn(t_s, force_n, rising=False)
        elif risen and self._rising is not True:
            self._turn(t_s, force_n, rising=True)
        elif self._rising is True:
            self._low_n = force_n
        elif self._rising is False:
            self._high_n = force_n
        return len(self._turns) == TURNS and t_s - self._turns[0] <= self._window_s

    def _turn(self, t_s: float, force_n: float, *, rising: bool) -> None:
        if self._rising is not None:
            self._turns.append(t_s)
        self._rising, self._low_n, self._high_n = rising, force_n, force_n
