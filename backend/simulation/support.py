"""Free-standing bottoms that rock and slide: their geometry, weights, and the resultant on each.

Every interface of the bottoms (table below the lowest included) carries the press and the weight of
what is above it. The body above rocks about the edge of the support polygon when the resultant
leaves it, and slides when the lateral force exceeds friction. Derivation: docs/simulated-bench.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from backend.config.simulation import SupportSettings
from backend.core.flow import FloatArray
from backend.objects.tower import Tower
from backend.simulation.support_area import Area, area_of

GRAVITY_M_S2 = 9.81
BoolArray: TypeAlias = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Stand:
    """What carries the touched face of B probes: m interfaces each, lowest first, mm in ``O``.

    ``area`` (B, m): what each interface can carry on. ``height_mm`` (B, m): touched face above it.
    ``weight_n`` (B, m) of all bodies above it; ``centre_nmm`` (B, m, 2): weight times their common
    centre of mass. ``rocked_nmm`` (B, m, m): growth of that moment at i per radian of rocking at j;
    ``moved_n`` (B, m, m): per mm of sliding at j. ``mu`` (B, m); infinite where nothing slides.
    """

    area: Area
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

    def take(self, index: NDArray[np.intp]) -> Stand:
        """Return the probes ``index``."""
        parts = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "area"}
        return Stand(area=self.area.take(index), **{k: v[index] for k, v in parts.items()})


@dataclass(frozen=True, slots=True)
class Pose:
    """Motion of the bodies above each interface since the probe began.

    ``rock_rad`` (B, m, 2): rotation as the direction in which the top leans; ``slide_mm``
    (B, m, 2).
    """

    rock_rad: FloatArray
    slide_mm: FloatArray

    @classmethod
    def upright(cls, count: int, interfaces: int) -> Pose:
        """Return B stands in which nothing has moved."""
        return cls(np.zeros((count, interfaces, 2)), np.zeros((count, interfaces, 2)))

    def take(self, index: NDArray[np.intp]) -> Pose:
        """Return the probes ``index``."""
        return Pose(self.rock_rad[index], self.slide_mm[index])

    def replaced(self, index: NDArray[np.intp], by: Pose) -> Pose:
        """Return a copy in which the probes ``index`` are those of ``by``."""
        rock, slide = self.rock_rad.copy(), self.slide_mm.copy()
        rock[index], slide[index] = by.rock_rad, by.slide_mm
        return Pose(rock, slide)


def stand_of(bottoms: Tower, settings: SupportSettings) -> Stand | None:
    """Return how one tower stands (B = 1); None where nothing in it can move."""
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
    above = _above(weight)
    count = len(bodies)
    later = np.maximum.outer(np.arange(count), np.arange(count))
    levers = _above(weight * rise)[later] - above[later] * base
    areas = [area_of(bottoms, first + k, origin) for k in range(count)]
    return Stand(
        area=Area.joined(areas),
        height_mm=(top - base)[None],
        weight_n=above[None],
        centre_nmm=_above(weight[:, None] * centre)[None],
        rocked_nmm=levers[None],
        moved_n=above[later][None],
        mu=np.full((1, count), settings.mu if settings.slides else np.inf),
        rocks=np.full((1, count), settings.rocks),
    )


def slid(bottoms: Tower, slide_mm: FloatArray) -> Tower:
    """Return the tower after its free bodies slid by ``slide_mm`` (m, 2) at their interfaces."""
    bodies = list(bottoms.bodies)
    first = len(bodies) - len(slide_mm)
    for k, (x, y) in enumerate(np.cumsum(slide_mm, axis=0).tolist(), start=first):
        at = bodies[k].at_mm
        bodies[k] = replace(bodies[k], at_mm=(at[0] + x, at[1] + y))
    return Tower(tuple(bodies))


def join_stands(stands: Sequence[Stand]) -> Stand:
    """Join stands of equally many interfaces along B."""
    names = [f.name for f in fields(Stand) if f.name != "area"]
    joined = {name: np.concatenate([getattr(stand, name) for stand in stands]) for name in names}
    return Stand(area=Area.stacked([stand.area for stand in stands]), **joined)


def topples(stand: Stand, pose: Pose) -> BoolArray:
    """Return (B,): whether without the press some centre of mass is beyond its edge by now."""
    moment = stand.centre_nmm + unladen(stand, pose)
    centre = moment / stand.weight_n[..., None] - drift_mm(stand, pose)
    foot, _ = stand.area.nearest(centre)
    return np.asarray(((foot != centre).any(axis=-1) & stand.rocks).any(axis=-1))


def unladen(stand: Stand, pose: Pose) -> FloatArray:
    """Return (B, m, 2) N·mm: how the moments of the weights have grown since the probe began."""
    return np.asarray(stand.rocked_nmm @ pose.rock_rad + stand.moved_n @ pose.slide_mm)


def drift_mm(stand: Stand, pose: Pose) -> FloatArray:
    """Return (B, m, 2): how far each support polygon has moved since the probe began."""
    lever = below_mm(stand)
    return np.asarray(lever @ pose.rock_rad + np.cumsum(pose.slide_mm, axis=1))


def below_mm(stand: Stand) -> FloatArray:
    """Return (B, m, m): height of interface i above interface j, 0 for j >= i."""
    rise = stand.height_mm[:, None, :] - stand.height_mm[:, :, None]
    return np.asarray(np.maximum(rise, 0.0))


def _above(values: FloatArray) -> FloatArray:
    """Return for each body the sum over itself and all above."""
    return np.asarray(np.cumsum(values[::-1], axis=0)[::-1], dtype=np.float64)
