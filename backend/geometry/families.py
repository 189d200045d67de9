"""Random outlines: the family of training, and the classes on which learned fusion is tested.

The training family of bottoms holds circles, rectangles, rounded rectangles and random convex
polygons in random orientations. The wide family adds triangles, slivers, rings, crescents, L, U,
stars and feet. An outline that overlaps a held-out one by more than ``SIMILAR_IOU`` (intersection
over union, aligned centroids, best of many orientations) is drawn again.

``fresh_bottom`` draws one of the ten classes ``FRESH_CLASSES``. The classes ``UNTRAINED_CLASSES``
are never drawn for a training. Its seed is the hash of a commit, so nobody can choose it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal, get_args

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.pieces import Piece, PieceLibrary
from touchdown.backend.geometry.regions import channel, crescent, ell, feet, region, ring, star, tee
from touchdown.backend.geometry.tower import Body

UNSEEN_BOTTOMS = ("short", "long", "hex20", "rect12x28")
UNSEEN_PIECES = ("pot", "barrel", "mushroom")
SIMILAR_IOU = 0.90
ROTATIONS = 36
SIZES_MM = (8.0, 32.0)  # mean diameter of a bottom
FACES_MM = (10.0, 30.0)
MAX_ASPECT_RATIO = 1.5
WIDTH_MM, HEIGHT_MM = 30.0, 20.0
HEIGHTS_MM, MASSES_G = (15.0, 45.0), (15.0, 60.0)  # of free bottoms
TALL_MM = 65.0  # greatest height of a free bottom of the wide family


OutlineKinds = Literal["convex", "any"]
REGION_SHARE, REGION_FACE_SHARE = 2.0 / 3.0, 0.25  # of bottoms and faces of the wide family
WIDTHS_MM = (20.0, 45.0)  # of its pieces between the pads


@dataclass(frozen=True, slots=True)
class ShapeFamily:
    """Random outlines that resemble none of ``unseen_bottoms`` and no face of ``unseen_faces``.

    ``kinds``: of the outlines, convex or any.
    """

    unseen_bottoms: tuple[outlines.Outline, ...]
    unseen_faces: tuple[outlines.Outline, ...]
    kinds: OutlineKinds = "convex"

    @classmethod
    def of(cls, catalogue: PieceLibrary, kinds: OutlineKinds = "convex") -> ShapeFamily:
        """Return the family without the bottoms and pieces of the tables."""
        return cls(
            tuple(catalogue.bottom(name).face for name in UNSEEN_BOTTOMS),
            tuple(catalogue.top(name).face for name in UNSEEN_PIECES),
            kinds,
        )

    def bottom(self, rng: np.random.Generator, *, free: bool = False) -> Body:
        """Return a random bottom: fixed to the table, or free to rock and slide, which is several
        times slower.
        """
        if self.kinds == "any" and rng.random() < REGION_SHARE:
            face = draw_region(rng, float(rng.uniform(LEAST_REGION_MM, SIZES_MM[1])))
        else:
            face = _draw_outline(rng, SIZES_MM, self.unseen_bottoms)
        if not free:
            return Body("bottom", face, face, HEIGHT_MM, 0.0, 0.5 * HEIGHT_MM, fixed=True)
        tallest = TALL_MM if self.kinds == "any" else HEIGHTS_MM[1]
        height = float(rng.uniform(HEIGHTS_MM[0], tallest))
        mass = float(rng.uniform(*MASSES_G))
        return Body("bottom", face, face, height, mass, 0.5 * height)

    def piece(self, rng: np.random.Generator) -> Piece:
        """Return a random piece: face, grip height and a centre of mass within 2 mm."""
        face, width = self._face(rng)
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
            width_mm=width,
            source="family",
        )

    def _face(self, rng: np.random.Generator) -> tuple[outlines.Outline, float]:
        """Return face and width of a piece; in the wide family both vary more."""
        if self.kinds == "convex":
            return _draw_outline(rng, FACES_MM, self.unseen_faces, round_share=0.5), WIDTH_MM
        width = float(rng.uniform(*WIDTHS_MM))
        if rng.random() < REGION_FACE_SHARE:
            return draw_region(rng, float(rng.uniform(LEAST_REGION_MM, FACES_MM[1]))), width
        return _draw_outline(rng, FACES_MM, self.unseen_faces, round_share=0.5), width


def similarity(first: outlines.Outline, second: outlines.Outline) -> float:
    """Return the intersection over union of two outlines: aligned centroids, best of many
    orientations.
    """
    a, b = _centred(first.polygon(48)), _centred(second.polygon(48))
    angles = 2.0 * pi * np.arange(ROTATIONS) / ROTATIONS
    turns = np.stack([outlines.rotated(b, float(angle)) for angle in angles])
    common = float(outlines.enclosed_area_mm2(outlines.overlap_edges(a[None], turns)).max())
    whole = outlines.polygon_of(a).area + outlines.polygon_of(b).area
    return common / float(whole - common)


def is_similar(first: outlines.Outline, second: outlines.Outline) -> bool:
    """Return True if the similarity exceeds ``SIMILAR_IOU``; areas that differ too much decide
    early.
    """
    areas = sorted((first.area_mm2, second.area_mm2))
    return areas[0] > SIMILAR_IOU * areas[1] and similarity(first, second) > SIMILAR_IOU


def _draw_outline(
    rng: np.random.Generator,
    sizes_mm: tuple[float, float],
    unseen: tuple[outlines.Outline, ...],
    round_share: float = 0.3,
) -> outlines.Outline:
    while True:
        size = float(rng.uniform(*sizes_mm))
        outline = outlines.circle(size) if rng.random() < round_share else _polygon(rng, size)
        if outline is not None and not any(is_similar(outline, other) for other in unseen):
            return outline


def _polygon(rng: np.random.Generator, size_mm: float) -> outlines.Outline | None:
    """Return a rectangle, a rounded one or a random convex polygon of the given mean diameter."""
    kind = int(rng.integers(3))
    ratio = float(rng.uniform(1.0, MAX_ASPECT_RATIO)) ** 0.5
    if kind < 2:
        half = 0.5 * 0.886 * size_mm * np.array([ratio, 1.0 / ratio])
        radius = float(half.min() * rng.uniform(0.2, 0.8)) if kind else 0.0
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half - radius)
        around = 2.0 * pi * np.arange(32 if kind else 1) / (32 if kind else 1)
        arcs = radius * np.stack([np.cos(around), np.sin(around)], axis=1)
        points = (corners[:, None] + arcs).reshape(-1, 2)
    else:
        angle = np.sort(rng.uniform(0.0, 2.0 * pi, int(rng.integers(5, 12))))
        points = 0.5 * size_mm * np.stack([ratio * np.cos(angle), np.sin(angle) / ratio], axis=1)
    hull = _centred(_hull(outlines.rotated(points, float(rng.uniform(0.0, 2.0 * pi)))))
    span = hull.max(axis=0) - hull.min(axis=0)
    if len(hull) < 3 or span.min() < 0.5 * size_mm:
        return None
    try:
        return outlines.convex_polygon(tuple((float(x), float(y)) for x, y in hull))
    except ValueError:
        return None  # nearly collinear corners


def _hull(points_mm: FloatArray) -> FloatArray:
    """Return the corners of the convex hull, counter-clockwise from the leftmost one."""
    import shapely

    corners = outlines.hull_of(shapely.multipoints(points_mm))
    return np.roll(corners, -int(np.lexsort(corners.T[::-1])[0]), axis=0)


LEAST_REGION_MM = 14.0
FEET = (5, 8, 9, 10, 11)
SLIVER_RATIO = 3.0  # greatest ratio of the sides of a rectangle of the wide family


def draw_region(rng: np.random.Generator, size_mm: float) -> outlines.Outline:
    """Return an outline of the wide family about ``size_mm`` wide, turned at random.

    Ring, crescent, L, U, star, two to four feet (five times as often, since they are the hardest),
    triangle, or a rectangle up to 3:1. The classes ``UNTRAINED_CLASSES`` are left to the tests.
    """
    while True:
        kind, a, b = int(rng.integers(12)), float(rng.uniform()), float(rng.uniform())
        wall = size_mm * (0.2 + 0.2 * a)
        try:
            if kind == 0:
                outline = ring(size_mm, size_mm * (0.3 + 0.5 * a))
            elif kind == 1:
                outline = crescent(size_mm, size_mm * (0.7 + 0.3 * a), size_mm * (0.3 + 0.2 * b))
            elif kind in (2, 3):
                build = ell if kind == 2 else channel
                outline = build(size_mm, size_mm * (0.7 + 0.3 * b), wall)
            elif kind == 4:
                outline = star(4 + int(4 * b), size_mm, size_mm * (0.4 + 0.3 * a))
            elif kind in FEET:
                outline = _feet(rng, 2 + int(3 * b), size_mm, wall)
            elif kind == 6:
                outline = _triangle(rng, size_mm)
            else:
                outline = outlines.rectangle(size_mm, size_mm / (1.5 + (SLIVER_RATIO - 1.5) * a))
            return _turned(outline, float(rng.uniform(0.0, 2.0 * pi)))
        except ValueError:
            continue  # too narrow, or the face centre is outside


def _feet(rng: np.random.Generator, count: int, size_mm: float, foot_mm: float) -> outlines.Outline:
    """Return round feet on a circle, about ``size_mm`` wide in all."""
    angle = 2.0 * pi * (np.arange(count) + 0.3 * rng.uniform(-1.0, 1.0, count)) / count
    at = 0.5 * (size_mm - foot_mm) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return feet([(float(x), float(y)) for x, y in at], foot_mm)


def _triangle(rng: np.random.Generator, size_mm: float) -> outlines.Outline:
    """Return a triangle about its centroid whose angles are 35 degrees at least."""
    share = rng.dirichlet(np.ones(3))
    angle = np.cumsum(2.0 * (pi / 180.0 * 35.0 + (pi - pi / 180.0 * 105.0) * share))
    corners = 0.5 * size_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _polygon_of(_centred(corners))


def _polygon_of(corners_mm: FloatArray) -> outlines.Outline:
    return outlines.convex_polygon(tuple((float(x), float(y)) for x, y in corners_mm))


def _turned(outline: outlines.Outline, angle_rad: float) -> outlines.Outline:
    def turn(corners: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
        return [(float(x), float(y)) for x, y in outlines.rotated(np.array(corners), angle_rad)]

    if outline.kind == "circle":
        return outline
    parts = outline.parts or ((outline.vertices_mm, ()),)
    return region((turn(outside), [turn(hole) for hole in holes]) for outside, holes in parts)


def _centred(polygon_mm: FloatArray) -> FloatArray:
    if len(polygon_mm) < 3:
        return polygon_mm
    x, y = polygon_mm.T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    sums = polygon_mm + np.roll(polygon_mm, -1, axis=0)
    return np.asarray(polygon_mm - (sums * cross[:, None]).sum(axis=0) / (3.0 * cross.sum()))


FreshClass = Literal[
    "disc", "rectangle", "triangle", "polygon", "ring", "frame", "feet", "bars", "ell", "tee"
]
FRESH_CLASSES: tuple[FreshClass, ...] = get_args(FreshClass)
UNTRAINED_CLASSES: tuple[FreshClass, ...] = ("frame", "bars", "tee")
FRESH_SEED = "b151a540c14f9b0cc66a92d3b1683025bbe7204e"  # the commit that froze bench-v2
FRESH_SIZES_MM = (14.0, 30.0)  # longest side, or diameter
FRESH_RATIO = 2.0  # greatest ratio of the sides
FRESH_FEATURE_MM = 4.0  # narrowest wall, bar and foot; gaps and holes are half as wide at least
FRESH_CONVEX_MM = 6.0  # diameter of a disc within every convex outline
FRESH_HEIGHTS_MM, FRESH_MASSES_G = (20.0, 60.0), (25.0, 60.0)


def fresh_bottom(seed: str, number: int) -> Piece:
    """Return the free test bottom ``number`` of the sequence of ``seed``, of class ``title``.

    Ten consecutive numbers are one of each class.

    Parameters
    ----------
    seed : str
        Hexadecimal number, such as the hash of a commit.
    number : int
        Number from 0 on.

    Raises
    ------
    ValueError
        If ``seed`` is no hexadecimal number, or ``number`` is negative.

    Examples
    --------
    >>> bottom = fresh_bottom("62b60783", 15)
    >>> bottom.title, len(bottom.face.parts[0][1])
    ('frame', 1)

    """
    rng = np.random.default_rng([int(seed, 16), number])
    title = FRESH_CLASSES[number % len(FRESH_CLASSES)]
    face = draw_fresh_outline(rng, title)
    height = float(rng.uniform(*FRESH_HEIGHTS_MM))
    return Piece(
        name=f"fresh-{seed[:12]}-{number}",
        title=title,
        roles=("bottom",),
        face=face,
        upper=face,
        lower=face,
        height_mm=height,
        com_height_mm=0.5 * height,
        com_xy_mm=(0.0, 0.0),
        mass_g=float(rng.uniform(*FRESH_MASSES_G)),
        grip_height_mm=None,
        width_mm=WIDTH_MM,
        source="fresh outlines",
    )


def draw_fresh_outline(rng: np.random.Generator, title: FreshClass) -> outlines.Outline:
    """Return an outline of one class, turned at random.

    The longest side is 14 to 30 mm, sides differ by a factor of 2 at most, and walls, bars and feet
    are 4 mm wide at least. A convex outline holds a disc of 6 mm.
    """
    while True:
        size, ratio = float(rng.uniform(*FRESH_SIZES_MM)), float(rng.uniform(1.0, FRESH_RATIO))
        share, least = float(rng.uniform()), FRESH_FEATURE_MM
        short = size / ratio
        wall = least + share * max(0.35 * short - least, 0.0)
        try:
            outline = _fresh_shape(rng, title, size, short, wall)
        except ValueError:
            continue
        if _is_wide(outline):
            return _turned(outline, float(rng.uniform(0.0, 2.0 * pi)))


def _fresh_shape(
    rng: np.random.Generator, title: FreshClass, size: float, short: float, wall: float
) -> outlines.Outline:
    if title == "polygon":
        angle = np.sort(rng.uniform(0.0, 2.0 * pi, int(rng.integers(5, 9))))
        around = np.stack([size * np.cos(angle), short * np.sin(angle)], axis=1)
        return _polygon_of(_centred(_hull(0.5 * around)))
    if title == "feet":
        return _feet(rng, int(rng.integers(3, 5)), size, wall)
    make: dict[str, Callable[[], outlines.Outline]] = {
        "disc": lambda: outlines.circle(size),
        "rectangle": lambda: outlines.rectangle(size, short),
        "triangle": lambda: _triangle(rng, size),
        "ring": lambda: ring(size, size - 2.0 * wall),
        "frame": lambda: _frame(size, short, wall),
        "bars": lambda: _bars(size, short, wall),
        "ell": lambda: ell(size, short, wall),
        "tee": lambda: tee(size, short, wall),
    }
    return make[title]()


def _box(x_mm: float, y_mm: float, middle_y_mm: float = 0.0) -> list[tuple[float, float]]:
    x, y, m = x_mm / 2, y_mm / 2, middle_y_mm
    return [(-x, m - y), (x, m - y), (x, m + y), (-x, m + y)]


def _frame(x_mm: float, y_mm: float, wall_mm: float) -> outlines.Outline:
    return region([(_box(x_mm, y_mm), [_box(x_mm - 2 * wall_mm, y_mm - 2 * wall_mm)])])


def _bars(x_mm: float, y_mm: float, wall_mm: float) -> outlines.Outline:
    at = 0.5 * (y_mm - wall_mm)
    return region((_box(x_mm, wall_mm, middle), []) for middle in (-at, at))


def _is_wide(outline: outlines.Outline) -> bool:
    """Return True if all parts and gaps are as wide as required."""
    import shapely

    whole, half = outlines.geometry_of(outline), 0.499 * FRESH_FEATURE_MM
    parts = shapely.get_parts(whole)
    inside = whole.buffer(-half if outline.parts else -0.5 * FRESH_CONVEX_MM)
    apart = shapely.get_parts(whole.buffer(0.5 * half))
    holes = [shapely.Polygon(hole) for part in parts for hole in part.interiors]
    return (
        len(shapely.get_parts(inside)) == len(apart) == len(parts)
        and not inside.is_empty
        and not any(hole.buffer(-0.5 * half).is_empty for hole in holes)
    )
