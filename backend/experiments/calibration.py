"""Do probabilities keep what they promise? Reliability and expected calibration error."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

BINS = 15


@dataclass(frozen=True, slots=True)
class Reliability:
    """Per bin of equal mass: mean ``promised`` probability, share that ``came`` true, ``count``."""

    promised: tuple[float, ...]
    came: tuple[float, ...]
    count: tuple[int, ...]

    @property
    def ece(self) -> float:
        """Mean distance between promise and truth, weighted by count; NaN without any."""
        weight = np.array(self.count, dtype=np.float64)
        if not weight.sum():
            return float("nan")
        gap = np.abs(np.array(self.promised) - np.array(self.came))
        return float((gap * weight).sum() / weight.sum())


def reliability(
    probability: FloatArray, truth: NDArray[np.bool_] | FloatArray, bins: int = BINS
) -> Reliability:
    """Sort ``probability`` (n,) into ``bins`` of equal mass and compare with ``truth`` (n,).

    A share in place of a truth stands for cases that were counted together.
    """
    order = np.argsort(probability, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    return Reliability(
        tuple(float(probability[part].mean()) for part in parts),
        tuple(float(truth[part].mean()) for part in parts),
        tuple(len(part) for part in parts),
    )
