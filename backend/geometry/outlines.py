"""Flat outlines of contact faces: overlap, grid points, and the true contact patch.

An outline is defined in its own face frame, origin at the centre of the face. Polygons are
counter-clockwise. Overlaps of convex outlines are vectorised over edges and over batches of
placements: the edge of an overlap consists of the parts of each outline inside the other. Each edge
is clipped to the half-planes of the other polygon (Cyrus and Beck 1978); area and distance follow
from these segments without ordering them. Regions have holes and several parts; shapely computes
their overlaps. The true contact patch is the label of the method (Ota et al. 2023, section III): a
face point is in contact if it lies inside the outline of the surface below.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import cos, hypot, pi, sin
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchdown.backend.core import FloatArray

EDGE_TOLERANCE_MM = 1e-9  # points this near to the edge count as inside, despite round-off

CIRCLE_SEGMENTS = 128  # corners of the polygon of a circle: 0.004 mm error at radius 12.5 mm

LEAST_PART_MM2 = 1e-6  # smaller parts of the overlap of a region are round-off

Point = tuple[float, float]
Ring = tuple[Point, ...]
Part = tuple[Ring, tuple[Ring, ...]]  # exterior and holes


@dataclass(frozen=True, slots=True)
class Outline:
    """An outline; build it with ``circle``, ``rectangle``, ``convex_polygon`` or ``region``.

    ``radius_mm`` is used by circles, ``vertices_mm`` (counter-clockwise) by convex polygons,
    ``parts`` by regions: exteriors counter-clockwise, holes clockwise.
    """

    kind: Literal["circle", "polygon", "region"]
    radius_mm: float = 0.0
    vertices_mm: Ring = ()
    parts: tuple[Part, ...] = ()

    def contains(self, points_mm: ArrayLike, /) -> NDArray[np.bool_]:
        """Return (...,) bool: True for points (..., 2) mm inside or on the edge."""
        points = np.asarray(points_mm, dtype=np.float64)
        if self.kind == "circle":
            reach = self.radius_mm + EDGE_TOLERANCE_MM
            return np.asarray((points**2).sum(axis=-1) <= reach**2)
        if self.kind == "region":
            import shapely

            inside = shapely.intersects_xy(_tolerant(self), points[..., 0], points[..., 1])
            return np.asarray(inside, dtype=np.bool_)
        start, normal = edge_normals(self.polygon())
        outward = points @ normal.T - (start * normal).sum(axis=1)
        return np.asarray((outward <= EDGE_TOLERANCE_MM).all(axis=-1))

    def polygon(self, segments: int = CIRCLE_SEGMENTS) -> FloatArray:
        """Return (k, 2) corners in mm, counter-clockwise; read-only, shared between callers.

        A circle becomes its inscribed polygon of ``segments`` corners, the first on +x. The corners
        of a region are those of its convex hull: ``path`` has all rings.
        """
        return _corners(self, segments)

    def path(self, segments: int = CIRCLE_SEGMENTS) -> FloatArray:
        """Return (k, 2) corners of all rings in mm, a row of NaN between two rings.

        The inside is that of the odd-even rule. The path of a convex outline is its ``polygon``.
        """
        return _corners(self, segments) if self.kind != "region" else _path(self)

    def placed(
        self, at_mm: Point, yaw_rad: float = 0.0, segments: int = CIRCLE_SEGMENTS
    ) -> FloatArray:
        """Return (k, 2): ``polygon`` turned by ``yaw_rad`` and moved to ``at_mm``."""
        return rotated(self.polygon(segments), yaw_rad) + np.asarray(at_mm, dtype=np.float64)

    @property
    def rings(self) -> tuple[Ring, ...]:
        """Exteriors and holes; empty for a circle."""
        if self.kind == "region":
            return tuple(ring for exterior, holes in self.parts for ring in (exterior, *holes))
        return (self.vertices_mm,) if self.vertices_mm else ()

    @property
    def half_extents_mm(self) -> Point:
        """Half extents along x and y, from the centre."""
        if self.kind == "circle":
            return self.radius_mm, self.radius_mm
        corners = [corner for ring in self.rings for corner in ring]
        return max(abs(x) for x, _ in corners), max(abs(y) for _, y in corners)

    @property
    def area_mm2(self) -> float:
        """Exact area."""
        if self.kind == "circle":
            return pi * self.radius_mm**2
        return float(geometry_of(self).area)


@cache
def _corners(outline: Outline, segments: int) -> FloatArray:
    if outline.kind == "circle":
        angle = 2 * pi * np.arange(segments) / segments
        corners = outline.radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    elif outline.kind == "region":
        corners = hull_of(geometry_of(outline))
    else:
        corners = np.array(outline.vertices_mm, dtype=np.float64)
    corners.flags.writeable = False
    return np.asarray(corners, dtype=np.float64)


@cache
def _path(outline: Outline) -> FloatArray:
    path = _joined([np.array(ring, dtype=np.float64) for ring in outline.rings])
    path.flags.writeable = False
    return path


def _joined(rings: list[FloatArray]) -> FloatArray:
    """Return rings as one path, (0, 2) without a ring."""
    gap = np.full((1, 2), np.nan)
    rows = [row for ring in rings for row in (gap, ring)][1:]
    return np.concatenate(rows) if rows else np.empty((0, 2))


def rings_of(path_mm: FloatArray) -> list[FloatArray]:
    """Return the rings (k, 2) of a path whose rings are separated by rows of NaN."""
    ends = [-1, *np.flatnonzero(np.isnan(path_mm[:, 0])).tolist(), len(path_mm)]
    return [path_mm[a + 1 : b] for a, b in pairwise(ends) if b - a > 1]


@cache
def geometry_of(outline: Outline, segments: int = CIRCLE_SEGMENTS) -> Any:
    """Return the outline as a polygon or multi-polygon of shapely."""
    import shapely

    if outline.kind != "region":
        return shapely.Polygon(outline.polygon(segments))
    parts = [shapely.Polygon(exterior, holes) for exterior, holes in outline.parts]
    return parts[0] if len(parts) == 1 else shapely.MultiPolygon(parts)


def polygon_of(corners_mm: FloatArray) -> Any:
    """Return corners (k, 2) as a polygon of shapely."""
    import shapely

    return shapely.Polygon(corners_mm)


def hull_of(geometry: Any) -> FloatArray:
    """Return the corners (k, 2) of the convex hull of a shapely geometry, counter-clockwise."""
    import shapely

    hull = shapely.orient_polygons(shapely.convex_hull(geometry))
    return np.asarray(shapely.get_coordinates(hull)[:-1], dtype=np.float64)


@cache
def _tolerant(outline: Outline) -> Any:
    """Return a region whose edges lie ``EDGE_TOLERANCE_MM`` farther out, prepared for queries."""
    import shapely

    grown = tuple(
        (_grown(exterior), tuple(_grown(hole) for hole in holes))
        for exterior, holes in outline.parts
    )
    geometry = geometry_of(Outline("region", parts=grown))
    shapely.prepare(geometry)
    shapely.intersects_xy(geometry, 0.0, 0.0)  # builds the index before other threads read it
    return geometry


def _grown(ring: Ring) -> Ring:
    corners = np.array(ring, dtype=np.float64)
    _, after = edge_normals(corners)
    before = np.roll(after, 1, axis=0)
    shared = np.maximum(1.0 + (before * after).sum(axis=1), 0.01)[:, None]
    moved = corners + EDGE_TOLERANCE_MM * (before + after) / shared
    return tuple((float(x), float(y)) for x, y in moved)


def rotated(points_mm: FloatArray, yaw_rad: float) -> FloatArray:
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
    """Return the distance (...,) of points (..., 2) to the nearest edge, negative outside.

    Beside a corner it is the distance to the farther of its two lines. The edge of a region is that
    of its convex hull: a ring supports what stands over its hole.
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
    return convex_polygon(((-a, -b), (a, -b), (a, b), (-a, b)))


def square(side_mm: float) -> Outline:
    """Return a square with sides along the axes."""
    return rectangle(side_mm, side_mm)


def regular_polygon(sides: int, across_corners_mm: float, rotation_rad: float = 0.0) -> Outline:
    """Return a regular polygon; its first corner lies at ``rotation_rad`` from +x."""
    angles = [rotation_rad + 2 * pi * i / sides for i in range(sides)]
    r = across_corners_mm / 2
    return convex_polygon(tuple((r * cos(a), r * sin(a)) for a in angles))


def convex_polygon(vertices_mm: tuple[Point, ...]) -> Outline:
    """Return a convex polygon around the origin, corners in order.

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
            raise ValueError(
                "the corners must be in counter-clockwise order around a convex polygon"
            )
        turn += np.arctan2(cross, first[0] * second[0] + first[1] * second[1])
    if turn > 3 * pi:
        raise ValueError("the corners must go around the polygon only once")
    outline = Outline("polygon", vertices_mm=tuple((float(x), float(y)) for x, y in vertices_mm))
    if not outline.contains((0.0, 0.0)):
        raise ValueError("the face centre (0, 0) must lie inside the polygon")
    return outline


NO_SUPPORT = float("-inf")  # margin over an empty overlap


NUDGE = 1e-9

CLOSING_TOLERANCE_MM = 1e-5  # the edge of a true overlap closes within this and is longer than this


@dataclass(frozen=True, slots=True)
class EdgeSegments:
    """Segments of edges: ``start_mm``, ``end_mm`` (..., k, 2); ``kept`` (..., k): they exist."""

    start_mm: FloatArray
    end_mm: FloatArray
    kept: NDArray[np.bool_]


def overlap_edges(first_mm: FloatArray, second_mm: FloatArray) -> EdgeSegments:
    """Return the edge of the overlap of two ccw convex polygons, (..., n, 2) and (..., m, 2) mm.

    The leading axes broadcast. Accurate to about 1e-7 mm.
    """
    second_mm = _perturbed(second_mm)
    own, other = _clip_edges(first_mm, second_mm), _clip_edges(second_mm, first_mm)
    start = np.concatenate([own.start_mm, other.start_mm], axis=-2)
    end = np.concatenate([own.end_mm, other.end_mm], axis=-2)
    kept = np.concatenate([own.kept, other.kept], axis=-1)
    # Segments of outlines that only touch do not close, or are very short: no overlap.
    along = (end - start) * kept[..., None]
    gap, length = along.sum(axis=-2), np.hypot(along[..., 0], along[..., 1]).sum(axis=-1)
    closes = np.hypot(gap[..., 0], gap[..., 1]) < CLOSING_TOLERANCE_MM
    closes &= length > CLOSING_TOLERANCE_MM
    return EdgeSegments(start, end, kept & closes[..., None])


def _perturbed(polygon_mm: FloatArray) -> FloatArray:
    """Rotate and shrink a polygon by 1e-9 about its middle, so that no two edges coincide.

    Outlines of equal pieces share edges exactly, and round-off would keep a shared edge twice or
    not at all.
    """
    middle = polygon_mm.mean(axis=-2, keepdims=True)
    away = polygon_mm - middle
    return np.asarray(middle + (1.0 - NUDGE) * rotated(away, np.sqrt(2.0) * NUDGE))


def _clip_edges(edges_of: FloatArray, within: FloatArray) -> EdgeSegments:
    start, normal = edge_normals(within)
    reach = (start * normal).sum(axis=-1)
    round_trip = np.concatenate([edges_of, edges_of[..., :1, :]], axis=-2)
    depths = reach[..., None, :] - round_trip @ np.swapaxes(normal, -1, -2)
    depth, after = depths[..., :-1, :], depths[..., 1:, :]
    inside = depths.min(axis=-1) >= 0.0
    whole = inside[..., :-1] & inside[..., 1:]
    low, high = np.zeros(whole.shape), whole.astype(np.float64)
    # Only edges that are neither inside nor outside of one half-plane need full clipping.
    doubtful = (np.maximum(depth, after).min(axis=-1) >= 0.0) & ~whole
    low[doubtful], high[doubtful] = _clip_interval(depth[doubtful], after[doubtful])
    along = round_trip[..., 1:, :] - edges_of
    kept = (high - low) * np.hypot(along[..., 0], along[..., 1]) > EDGE_TOLERANCE_MM
    low, high = np.where(kept, low, 0.0), np.where(kept, high, 0.0)
    return EdgeSegments(edges_of + low[..., None] * along, edges_of + high[..., None] * along, kept)


def _clip_interval(depth: FloatArray, after: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return entry and exit (0..1) of edges into all half-planes, from the depths of their ends."""
    drop = depth - after
    crossing = np.divide(depth, drop, out=np.zeros_like(depth), where=drop != 0.0)
    entry = np.where(drop < 0.0, crossing, 0.0).max(axis=-1)
    leave = np.where(drop > 0.0, crossing, 1.0).min(axis=-1)
    return np.maximum(entry, 0.0), np.minimum(leave, 1.0)


def enclosed_area_mm2(cut: EdgeSegments) -> FloatArray:
    """Return the area (...,) of the overlap by Green's theorem."""
    a, b = cut.start_mm, cut.end_mm
    cross = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.asarray(np.maximum(0.5 * (cross * cut.kept).sum(axis=-1), 0.0), dtype=np.float64)


def polygon_edges(polygon_mm: FloatArray) -> EdgeSegments:
    """Return the edges of a ccw polygon (k, 2)."""
    end = np.roll(polygon_mm, -1, axis=-2)
    return EdgeSegments(polygon_mm, end, np.hypot(*np.moveaxis(end - polygon_mm, -1, 0)) > 0.0)


def edges_to_polygon(cut: EdgeSegments) -> FloatArray:
    """Return the overlap (without leading axes) as a ccw polygon (k, 2); k = 0 if it is empty."""
    points = cut.start_mm[cut.kept]
    if len(points) < 3:
        return np.empty((0, 2))
    away = points - points.mean(axis=0)
    return np.asarray(points[np.argsort(np.arctan2(away[:, 1], away[:, 0]))], dtype=np.float64)


def signed_distances_mm(points_mm: FloatArray, cut: EdgeSegments) -> FloatArray:
    """Return the signed distance (...,) of points (..., 2) to the edge of a convex overlap.

    Positive inside, negative outside, ``NO_SUPPORT`` where the overlap is empty.
    """
    along = cut.end_mm - cut.start_mm
    length2 = np.where(cut.kept, (along**2).sum(axis=-1), 1.0)
    away = points_mm[..., None, :] - cut.start_mm
    share = np.clip((away * along).sum(axis=-1) / length2, 0.0, 1.0)
    gap = away - share[..., None] * along
    distance = np.where(cut.kept, np.hypot(gap[..., 0], gap[..., 1]), np.inf).min(axis=-1)
    side = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
    inside = (np.where(cut.kept, side, 0.0) >= 0.0).all(axis=-1)
    signed = np.where(inside, distance, -distance)
    return np.asarray(np.where(cut.kept.any(axis=-1), signed, NO_SUPPORT), dtype=np.float64)


def face_points(outline: Outline, pitch_mm: float = 1.0) -> FloatArray:
    """Return the lattice points (N, 2) of a face in mm, row by row (y, then x, ascending).

    Points lie at whole multiples of ``pitch_mm``, the face centre among them: 177 for a circle of
    15 mm, 349 for 21.2 mm, 505 for 25.4 mm. Raises ValueError unless the pitch is positive.
    """
    if not pitch_mm > 0.0:
        raise ValueError("the pitch must be positive")
    reach_x, reach_y = (
        int((extent + EDGE_TOLERANCE_MM) / pitch_mm) for extent in outline.half_extents_mm
    )
    x = pitch_mm * np.arange(-reach_x, reach_x + 1)
    y = pitch_mm * np.arange(-reach_y, reach_y + 1)
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(lattice[outline.contains(lattice)], dtype=np.float64)


def true_patch(
    points_mm: FloatArray, offset_mm: ArrayLike, bottom: Outline, yaw_rad: float = 0.0
) -> NDArray[np.bool_]:
    """Return (..., N) bool: face points in contact with the face at ``offset_mm`` (..., 2).

    ``yaw_rad`` rotates the face about its centre; the bottom outline is in frame ``O``.
    """
    offset = np.asarray(offset_mm, dtype=np.float64)
    return bottom.contains(rotated(points_mm, yaw_rad) + offset[..., None, :])


def overlap_polygon(
    face: Outline, offset_mm: tuple[float, float], bottom: Outline, yaw_rad: float = 0.0
) -> FloatArray:
    """Return the true overlap (k, 2) in frame ``O``, counter-clockwise; k = 0 without overlap.

    With a region it is a path: holes are clockwise, and a row of NaN separates two rings.
    """
    if not _has_region(face, bottom):
        return edges_to_polygon(overlap_edges(face.placed(offset_mm, yaw_rad), bottom.polygon()))
    import shapely

    both = [
        ring
        for part in shapely.get_parts(
            common_area(face, offset_mm, yaw_rad, bottom, (0.0, 0.0), 0.0)
        )
        for ring in (part.exterior, *part.interiors)
    ]
    return _joined([shapely.get_coordinates(ring)[:-1] for ring in both])


def contact_edges(
    face: Outline,
    at_mm: Point,
    yaw_rad: float,
    below: Outline,
    below_at_mm: Point = (0.0, 0.0),
    below_yaw_rad: float = 0.0,
) -> EdgeSegments:
    """Return the edge of the convex hull of the contact of two placed outlines.

    A rigid flat piece is supported within this hull. The overlap of two convex outlines is its own
    hull.
    """
    if not _has_region(face, below):
        return overlap_edges(face.placed(at_mm, yaw_rad), below.placed(below_at_mm, below_yaw_rad))
    common = common_area(face, at_mm, yaw_rad, below, below_at_mm, below_yaw_rad)
    if common.is_empty:
        return EdgeSegments(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1, dtype=np.bool_))
    return polygon_edges(hull_of(common))


def contact_margins_mm(
    face: Outline, com_xy_mm: Point, below: Outline, places_mm: FloatArray
) -> FloatArray:
    """Return the margin (n,) of a piece whose centre of mass is at each of ``places_mm`` (n, 2).

    The signed distance of the place to the convex hull of the contact, positive inside. Without
    contact it is the negative distance to ``below``.
    """
    return hull_margins_mm(face, com_xy_mm, below, places_mm)[0]


def hull_margins_mm(
    face: Outline, com_xy_mm: Point, below: Outline, places_mm: FloatArray
) -> tuple[FloatArray, NDArray[np.intp], NDArray[np.object_]]:
    """Return the margins of ``contact_margins_mm``, the rows with contact, and the areas there."""
    import shapely

    support, at = geometry_of(below), shapely.points(places_mm)
    margin = np.asarray(-shapely.distance(support, at), dtype=np.float64)
    centre = places_mm - np.asarray(com_xy_mm)
    gap = shapely.distance(support, shapely.points(centre))
    near = np.flatnonzero(gap <= np.hypot(*face.half_extents_mm))
    areas = shapely.intersection(_copies(geometry_of(face), centre[near]), support)
    touching = np.flatnonzero(~shapely.is_empty(areas))
    near, areas = near[touching], areas[touching]
    hulls = shapely.convex_hull(areas)
    depth = shapely.distance(shapely.boundary(hulls), at[near])
    beyond = shapely.distance(hulls, at[near])
    inside = np.where(shapely.area(hulls) > 0.0, depth, 0.0)
    margin[near] = np.where(beyond > 0.0, -beyond, inside)
    return margin, near, areas


def _has_region(first: Outline, second: Outline) -> bool:
    return "region" in (first.kind, second.kind)


def common_area(
    first: Outline,
    first_at_mm: Point,
    first_yaw_rad: float,
    second: Outline,
    second_at_mm: Point,
    second_yaw_rad: float,
) -> Any:
    """Return the common area of two placed outlines as polygons of shapely, round-off removed."""
    import shapely

    return large_parts(
        shapely.intersection(
            _moved(geometry_of(first), first_at_mm, first_yaw_rad),
            _moved(geometry_of(second), second_at_mm, second_yaw_rad),
        )
    )


def large_parts(geometry: Any) -> Any:
    """Return the polygons of a geometry of shapely without round-off."""
    import shapely

    parts = shapely.get_parts(geometry)
    parts = shapely.orient_polygons(parts[shapely.area(parts) > LEAST_PART_MM2])
    return shapely.multipolygons(parts)


def _moved(geometry: Any, at_mm: Point, yaw_rad: float) -> Any:
    import shapely

    return shapely.transform(geometry, lambda xy: rotated(xy, yaw_rad) + np.asarray(at_mm))


def _copies(geometry: Any, at_mm: FloatArray) -> NDArray[np.object_]:
    """Return a copy of the geometry at each of ``at_mm`` (n, 2)."""
    import shapely

    corners = shapely.get_coordinates(geometry)
    places = (corners + at_mm[:, None]).reshape(-1, 2)
    return np.asarray(shapely.set_coordinates(np.repeat(geometry, len(at_mm)), places))


def _region_overlap_mm2(
    face: Outline, offset_mm: FloatArray, bottom: Outline, yaw_rad: float, segments: int
) -> FloatArray:
    import shapely

    turned = _moved(geometry_of(face, segments), (0.0, 0.0), yaw_rad)
    moved = _copies(turned, offset_mm.reshape(-1, 2))
    area = shapely.area(shapely.intersection(moved, geometry_of(bottom, segments)))
    return np.asarray(area.reshape(offset_mm.shape[:-1]), dtype=np.float64)


def overlap_area_mm2(
    face: Outline,
    offset_mm: ArrayLike,
    bottom: Outline,
    yaw_rad: float = 0.0,
    segments: int = CIRCLE_SEGMENTS,
) -> FloatArray:
    """Return the overlap area (...,) in mm² of the face at each offset (..., 2).

    Exact for two circles; otherwise a circle counts as a polygon of ``segments`` corners.
    """
    offset = np.asarray(offset_mm, dtype=np.float64)
    if face.kind == bottom.kind == "circle":
        return _circle_overlap_mm2(
            np.hypot(offset[..., 0], offset[..., 1]), face.radius_mm, bottom.radius_mm
        )
    if _has_region(face, bottom):
        return _region_overlap_mm2(face, offset, bottom, yaw_rad, segments)
    moved = rotated(face.polygon(segments), yaw_rad) + offset[..., None, :]
    return enclosed_area_mm2(overlap_edges(moved, bottom.polygon(segments)))


def _circle_overlap_mm2(distance_mm: FloatArray, r: float, s: float) -> FloatArray:
    """Return the common area of circles of radius r and s mm."""
    apart = np.clip(distance_mm, abs(r - s), r + s)
    # Distance from each centre to the common chord; concentric equal circles share a diameter.
    near = np.divide(apart**2 + r**2 - s**2, 2 * apart, out=np.zeros_like(apart), where=apart > 0)
    segments = [
        radius**2 * np.arccos(np.clip(chord / radius, -1.0, 1.0))
        - chord * np.sqrt(np.maximum(radius**2 - chord**2, 0.0))
        for radius, chord in ((r, near), (s, apart - near))
    ]
    return np.asarray(np.maximum(segments[0] + segments[1], 0.0), dtype=np.float64)


# Centres of the four dots in ``O``, counter-clockwise from the lower left.
BOARD_DOTS_MM: FloatArray = np.array([[-40.0, -40.0], [40.0, -40.0], [40.0, 40.0], [-40.0, 40.0]])
BOARD_DOT_RADIUS_MM = 4.0
