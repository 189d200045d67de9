"""Success rates with their uncertainty."""

from __future__ import annotations

import math

Z_95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution."""


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float] | None:
    """Return the Wilson score interval (0..1), None without a trial (Wilson 1927)."""
    if trials <= 0:
        return None
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    low, high = (centre - half) / scale, (centre + half) / scale
    return max(0.0, low), min(1.0, high)
