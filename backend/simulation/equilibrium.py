"""Newton's method with step halving for R(q) = contact wrench - K (q - q°) = 0, batched."""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray
from backend.simulation.contact import Cells, Touch, tangent, touch

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
    q = start
    now = touch(cells, anchor, q)
    residual = now.wrench - stiffness * (q - zero)
    size = _size(residual)
    for done in range(iterations):
        busy = size > TOLERANCE
        if not busy.any():
            break
        few = np.flatnonzero(busy)
        if len(few) <= FEW * len(q):
            # Every probe for itself: the others would only be computed again.
            q = q + 0.0
            q[few], _, size[few] = balance(
                cells.take(few),
                anchor[:, few],
                q[few],
                zero[few],
                stiffness[few],
                iterations - done,
            )
            return q, touch(cells, anchor, q), size
        matrix = tangent(cells, now)
        matrix[:, _DIAGONAL, _DIAGONAL] -= stiffness
        step = np.linalg.solve(matrix, -residual[:, :, None])[:, :, 0]
        step[~busy] = 0.0
        for _ in range(HALVINGS):
            trial = q + step
            there = touch(cells, anchor, trial)
            left = there.wrench - stiffness * (trial - zero)
            new_size = _size(left)
            worse = busy & ~(new_size < size)
            if not worse.any():
                break
            step[worse] *= 0.5
        q, now, residual, size = trial, there, left, new_size
    return q, now, size


_DIAGONAL = np.arange(6)


def _size(residual: FloatArray) -> FloatArray:
    scaled = residual * SCALE
    return np.asarray(np.sqrt((scaled * scaled).sum(axis=1)), dtype=np.float64)
