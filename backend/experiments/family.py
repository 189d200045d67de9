"""A broad family of bottoms and pieces to learn from; what is called unseen stays out of it.

Circles, rectangles up to 1.5 to 1, rounded ones and random convex polygons, turned at random. An
outline that would cover one of the unseen ones by more than ``LIKE`` (intersection over union,
centroids on each other, at the best of many turns) is drawn again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np

from backend.core.flow import FloatArray
from backend.objects import clipping
from backend.objects.catalogue import Catalogue, Piece
from backend.objects.shapes import Outline, circle, convex, turned
from backend.objects.tower import Body
from backend.placement.hull import convex_hull

UNSEEN_BOTTOMS = ("short", "long", "hex20", "rect12x28")
UNSEEN_PIECES = ("pot", "barrel", "mushroom")
LIKE = 0.90
TURNS = 36
SIZES_MM = (8.0, 32.0)
"""Mean diameter of a bottom."""
FACES_MM = (10.0, 30.0)
LONGEST = 1.5
WIDTH_MM, HEIGHT_MM = 30.0, 20.0
HEIGHTS_MM, MASSES_G = (15.0, 45.0), (15.0, 60.0)
"""Of bottoms that stand free."""


@dataclass(frozen=True, slots=True)
class Family:
    """Draws outlines that resemble none of ``unseen_bottoms``, faces none of ``unseen_faces``."""

    unseen_bottoms: tuple[Outline, ...]
    unseen_faces: tuple[Outline, ...]

    @classmethod
    def of(
        cls,
        catalogue: Catalogue,
        bottoms: tuple[str, ...] = UNSEEN_BOTTOMS,
        pieces: tuple[str, ...] = UNSEEN_PIECES,
    ) -> Family:
        """Return the family without the named bottoms and pieces; raises ``InputError``."""
        return cls(
            tuple(catalogue.bottom(name).face for name in bottoms),
            tuple(catalogue.top(name).face for name in pieces),
        )

    def bottom(self, rng: np.random.Generator, *, free: bool = False) -> Body:
        """Return a bottom that is fixed to the table; or a free one, which rocks and slides and
        takes several times longer.
        """
        face = _drawn(rng, SIZES_MM, self.unseen_bottoms)
        if not free:
            return Body("bottom", face, face, HEIGHT_MM, 0.0, 0.5 * HEIGHT_MM, fixed=True)
        height, mass = float(rng.uniform(*HEIGHTS_MM)), float(rng.uniform(*MASSES_G))
        return Body("bottom", face, face, height, mass, 0.5 * height)

    def piece(self, rng: np.random.Generator) -> Piece:
        """Return a piece: face, grip height, and a centre of mass up to 2 mm off the middle."""
        face = _drawn(rng, FACES_MM, self.unseen_faces, round_share=0.5)
        reach = 2.0 * float(rng.random()) * bool(rng.random() < 0.5)
        angle = float(rng.uniform(0.0, 2.0 * pi))
        return Piece(
            name="piece",
            title="Piece",
            roles=("top",),
            face=face,
            upper=None,
            lower=face,
            height_mm=45.0,
            com_height_mm=22.0,
            com_xy_mm=(reach * float(np.cos(angle)), reach * float(np.sin(angle))),
            mass_g=20.0,
            grip_height_mm=float(rng.uniform(27.0, 43.0)),
            width_mm=WIDTH_MM,
            fixed=False,
            nominal=True,
            sha256="",
            source="family",
        )


def likeness(first: Outline, second: Outline) -> float:
    """Return the intersection over union of two outlines, centroids aligned, best of many turns."""
    a, b = _centred(first.polygon(48)), _centred(second.polygon(48))
    angles = 2.0 * pi * np.arange(TURNS) / TURNS
    turns = np.stack([turned(b, float(angle)) for angle in angles])
    common = float(clipping.area_mm2(clipping.overlap(a[None], turns)).max())
    return common / (area_mm2(a) + area_mm2(b) - common)


def resembles(first: Outline, second: Outline) -> bool:
    """Whether the likeness exceeds ``LIKE``; no more can be common than the smaller one covers."""
    areas = sorted((first.area_mm2, second.area_mm2))
    return areas[0] > LIKE * areas[1] and likeness(first, second) > LIKE


def area_mm2(polygon_mm: FloatArray) -> float:
    """Return the area of a polygon (k, 2) in order."""
    x, y = polygon_mm.T
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def _drawn(
    rng: np.random.Generator,
    sizes_mm: tuple[float, float],
    unseen: tuple[Outline, ...],
    round_share: float = 0.3,
) -> Outline:
    while True:
        size = float(rng.uniform(*sizes_mm))
        outline = circle(size) if rng.random() < round_share else _polygon(rng, size)
        if outline is not None and not any(resembles(outline, other) for other in unseen):
            return outline


def _polygon(rng: np.random.Generator, size_mm: float) -> Outline | None:
    """Return a rectangle, a rounded one or a random convex polygon of that mean diameter."""
    kind = int(rng.integers(3))
    ratio = float(rng.uniform(1.0, LONGEST)) ** 0.5
    if kind < 2:
        half = 0.5 * 0.886 * size_mm * np.array([ratio, 1.0 / ratio])
        radius = float(half.min() * rng.uniform(0.2, 0.8)) if kind else 0.0
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half - radius)
        arcs = radius * _circle_points(32 if kind else 1)
        points = (corners[:, None] + arcs).reshape(-1, 2)
    else:
        angle = np.sort(rng.uniform(0.0, 2.0 * pi, int(rng.integers(5, 12))))
        points = 0.5 * size_mm * np.stack([ratio * np.cos(angle), np.sin(angle) / ratio], axis=1)
    hull = _centred(convex_hull(turned(points, float(rng.uniform(0.0, 2.0 * pi)))))
    span = hull.max(axis=0) - hull.min(axis=0)
    if len(hull) < 3 or span.min() < 0.5 * size_mm:
        return None
    try:
        return convex(tuple((float(x), float(y)) for x, y in hull))
    except ValueError:
        return None  # nearly collinear corners


@lru_cache(maxsize=4)
def _circle_points(count: int) -> FloatArray:
    angle = 2.0 * pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _centred(polygon_mm: FloatArray) -> FloatArray:
    """Return a polygon with its centroid at (0, 0)."""
    if len(polygon_mm) < 3:
        return polygon_mm
    x, y = polygon_mm.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = polygon_mm + np.roll(polygon_mm, -1, axis=0)
    return np.asarray(polygon_mm - (sums * cross[:, None]).sum(axis=0) / (3.0 * cross.sum()))
