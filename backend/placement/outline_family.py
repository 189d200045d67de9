"""Outlines that a support may have: circles, squares, and rectangles up to 1.5 to 1.

Longer rectangles and hexagons stay out, as they stay out of all training: bottoms of these kinds
remain unseen.
"""

from __future__ import annotations

from functools import lru_cache
from math import pi

import numpy as np

from backend.core.flow import FloatArray
from backend.objects.shapes import Outline, circle, convex, edge_normals, rectangle, turned

DIAMETERS_MM = tuple(float(d) for d in range(10, 31))
SIDES_MM = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 22.0, 24.0, 26.0)
RATIOS = (1.25, 1.5)
EIGHTH = pi / 4


@lru_cache(maxsize=1)
def family() -> tuple[Outline, ...]:
    """Return all outlines, each centred on its frame."""
    found = [circle(d) for d in DIAMETERS_MM]
    for side in SIDES_MM:
        square = rectangle(side, side)
        found += [square, _turned(square, EIGHTH)]
        for ratio in RATIOS:
            long = side * ratio**0.5, side / ratio**0.5
            found += [rectangle(*long), rectangle(*long[::-1])]
    return tuple(found)


def inset_mm(outline: Outline, points_mm: FloatArray) -> FloatArray:
    """Return (...,) how far points (..., 2) lie within the outline; negative outside.

    The distance to the nearest edge; beside a corner that to the farther of its lines.
    """
    if outline.kind == "circle":
        return np.asarray(outline.radius_mm - np.hypot(points_mm[..., 0], points_mm[..., 1]))
    start, outward = edge_normals(outline.polygon())
    reach = (start * outward).sum(axis=1)
    return np.asarray((reach - points_mm @ outward.T).min(axis=-1), dtype=np.float64)


def _turned(outline: Outline, angle_rad: float) -> Outline:
    corners = turned(outline.polygon(), angle_rad)
    return convex(tuple((float(x), float(y)) for x, y in corners))
