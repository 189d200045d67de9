"""What the wrist sensor tells in air, and how far that has moved by the time of the contact.

A zero that is a descent old is off by what the sensor has drifted since, and the compliant arm
would give way to it as to a force: 0.2 N are 0.013 mm at 15 N/mm.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from backend.core.flow import FloatArray

AIR_S = 0.2
"""Length of the air that is averaged."""
GAP_S = 0.05
"""It ends so long before the onset, which is known within 0.05 mm only."""
KEPT_S = 1.0
"""The onset lies by less than this before the newest sample."""
LEAST_SAMPLES = 10


class AirZero:
    """``t_s`` (n,), ``force_n`` (n, 3): untared samples in air, up to the start of a press."""

    def __init__(self, t_s: FloatArray, force_n: FloatArray) -> None:
        self.start_n = force_n[t_s >= t_s[-1] - AIR_S].mean(axis=0)
        """(3,) mean at the start of the press."""
        self._blocks = deque([(t_s, force_n)])

    def feed(self, t_s: FloatArray, force_n: FloatArray) -> None:
        """Take finite samples (n,), (n, 3) on the way down."""
        if not len(t_s):
            return
        self._blocks.append((t_s, force_n))
        while self._blocks[0][0][-1] < t_s[-1] - KEPT_S:
            self._blocks.popleft()

    def moved_n(self, onset_s: float) -> FloatArray:
        """Return (3,) by how much the air before ``onset_s`` differs from that of the start.

        Zero where there are too few samples to tell.
        """
        t_s, force_n = (np.concatenate(part) for part in zip(*self._blocks, strict=True))
        air = (t_s >= onset_s - GAP_S - AIR_S) & (t_s <= onset_s - GAP_S)
        if np.count_nonzero(air) < LEAST_SAMPLES:
            return np.zeros(3)
        return np.asarray(force_n[air].mean(axis=0) - self.start_n)
