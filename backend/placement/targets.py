"""Places worth going to: the middle of the support, the most probable cells, a spiral."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import count
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from backend.config.method import PolicySettings
from backend.core.flow import FloatArray
from backend.placement.belief import Belief
from backend.placement.hull import inside
from backend.placement.stability import confident, support_hull_mm

XY = tuple[float, float]
BEST_PERCENTILE = 95.0


def hull_centre(
    belief: Belief, delta: float, what: Literal["area", "cells", "vertices"]
) -> XY | None:
    """Return the middle of the confident support on the whole map, None without any.

    The paper divides a sum over the hull's points by their number; the readings are all cells
    inside the hull ("area"), the confident cells, or the hull's vertices.
    """
    cells = confident(belief, delta)
    hull = support_hull_mm(belief, cells)
    if not len(hull):
        return None
    if what == "vertices" or (what == "area" and len(hull) < 3):
        return _mean(hull)
    # Every cell inside the hull lies in the box round the confident ones.
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    centres = belief.map.cell_centres_mm()[box]
    return _mean(centres[cells[box] if what == "cells" else inside(hull, centres)])


def best_cells(belief: Belief) -> XY | None:
    """Return the mean of the covered cells from the 95th percentile of probability upwards.

    "From" and not "above": where many cells share the highest value none lies above it.
    """
    covered: NDArray[np.bool_] = belief.map.covered
    if not covered.any():
        return None
    least = np.percentile(belief.map.log_odds[covered], BEST_PERCENTILE)
    chosen = covered & (belief.map.log_odds >= least)
    return _mean(belief.map.cell_centres_mm()[chosen])


def next_on_spiral(centre_mm: XY, belief: Belief, settings: PolicySettings) -> XY:
    """Return the first place on a square spiral round ``centre_mm`` that was not yet probed."""
    step = settings.longest_step_mm
    for column, row in _spiral():
        place = (centre_mm[0] + step * column, centre_mm[1] + step * row)
        if not any(math.dist(place, visit) < 0.5 * step for visit in belief.visits):
            return place
    raise AssertionError("unreachable: the spiral does not end")


def _spiral() -> Iterator[tuple[int, int]]:
    """Whole places outwards from (0, 0), neighbours at distance 1: right, up, left, down."""
    x, y = 0, 0
    yield x, y
    for turn in count():
        dx, dy = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn % 4]
        for _ in range(turn // 2 + 1):
            x, y = x + dx, y + dy
            yield x, y


def _mean(points: FloatArray) -> XY:
    x, y = points.reshape(-1, 2).mean(axis=0)
    return float(x), float(y)
