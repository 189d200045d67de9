"""Newton's method with step halving for R(q) = contact wrench - K (q - q°) = 0, batched."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation.contact import Cells, Touch, tangent, touch
from backend.simulation.halving import fall

SCALE = np.array([1.0, 1.0, 1.0, 1 / 20.0, 1 / 20.0, 1 / 20.0])
"""Residual scale: forces in N, moments divided by 20 mm."""
TOLERANCE = 1e-6
RESIDUAL_LIMIT = 1e-4
"""Largest scaled residual of a usable step."""
MAX_ITERATIONS = 60
HALVINGS = 10
FEW = 0.6
"""Below this share of unfinished probes it pays to pick them out."""


def balance(
    cells: Cells,
    anchor: FloatArray,
    start: FloatArray,
    zero: FloatArray,
    stiffness: FloatArray,
    iterations: int = MAX_ITERATIONS,
) -> tuple[FloatArray, Touch, FloatArray]:
    """Return (q (B, 6), cell forces there, scaled residual (B,)).

    ``start`` (B, 6): first guess; ``zero`` q° (B, 6); ``stiffness`` (B, 6): diagonal of K.
    Steps that do not lower the residual of a probe are halved for that probe alone.
    """
    spring = _Spring(cells, anchor, zero, stiffness)
    now = spring.at(start)
    for done in range(iterations):
        busy = now.size > TOLERANCE
        if not busy.any():
            break
        few = np.flatnonzero(busy)
        if len(few) <= FEW * len(start):
            # Every probe for itself: the others would only be computed again.
            q, size = now.q + 0.0, now.size
            q[few], _, size[few] = balance(
                cells.take(few),
                anchor[:, few],
                q[few],
                zero[few],
                stiffness[few],
                iterations - done,
            )
            return q, touch(cells, anchor, q), size
        matrix = tangent(cells, now.touch)
        matrix[:, _DIAGONAL, _DIAGONAL] -= stiffness
        step = np.asarray(np.linalg.solve(matrix, -now.left[:, :, None])[:, :, 0], np.float64)
        step[~busy] = 0.0
        now = _stepped(spring, now, step, busy)
    return now.q, now.touch, now.size


@dataclass(frozen=True, slots=True)
class _Trial:
    """Motion ``q`` (B, 6), the forces there, and what is ``left`` (B, 6), as one ``size`` (B,)."""

    q: FloatArray
    touch: Touch
    left: FloatArray
    size: FloatArray

    def take(self, rows: NDArray[np.intp]) -> _Trial:
        return _Trial(self.q[rows], self.touch.take(rows), self.left[rows], self.size[rows])

    def put(self, rows: NDArray[np.intp], by: _Trial) -> None:
        self.q[rows], self.left[rows], self.size[rows] = by.q, by.left, by.size
        self.touch.put(rows, by.touch)


@dataclass(frozen=True, slots=True)
class _Spring:
    """What pulls on the cells, as given to ``balance``."""

    cells: Cells
    anchor: FloatArray
    zero: FloatArray
    stiffness: FloatArray

    def take(self, rows: NDArray[np.intp]) -> _Spring:
        return _Spring(
            self.cells.take(rows), self.anchor[:, rows], self.zero[rows], self.stiffness[rows]
        )

    def at(self, q: FloatArray) -> _Trial:
        there = touch(self.cells, self.anchor, q)
        left = there.wrench - self.stiffness * (q - self.zero)
        return _Trial(q, there, left, _size(left))


def _stepped(spring: _Spring, now: _Trial, step: FloatArray, busy: NDArray[np.bool_]) -> _Trial:
    """Go one Newton step, halved for each probe until its residual falls."""
    after = spring.at(now.q + step)

    def at(rows: NDArray[np.intp], share: FloatArray) -> _Trial:
        return spring.take(rows).at(now.q[rows] + share[:, None] * step[rows])

    worse = np.flatnonzero(busy & ~(after.size < now.size))
    fall(after, now.size, worse, HALVINGS, at)
    return after


_DIAGONAL = np.arange(6)


def _size(residual: FloatArray) -> FloatArray:
    scaled = residual * SCALE
    return np.asarray(np.sqrt((scaled * scaled).sum(axis=1)), dtype=np.float64)
