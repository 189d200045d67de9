"""Upper faces that are not flat (inclined, stepped, domed), and how a rigid piece rests on them.

Angles are small: horizontal positions do not change while the piece turns, and its centre of mass,
``h`` above the face, moves by ``-h s`` for the slope ``s`` of the face. The piece touches where
height minus plane is largest over the overlap. Released upright and guided by the opening fingers,
it turns slowly about the point of the hull of its contacts that is nearest to its centre of mass,
until that lies inside the hull. The face then rests on a facet of the convex hull of the heights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, hypot, inf, pi, radians, sin, tan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import outlines

MAX_TURN = tan(radians(5.0))  # slope beyond which a released piece counts as turned
PITCH_MM = 1.0  # of the points that stand for a dome
TOUCH_MM = 1e-9  # points this near to the plane touch it
MAX_EVENTS = 1000  # new contacts until the piece rests
DIRECTIONS = 32  # in which the margin is searched
# Distances beyond the hull at which a place of rest is searched, mm.
REACHES_MM = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0)
MARGIN_MM = 1e-3  # resolution of the margin


@dataclass(frozen=True, slots=True)
class Surface:
    """Heights of an upper face in its own frame, above a level face through its centre.

    Attributes
    ----------
    tilt_rad : tuple of float
        Small rotations about x and y, rad: the face rises by ``tilt_x y - tilt_y x``.
    step_mm : float
        Height of the part beyond the step line.
    step_line : tuple of float
        Direction (rad) of the normal of the step line, towards the higher part, and its distance
        (mm) from the centre of the face.
    dome_mm : float
        Radius of a dome with its apex at the centre of the face; 0 without a dome.

    Examples
    --------
    >>> Surface(step_mm=0.5).heights_mm(np.array([[-3.0, 0.0], [3.0, 0.0]])).tolist()
    [0.0, 0.5]

    """

    tilt_rad: outlines.Point = (0.0, 0.0)
    step_mm: float = 0.0
    step_line: outlines.Point = (0.0, 0.0)
    dome_mm: float = 0.0

    @property
    def flat(self) -> bool:
        """True if all heights are 0."""
        return not (any(self.tilt_rad) or self.step_mm or self.dome_mm)

    @property
    def kind(self) -> str:
        """The first that it is of domed, stepped, tilted and flat."""
        sizes = {"domed": self.dome_mm, "stepped": self.step_mm, "tilted": any(self.tilt_rad)}
        return next((name for name, size in sizes.items() if size), "flat")

    @property
    def slope(self) -> outlines.Point:
        """Rise per mm along x and y due to the tilt."""
        return -self.tilt_rad[1], self.tilt_rad[0]

    @property
    def coefficients(self) -> tuple[float, ...]:
        """Slopes, curvature, step, and normal and distance of its line."""
        angle, distance = self.step_line
        curvature = 1.0 / self.dome_mm if self.dome_mm else 0.0
        return (*self.slope, curvature, self.step_mm, cos(angle), sin(angle), distance)

    def heights_mm(self, points_mm: FloatArray) -> FloatArray:
        """Return the heights (n,) at the points (n, 2)."""
        return np.asarray(surface_heights_mm([self], points_mm[None])[0], dtype=np.float64)


FLAT = Surface()


def surface_heights_mm(surfaces: Sequence[Surface], points_mm: FloatArray) -> FloatArray:
    """Return the heights (B, n) of B surfaces at their points (B, n, 2)."""
    x, y = points_mm[..., 0], points_mm[..., 1]
    values = np.array([surface.coefficients for surface in surfaces]).T[..., None]
    slope_x, slope_y, curvature, step, cos_n, sin_n, distance = values
    heights = slope_x * x + slope_y * y - 0.5 * curvature * (x * x + y * y)
    return np.asarray(heights + step * (cos_n * x + sin_n * y >= distance), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class PieceOnSurface:
    """A flat face above the overlap with a surface, in the frame of the surface.

    ``points_mm`` (n, 2), ``heights_mm`` (n,): points that the face can touch. ``com_height_mm``:
    centre of mass above the face. ``max_turn``: slope beyond which the piece does not count as
    resting, or slides.
    """

    points_mm: FloatArray
    heights_mm: FloatArray
    com_height_mm: float
    max_turn: float = MAX_TURN

    @classmethod
    def over(  # noqa: PLR0913 - three place the face
        cls,
        face: outlines.Outline,
        at_mm: outlines.Point,
        yaw_rad: float,
        below: outlines.Outline,
        surface: Surface,
        com_height_mm: float,
        mu: float = inf,
    ) -> PieceOnSurface:
        """Return ``face`` at ``at_mm``, rotated by ``yaw_rad``, over ``surface`` of ``below``."""
        points, heights = _touchable(
            outlines.common_area(face, at_mm, yaw_rad, below, (0.0, 0.0), 0.0), surface
        )
        return cls(points, heights, com_height_mm, min(MAX_TURN, mu))

    def rest_slope(self, centre_mm: FloatArray) -> FloatArray | None:
        """Return the slope (2,) at which the piece comes to rest, None if it does not.

        ``centre_mm`` (2,): centre of mass above the upright face.
        """
        if not len(self.points_mm):
            return None
        slope = np.zeros(2)
        gap = self.heights_mm.max() - self.heights_mm
        for _ in range(MAX_EVENTS):
            centre = centre_mm - self.com_height_mm * slope
            foot = _nearest(self.points_mm[gap <= TOUCH_MM], centre)
            way = foot - centre
            length = hypot(*way)
            if length <= TOUCH_MM:
                return slope
            # The foot stays, and the centre moves away from it, until the next point touches.
            rate = (self.points_mm - foot) @ (way / length)
            nears = rate < -TOUCH_MM
            nears &= gap > TOUCH_MM
            turn = (gap[nears] / -rate[nears]).min(initial=inf)
            slope = slope + min(turn, 1.0) * way / length
            if hypot(*slope) > self.max_turn:
                return None
            gap = np.maximum(gap + turn * rate, 0.0)
        return None

    def margin_mm(self, centre_mm: FloatArray) -> float:
        """Return the shortest shift of the centre of mass that changes the result of a release.

        Positive if the piece comes to rest, negative if not, ``NO_SUPPORT`` without overlap. The
        shift is searched along 32 directions, so that it is up to 0.5 % too long.
        """
        if not len(self.points_mm):
            return outlines.NO_SUPPORT
        angles = 2.0 * pi * np.arange(DIRECTIONS) / DIRECTIONS
        rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        if self.rest_slope(centre_mm) is not None:
            least = 1.0 + float(np.hypot(*(self.points_mm - centre_mm).T).max())
            for ray in rays:
                least = self._crossing_mm(centre_mm, ray, least, rests=True)
            return least
        outside = float(np.hypot(*(_nearest(self.points_mm, centre_mm) - centre_mm)))
        for reach in REACHES_MM:
            least = outside + reach
            ends = centre_mm + least * rays
            near = [r for r, at in zip(rays, ends, strict=True) if self.rest_slope(at) is not None]
            for ray in near:
                least = self._crossing_mm(centre_mm, ray, least, rests=False)
            if near:
                break
        return -least

    def _crossing_mm(
        self, centre_mm: FloatArray, ray: FloatArray, far: float, *, rests: bool
    ) -> float:
        """Return the distance along ``ray`` at which the result changes, at most ``far``."""
        low, high = 0.0, far
        if (self.rest_slope(centre_mm + far * ray) is not None) is rests:
            return far
        while high - low > MARGIN_MM:
            tried = 0.5 * (low + high)
            alike = (self.rest_slope(centre_mm + tried * ray) is not None) is rests
            low, high = (tried, high) if alike else (low, tried)
        return high


def _touchable(area: Any, surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Return the points (n, 2) of an overlap that a flat face can touch, and their heights (n,)."""
    import shapely

    found: list[tuple[FloatArray, FloatArray]] = [(np.empty((0, 2)), np.empty(0))]
    level = Surface(surface.tilt_rad, dome_mm=surface.dome_mm)
    for part, lift_mm in step_levels(area, surface):
        if shapely.is_empty(part):
            continue
        points = outlines.hull_of(part) if not surface.dome_mm else spread_points(part)
        found.append((points, level.heights_mm(points) + lift_mm))
    points, heights = (np.concatenate(values) for values in zip(*found, strict=True))
    return points, heights


def step_levels(area: Any, surface: Surface) -> list[tuple[Any, float]]:
    """Return the parts of the overlap on both sides of the step, and their lifts."""
    import shapely

    if not surface.step_mm or shapely.is_empty(area):
        return [(area, 0.0)]
    angle, distance = surface.step_line
    far = 2.0 * max(map(abs, (*shapely.bounds(area).tolist(), distance, 1.0)))
    box = np.array([(distance, -far), (distance + far, -far), (distance + far, far)])
    box = np.concatenate([box, [(distance, far)]])
    high = shapely.Polygon(outlines.rotated(box, angle))
    return [
        (outlines.large_parts(shapely.intersection(area, high)), surface.step_mm),
        (outlines.large_parts(shapely.difference(area, high)), 0.0),
    ]


def spread_points(area: Any, spacing_mm: float = PITCH_MM, *, inside: bool = True) -> FloatArray:
    """Return points (n, 2) along the edges of an area of shapely, and on a lattice ``inside``."""
    import shapely

    edge = shapely.get_coordinates(shapely.segmentize(area, spacing_mm))
    if not inside or not len(edge):
        return np.asarray(edge, dtype=np.float64)
    low_x, low_y, high_x, high_y = shapely.bounds(area)
    axes = (np.arange(a, b, spacing_mm) for a, b in ((low_x, high_x), (low_y, high_y)))
    lattice = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    return np.concatenate([edge, lattice[shapely.contains_xy(area, *lattice.T)]])


def _nearest(points_mm: FloatArray, at_mm: FloatArray) -> FloatArray:
    """Return the point of the convex hull of points (k, 2) that is nearest to ``at_mm`` (2,)."""
    import shapely

    hull = shapely.convex_hull(shapely.multipoints(points_mm))
    way = shapely.shortest_line(hull, shapely.Point(at_mm))
    return np.asarray(shapely.get_coordinates(way)[0], dtype=np.float64)


COARSE_MM, SIMPLE_MM = 2.0, 0.02  # points on a dome, and error of outlines, of many margins
RAYS, NEAR_MM = 16, 0.06  # directions in which each of many margins is searched, and resolution
TOO_DEEP_MM = -1e3
# Points that n faces can touch: x, y and distance below the highest point of each face, (n, k) mm.
Touchable = tuple[FloatArray, FloatArray, FloatArray]
Rows = NDArray[np.intp]


def surface_margins_mm(
    face: outlines.Outline,
    com_xy_mm: outlines.Point,
    com_height_mm: float,
    below: outlines.Outline,
    surface: Surface,
    places_mm: FloatArray,
) -> FloatArray:
    """Return the margins (n,) of ``contact_margins_mm`` on the ``surface`` of a face ``below``.

    Where the faces overlap it is the margin of ``PieceOnSurface``, to about 0.1 mm: many pieces are
    turned side by side, on coarser points, and 16 directions are searched.
    """
    import shapely

    margin, rows, areas = outlines.hull_margins_mm(face, com_xy_mm, below, places_mm)
    large = shapely.area(areas) > outlines.LEAST_PART_MM2
    if large.any() and not surface.flat:
        rows, areas, at = rows[large], areas[large], places_mm[rows[large]]
        points = _touchable_points(face, at - np.asarray(com_xy_mm), below, surface, areas)
        hulls = shapely.convex_hull(areas)
        margin[rows] = _search_margins(points, com_height_mm, hulls, at, margin[rows])
    return margin


def _touchable_points(
    face: outlines.Outline,
    at_mm: FloatArray,
    below: outlines.Outline,
    surface: Surface,
    areas: NDArray[np.object_],
) -> Touchable:
    import shapely

    level, support = replace(surface, step_mm=0.0), outlines.geometry_of(below)
    found = []
    for part, lift_mm in step_levels(support, surface):
        shared = shapely.intersection(areas, part) if surface.step_mm else areas
        if not surface.dome_mm:
            shared = shapely.convex_hull(shared)
        edges = shapely.simplify(shared, SIMPLE_MM)
        if surface.dome_mm:
            edges = shapely.segmentize(edges, COARSE_MM)
        points, owner = shapely.get_coordinates(edges, return_index=True)
        found.append((points, owner, level.heights_mm(points) + lift_mm))
    if surface.dome_mm:
        lattice = spread_points(support, COARSE_MM)
        owner, point = np.nonzero(face.contains(lattice - at_mm[:, None]))
        found.append((lattice[point], owner, surface.heights_mm(lattice)[point]))
    points, owner, heights = map(np.concatenate, zip(*found, strict=True))
    order = np.argsort(owner, kind="stable")
    count = np.bincount(owner, minlength=len(areas))
    column = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    packed = np.zeros((3, len(areas), count.max()))
    packed[2] = TOO_DEEP_MM
    packed[:, owner[order], column] = *points[order].T, heights[order]
    x, y, height = packed
    return x, y, height.max(axis=1, keepdims=True) - height


def _come_to_rest(
    points: Touchable, rows: Rows, centre_mm: FloatArray, com_height_mm: float
) -> NDArray[np.bool_]:
    """Return (m,): True if ``PieceOnSurface.rest_slope`` exists for the piece ``rows[i]``."""
    found, left = np.zeros(len(rows), np.bool_), np.arange(len(rows))
    (x, y, gap), slope = (values[rows] for values in points), np.zeros((len(rows), 2))
    for _ in range(MAX_EVENTS):
        if not len(left):
            break
        centre = centre_mm[left] - com_height_mm * slope
        way = _ways_to_hulls(x, y, gap <= TOUCH_MM, centre)
        length = np.hypot(*way.T)
        found[left[length <= TOUCH_MM]] = True
        along = way / np.maximum(length, TOUCH_MM)[:, None]
        rate = x * along[:, :1] + y * along[:, 1:]
        rate -= ((centre + way) * along).sum(axis=1)[:, None]
        nears = (rate < -TOUCH_MM) & (gap > TOUCH_MM)
        turn = np.divide(gap, -rate, out=np.ones_like(gap), where=nears).min(axis=1)
        slope = slope + turn[:, None] * along
        gap = np.maximum(gap + turn[:, None] * rate, 0.0)
        on = (length > TOUCH_MM) & (np.hypot(*slope.T) <= MAX_TURN)
        x, y, gap, slope, left = x[on], y[on], gap[on], slope[on], left[on]
    return found


def _search_margins(
    points: Touchable,
    com_height_mm: float,
    hulls: NDArray[np.object_],
    at_mm: FloatArray,
    flat_mm: FloatArray,
) -> FloatArray:
    """Return the distances (n,) at which the results change, negative without rest.

    ``flat_mm``: distances of the centres of mass ``at_mm`` (n, 2) to the hulls; a piece whose
    centre of mass is outside never rests. The first ray leads to the nearest edge of the hull.
    """
    import shapely

    rests = _come_to_rest(points, np.arange(len(at_mm)), at_mm, com_height_mm)
    ways = shapely.shortest_line(shapely.boundary(hulls), shapely.points(at_mm))
    towards = shapely.get_coordinates(ways)[::2] - at_mm
    # From outside the hull half a circle of rays meets all of it.
    between = np.where(flat_mm < 0.0, 1.0, 2.0) * pi / RAYS
    angle = np.arctan2(towards[:, 1], towards[:, 0])[:, None]
    angle = angle + between[:, None] * (np.arange(RAYS) - RAYS // 2)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)

    def changed(tried: NDArray[np.bool_], radius_mm: FloatArray) -> NDArray[np.bool_]:
        """Return (n, RAYS): True where the result at the end of a ray of ``tried`` differs."""
        rows, ray = np.nonzero(tried)
        ends = at_mm[rows] + radius_mm[rows, None] * rays[rows, ray]
        now = shapely.intersects_xy(hulls[rows], *ends.T)
        now[now] = _come_to_rest(points, rows[now], ends[now], com_height_mm)
        found = np.zeros_like(tried)
        found[rows, ray] = now != rests[rows]
        return found

    outside = np.maximum(-flat_mm, 0.0)
    low, high = np.where(rests, 0.0, outside), np.where(rests, flat_mm, outside)
    play = changed(np.repeat(rests[:, None], RAYS, axis=1), high)
    for reach in REACHES_MM[2::2]:
        waits = ~rests & ~play.any(axis=1)
        low, high = np.where(waits, high, low), np.where(waits, outside + reach, high)
        play |= changed(np.repeat(waits[:, None], RAYS, axis=1), high)
    low = np.where(play.any(axis=1), low, high)
    while (wide := high - low > NEAR_MM).any():
        middle = 0.5 * (low + high)
        now = changed(play & wide[:, None], middle)
        some = now.any(axis=1)
        low, high = np.where(wide & ~some, middle, low), np.where(some, middle, high)
        play = np.where(now.any(axis=1, keepdims=True), now, play)
    return np.asarray(np.where(rests, 0.5, -0.5) * (low + high))


def _ways_to_hulls(
    x: FloatArray, y: FloatArray, among: NDArray[np.bool_], at_mm: FloatArray
) -> FloatArray:
    """Return the ways (m, 2) from ``at_mm`` to the hulls of the points ``among`` (m, k), 0 inside.

    Gilbert, Johnson and Keerthi 1988, in the plane.
    """
    rows, column = np.nonzero(among)
    count = np.bincount(rows)
    first = np.cumsum(count) - count
    index = np.arange(count.max())
    index = first[:, None] + np.where(index < count[:, None], index, 0)  # repeats the first point
    points = (np.stack([x[rows, column], y[rows, column]], axis=1) - at_mm[rows])[index]
    one = np.arange(len(points))
    a = b = way = points[one, (points**2).sum(axis=-1).argmin(axis=1)]
    for _ in range(2 * points.shape[1]):
        c = points[one, (points @ way[:, :, None])[..., 0].argmin(axis=1)]
        closer = ((way * (way - c)).sum(axis=1) > TOUCH_MM * np.hypot(*way.T))[:, None]
        if not closer.any():
            break
        turns = [p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))]
        within = np.abs(np.sign(turns).sum(axis=0)) == 3.0
        on_a, on_b = _nearest_of_segments(a, c), _nearest_of_segments(b, c)
        takes_a = ((on_a**2).sum(axis=1) < (on_b**2).sum(axis=1))[:, None]
        better = np.where(within[:, None], 0.0, np.where(takes_a, on_a, on_b))
        a, b = np.where(closer & ~takes_a, b, a), np.where(closer, c, b)
        way = np.where(closer, better, way)
    return np.asarray(way)


def _nearest_of_segments(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the points (m, 2) of segments that are nearest to the origin."""
    along = end - start
    length2 = np.maximum((along**2).sum(axis=1), TOUCH_MM**2)
    share = np.clip(-(start * along).sum(axis=1) / length2, 0.0, 1.0)
    return np.asarray(start + share[:, None] * along)
