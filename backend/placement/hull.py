"""Convex hulls of few points, and the signed distance of a point to the edge of one."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

ON_EDGE_MM = 1e-9
"""Rounding allowance of an edge: a point this far outside still lies on it."""

Point = tuple[float, float]


def convex_hull(points: NDArray[np.number]) -> FloatArray:
    """Return the (k, 2) counter-clockwise corners of the hull of ``points`` (n, 2).

    k is 0 for no point, 1 for one place, 2 for collinear points. Corners are strict: no three lie
    on one line. Exact for integer coordinates below 2**25, which is why the map calls it with cell
    indices and not with lengths. Andrew's monotone chain (Inf. Process. Lett. 9 (1979) 216).
    """
    chain = _column_ends(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    if len(chain) < 3:
        return np.array(chain, dtype=np.float64).reshape(-1, 2)
    lower = _half(chain)
    upper = _half(chain[::-1])
    return np.array(lower[:-1] + upper[:-1], dtype=np.float64)


def signed_margin_mm(hull: FloatArray, point: Point) -> float:
    """Return the distance of ``point`` to the edge of ``hull``: positive inside, negative outside.

    ``hull`` (k, 2) is counter-clockwise. A point or line has no inside: the result is never
    positive there. Returns -inf without support (k = 0).
    """
    if not len(hull):
        return -math.inf
    start = hull
    edge = np.roll(hull, -1, axis=0) - start
    to_point = np.asarray(point, dtype=np.float64) - start
    squared = np.maximum((edge**2).sum(axis=1), np.finfo(np.float64).tiny)
    along = np.clip((to_point * edge).sum(axis=1) / squared, 0.0, 1.0)
    nearest = to_point - along[:, None] * edge
    distance = float(np.hypot(nearest[:, 0], nearest[:, 1]).min())
    if len(hull) < 3:
        return -distance
    left_of = edge[:, 0] * to_point[:, 1] - edge[:, 1] * to_point[:, 0]
    return distance if bool((left_of >= 0).all()) else -distance


def inside(hull: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Return for ``points`` (..., 2) whether they lie in the hull or on its edge.

    ``hull`` (k, 2) counter-clockwise with k >= 3; nothing lies inside a smaller one.
    """
    if len(hull) < 3:
        return np.zeros(points.shape[:-1], dtype=np.bool_)
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.stack((edge[:, 1], -edge[:, 0])) / np.hypot(edge[:, 0], edge[:, 1])
    reach = (hull * normal.T).sum(axis=1)
    return np.asarray((points @ normal <= reach + ON_EDGE_MM).all(axis=-1), dtype=np.bool_)


def _column_ends(points: FloatArray) -> list[Point]:
    """Sort by x, then y, and keep the two ends of each column: only they can be corners."""
    if not len(points):
        return []
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    new_column = np.concatenate(([True], ordered[1:, 0] != ordered[:-1, 0]))
    ends = new_column | np.concatenate((new_column[1:], [True]))
    kept = ordered[ends]
    distinct = np.concatenate(([True], (kept[1:] != kept[:-1]).any(axis=1)))
    return [(float(x), float(y)) for x, y in kept[distinct]]


def _half(chain: Sequence[Point]) -> list[Point]:
    """Return one chain of the hull: every turn is to the left."""
    half: list[Point] = []
    for point in chain:
        while len(half) >= 2 and _turn(half[-2], half[-1], point) <= 0:
            half.pop()
        half.append(point)
    return half


def _turn(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
