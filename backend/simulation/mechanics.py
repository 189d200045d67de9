"""Quasi-static equilibrium of a held piece pressed on a bottom, batched over probes.

Source: bench reference 3.7. One call of ``advance`` is one time step: Newton with step halving per
probe, grip slip by return mapping round it, then the slider anchors move.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation import contact, grasp
from backend.simulation.conditions import Conditions
from backend.simulation.equilibrium import RESIDUAL_LIMIT
from backend.simulation.slipping import Grip, Step, gripped
from backend.simulation.support import Pose, Stand, topples

SPLITS = 2
"""A step without balance is gone again in halves, and these again, so many times."""
_MOVING = ("q", "slip", "relaxed", "residual", "depth_mm", "slope", "toppled")


class Region(Protocol):
    """A flat outline (``backend.objects.shapes.Outline`` is one)."""

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        """Return which points (..., 2) lie inside."""


@dataclass(frozen=True, slots=True)
class Carried:
    """What a gripping takes from probe to probe: ``slip`` (B, 2, 3) and ``relaxed`` (B, 2, 4)."""

    slip: FloatArray
    relaxed: FloatArray

    @classmethod
    def fresh(cls, count: int) -> Carried:
        """Return ``count`` grippings that have not slipped."""
        return cls(np.zeros((count, 2, 3)), np.zeros((count, 2, 4)))

    def take(self, index: NDArray[np.intp]) -> Carried:
        """Return the grippings ``index``."""
        return Carried(self.slip[index], self.relaxed[index])

    def replaced(self, index: NDArray[np.intp], by: Carried) -> Carried:
        """Return a copy in which the grippings ``index`` are those of ``by``."""
        slip, relaxed = self.slip.copy(), self.relaxed.copy()
        slip[index], relaxed[index] = by.slip, by.relaxed
        return Carried(slip, relaxed)


@dataclass(frozen=True, slots=True)
class ContactState:
    """What B probes carry from one time step to the next.

    ``q`` (B, 6) mm and rad; ``slip`` (B, 2, 3); ``anchor`` (2, B, n); ``relaxed`` (B, 2, 4);
    ``residual`` (B,): worst of the probe so far. ``depth_mm`` (B,): last command; ``slope`` (B, 6):
    change of q per mm of it, for the first guess of the next step. ``stand``: what carries the
    touched face, None if that is rigid; ``pose`` of it; ``pivot_mm`` (B, 2): ``G`` over ``O``;
    ``toppled`` (B,): the supports would not come back upright. ``splits``: how often a step in
    which moving supports find no balance is gone again in halves.
    """

    cells: contact.Cells
    conditions: Conditions
    q: FloatArray
    slip: FloatArray
    anchor: FloatArray
    relaxed: FloatArray
    residual: FloatArray
    depth_mm: FloatArray
    slope: FloatArray
    pivot_mm: FloatArray
    stand: Stand | None
    pose: Pose
    toppled: NDArray[np.bool_]
    splits: int = SPLITS

    def on(self, stand: Stand | None, splits: int = SPLITS) -> ContactState:
        """Return the state on supports that can rock and slide, upright by now; None: rigid."""
        if stand is None:
            return self
        pose = Pose.upright(len(self.q), stand.interfaces)
        return replace(self, stand=stand, pose=pose, splits=splits)

    def take(self, rows: NDArray[np.intp]) -> ContactState:
        """Return the probes ``rows``."""
        return replace(
            self,
            cells=self.cells.take(rows),
            conditions=self.conditions.take(rows),
            anchor=self.anchor[:, rows],
            pivot_mm=self.pivot_mm[rows],
            stand=None if self.stand is None else self.stand.take(rows),
            pose=self.pose.take(rows),
            **{name: getattr(self, name)[rows] for name in _MOVING},
        )

    def replaced(self, rows: NDArray[np.intp], by: ContactState) -> ContactState:
        """Return a copy in which the probes ``rows`` have moved on to ``by``."""
        anchor = self.anchor.copy()
        anchor[:, rows] = by.anchor
        moved = {n: _put(getattr(self, n), rows, getattr(by, n)) for n in _MOVING}
        return replace(self, anchor=anchor, pose=self.pose.replaced(rows, by.pose), **moved)


@dataclass(frozen=True, slots=True)
class Solved:
    """Equilibrium of B probes.

    ``q`` (B, 6); ``wrench_g`` (B, 6): contact forces on the piece, N and N·mm at the pivot ``G``;
    ``strain`` (B, 2, 3): elastic gel strain (mm, mm, rad); ``normal_n`` (B, 2): pad forces;
    ``slip`` (B, 2, 3); ``residual`` (B,) scaled; ``cop_mm`` (B, 2) centre of pressure in ``F``
    (NaN in air); ``pressing_n`` (B,) = Fz.
    """

    q: FloatArray
    wrench_g: FloatArray
    strain: FloatArray
    normal_n: FloatArray
    slip: FloatArray
    residual: FloatArray
    cop_mm: FloatArray

    def replaced(self, rows: NDArray[np.intp], by: Solved) -> Solved:
        """Return a copy in which the probes ``rows`` are those of ``by``."""
        names = [f.name for f in fields(self)]
        return Solved(**{n: _put(getattr(self, n), rows, getattr(by, n)) for n in names})

    @property
    def pressing_n(self) -> FloatArray:
        """(B,) press force in N."""
        return np.asarray(self.wrench_g[:, 2], dtype=np.float64)


def begin(
    face_points_mm: FloatArray,
    outline: Region,
    offset_mm: FloatArray,
    conditions: Conditions,
    previous: ContactState | Carried | None = None,
    pitch_mm: float = 1.0,
) -> ContactState:
    """Start B probes at the true displacements ``offset_mm`` (B, 2) above one bottom ``outline``.

    ``face_points_mm`` (N, 2): lattice of ``pitch_mm`` on the face, in ``F``. From ``previous``
    (same gripping) grip slip and gel state are kept; the slider anchors start afresh. The bottom is
    rigid; see ``ContactState.on``.
    """
    cos, sin = np.cos(conditions.yaw_rad)[:, None], np.sin(conditions.yaw_rad)[:, None]
    s_x = cos * face_points_mm[:, 0] - sin * face_points_mm[:, 1]
    s_y = sin * face_points_mm[:, 0] + cos * face_points_mm[:, 1]
    s = np.stack([s_x, s_y], axis=-1)
    packed, exists = contact.pack(s, outline.contains(s + offset_mm[:, None, :]))
    x = packed[..., 0] - conditions.grasp_offset_mm[:, :1]
    y = packed[..., 1]
    tilt = conditions.tilt_rad
    gap = tilt[:, 1:] * packed[..., 0] - tilt[:, :1] * packed[..., 1]
    gap -= np.where(exists, gap, -np.inf).max(axis=1, initial=-1e9)[:, None]
    area = np.where(exists, pitch_mm**2, 0.0)
    cells = contact.Cells(
        x=x,
        y=y,
        gap_mm=gap,
        normal=conditions.foundation_n_mm3[:, None] * area,
        tangential=conditions.tangential_n_mm3[:, None] * area,
        basis=np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1),
        r_z=-(conditions.grip_height_mm + conditions.grasp_offset_mm[:, 1]),
        mu=conditions.mu[:, None],
        count=exists.sum(axis=1),
    )
    count = conditions.count
    kept = Carried.fresh(count) if previous is None else previous
    return ContactState(
        cells=cells,
        conditions=conditions,
        q=np.zeros((count, 6)),
        slip=kept.slip,
        anchor=np.zeros((2, *x.shape)),
        relaxed=kept.relaxed,
        residual=np.zeros(count),
        depth_mm=np.zeros(count),
        slope=np.zeros((count, 6)),
        pivot_mm=offset_mm + np.stack([conditions.grasp_offset_mm[:, 0], np.zeros(count)], axis=1),
        stand=None,
        pose=Pose.upright(count, 0),
        toppled=np.zeros(count, dtype=np.bool_),
    )


def advance(
    state: ContactState, commanded_mm: FloatArray, dt_s: float | FloatArray
) -> tuple[ContactState, Solved]:
    """Solve the next time step of ``dt_s`` for the command ``commanded_mm`` (B, 3).

    The command is relative to the height of first touch (z below it is negative) and to the probing
    position. Where moving supports find no balance the step is gone again in halves.
    Never raises for lack of convergence: check ``residual`` against ``RESIDUAL_LIMIT``.
    """
    after, solved = _advanced(state, commanded_mm, dt_s)
    alive = state.residual <= RESIDUAL_LIMIT
    lost = np.flatnonzero(alive & ~(solved.residual <= RESIDUAL_LIMIT))
    if state.stand is None or not state.splits or not len(lost):
        return after, solved
    part = replace(state.take(lost), splits=state.splits - 1)
    end_mm = commanded_mm[lost]
    half_s = 0.5 * np.broadcast_to(np.asarray(dt_s, dtype=np.float64), alive.shape)[lost]
    middle_mm = end_mm.copy()
    middle_mm[:, 2] = 0.5 * (part.depth_mm + end_mm[:, 2])
    part, _ = advance(part, middle_mm, half_s)
    part, found = advance(part, end_mm, half_s)
    return after.replaced(lost, part), solved.replaced(lost, found)


def _advanced(
    state: ContactState, commanded_mm: FloatArray, dt_s: float | FloatArray
) -> tuple[ContactState, Solved]:
    conditions = state.conditions
    spring = grasp.springs(conditions, state.relaxed, dt_s)
    travel = commanded_mm[:, 2] - state.depth_mm
    step = Step(
        state.cells,
        state.anchor,
        conditions,
        spring,
        commanded_mm,
        state.stand,
        state.pivot_mm,
        state.pose,
        not state.splits,
    )
    start = Grip.begun(
        state.q + travel[:, None] * state.slope,
        state.pose,
        state.slip,
        state.residual <= RESIDUAL_LIMIT,
    )
    found, now = gripped(step, start)
    q, slip, pose, residual = found.q, found.slip, found.pose, found.residual
    elastic = found.d.copy()
    elastic[:, :, :3] -= slip
    moved = np.abs(travel[:, None]) > 1e-6
    way = np.where(moved, travel[:, None], 1.0)
    after = replace(
        state,
        q=q,
        slip=slip,
        anchor=contact.moved_anchor(state.cells, now),
        relaxed=grasp.relax(state.relaxed, elastic, conditions, dt_s),
        residual=np.maximum(state.residual, residual),
        depth_mm=commanded_mm[:, 2],
        slope=np.where(moved, (q - state.q) / way, state.slope),
        pose=pose,
        toppled=state.toppled | _toppled(state, pose, residual),
    )
    solved = Solved(
        q=q,
        wrench_g=now.wrench,
        strain=elastic[:, :, :3],
        normal_n=found.normal_n,
        slip=slip,
        residual=residual,
        cop_mm=_centre_of_pressure(now.wrench, state.cells.r_z),
    )
    return after, solved


def _put(values: Any, rows: NDArray[np.intp], by: Any) -> Any:
    """Return the array ``values`` with ``rows`` from ``by``; which array it is, the name says."""
    changed = values.copy()
    changed[rows] = by
    return changed


def _toppled(state: ContactState, pose: Pose, residual: FloatArray) -> NDArray[np.bool_]:
    if state.stand is None:
        return np.zeros_like(state.toppled)
    return topples(state.stand, pose) & (residual <= RESIDUAL_LIMIT)


def _centre_of_pressure(wrench: FloatArray, r_z: FloatArray) -> FloatArray:
    force = np.where(wrench[:, 2] > 0.0, wrench[:, 2], np.nan)
    x = -(wrench[:, 4] - r_z * wrench[:, 0]) / force
    y = (wrench[:, 3] + r_z * wrench[:, 1]) / force
    return np.stack([x, y], axis=1)
