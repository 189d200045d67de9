"""Loads of emulated wrist sensors."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence

from touchdown.backend.emulation.fault_plan import Faults

NOISE = (0.1, 0.1, 0.1, 0.004, 0.004, 0.004)
"""Standard deviation of one sample, N and N·m."""
GRIPPER_N = -14.7
"""A gripper of 1.5 kg hangs below the sensor."""
BEYOND = 1e5
"""A load no sensor can tell, N and N·m."""


def noisy(
    wrench: Callable[[float], Sequence[float]],
    noise: Sequence[float] = NOISE,
    seed: int = 0,
) -> Callable[[float], tuple[float, ...]]:
    """Return ``wrench`` with independent noise on every sample."""
    rng = random.Random(seed)  # noqa: S311

    def felt(now_s: float) -> tuple[float, ...]:
        pairs = zip(wrench(now_s), noise, strict=True)
        return tuple(rng.gauss(value, sigma) for value, sigma in pairs)

    return felt


def hanging(now_s: float, swing_n: float = 0.3, period_s: float = 4.0) -> tuple[float, ...]:
    """Return the wrench of a gripper that sways slowly: six values, N and N·m."""
    sway_n = swing_n * math.sin(2 * math.pi * now_s / period_s)
    return sway_n, 0.5 * sway_n, GRIPPER_N, 0.0, 0.05 * sway_n, 0.0


def suffering(
    wrench: Callable[[float], Sequence[float]], faults: Faults
) -> Callable[[float], tuple[float, ...]]:
    """Return ``wrench`` as a sensor with these faults feels it: freeze, saturate, drift."""
    last: tuple[float, ...] | None = None

    def felt(now_s: float) -> tuple[float, ...]:
        nonlocal last
        if faults.active("saturate", now_s):
            return (BEYOND,) * 6
        if last is None or not faults.active("freeze", now_s):
            x, y, z, *moments = wrench(now_s)
            last = (x, y, z + faults.drift_n(now_s), *moments)
        return last

    return felt
