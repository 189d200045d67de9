"""How stiff a contact is: the slope of the force against the command that caused it."""

from __future__ import annotations

from collections import deque

import numpy as np

LOW_N, HIGH_N = 1.0, 5.0
LEAST_SAMPLES = 4


class ContactStiffness:
    """Takes command and force once per cycle; the force answers a loop delay later."""

    def __init__(self, delay_s: float) -> None:
        self._delay_s = delay_s
        self._commands: deque[tuple[float, float]] = deque(maxlen=64)
        self._seen: list[tuple[float, float]] = []
        self.found_n_mm: float | None = None
        """Found once the force has risen from 1 to 5 N; a softer contact is never found."""

    def feed(self, t_s: float, command_z_mm: float, force_n: float) -> None:
        """Take the height commanded at ``t_s`` and the press force felt then."""
        self._commands.append((t_s, command_z_mm))
        if self.found_n_mm is not None:
            return
        if not force_n >= LOW_N:
            # One rise tells it: what bounces in between belongs to no slope.
            self._seen.clear()
        elif force_n <= HIGH_N:
            times, heights = zip(*self._commands, strict=True)
            self._seen.append((float(np.interp(t_s - self._delay_s, times, heights)), force_n))
        elif len(self._seen) >= LEAST_SAMPLES:
            self.found_n_mm = self._slope()

    def _slope(self) -> float:
        heights, forces = np.array(self._seen).T
        away = heights - heights.mean()
        return float(-(away @ forces) / max(float(away @ away), 1e-9))
