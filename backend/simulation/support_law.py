"""The laws of supports that rock and slide: how far a trial solution is from them.

The resultant c of an interface lies in its support polygon and its rocking is normal to it there;
the lateral force lies in the friction disc and its sliding is normal to it there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation.contact import Cells, Touch
from backend.simulation.support import Pose, Stand, drift_mm, unladen

ROCK_MM_RAD = 1000.0
"""Weight of an angle beside a place in the law of rocking: any positive one gives the same."""
SLIDE_N_MM = 10.0
MOMENT_N_MM = 0.4
"""A resultant off by 1 mm counts as this residual, as 8 N do in the scale of the piece."""
AXES = np.eye(2)


@dataclass(frozen=True, slots=True)
class Held:
    """Grasp and place of B probes during one solution.

    ``zero`` q° (B, 6) and ``stiffness`` (B, 6) of the grasp; ``pivot_mm`` (B, 2): the pivot over
    ``O``; ``slid_mm``, ``leaned_rad`` (B, m, 2): sliding and rocking so far. ``drag_mm_rad``: the
    resultant is taken as shifted back by so much per radian of rocking further than that.
    """

    cells: Cells
    anchor: FloatArray
    zero: FloatArray
    stiffness: FloatArray
    stand: Stand
    pivot_mm: FloatArray
    slid_mm: FloatArray
    leaned_rad: FloatArray
    drag_mm_rad: float = 0.0

    def take(self, rows: NDArray[np.intp]) -> Held:
        """Return the probes ``rows``."""
        return Held(
            self.cells.take(rows),
            self.anchor[:, rows],
            self.zero[rows],
            self.stiffness[rows],
            self.stand.take(rows),
            self.pivot_mm[rows],
            self.slid_mm[rows],
            self.leaned_rad[rows],
            self.drag_mm_rad,
        )


@dataclass(frozen=True, slots=True)
class Law:
    """How far the supports are from their laws, and what is needed to linearise that.

    ``load_n`` (B, m); ``centre_mm`` (B, m, 2): where the resultant is; ``corner_mm`` and
    ``corner_slope``: the nearest point of the polygon; ``rock``, ``slide`` (B, m, 2): residuals in
    mm and N; ``reach``, ``reach_load``: derivative of the nearest lateral force by force and load.
    """

    load_n: FloatArray
    centre_mm: FloatArray
    corner_mm: FloatArray
    corner_slope: FloatArray
    rock: FloatArray
    slide: FloatArray
    reach: FloatArray
    reach_load: FloatArray

    @classmethod
    def at(cls, held: Held, q: FloatArray, pose: Pose, now: Touch) -> Law:
        """Return the law at the motion ``q`` (B, 6), supports at ``pose``, forces ``now``."""
        stand = held.stand
        load = now.wrench[:, 2:3] + stand.weight_n
        moment = np.einsum("bmij,bj->bmi", levers(held), now.wrench)
        moment += now.wrench[:, None, 2:3] * face_motion(held.cells, q)[:, None]
        moment += stand.centre_nmm + unladen(stand, pose)
        centre = moment / load[..., None]
        at = centre - drift_mm(stand, pose)
        at -= held.drag_mm_rad * (pose.rock_rad - held.leaned_rad)
        corner, slope = stand.area.nearest(at + ROCK_MM_RAD * pose.rock_rad)
        rock = np.where(stand.rocks[..., None], at - corner, pose.rock_rad * ROCK_MM_RAD)
        lateral = -now.wrench[:, None, :2]
        tried = lateral + SLIDE_N_MM * (pose.slide_mm - held.slid_mm)
        size = np.maximum(np.hypot(tried[..., 0], tried[..., 1]), 1e-12)
        share = np.minimum(1.0, stand.mu * load / size)[..., None]
        along = tried / size[..., None]
        sliding = share < 1.0
        outward = along[..., :, None] * along[..., None, :]
        reach = share[..., None] * (AXES - outward * sliding[..., None])
        return cls(
            load_n=load,
            centre_mm=centre,
            corner_mm=corner,
            corner_slope=slope,
            rock=rock,
            slide=lateral - share * tried,
            reach=reach,
            reach_load=np.where(sliding, np.where(sliding, stand.mu[..., None], 0.0) * along, 0.0),
        )

    def take(self, rows: NDArray[np.intp]) -> Law:
        """Return the probes ``rows``."""
        return Law(*(getattr(self, name)[rows] for name in self.__slots__))

    def put(self, rows: NDArray[np.intp], by: Law) -> None:
        """Overwrite the probes ``rows``."""
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(by, name)

    @property
    def size(self) -> FloatArray:
        """(B,) residual in N."""
        rock = MOMENT_N_MM * self.rock
        return np.asarray(np.sqrt((rock**2 + self.slide**2).sum(axis=(1, 2))), dtype=np.float64)


def levers(held: Held) -> FloatArray:
    """Return (B, m, 2, 6): moments of a unit wrench on the piece, as resultant times load."""
    up = held.stand.height_mm - held.cells.r_z[:, None]
    levers = np.zeros((*up.shape, 2, 6))
    levers[..., 0, 0] = levers[..., 1, 1] = -up
    levers[..., :, 2] = held.pivot_mm[:, None]
    levers[..., 0, 4], levers[..., 1, 3] = -1.0, 1.0
    return levers


def face_motion(cells: Cells, q: FloatArray) -> FloatArray:
    """Return (B, 2): motion of the middle of the face, which the press moves with."""
    along = np.stack([q[:, 4], -q[:, 3]], axis=1)
    return np.asarray(q[:, :2] + cells.r_z[:, None] * along)
