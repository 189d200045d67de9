"""How far the wrist sensor has drifted, by what it tells in still air (reliability S8).

The wrench of a hand that hangs free is its weight and the error of its sensor. The weight stays,
so that what changes slowly is drift; what changes at once is a load, and counts for nothing.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from backend.core.flow import FloatArray

BLOCK_S = 0.5
"""Samples of so long are one mean."""
LEAST_S = 0.15
"""Shorter air says nothing."""
STEP_N = 0.15
"""From one mean to the next; more, or more than the noise explains, is a load."""
FAST_N_S = 0.1
"""Between two stays in air it may have drifted by so much more a second; beyond is a load."""
NOISES = 8.0
BROKEN_S = 0.2
"""Samples that are farther apart are not one air."""
LONGEST_GAP_S = 60.0
"""What happened over a longer time out of the air is not known."""
WINDOW_S = 300.0
"""Drift is told over so long: a tare is as old as that at most (reliability S8)."""
NAMED_N, QUIET_N = 0.5, 0.25
"""So much drift is named, well before it reaches 1 N, until there is as little as this again."""
SOON_S = 5.0
"""Less time in air gives no figure yet."""


@dataclass(frozen=True, slots=True)
class Drift:
    """By how much, in N, a still wrist sensor moved within the last ``over_s``; ``named``: much."""

    moved_n: float
    over_s: float
    named: bool = False

    @property
    def rate_n_s(self) -> float:
        """Mean rate in N a second."""
        return self.moved_n / self.over_s

    def text(self) -> str:
        """Return it as an episode keeps it."""
        return f"{self.moved_n:.3f} N in {self.over_s:.1f} s"

    def words(self) -> str:
        """Return it as the read-out shows it."""
        over = f"{self.over_s:.0f} s" if self.over_s < 99.5 else f"{self.over_s / 60.0:.0f} min"
        return f"drift {self.moved_n:.2f} N in {over}"


@dataclass(frozen=True, slots=True)
class _Air:
    """One mean of still air: until when, (3,) N, and the standard deviation of that mean."""

    until_s: float
    mean_n: FloatArray
    sigma_n: float


class DriftWatch:
    """Adds up what the air moves; the caller knows what air is."""

    def __init__(self) -> None:
        self._blocks: list[tuple[FloatArray, FloatArray]] = []
        self._last: _Air | None = None
        self._contiguous = False
        self._sum_n = np.zeros(3)
        self._step_n: FloatArray | None = None
        self._loaded = False
        self._told: deque[tuple[float, FloatArray]] = deque()
        self._named = False

    def feed(self, t_s: FloatArray, force_n: FloatArray) -> None:
        """Take untared samples (n,), (n, 3) in still air, with the same load as those before."""
        finite = np.isfinite(force_n).all(axis=1)
        t_s, force_n = t_s[finite], force_n[finite]
        if not len(t_s):
            return
        if self._blocks and t_s[0] - self._blocks[-1][0][-1] > BROKEN_S:
            self.leave()
        self._blocks.append((t_s, force_n))
        if t_s[-1] - self._blocks[0][0][0] >= BLOCK_S:
            self._close()

    def leave(self) -> None:
        """Leave the air, or stand still no longer: until the next air more may change."""
        if self._blocks and self._blocks[-1][0][-1] - self._blocks[0][0][0] >= LEAST_S:
            self._close()
        self._blocks.clear()
        self._contiguous = False

    def reload(self) -> None:
        """Begin with another load: a piece was gripped or let go, or the hand was turned."""
        self.leave()
        self._last = None

    def drift(self) -> Drift | None:
        """Return what was found, None as long as that is too little to say."""
        if not self._told or self._told[-1][0] - self._told[0][0] < SOON_S:
            return None
        (first_s, first_n), (last_s, last_n) = self._told[0], self._told[-1]
        moved_n = float(np.linalg.norm(last_n - first_n))
        self._named = moved_n >= (QUIET_N if self._named else NAMED_N)
        return Drift(moved_n, last_s - first_s, self._named)

    def _close(self) -> None:
        """Take the mean of what is gathered, and what it moved since the one before."""
        t_s, force_n = (np.concatenate(part) for part in zip(*self._blocks, strict=True))
        self._blocks.clear()
        sigma_n = float(force_n.std(axis=0).max()) / math.sqrt(len(t_s))
        air = _Air(float(t_s[-1]), force_n.mean(axis=0), sigma_n)
        before, self._last = self._last, air
        if before is None:
            self._count(None)
        elif self._is_load(before, air):
            # The means beside it may hold a part of the load.
            self._step_n, self._loaded = None, True
        else:
            self._count(None if self._loaded else air.mean_n - before.mean_n)
        self._contiguous = True
        self._told.append((air.until_s if before is None else before.until_s, self._sum_n))
        while self._told[0][0] < air.until_s - WINDOW_S:
            self._told.popleft()

    def _count(self, step_n: FloatArray | None) -> None:
        """Add the step before, now that no load followed it; keep this one."""
        if self._step_n is not None:
            self._sum_n = self._sum_n + self._step_n
        self._step_n, self._loaded = step_n, False

    def _is_load(self, before: _Air, air: _Air) -> bool:
        gap_s = 0.0 if self._contiguous else air.until_s - before.until_s
        noise_n = NOISES * math.hypot(air.sigma_n, before.sigma_n)
        moved_n = float(np.linalg.norm(air.mean_n - before.mean_n))
        return gap_s > LONGEST_GAP_S or moved_n > max(STEP_N, noise_n) + FAST_N_S * gap_s
