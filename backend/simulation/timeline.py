"""Values at the ends of uneven time steps, linear in between, for B probes at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from backend.core.flow import FloatArray
from backend.simulation.mechanics import Solved

VALUES = 14


@dataclass(frozen=True, slots=True)
class Timeline:
    """``t_s`` (B, M), never falling; ``values`` (B, M, 14): wrench at ``G``, strain, pad forces."""

    t_s: FloatArray
    values: FloatArray

    def at(self, t_s: FloatArray) -> FloatArray:
        """Return (B, Q, 14) at the times (B, Q); constant before the first and after the last."""
        last = self.t_s.shape[1] - 1
        after = (self.t_s[:, None, :] <= t_s[:, :, None]).sum(axis=-1)
        right = np.clip(after, 0, last)
        left = np.clip(after - 1, 0, last)
        rows = np.arange(len(t_s))[:, None]
        t_left = self.t_s[rows, left]
        gap = self.t_s[rows, right] - t_left
        share = np.where(gap > 0.0, (t_s - t_left) / np.where(gap > 0.0, gap, 1.0), 0.0)
        low = self.values[rows, left]
        high = self.values[rows, right]
        return np.asarray(low + share[..., None] * (high - low), dtype=np.float64)

    def followed_by(self, later: Self) -> Timeline:
        """Join two stretches."""
        return Timeline(
            np.concatenate([self.t_s, later.t_s], axis=1),
            np.concatenate([self.values, later.values], axis=1),
        )


def packed(solved: Solved) -> FloatArray:
    """Return (B, 14) of one equilibrium."""
    flat = solved.strain.reshape(len(solved.strain), 6)
    return np.concatenate([solved.wrench_g, flat, solved.normal_n], axis=1)
