"""Outlines with holes and several parts: checked construction, usual shapes, convex cells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import acos, cos, isfinite, pi, sin
from typing import Any

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry.outlines import (
    Outline,
    Part,
    Point,
    Ring,
    convex_polygon,
    edge_normals,
    geometry_of,
)

LEAST_FEATURE_MM = 0.2  # narrower walls, slits and holes are refused
SPIKE_MM = 0.9  # longest tip that is narrower than that: of a corner of about 12 degrees
LARGEST_MM = 500.0
MOST_CORNERS = 4000
ARC_SEGMENTS = 64  # corners of a full circle of the shapes below

Corners = Sequence[Sequence[float]]


def region(parts: Iterable[tuple[Corners, Iterable[Corners]]]) -> Outline:
    """Return the outline of one or several parts with holes.

    A single convex part round the face centre becomes a polygon. The direction of the rings is
    free, and a repeated first corner at the end of a ring is left out.

    Parameters
    ----------
    parts : iterable of (exterior, holes)
        Corners (x, y) in mm, in the frame of the face.

    Returns
    -------
    Outline
        Exteriors counter-clockwise, holes clockwise.

    Raises
    ------
    ValueError
        If a ring crosses itself or has no area, a hole is not inside, parts touch, a wall, slit or
        hole is narrower than 0.2 mm, a coordinate is beyond 500 mm, or the face centre (0, 0) is
        outside the convex hull. The message names the place.

    Examples
    --------
    >>> square = [(-6, -6), (6, -6), (6, 6), (-6, 6)]
    >>> frame = region([(square, [[(x / 2, y / 2) for x, y in square]])])
    >>> frame.area_mm2, bool(frame.contains((0.0, 0.0)))
    (108.0, False)

    """
    rings = [
        (_ring(exterior, f"part {i}"), [_ring(hole, f"a hole of part {i}") for hole in holes])
        for i, (exterior, holes) in enumerate(parts, start=1)
    ]
    if not rings:
        raise ValueError("a region needs at least one part")
    if sum(len(ring) for part, holes in rings for ring in (part, *holes)) > MOST_CORNERS:
        raise ValueError(f"a region has at most {MOST_CORNERS} corners")
    oriented: tuple[Part, ...] = tuple(
        (_turned(exterior, 1.0), tuple(_turned(hole, -1.0) for hole in holes))
        for exterior, holes in rings
    )
    if len(oriented) == 1 and not oriented[0][1]:
        try:
            return convex_polygon(oriented[0][0])
        except ValueError:
            pass
    outline = Outline("region", parts=oriented)
    _check(outline)
    return outline


def _ring(corners: Corners, where: str) -> Ring:
    if any(len(corner) != 2 for corner in corners):
        raise ValueError(f"{where}: every corner needs x and y")
    ring = tuple((float(x), float(y)) for x, y in corners)
    if len(ring) > 1 and ring[0] == ring[-1]:
        ring = ring[:-1]
    if len(ring) < 3:
        raise ValueError(f"{where} needs at least 3 corners")
    for x, y in ring:
        if not (isfinite(x) and isfinite(y) and max(abs(x), abs(y)) <= LARGEST_MM):
            raise ValueError(f"{where}: ({x:g}, {y:g}) is not within {LARGEST_MM:g} mm")
    return ring


def _turned(ring: Ring, direction: float) -> Ring:
    x, y = np.array(ring).T
    area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
    return ring if area * direction >= 0.0 else ring[::-1]


def _check(outline: Outline) -> None:
    """Raise ValueError unless the region is valid and wide enough everywhere."""
    import shapely

    whole = geometry_of(outline)
    for i, part in enumerate(shapely.get_parts(whole), start=1):
        if not shapely.is_valid(part):
            raise ValueError(f"part {i} is not a simple outline: {_fault(part)}")
        if not part.area > 0.0:
            raise ValueError(f"part {i} has no area")
    if not shapely.is_valid(whole):
        raise ValueError(f"two parts touch or overlap: {_fault(whole)}")
    space = shapely.difference(shapely.envelope(whole).buffer(2.0), whole)
    for what, shape in (("material", whole), ("gap", space)):
        narrow = _narrow(shape)
        if narrow is not None:
            raise ValueError(
                f"the {what} is narrower than {LEAST_FEATURE_MM:g} mm near"
                f" ({narrow[0]:.1f}, {narrow[1]:.1f})"
            )
    if not shapely.intersects_xy(shapely.convex_hull(whole), 0.0, 0.0):
        raise ValueError("the face centre (0, 0) must lie inside the convex hull of the region")


def _fault(shape: Any) -> str:
    """Return reason and place of an invalid shape, such as "self-intersection near (2, 5)"."""
    import shapely

    reason, _, place = shapely.is_valid_reason(shape).rstrip("]").partition("[")
    return f"{reason.lower()} near ({', '.join(place.split())})"


def _narrow(shape: Any) -> Point | None:
    """Return a place where ``shape`` is too narrow, None without one; sharp corners may remain."""
    import shapely

    radius = 0.49 * LEAST_FEATURE_MM
    eroded = shape.buffer(-radius)
    left = shapely.difference(shape, eroded.buffer(radius + SPIKE_MM))
    if left.is_empty:
        # A neck may be short: what is connected must stay connected, and holes must stay closed.
        whole = _ring_count(shape)
        if _ring_count(eroded) == whole:
            return None
        every = shapely.get_parts(shapely.difference(shape, eroded.buffer(1.001 * radius)))
        cuts = [p for p in every if _ring_count(shape.difference(p.buffer(radius))) != whole]
        left = shapely.union_all(cuts or every)
    at = max(shapely.get_parts(left), key=shapely.area).representative_point()
    return round(at.x, 1) + 0.0, round(at.y, 1) + 0.0


def _ring_count(shape: Any) -> tuple[int, int]:
    import shapely

    parts = shapely.get_parts(shape)
    return len(parts), int(shapely.get_num_interior_rings(parts).sum())


def _arc(radius_mm: float, start_rad: float, end_rad: float, middle: Point = (0.0, 0.0)) -> Ring:
    """Return points of an arc, both ends included."""
    count = max(2, round(abs(end_rad - start_rad) / (2 * pi) * ARC_SEGMENTS))
    angles = np.linspace(start_rad, end_rad, count + 1)
    x, y = middle
    return tuple((x + radius_mm * cos(a), y + radius_mm * sin(a)) for a in angles)


def _round(radius_mm: float, middle: Point = (0.0, 0.0)) -> Ring:
    return _arc(radius_mm, 0.0, 2 * pi, middle)[:-1]


def _about_centroid(ring: Ring) -> Outline:
    """Return the region of one ring with its centroid at the face centre."""
    import shapely

    centre = shapely.Polygon(ring).centroid
    return region([([(x - centre.x, y - centre.y) for x, y in ring], [])])


def ring(outer_mm: float, inner_mm: float) -> Outline:
    """Return a ring of two diameters; raises ValueError unless 0 < inner < outer."""
    if not 0.0 < inner_mm < outer_mm < float("inf"):
        raise ValueError("the inner diameter must be positive and smaller than the outer one")
    return region([(_round(outer_mm / 2), [_round(inner_mm / 2)])])


def crescent(diameter_mm: float, cut_mm: float, shift_mm: float) -> Outline:
    """Return a disc without a second disc of ``cut_mm`` whose centre is ``shift_mm`` along +x."""
    r, s = diameter_mm / 2, cut_mm / 2
    if not (0.0 < abs(r - s) < shift_mm < r + s < float("inf")):
        raise ValueError("the two circles of a crescent must cross")
    a = acos((r**2 + shift_mm**2 - s**2) / (2 * r * shift_mm))
    b = acos((shift_mm - r * cos(a)) / s)
    outer = _arc(r, a, 2 * pi - a)
    inner = _arc(s, pi + b, pi - b, (shift_mm, 0.0))
    return _about_centroid((*outer, *inner[1:-1]))


def ell(x_mm: float, y_mm: float, wall_mm: float) -> Outline:
    """Return an L of two legs with the given outer lengths, about its centroid."""
    x, y, w = x_mm, y_mm, wall_mm
    return _about_centroid(((0, 0), (x, 0), (x, w), (w, w), (w, y), (0, y)))


def tee(x_mm: float, y_mm: float, wall_mm: float) -> Outline:
    """Return a T with its bar along x, about its centroid."""
    x, y, w = x_mm / 2, y_mm, wall_mm
    h = w / 2
    return _about_centroid(
        ((-h, 0), (h, 0), (h, y - w), (x, y - w), (x, y), (-x, y), (-x, y - w), (-h, y - w))
    )


def channel(x_mm: float, y_mm: float, wall_mm: float) -> Outline:
    """Return a U that is open towards +y, about its centroid."""
    x, y, w = x_mm, y_mm, wall_mm
    return _about_centroid(((0, 0), (x, 0), (x, y), (x - w, y), (x - w, w), (w, w), (w, y), (0, y)))


def star(points: int, outer_mm: float, inner_mm: float, rotation_rad: float = 0.0) -> Outline:
    """Return a star; ``outer_mm`` and ``inner_mm``: diameters through tips and notches."""
    if not (points >= 3 and 0.0 < inner_mm < outer_mm):
        raise ValueError("a star needs at least 3 points and 0 < inner < outer diameter")
    angles = rotation_rad + pi / points * np.arange(2 * points)
    reach = np.where(np.arange(2 * points) % 2, inner_mm, outer_mm) / 2
    return region([(np.stack([reach * np.cos(angles), reach * np.sin(angles)], 1).tolist(), [])])


def feet(at_mm: Iterable[Point], diameter_mm: float) -> Outline:
    """Return one round foot at each place."""
    return region([(_round(diameter_mm / 2, at), []) for at in at_mm])


def convex_cells(outline: Outline) -> list[FloatArray]:
    """Return counter-clockwise convex polygons (k, 2) mm that fill an outline without overlap.

    A constrained Delaunay triangulation whose neighbours are joined while they stay convex (Hertel
    and Mehlhorn 1983).
    """
    if outline.kind != "region":
        return [outline.polygon()]
    import shapely

    triangles = shapely.get_parts(
        shapely.orient_polygons(shapely.constrained_delaunay_triangles(geometry_of(outline)))
    )
    cells = [[(x, y) for x, y in shapely.get_coordinates(t)[:-1].tolist()] for t in triangles]
    owner = {edge: i for i, cell in enumerate(cells) for edge in _edges(cell)}
    for a, b in list(owner):
        first, second = owner.get((a, b)), owner.get((b, a))
        if first is None or second is None or first == second:
            continue
        joined = _join(cells[first], cells[second], a, b)
        if joined is None:
            continue
        cells[first], cells[second] = joined, []
        del owner[a, b], owner[b, a]
        owner |= dict.fromkeys(_edges(joined), first)
    return [np.array(cell) for cell in cells if cell]


def _edges(cell: list[Point]) -> list[tuple[Point, Point]]:
    return list(zip(cell, [*cell[1:], cell[0]], strict=True))


def _join(first: list[Point], second: list[Point], a: Point, b: Point) -> list[Point] | None:
    """Return the union of two cells over their edge ``a`` to ``b``, None unless it is convex."""
    i, j = first.index(b), second.index(a)
    joined = [*first[i:], *first[:i], *(second[j:] + second[:j])[1:-1]]
    corners = np.array(joined)
    _, normal = edge_normals(corners)
    after = np.roll(normal, -1, axis=0)
    turn = normal[:, 0] * after[:, 1] - normal[:, 1] * after[:, 0]
    return joined if bool((turn > -1e-9).all()) else None
