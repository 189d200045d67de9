"""Gives each marker the dot that is its own, one to one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from backend.core.flow import GRID_COLS, GRID_ROWS, FloatArray

NEAREST_ORDER_PX = 4.0
"""Neighbours closer than this along their axis have lost their order."""


def nearest_dots(expected_px: FloatArray, dots_px: FloatArray, reach_px: float) -> NDArray[np.intp]:
    """Return for each of n places the dot that is nearest both ways within ``reach_px``, else -1.

    One to one by construction; ``dots_px`` is (m, 2).
    """
    owner = np.full(len(expected_px), -1, dtype=np.intp)
    if not len(dots_px):
        return owner
    gap = _gap(expected_px, dots_px)
    mine, theirs = gap.argmin(axis=1), gap.argmin(axis=0)
    places = np.arange(len(expected_px))
    mutual = (theirs[mine] == places) & (gap[places, mine] <= reach_px)
    owner[mutual] = mine[mutual]
    return owner


def assign_rest(
    owner: NDArray[np.intp], expected_px: FloatArray, dots_px: FloatArray, reach_px: float
) -> NDArray[np.intp]:
    """Complete ``owner``: markers without a dot share out the free dots at least total distance."""
    places = np.flatnonzero(owner < 0)
    free = np.setdiff1d(np.arange(len(dots_px)), owner)
    completed = owner.copy()
    if not len(places) or not len(free):
        return completed
    gap = _gap(expected_px[places], dots_px[free])
    rows, cols = linear_sum_assignment(np.minimum(gap, 2 * reach_px))
    near = gap[rows, cols] <= reach_px
    completed[places[rows[near]]] = free[cols[near]]
    return completed


def out_of_order(position_px: FloatArray) -> NDArray[np.bool_]:
    """Return the (63,) markers whose right or lower neighbour is not right of or below them."""
    grid = position_px.reshape(GRID_ROWS, GRID_COLS, 2)
    wrong = np.zeros((GRID_ROWS, GRID_COLS), dtype=bool)
    across = np.diff(grid[:, :, 0], axis=1) < NEAREST_ORDER_PX
    wrong[:, :-1] |= across
    wrong[:, 1:] |= across
    down = np.diff(grid[:, :, 1], axis=0) < NEAREST_ORDER_PX
    wrong[:-1] |= down
    wrong[1:] |= down
    return wrong.ravel()


def _gap(expected_px: FloatArray, dots_px: FloatArray) -> FloatArray:
    across = expected_px[:, None, 0] - dots_px[None, :, 0]
    down = expected_px[:, None, 1] - dots_px[None, :, 1]
    # Not hypot, whose care for overflow takes six times as long.
    return np.asarray(np.sqrt(across * across + down * down), dtype=np.float64)
