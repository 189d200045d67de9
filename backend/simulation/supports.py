"""Free-standing bottoms that rock and slide: geometry, weights, and the resultant on each.

Each interface of the bottoms (table below the lowest included) carries the press and the weight
above it. The body above rocks about the edge of the support polygon when the resultant leaves it,
and slides when the lateral force exceeds friction. Derivation: docs/simulated-bench.md.

The support area of two convex faces is their overlap. Each face is a polygon offset outwards by a
radius (a disc is a point with an offset), so that the edge of a disc is smooth; Newton's method
would stall at the corners of a 128-gon. Where a face has holes or several parts, the support area
is the convex hull of the overlap: the resultant of a rigid body can lie anywhere in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SupportSettings
from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import (
    Body,
    Outline,
    Tower,
    contact_edges,
    edges_to_polygon,
    enclosed_area_mm2,
    interface_overlap,
    polygon_edges,
    signed_distances_mm,
)
from touchdown.backend.simulation.rows import Rows

_UNIT = np.eye(2)
ON_MM = 1e-7
LEAST_ARC = 16  # corners of a circle
SAME_HULL = 0.996  # share of the area from which two hulls count as equal
CORNER_MM = 0.01  # A point this near to the edges of both faces is a corner of the overlap


@dataclass(frozen=True, slots=True)
class SupportArea(Rows):
    """Overlaps of pairs of faces with leading axes (...): (B, m), or none for a single one.

    ``core_mm`` (..., 2 faces, v, 2) counter-clockwise, padded with copies of a corner; ``grown_mm``
    (..., 2): offset radius; ``corner_mm`` (..., c, 2): crossings of the edges, padded with
    infinity.
    """

    core_mm: FloatArray
    grown_mm: FloatArray
    corner_mm: FloatArray

    @classmethod
    def joined(cls, areas: Sequence[SupportArea]) -> SupportArea:
        """Return the areas of one tower as (1, m)."""
        parts = _pad_areas(areas)
        return cls(*(np.stack([getattr(a, f.name) for a in parts])[None] for f in fields(cls)))

    @classmethod
    def stacked(cls, areas: Sequence[SupportArea]) -> SupportArea:
        """Join along the first axis."""
        parts = _pad_areas(areas)
        return cls(*(np.concatenate([getattr(a, f.name) for a in parts]) for f in fields(cls)))

    def nearest(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the nearest points (..., 2) of the areas, and their slope (..., 2, 2).

        The slope is the identity inside, a projection outside, zero at a corner.
        """
        if self._alike():
            # A body on the table: only its own face.
            feet, slopes = _project(
                self.core_mm[..., :1, :, :], self.grown_mm[..., :1], points_mm[..., None, :]
            )
            return feet[..., 0, :], slopes[..., 0, :, :]
        feet, slopes = _project(self.core_mm, self.grown_mm, points_mm[..., None, :])
        other, _ = _project(self.core_mm[..., ::-1, :, :], self.grown_mm[..., ::-1], feet)
        usable = ((other - feet) ** 2).sum(axis=-1) <= ON_MM**2
        distance = np.where(usable, ((points_mm[..., None, :] - feet) ** 2).sum(axis=-1), np.inf)
        corner = ((points_mm[..., None, :] - self.corner_mm) ** 2).sum(axis=-1)
        every = np.concatenate([feet, self.corner_mm], axis=-2)
        # Without a candidate, due to rounding, the foot on the first face is used.
        distance = np.concatenate([np.minimum(distance, 1e30), corner], axis=-1)
        best = distance.argmin(axis=-1)
        foot = np.take_along_axis(every, best[..., None, None], axis=-2)[..., 0, :]
        face = np.minimum(best, 1)[..., None, None, None]
        slope = np.take_along_axis(slopes, face, axis=-3)[..., 0, :, :]
        return foot, np.asarray(slope * (best < 2)[..., None, None])

    def _alike(self) -> bool:
        """Return True if both faces are equal everywhere, without crossings."""
        core, grown = self.core_mm, self.grown_mm
        return (
            not self.corner_mm.shape[-2]
            and np.array_equal(core[..., 0, :, :], core[..., 1, :, :])
            and np.array_equal(grown[..., 0], grown[..., 1])
        )

    def foremost(self, direction: FloatArray) -> FloatArray:
        """Return the points (..., 2) of the areas farthest along ``direction`` (..., 2)."""
        ahead = (self.core_mm @ direction[..., None, :, None])[..., 0].argmax(axis=-1)
        corner = np.take_along_axis(self.core_mm, ahead[..., None, None], axis=-2)[..., 0, :]
        size = np.hypot(direction[..., 0], direction[..., 1])
        outward = direction / np.where(size > 0.0, size, 1.0)[..., None]
        tip = corner + self.grown_mm[..., None] * outward[..., None, :]
        other, _ = _project(self.core_mm[..., ::-1, :, :], self.grown_mm[..., ::-1], tip)
        usable = ((other - tip) ** 2).sum(axis=-1) <= ON_MM**2
        along = np.where(usable, (tip @ direction[..., None])[..., 0], -1e30)
        exists = np.isfinite(self.corner_mm[..., 0])
        known = np.where(exists[..., None], self.corner_mm, 0.0)
        at_corner = np.where(exists, (known @ direction[..., None])[..., 0], -np.inf)
        best = np.concatenate([along, at_corner], axis=-1).argmax(axis=-1)[..., None, None]
        every = np.concatenate([tip, known], axis=-2)
        return np.asarray(np.take_along_axis(every, best, axis=-2)[..., 0, :])


def interface_area(tower: Tower, k: int, origin_mm: FloatArray) -> SupportArea:
    """Return the area under body ``k`` of ``tower``, relative to ``origin_mm`` (2,)."""
    own, below = tower.bodies[k], tower.bodies[k - 1] if k else None
    lower = _convex(own.lower)
    faces, corners = [_face(own, lower, origin_mm)], np.empty((0, 2))
    if below is None or below.upper is None:
        faces = [*faces, *faces]
    else:
        upper = _convex(below.upper)
        faces.append(_face(below, upper, origin_mm))
        cut = contact_edges(lower, own.at_mm, own.yaw_rad, upper, below.at_mm, below.yaw_rad)
        ring = edges_to_polygon(cut) - origin_mm
        regions = "region" in (own.lower.kind, below.upper.kind)
        hull = interface_overlap(tower, k) if regions else cut
        if enclosed_area_mm2(hull) < SAME_HULL * enclosed_area_mm2(cut) and hull.kept.any():
            # The hulls of the faces overlap beyond the hull of the contact.
            faces = 2 * [(edges_to_polygon(hull) - origin_mm, 0.0)]
        else:
            near = [_edge_distance_mm(core, grown, ring) < CORNER_MM for core, grown in faces]
            corners = ring[near[0] & near[1]]
            if lower.kind == upper.kind == "circle":
                corners = _crossings(faces)
    widest = max(len(core) for core, _ in faces)
    cores = np.stack([np.pad(c, ((0, widest - len(c)), (0, 0)), "edge") for c, _ in faces])
    return SupportArea(cores, np.array([grown for _, grown in faces]), corners)


def _convex(outline: Outline) -> Outline:
    """Return the hull of a region, as a disc where all its corners lie on a circle."""
    if outline.kind != "region":
        return outline
    hull = outline.polygon()
    radius = np.hypot(hull[:, 0], hull[:, 1])
    if len(hull) >= LEAST_ARC and np.ptp(radius) < ON_MM:
        return Outline("circle", radius_mm=float(radius[0]))
    return Outline("polygon", vertices_mm=tuple((float(x), float(y)) for x, y in hull))


def _face(body: Body, outline: Outline, origin_mm: FloatArray) -> tuple[FloatArray, float]:
    if outline.kind == "circle":
        return np.array([body.at_mm]) - origin_mm, outline.radius_mm
    return outline.placed(body.at_mm, body.yaw_rad) - origin_mm, 0.0


def _crossings(faces: Sequence[tuple[FloatArray, float]]) -> FloatArray:
    """Return the crossings (2, 2) of two circles, (0, 2) if there are none."""
    (a, r), (b, s) = ((core[0], grown) for core, grown in faces)
    apart = float(np.hypot(*(b - a)))
    if not abs(r - s) < apart < r + s:
        return np.empty((0, 2))
    along = (b - a) / apart
    near = (apart**2 + r**2 - s**2) / (2 * apart)
    side = np.sqrt(max(r**2 - near**2, 0.0)) * np.array([-along[1], along[0]])
    return np.asarray(a + near * along + np.array([[1.0], [-1.0]]) * side)


def _edge_distance_mm(core_mm: FloatArray, grown_mm: float, points_mm: FloatArray) -> FloatArray:
    if len(core_mm) == 1:
        away = points_mm - core_mm[0]
        return np.asarray(np.abs(np.hypot(away[:, 0], away[:, 1]) - grown_mm))
    return np.abs(signed_distances_mm(points_mm, polygon_edges(core_mm)))


def _pad_areas(areas: Sequence[SupportArea]) -> list[SupportArea]:
    most = max(area.core_mm.shape[-2] for area in areas)
    crossings = max(area.corner_mm.shape[-2] for area in areas)
    padded = []
    for area in areas:
        core, corner = area.core_mm, area.corner_mm
        copies = np.repeat(core[..., -1:, :], most - core.shape[-2], axis=-2)
        absent = np.full((*corner.shape[:-2], crossings - corner.shape[-2], 2), np.inf)
        core = np.concatenate([core, copies], axis=-2)
        padded.append(SupportArea(core, area.grown_mm, np.concatenate([corner, absent], axis=-2)))
    return padded


def _project(
    core_mm: FloatArray, grown_mm: FloatArray, points_mm: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the points of offset polygons nearest to points (..., 2), and the slope."""
    foot, slope = _project_on_core(core_mm, points_mm)
    away = points_mm - foot
    distance = np.hypot(away[..., 0], away[..., 1])[..., None]
    inside = distance <= grown_mm[..., None]
    safe = np.where(distance > 0.0, distance, 1.0)
    outward = away / safe
    turn = _UNIT - outward[..., :, None] * outward[..., None, :]
    share = (grown_mm[..., None] / safe)[..., None]
    outside = slope + share * turn @ (_UNIT - slope)
    return (
        np.where(inside, points_mm, foot + grown_mm[..., None] * outward),
        np.where(inside[..., None], _UNIT, outside),
    )


def _project_on_core(core_mm: FloatArray, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    if core_mm.shape[-2] == 1:
        # Discs only, the usual bottoms.
        return core_mm[..., 0, :] + np.zeros_like(points_mm), np.zeros((*points_mm.shape, 2))
    along = np.roll(core_mm, -1, axis=-2) - core_mm
    length2 = (along**2).sum(axis=-1)
    exists = length2 > 0.0
    away = points_mm[..., None, :] - core_mm
    side = along[..., 0] * away[..., 1] - along[..., 1] * away[..., 0]
    inside = (side >= 0.0).all(axis=-1) & exists.any(axis=-1)
    length2 = np.where(exists, length2, 1.0)
    share = (away * along).sum(axis=-1) / length2
    gap = away - np.clip(share, 0.0, 1.0)[..., None] * along
    best = (gap**2).sum(axis=-1).argmin(axis=-1)[..., None]
    foot = points_mm - np.take_along_axis(gap, best[..., None], axis=-2)[..., 0, :]
    chosen = np.take_along_axis(along, best[..., None], axis=-2)[..., 0, :]
    share = np.take_along_axis(share, best, axis=-1)[..., 0]
    chosen *= ((share > 0.0) & (share < 1.0))[..., None]
    slope = chosen[..., :, None] * chosen[..., None, :]
    slope /= np.take_along_axis(length2, best, axis=-1)[..., None]
    slope = np.where(inside[..., None, None], _UNIT, slope)
    return np.where(inside[..., None], points_mm, foot), slope


GRAVITY_M_S2 = 9.81
BoolArray: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class SupportStack(Rows):
    """Supports of the touched face of B probes: m interfaces each, lowest first, mm in ``O``.

    ``area`` (B, m): support area of each interface. ``height_mm`` (B, m): touched face above it.
    ``weight_n`` (B, m) of all bodies above it; ``centre_nmm`` (B, m, 2): weight times their common
    centre of mass. ``rocked_nmm`` (B, m, m): derivative of that moment at i by rocking at j, per
    rad; ``moved_n`` (B, m, m): by sliding at j, per mm. ``mu`` (B, m); infinite without sliding.
    """

    area: SupportArea
    height_mm: FloatArray
    weight_n: FloatArray
    centre_nmm: FloatArray
    rocked_nmm: FloatArray
    moved_n: FloatArray
    mu: FloatArray
    rocks: BoolArray

    @property
    def interfaces(self) -> int:
        """Number m of interfaces."""
        return int(self.height_mm.shape[1])


@dataclass(frozen=True, slots=True)
class SupportMotion(Rows):
    """Motion of the bodies above each interface since the probe began.

    ``rock_rad`` (B, m, 2): rotation as the direction in which the top leans; ``slide_mm``
    (B, m, 2).
    """

    rock_rad: FloatArray
    slide_mm: FloatArray

    @classmethod
    def upright(cls, count: int, interfaces: int) -> SupportMotion:
        """Return B stacks without motion."""
        return cls(np.zeros((count, interfaces, 2)), np.zeros((count, interfaces, 2)))


def support_stack(bottoms: Tower, settings: SupportSettings) -> SupportStack | None:
    """Return the supports of one tower (B = 1); None if nothing in it can move."""
    first = 1 if bottoms.bodies[0].fixed else 0
    bodies = bottoms.bodies[first:]
    if not bodies or not (settings.rocks or settings.slides):
        return None
    origin = np.asarray(bottoms.bodies[-1].at_mm, dtype=np.float64)
    floor = np.concatenate([[0.0], np.cumsum([body.height_mm for body in bodies])])
    base, top = floor[:-1], floor[-1]
    weight = np.array([1e-3 * body.mass_g * GRAVITY_M_S2 for body in bodies])
    centre = np.array([body.centre_mm for body in bodies]) - origin
    rise = np.array([body.com_height_mm for body in bodies]) + base
    above = _sum_above(weight)
    count = len(bodies)
    later = np.maximum.outer(np.arange(count), np.arange(count))
    levers = _sum_above(weight * rise)[later] - above[later] * base
    areas = [interface_area(bottoms, first + k, origin) for k in range(count)]
    return SupportStack(
        area=SupportArea.joined(areas),
        height_mm=(top - base)[None],
        weight_n=above[None],
        centre_nmm=_sum_above(weight[:, None] * centre)[None],
        rocked_nmm=levers[None],
        moved_n=above[later][None],
        mu=np.full((1, count), settings.mu if settings.slides else np.inf),
        rocks=np.full((1, count), settings.rocks),
    )


def slide_bottoms(bottoms: Tower, slide_mm: FloatArray) -> Tower:
    """Return the tower after its free bodies slid by ``slide_mm`` (m, 2) at their interfaces."""
    bodies = list(bottoms.bodies)
    first = len(bodies) - len(slide_mm)
    for k, (x, y) in enumerate(np.cumsum(slide_mm, axis=0).tolist(), start=first):
        at = bodies[k].at_mm
        bodies[k] = replace(bodies[k], at_mm=(at[0] + x, at[1] + y))
    return Tower(tuple(bodies))


def join_support_stacks(stands: Sequence[SupportStack]) -> SupportStack:
    """Join stacks with equal numbers of interfaces along B."""
    names = [f.name for f in fields(SupportStack) if f.name != "area"]
    joined = {name: np.concatenate([getattr(stand, name) for stand in stands]) for name in names}
    return SupportStack(area=SupportArea.stacked([stand.area for stand in stands]), **joined)


def topples(stand: SupportStack, pose: SupportMotion) -> BoolArray:
    """Return (B,): True if, without the press, a centre of mass is beyond its edge."""
    moment = stand.centre_nmm + weight_moment_growth(stand, pose)
    centre = moment / stand.weight_n[..., None] - polygon_drift_mm(stand, pose)
    foot, _ = stand.area.nearest(centre)
    return np.asarray(((foot != centre).any(axis=-1) & stand.rocks).any(axis=-1))


def weight_moment_growth(stand: SupportStack, pose: SupportMotion) -> FloatArray:
    """Return (B, m, 2): change of the moments of the weights since the probe began, N·mm."""
    return np.asarray(stand.rocked_nmm @ pose.rock_rad + stand.moved_n @ pose.slide_mm)


def polygon_drift_mm(stand: SupportStack, pose: SupportMotion) -> FloatArray:
    """Return (B, m, 2): motion of each support polygon since the probe began, mm."""
    lever = interface_heights_mm(stand)
    return np.asarray(lever @ pose.rock_rad + np.cumsum(pose.slide_mm, axis=1))


def interface_heights_mm(stand: SupportStack) -> FloatArray:
    """Return (B, m, m): height of interface i above interface j, 0 for j >= i."""
    rise = stand.height_mm[:, None, :] - stand.height_mm[:, :, None]
    return np.asarray(np.maximum(rise, 0.0))


def _sum_above(values: FloatArray) -> FloatArray:
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1], dtype=np.float64)
