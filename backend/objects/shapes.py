"""Flat convex outlines: circles and polygons, the shapes of every contact face.

An outline lives in its own face frame, origin at the face's centre. Polygons are counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import cos, hypot, pi, sin
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from backend.core.flow import FloatArray

EDGE_TOLERANCE_MM = 1e-9
"""Points this near to the edge count as inside, so that round-off does not decide."""

CIRCLE_SEGMENTS = 128
"""Corners of the inscribed polygon of a circle: radius error below 0.004 mm at radius 12.5 mm."""

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Outline:
    """A convex outline; build it with ``circle``, ``rectangle``, ``regular`` or ``convex``.

    ``radius_mm`` is used by circles, ``vertices_mm`` (counter-clockwise) by polygons.
    """

    kind: Literal["circle", "polygon"]
    radius_mm: float = 0.0
    vertices_mm: tuple[Point, ...] = ()

    def contains(self, points_mm: ArrayLike, /) -> NDArray[np.bool_]:
        """Return (...,) bool: which of the points (..., 2) mm lie inside or on the edge."""
        points = np.asarray(points_mm, dtype=np.float64)
        if self.kind == "circle":
            reach = self.radius_mm + EDGE_TOLERANCE_MM
            return np.asarray((points**2).sum(axis=-1) <= reach**2)
        start, normal = edge_normals(self.polygon())
        outward = points @ normal.T - (start * normal).sum(axis=1)
        return np.asarray((outward <= EDGE_TOLERANCE_MM).all(axis=-1))

    def polygon(self, segments: int = CIRCLE_SEGMENTS) -> FloatArray:
        """Return (k, 2) corners in mm, counter-clockwise; read-only, shared between callers.

        A circle becomes its inscribed polygon of ``segments`` corners, the first on +x.
        """
        return _corners(self, segments)

    def placed(
        self, at_mm: Point, yaw_rad: float = 0.0, segments: int = CIRCLE_SEGMENTS
    ) -> FloatArray:
        """Return (k, 2) corners of the outline turned by ``yaw_rad`` and moved to ``at_mm``."""
        return turned(self.polygon(segments), yaw_rad) + np.asarray(at_mm, dtype=np.float64)

    @property
    def half_extents_mm(self) -> Point:
        """Farthest reach from the centre along x and along y."""
        if self.kind == "circle":
            return self.radius_mm, self.radius_mm
        return max(abs(x) for x, _ in self.vertices_mm), max(abs(y) for _, y in self.vertices_mm)

    @property
    def area_mm2(self) -> float:
        """Exact area."""
        if self.kind == "circle":
            return pi * self.radius_mm**2
        closed = (*self.vertices_mm, self.vertices_mm[0])
        return 0.5 * sum(a[0] * b[1] - b[0] * a[1] for a, b in pairwise(closed))


@cache
def _corners(outline: Outline, segments: int) -> FloatArray:
    if outline.kind == "circle":
        angle = 2 * pi * np.arange(segments) / segments
        corners = outline.radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        corners = np.array(outline.vertices_mm, dtype=np.float64)
    corners.flags.writeable = False
    return np.asarray(corners, dtype=np.float64)


def turned(points_mm: FloatArray, yaw_rad: float) -> FloatArray:
    """Return the points (..., 2) turned about the origin by ``yaw_rad``."""
    if yaw_rad == 0.0:
        return points_mm
    c, s = cos(yaw_rad), sin(yaw_rad)
    return np.asarray(points_mm @ np.array([[c, s], [-s, c]]), dtype=np.float64)


def edge_normals(polygon_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return start points and outward unit normals, both (..., k, 2), of a ccw polygon's edges."""
    along = np.concatenate([polygon_mm[..., 1:, :], polygon_mm[..., :1, :]], axis=-2) - polygon_mm
    normal = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    length = np.hypot(along[..., 0], along[..., 1])[..., None]
    return polygon_mm, normal / np.where(length > 0.0, length, 1.0)


def inset_mm(outline: Outline, points_mm: FloatArray) -> FloatArray:
    """Return (...,) how far points (..., 2) lie within the outline; negative outside.

    The distance to the nearest edge; beside a corner that to the farther of its lines.
    """
    if outline.kind == "circle":
        return np.asarray(outline.radius_mm - np.hypot(points_mm[..., 0], points_mm[..., 1]))
    start, outward = edge_normals(outline.polygon())
    reach = (start * outward).sum(axis=1)
    return np.asarray((reach - points_mm @ outward.T).min(axis=-1), dtype=np.float64)


def circle(diameter_mm: float) -> Outline:
    """Return a circle; raises ValueError unless the diameter is positive and finite."""
    if not 0.0 < diameter_mm < float("inf"):
        raise ValueError("the diameter must be positive")
    return Outline("circle", radius_mm=diameter_mm / 2)


def rectangle(x_mm: float, y_mm: float) -> Outline:
    """Return a rectangle with sides along x and y; raises ValueError unless both are positive."""
    a, b = x_mm / 2, y_mm / 2
    return convex(((-a, -b), (a, -b), (a, b), (-a, b)))


def square(side_mm: float) -> Outline:
    """Return a square with sides along the axes."""
    return rectangle(side_mm, side_mm)


def regular(sides: int, across_corners_mm: float, rotation_rad: float = 0.0) -> Outline:
    """Return a regular polygon; its first corner lies at ``rotation_rad`` from +x."""
    angles = [rotation_rad + 2 * pi * i / sides for i in range(sides)]
    r = across_corners_mm / 2
    return convex(tuple((r * cos(a), r * sin(a)) for a in angles))


def convex(vertices_mm: tuple[Point, ...]) -> Outline:
    """Return a convex polygon round the origin, corners in order.

    Raises ValueError if it has fewer than 3 corners, is clockwise, not strictly convex, or if the
    face centre (0, 0) is not inside.
    """
    count = len(vertices_mm)
    if count < 3:
        raise ValueError("a polygon needs at least 3 corners")
    turn = 0.0
    for i in range(count):
        a, b, c = (vertices_mm[(i + k) % count] for k in range(3))
        first, second = (b[0] - a[0], b[1] - a[1]), (c[0] - b[0], c[1] - b[1])
        cross = first[0] * second[1] - first[1] * second[0]
        if not cross > EDGE_TOLERANCE_MM * (hypot(*first) + hypot(*second)):
            raise ValueError("the corners must run counter-clockwise round a convex polygon")
        turn += np.arctan2(cross, first[0] * second[0] + first[1] * second[1])
    if turn > 3 * pi:
        raise ValueError("the corners must run only once round the polygon")
    outline = Outline("polygon", vertices_mm=tuple((float(x), float(y)) for x, y in vertices_mm))
    if not outline.contains((0.0, 0.0)):
        raise ValueError("the face centre (0, 0) must lie inside the polygon")
    return outline
