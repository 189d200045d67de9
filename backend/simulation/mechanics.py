"""Quasi-static equilibrium of grasped pieces pressed on a bottom, batched over probes.

The grasp has series springs, an elastic zero, a limit surface and an optional Maxwell branch. One
call of ``advance_probes`` is one time step: Newton with step halving per probe, return mapping of
the grip slip around it, then the slider anchors move. On rigid supports all probes of a batch run
the same number of passes; on moving supports, where a pass is expensive, each probe ends by itself.

Finger index 0 is left (y = +w/2), 1 is right. Axes of ``slip`` and ``strain``: x (mm), z (mm),
rotation about the jaw axis (rad).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import Surface, surface_heights_mm
from touchdown.backend.simulation import contact
from touchdown.backend.simulation.conditions import Conditions
from touchdown.backend.simulation.contact import (
    RESIDUAL_LIMIT,
    ContactCells,
    ContactForces,
    contact_forces,
    solve_equilibrium,
)
from touchdown.backend.simulation.moving_supports import (
    SolutionInputs,
    carried_motion,
    solve_on_supports,
)
from touchdown.backend.simulation.rows import Rows
from touchdown.backend.simulation.supports import SupportMotion, SupportStack, topples

SIGN = np.array([1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Springs(Rows):
    """Stiffness and unloaded positions of the springs of B grasps in one time step.

    ``finger`` (B, 4): x, z, torsion, y of one finger, Maxwell branch included. ``series`` (B, 3)
    k̄ and ``matrix_diagonal`` (B, 6) of K. ``give`` (B, 3) = k̄ / K_r. ``hidden`` (B, 2, 4): shift
    of the unloaded position that the Maxwell branches add to the slip.
    """

    finger: FloatArray
    series: FloatArray
    matrix_diagonal: FloatArray
    give: FloatArray
    hidden: FloatArray


def springs(conditions: Conditions, relaxed: FloatArray, dt_s: float | FloatArray) -> Springs:
    """Return the equivalent springs of one implicit step of ``dt_s``.

    ``relaxed`` (B, 2, 8): inner states v of the Maxwell branches (x, z, torsion, y), those of the
    slower ones last; without creep (B, 2, 4) suffices.
    """
    b = 1.0 / (1.0 + dt_s / conditions.relax_s)
    share = conditions.alpha * b
    stiffer = 1.0 + share
    slow = np.zeros_like(share)
    if conditions.creep.any():
        slow = conditions.creep / (1.0 + dt_s / conditions.creep_s)
        stiffer = stiffer + slow
    shear, normal = conditions.shear_n_mm * stiffer, conditions.normal_n_mm * stiffer
    torsion = conditions.torsion_nmm * stiffer
    finger = np.empty((len(shear), 4))
    finger[:, 0] = finger[:, 1] = shear
    finger[:, 2], finger[:, 3] = torsion, normal
    both = 2.0 * finger[:, [0, 3, 0]]
    series = both * conditions.robot_n_mm / (both + conditions.robot_n_mm)
    diagonal = np.empty((len(shear), 6))
    diagonal[:, :3] = series
    diagonal[:, 3] = diagonal[:, 5] = 2.0 * shear * (0.5 * conditions.width_mm) ** 2
    diagonal[:, 4] = 2.0 * torsion
    hidden = (share / stiffer)[:, None, None] * relaxed[..., :4]
    if slow.any():
        hidden += (slow / stiffer)[:, None, None] * relaxed[..., 4:]
    return Springs(finger, series, diagonal, series / conditions.robot_n_mm, hidden)


def elastic_zero(
    commanded_mm: FloatArray, unloaded: FloatArray, width_mm: FloatArray
) -> FloatArray:
    """Return q° (B, 6). ``unloaded`` (B, 2, 4): slip plus hidden shift (x, z, torsion, y)."""
    mean = 0.5 * (unloaded[:, 0] + unloaded[:, 1])
    difference = (unloaded[:, 0] - unloaded[:, 1]) / width_mm[:, None]
    zero = np.empty((len(commanded_mm), 6))
    zero[:, 0] = commanded_mm[:, 0] + mean[:, 0]
    zero[:, 1] = commanded_mm[:, 1] + mean[:, 3]
    zero[:, 2] = commanded_mm[:, 2] + mean[:, 1]
    zero[:, 3] = difference[:, 1]
    zero[:, 4] = mean[:, 2]
    zero[:, 5] = -difference[:, 0]
    return zero


def pad_motion(
    q: FloatArray,
    zero: FloatArray,
    commanded_mm: FloatArray,
    give: FloatArray,
    width_mm: FloatArray,
) -> FloatArray:
    """Return d (B, 2, 4): motion of the piece relative to each pad (x, z, torsion, y)."""
    body = commanded_mm + give * (q - zero)[:, :3]
    moved = q[:, :3] - body
    swing = 0.5 * width_mm[:, None] * SIGN
    d = np.empty((len(q), 2, 4))
    d[:, :, 0] = moved[:, :1] - q[:, 5:6] * swing
    d[:, :, 1] = moved[:, 2:3] + q[:, 3:4] * swing
    d[:, :, 2] = q[:, 4:5]
    d[:, :, 3] = moved[:, 1:2]
    return d


def normal_force_n(d: FloatArray, spring: Springs, grip_force_n: FloatArray) -> FloatArray:
    """Return N_i (B, 2), the force that presses each pad on the piece (not below zero)."""
    push = spring.finger[:, 3:4] * (d[:, :, 3] - spring.hidden[:, :, 3]) * SIGN
    return np.asarray(np.maximum(grip_force_n[:, None] + push, 0.0), dtype=np.float64)


def returned_slip(
    slip: FloatArray, d: FloatArray, spring: Springs, normal_n: FloatArray, conditions: Conditions
) -> FloatArray:
    """Return the slip (B, 2, 3) after mapping the pad forces back onto the limit surface."""
    strain = d[:, :, :3] - slip - spring.hidden[:, :, :3]
    force = spring.finger[:, None, :3] * strain
    limit = np.maximum(conditions.mu_grip[:, None] * normal_n, 1e-9)
    phi = (force[..., 0] ** 2 + force[..., 1] ** 2) / limit**2
    phi += (force[..., 2] / (limit * conditions.limit_radius_mm[:, None])) ** 2
    excess = np.where(
        (phi > 1.0) & conditions.slips[:, None], 1.0 - 1.0 / np.sqrt(np.maximum(phi, 1.0)), 0.0
    )
    return np.asarray(slip + excess[..., None] * strain, dtype=np.float64)


def relax(
    relaxed: FloatArray, strain: FloatArray, conditions: Conditions, dt_s: float | FloatArray
) -> FloatArray:
    """Return the Maxwell states v (B, 2, 8) after an implicit step of ``dt_s``."""
    after = np.empty_like(relaxed)
    b = (1.0 / (1.0 + dt_s / conditions.relax_s))[:, None, None]
    after[..., :4] = b * relaxed[..., :4] + (1.0 - b) * strain
    if conditions.creep.any():
        b = (1.0 / (1.0 + dt_s / conditions.creep_s))[:, None, None]
        after[..., 4:] = b * relaxed[..., 4:] + (1.0 - b) * strain
    else:
        after[..., 4:] = relaxed[..., 4:]
    return after


SLIP_TOLERANCE = 1e-5
MAX_SLIP_PASSES = 200


@dataclass(frozen=True, slots=True)
class TimeStep(Rows):
    """Inputs of a time step of B probes.

    ``commanded_mm`` (B, 3); ``stand``: supports of the touched face, None if rigid; ``pivot_mm``
    (B, 2): ``G`` over ``O``; ``pose`` of the supports at the start. ``last``: the step is not split
    any further.
    """

    cells: ContactCells
    anchor: FloatArray
    conditions: Conditions
    spring: Springs
    commanded_mm: FloatArray
    stand: SupportStack | None
    pivot_mm: FloatArray
    pose: SupportMotion
    last: bool

    def held(self, zero: FloatArray, stand: SupportStack) -> SolutionInputs:
        """Return the grasp with the elastic zero ``zero`` (B, 6) on ``stand``."""
        return SolutionInputs(
            self.cells,
            self.anchor,
            zero,
            self.spring.matrix_diagonal,
            stand,
            self.pivot_mm,
            self.pose.slide_mm,
            self.pose.rock_rad,
            np.zeros(len(zero)),
        )


@dataclass(frozen=True, slots=True)
class GripSolution(Rows):
    """A trial solution of B probes.

    ``q`` (B, 6); ``pose`` of the supports; ``slip`` (B, 2, 3) of this equilibrium; ``d``
    (B, 2, 4): motion relative to the pads; ``normal_n`` (B, 2); ``residual`` (B,); ``alive`` (B,):
    probes whose supports were in equilibrium so far.
    """

    q: FloatArray
    pose: SupportMotion
    slip: FloatArray
    d: FloatArray
    normal_n: FloatArray
    residual: FloatArray
    alive: NDArray[np.bool_]

    @classmethod
    def begun(
        cls, q: FloatArray, pose: SupportMotion, slip: FloatArray, alive: NDArray[np.bool_]
    ) -> GripSolution:
        """Return the start of the search."""
        count = len(q)
        return cls(
            q, pose, slip, np.zeros((count, 2, 4)), np.zeros((count, 2)), np.zeros(count), alive
        )


def solve_with_slip(step: TimeStep, start: GripSolution) -> tuple[GripSolution, ContactForces]:
    """Return the equilibrium near ``start`` after slip of the pads, and its cell forces.

    Without convergence the residual is infinite; never raises.
    """
    if step.stand is None:
        return _solve_on_rigid(step, start)
    return _solve_on_moving(step, step.stand, start)


def _solve_on_rigid(step: TimeStep, start: GripSolution) -> tuple[GripSolution, ContactForces]:
    now = start
    for _ in range(MAX_SLIP_PASSES):
        zero = _elastic_zero_of(step, now.slip)
        q, there, residual = solve_equilibrium(
            step.cells, step.anchor, now.q, zero, step.spring.matrix_diagonal
        )
        now, mapped = _map_slip(step, replace(now, q=q, residual=residual), zero)
        if np.abs(mapped - now.slip).max(initial=0.0) < SLIP_TOLERANCE:
            return now, there
        now = replace(now, slip=mapped)
    return replace(now, residual=np.full_like(now.residual, np.inf)), there


def _solve_on_moving(
    step: TimeStep, stand: SupportStack, start: GripSolution
) -> tuple[GripSolution, ContactForces]:
    rows = np.arange(len(start.q))
    ends, part, now = start, step, start
    for _ in range(MAX_SLIP_PASSES):
        assert part.stand is not None
        zero = _elastic_zero_of(part, now.slip)
        held = part.held(zero, part.stand)
        settled = solve_on_supports(held, now.q, now.pose, now.alive, eased=step.last)
        now = replace(
            now,
            q=settled.q,
            pose=settled.pose,
            residual=settled.residual,
            alive=now.alive & (settled.residual <= RESIDUAL_LIMIT),
        )
        now, mapped = _map_slip(part, now, zero)
        ends = ends.replaced(rows, now)
        change = np.abs(mapped - now.slip).max(axis=(1, 2), initial=0.0)
        slipping = np.flatnonzero(now.alive & ~(change < SLIP_TOLERANCE))
        if not len(slipping):
            break
        if len(slipping) < len(rows):
            rows, part = rows[slipping], part.take(slipping)
            now, mapped = now.take(slipping), mapped[slipping]
        now = replace(now, slip=mapped)
    else:
        residual = ends.residual.copy()
        residual[rows] = np.inf
        ends = replace(ends, residual=residual)
    ride = carried_motion(step.held(np.zeros_like(ends.q), stand), ends.pose)
    return ends, contact_forces(step.cells, step.anchor, ends.q - ride)


def _elastic_zero_of(step: TimeStep, slip: FloatArray) -> FloatArray:
    unloaded = step.spring.hidden.copy()
    unloaded[:, :, :3] += slip
    return elastic_zero(step.commanded_mm, unloaded, step.conditions.width_mm)


def _map_slip(
    step: TimeStep, now: GripSolution, zero: FloatArray
) -> tuple[GripSolution, FloatArray]:
    """Return ``now`` with the motion of the pads, and the slip after return mapping."""
    conditions, spring = step.conditions, step.spring
    d = pad_motion(now.q, zero, step.commanded_mm, spring.give, conditions.width_mm)
    normal_n = normal_force_n(d, spring, conditions.grip_force_n)
    mapped = returned_slip(now.slip, d, spring, normal_n, conditions)
    return replace(now, d=d, normal_n=normal_n), mapped


MAX_SPLITS = 2  # A step without equilibrium is halved this often


class Region(Protocol):
    """An outline (``touchdown.backend.geometry.outlines.Outline`` is one)."""

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        """Return True for points (..., 2) inside."""


@dataclass(frozen=True, slots=True)
class GraspHistory(Rows):
    """State of a grip between probes: ``slip`` (B, 2, 3) and ``relaxed`` (B, 2, 8)."""

    slip: FloatArray
    relaxed: FloatArray

    @classmethod
    def fresh(cls, count: int) -> GraspHistory:
        """Return ``count`` grips without slip."""
        return cls(np.zeros((count, 2, 3)), np.zeros((count, 2, 8)))


@dataclass(frozen=True, slots=True)
class ContactState(Rows):
    """State of B probes between time steps.

    ``q`` (B, 6) mm and rad; ``slip`` (B, 2, 3); ``anchor`` (2, B, n); ``relaxed`` (B, 2, 8);
    ``residual`` (B,): largest of the probe so far. ``depth_mm`` (B,): last command; ``slope``
    (B, 6): change of q per mm of it, for the initial guess of the next step. ``stand``: supports of
    the touched face, None if rigid; ``pose`` of them; ``pivot_mm`` (B, 2): ``G`` over ``O``;
    ``toppled`` (B,): the supports would not return upright. ``splits``: number of times that a step
    without equilibrium of moving supports is halved.
    """

    cells: contact.ContactCells
    conditions: Conditions
    q: FloatArray
    slip: FloatArray
    anchor: FloatArray
    relaxed: FloatArray
    residual: FloatArray
    depth_mm: FloatArray
    slope: FloatArray
    pivot_mm: FloatArray
    stand: SupportStack | None
    pose: SupportMotion
    toppled: NDArray[np.bool_]
    splits: int = MAX_SPLITS

    def on(self, stand: SupportStack | None, splits: int = MAX_SPLITS) -> ContactState:
        """Return the state on supports that can rock and slide, now upright; None: rigid."""
        if stand is None:
            return self
        pose = SupportMotion.upright(len(self.q), stand.interfaces)
        return replace(self, stand=stand, pose=pose, splits=splits)


@dataclass(frozen=True, slots=True)
class ProbeEquilibrium(Rows):
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

    @property
    def pressing_n(self) -> FloatArray:
        """(B,) press force in N."""
        return np.asarray(self.wrench_g[:, 2], dtype=np.float64)


def begin_probes(  # noqa: PLR0913 - two describe the lattice
    face_points_mm: FloatArray,
    outline: Region,
    offset_mm: FloatArray,
    conditions: Conditions,
    previous: ContactState | GraspHistory | None = None,
    pitch_mm: float = 1.0,
    subcells: int = 1,
    surfaces: Sequence[Surface] = (),
) -> ContactState:
    """Start B probes at the true displacements ``offset_mm`` (B, 2) above one bottom ``outline``.

    ``face_points_mm`` (N, 2): lattice of ``pitch_mm`` on the face, in ``F``. With ``subcells`` k,
    the k by k points around each k-th one form one cell, weighted by those that overlap. Slip and
    gel state of ``previous`` (same grip) are kept; the slider anchors are reset. ``surfaces``:
    heights of each bottom, all flat by default. The bottom is rigid; see ``ContactState.on``.
    """
    cos, sin = np.cos(conditions.yaw_rad)[:, None], np.sin(conditions.yaw_rad)[:, None]
    s_x = cos * face_points_mm[:, 0] - sin * face_points_mm[:, 1]
    s_y = sin * face_points_mm[:, 0] + cos * face_points_mm[:, 1]
    s = np.stack([s_x, s_y], axis=-1)
    inside = outline.contains(s + offset_mm[:, None, :])
    if subcells > 1:
        cell_mm = subcells * pitch_mm
        packed, covered = contact.merge_points(face_points_mm, cell_mm, s, inside)
        exists = covered > 0.0
    else:
        packed, exists = contact.pack_cells(s, inside)
        covered = exists.astype(np.float64)
    x = packed[..., 0] - conditions.grasp_offset_mm[:, :1]
    y = packed[..., 1]
    tilt = conditions.tilt_rad
    gap = tilt[:, 1:] * packed[..., 0] - tilt[:, :1] * packed[..., 1]
    if conditions.crown_rad.any():
        reach_mm = np.sqrt((face_points_mm**2).sum(axis=1).max())
        gap -= (0.5 / reach_mm) * conditions.crown_rad[:, None] * (packed**2).sum(axis=-1)
    if not all(surface.flat for surface in surfaces):
        gap += surface_heights_mm(surfaces, packed + offset_mm[:, None, :])
    gap -= np.where(exists, gap, -np.inf).max(axis=1, initial=-1e9)[:, None]
    area = pitch_mm**2 * covered
    cells = contact.ContactCells(
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
    kept = GraspHistory.fresh(count) if previous is None else previous
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
        pose=SupportMotion.upright(count, 0),
        toppled=np.zeros(count, dtype=np.bool_),
    )


def advance_probes(
    state: ContactState, commanded_mm: FloatArray, dt_s: float | FloatArray
) -> tuple[ContactState, ProbeEquilibrium]:
    """Solve the next time step of ``dt_s`` for the command ``commanded_mm`` (B, 3).

    The command is relative to the height of first touch (z below it is negative) and to the probing
    position. Steps without equilibrium of moving supports are halved. Never raises: compare
    ``residual`` with ``RESIDUAL_LIMIT``.
    """
    after, solved = _advance_once(state, commanded_mm, dt_s)
    alive = state.residual <= RESIDUAL_LIMIT
    lost = np.flatnonzero(alive & ~(solved.residual <= RESIDUAL_LIMIT))
    if state.stand is None or not state.splits or not len(lost):
        return after, solved
    part = replace(state.take(lost), splits=state.splits - 1)
    end_mm = commanded_mm[lost]
    half_s = 0.5 * np.broadcast_to(np.asarray(dt_s, dtype=np.float64), alive.shape)[lost]
    middle_mm = end_mm.copy()
    middle_mm[:, 2] = 0.5 * (part.depth_mm + end_mm[:, 2])
    part, _ = advance_probes(part, middle_mm, half_s)
    part, found = advance_probes(part, end_mm, half_s)
    failed = np.flatnonzero(~(found.residual <= RESIDUAL_LIMIT))
    if len(failed):
        # The way may lead through states without equilibrium that the whole step passes.
        begun = replace(state.take(lost[failed]), splits=0)
        whole, at_end = _advance_once(begun, end_mm[failed], 2.0 * half_s[failed])
        part, found = part.replaced(failed, whole), found.replaced(failed, at_end)
    return after.replaced(lost, part), solved.replaced(lost, found)


def _advance_once(
    state: ContactState, commanded_mm: FloatArray, dt_s: float | FloatArray
) -> tuple[ContactState, ProbeEquilibrium]:
    conditions = state.conditions
    spring = springs(conditions, state.relaxed, dt_s)
    travel = commanded_mm[:, 2] - state.depth_mm
    step = TimeStep(
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
    start = GripSolution.begun(
        state.q + travel[:, None] * state.slope,
        state.pose,
        state.slip,
        state.residual <= RESIDUAL_LIMIT,
    )
    found, now = solve_with_slip(step, start)
    q, slip, pose, residual = found.q, found.slip, found.pose, found.residual
    elastic = found.d.copy()
    elastic[:, :, :3] -= slip
    moved = np.abs(travel[:, None]) > 1e-6
    way = np.where(moved, travel[:, None], 1.0)
    toppled = state.toppled
    if state.stand is not None:
        toppled = toppled | (topples(state.stand, pose) & (residual <= RESIDUAL_LIMIT))
    after = replace(
        state,
        q=q,
        slip=slip,
        anchor=contact.updated_anchor(state.cells, now),
        relaxed=relax(state.relaxed, elastic, conditions, dt_s),
        residual=np.maximum(state.residual, residual),
        depth_mm=commanded_mm[:, 2],
        slope=np.where(moved, (q - state.q) / way, state.slope),
        pose=pose,
        toppled=toppled,
    )
    r_z, (fx, fy, fz, mx, my, _) = state.cells.r_z, now.wrench.T
    press = np.where(fz > 0.0, fz, np.nan)
    solved = ProbeEquilibrium(
        q=q,
        wrench_g=now.wrench,
        strain=elastic[:, :, :3],
        normal_n=found.normal_n,
        slip=slip,
        residual=residual,
        cop_mm=np.stack([-(my - r_z * fx) / press, (mx + r_z * fy) / press], axis=1),
    )
    return after, solved
