"""Least, greatest, mean and deviation of many rows, a block at a time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


class RunningStats:
    """Statistics over the first axis of all blocks (Chan, Golub and LeVeque 1979)."""

    def __init__(self) -> None:
        self.count = 0
        self._least: NDArray[Any] = np.array(np.inf)
        self._greatest: NDArray[Any] = np.array(-np.inf)
        self._mean: NDArray[Any] = np.array(0.0)
        self._squares: NDArray[Any] = np.array(0.0)

    def add(self, rows: NDArray[np.float64]) -> None:
        """Take a block (n, ...)."""
        n, mean = len(rows), rows.mean(axis=0)
        gap, total = mean - self._mean, self.count + n
        self._least = np.minimum(self._least, rows.min(axis=0))
        self._greatest = np.maximum(self._greatest, rows.max(axis=0))
        within = ((rows - mean) ** 2).sum(axis=0)
        self._squares = self._squares + within + gap**2 * (self.count * n / total)
        self._mean = self._mean + gap * (n / total)
        self.count = total

    def result(self) -> dict[str, Any]:
        """Return min, max, mean, std and count as lists, as LeRobot keeps them."""
        deviation = np.sqrt(self._squares / self.count)
        return {
            "min": self._least.tolist(),
            "max": self._greatest.tolist(),
            "mean": self._mean.tolist(),
            "std": deviation.tolist(),
            "count": [self.count],
        }
