"""Equilibrium of a piece pressed on bottoms that may rock or slide, batched over probes.

Unknowns: the motion q of the piece, and at each interface the rocking a and the sliding s. Both
obey the same law: the resultant c is in the support polygon and a is normal to it there; the
lateral force T is in the friction disc and s is normal to it there. Each is written as ``c =
nearest point to (c + a)`` and solved together with the piece by Newton's method. Probes with
supports at rest need one check only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.simulation.contact import (
    RESIDUAL_LIMIT,
    RESIDUAL_SCALE,
    TOLERANCE,
    BatchTrial,
    ContactCells,
    ContactForces,
    contact_forces,
    halve_steps,
    solve_equilibrium,
    tangent_stiffness,
)
from touchdown.backend.simulation.rows import Rows
from touchdown.backend.simulation.supports import (
    SupportMotion,
    SupportStack,
    interface_heights_mm,
    polygon_drift_mm,
    weight_moment_growth,
)

# Weight of an angle against a position; any positive value has the same solution.
ROCK_MM_RAD = 1000.0
SLIDE_N_MM = 10.0
MOMENT_N_MM = 0.4  # residual in N of a resultant that is off by 1 mm
AXES = np.eye(2)


@dataclass(frozen=True, slots=True)
class SolutionInputs(Rows):
    """Grasp and position of B probes during one solution.

    ``zero`` q° (B, 6) and ``stiffness`` (B, 6) of the grasp; ``pivot_mm`` (B, 2): the pivot over
    ``O``; ``slid_mm``, ``leaned_rad`` (B, m, 2): sliding and rocking so far. ``drag_mm_rad``
    (B,): shift of the resultant per radian of further rocking.
    """

    cells: ContactCells
    anchor: FloatArray
    zero: FloatArray
    stiffness: FloatArray
    stand: SupportStack
    pivot_mm: FloatArray
    slid_mm: FloatArray
    leaned_rad: FloatArray
    drag_mm_rad: FloatArray


@dataclass(frozen=True, slots=True)
class SupportLaw(Rows):
    """Residuals of the support laws and their derivatives.

    ``load_n`` (B, m); ``centre_mm`` (B, m, 2): position of the resultant; ``corner_mm`` and
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
    def at(
        cls, held: SolutionInputs, q: FloatArray, pose: SupportMotion, now: ContactForces
    ) -> SupportLaw:
        """Return the law at the motion ``q`` (B, 6), supports at ``pose``, forces ``now``."""
        stand = held.stand
        load = now.wrench[:, 2:3] + stand.weight_n
        moment = np.einsum("bmij,bj->bmi", moment_arms(held), now.wrench)
        moment += now.wrench[:, None, 2:3] * face_motion(held.cells, q)[:, None]
        moment += stand.centre_nmm + weight_moment_growth(stand, pose)
        centre = moment / load[..., None]
        at = centre - polygon_drift_mm(stand, pose)
        at -= held.drag_mm_rad[:, None, None] * (pose.rock_rad - held.leaned_rad)
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

    @property
    def size(self) -> FloatArray:
        """(B,) residual in N."""
        rock = MOMENT_N_MM * self.rock
        return np.asarray(np.sqrt((rock**2 + self.slide**2).sum(axis=(1, 2))), dtype=np.float64)


def moment_arms(held: SolutionInputs) -> FloatArray:
    """Return (B, m, 2, 6): moments of a unit wrench on the piece."""
    up = held.stand.height_mm - held.cells.r_z[:, None]
    levers = np.zeros((*up.shape, 2, 6))
    levers[..., 0, 0] = levers[..., 1, 1] = -up
    levers[..., :, 2] = held.pivot_mm[:, None]
    levers[..., 0, 4], levers[..., 1, 3] = -1.0, 1.0
    return levers


def face_motion(cells: ContactCells, q: FloatArray) -> FloatArray:
    """Return (B, 2): motion of the centre of the face."""
    along = np.stack([q[:, 4], -q[:, 3]], axis=1)
    return np.asarray(q[:, :2] + cells.r_z[:, None] * along)


MAX_ITERATIONS = 40
HALVINGS = 12
# The search ends when the residual has not fallen to PROGRESS within PATIENCE iterations.
PATIENCE, PROGRESS = 8, 0.5
# Drag on the supports: the first, the factors after each step, and the largest and least in use.
FIRST_DRAG_MM_RAD, LESS_DRAG, MORE_DRAG = 1e6, 0.2, 8.0
MAX_DRAG_MM_RAD, NO_DRAG_MM_RAD = 1e9, 1.0
AT_REST_MM = 0.01  # shift of the resultant by the drag that ends the motion
MAX_DRAG_STEPS = 60
VISCOUS = 1e-6  # keeps the Jacobian regular where face and table slide; not in the residual


@dataclass(frozen=True, slots=True)
class SupportSolution(Rows):
    """A trial solution: motion ``q`` (B, 6), supports, scaled ``residual`` (B,)."""

    q: FloatArray
    pose: SupportMotion
    residual: FloatArray


def solve_on_supports(
    held: SolutionInputs,
    q: FloatArray,
    pose: SupportMotion,
    alive: NDArray[np.bool_],
    *,
    eased: bool,
) -> SupportSolution:
    """Return the equilibrium nearest to the guess ``q`` (B, 6), ``pose``.

    The supports of probes that are not ``alive`` (B,) stay, with an infinite residual. ``eased``:
    use a relaxed drag if the first search fails.
    """
    # Supports at rest: infinite residual if they would move.
    ride = carried_motion(held, pose)
    relative, now, residual = solve_equilibrium(
        held.cells, held.anchor, q - ride, held.zero - ride, held.stiffness
    )
    q = relative + ride
    rests = SupportLaw.at(held, q, pose, now).size <= TOLERANCE
    start = SupportSolution(q, pose, np.where(rests, residual, np.inf))
    rows = np.flatnonzero(alive & ~(start.residual <= TOLERANCE))
    if not len(rows):
        return start
    loose = held.take(rows)
    found = _solve_newton(loose, start.q[rows], start.pose.take(rows))
    lost = np.flatnonzero(~(found.residual <= TOLERANCE))
    if eased and len(lost):
        again = _search_with_drag(loose.take(lost), start.take(rows[lost]))
        found = found.replaced(lost, again)
    # Without an equilibrium the press continues on rigid supports.
    usable = np.flatnonzero(found.residual <= RESIDUAL_LIMIT)
    return start.replaced(rows[usable], found.take(usable))


def carried_motion(
    held: SolutionInputs, pose: SupportMotion, edge_mm: FloatArray | None = None
) -> FloatArray:
    """Return (B, 6): motion of the touched face as a motion about the pivot, like q.

    ``edge_mm`` (B, m, 2): points that stay down; None: those of the present rocking.
    """
    stand = held.stand
    rocked = pose.rock_rad.sum(axis=1)
    moved = (stand.height_mm[..., None] * pose.rock_rad + pose.slide_mm).sum(axis=1)
    edge = stand.area.foremost(pose.rock_rad) if edge_mm is None else edge_mm
    lift = (edge * pose.rock_rad).sum(axis=(1, 2))
    ride = np.zeros((len(rocked), 6))
    ride[:, :2] = moved - held.cells.r_z[:, None] * rocked
    ride[:, 2] = lift - (rocked * held.pivot_mm).sum(axis=1)
    ride[:, 3], ride[:, 4] = -rocked[:, 1], rocked[:, 0]
    return ride


def _search_with_drag(held: SolutionInputs, start: SupportSolution) -> SupportSolution:
    """Search with drag from the present supports, then from upright ones.

    A face that loses its hold lets the supports fall back, and touches them again upright.
    """
    found = _relaxed_drag(held, _motion_on_resting(held, start.q, start.pose), start.pose)
    lost = np.flatnonzero(~(found.residual <= TOLERANCE))
    if len(lost):
        part, pose = held.take(lost), start.pose.take(lost)
        upright = replace(pose, rock_rad=np.zeros_like(pose.rock_rad))
        q = _motion_on_resting(part, part.zero, upright)
        found = found.replaced(lost, _relaxed_drag(part, q, upright))
    return found


def _motion_on_resting(held: SolutionInputs, q: FloatArray, pose: SupportMotion) -> FloatArray:
    """Return the motion (B, 6) in equilibrium on supports that rest at ``pose``.

    The search from ``q`` can end where all cells slide. It is repeated from the unloaded grasp,
    where the normal forces are large and the cells stick.
    """
    ride = carried_motion(held, pose)
    zero = held.zero - ride
    relative, _, residual = solve_equilibrium(
        held.cells, held.anchor, q - ride, zero, held.stiffness
    )
    lost = np.flatnonzero(~(residual <= TOLERANCE))
    if len(lost):
        cells, anchor = held.cells.take(lost), held.anchor[:, lost]
        again = solve_equilibrium(cells, anchor, zero[lost], zero[lost], held.stiffness[lost])
        relative[lost] = again[0]
    return relative + ride


def _relaxed_drag(held: SolutionInputs, q: FloatArray, pose: SupportMotion) -> SupportSolution:
    """Follow the supports while they give way against a viscous drag, until they are at rest.

    Each pass is an implicit Euler step of duration 1 / drag. The drag falls after a step with a
    solution and rises after one without. The equilibrium found is the one that a slow motion of the
    supports reaches: a tower that tips about another edge passes states without equilibrium.
    """
    ends = SupportSolution(q, pose, np.full(len(q), np.inf))
    rows, drag, now = np.arange(len(q)), np.full(len(q), FIRST_DRAG_MM_RAD), ends
    for _ in range(MAX_DRAG_STEPS):
        slowly = replace(held, leaned_rad=now.pose.rock_rad, drag_mm_rad=drag)
        found = _solve_newton(slowly, now.q, now.pose)
        solved = found.residual <= TOLERANCE
        pull_mm = np.abs(found.pose.rock_rad - now.pose.rock_rad).max(axis=(1, 2)) * drag
        now = now.replaced(np.flatnonzero(solved), found.take(np.flatnonzero(solved)))
        drag = drag * np.where(solved, LESS_DRAG, MORE_DRAG)
        near = np.flatnonzero(solved & ((pull_mm < AT_REST_MM) | (drag < NO_DRAG_MM_RAD)))
        going = drag <= MAX_DRAG_MM_RAD
        if len(near):
            free = _solve_newton(held.take(near), now.q[near], now.pose.take(near))
            done = free.residual <= TOLERANCE
            ends = ends.replaced(rows[near[done]], free.take(np.flatnonzero(done)))
            going[near[done]] = False
        left = np.flatnonzero(going)
        if not len(left):
            break
        if len(left) < len(rows):
            rows, drag, now, held = rows[left], drag[left], now.take(left), held.take(left)
    return ends


def _solve_newton(held: SolutionInputs, q: FloatArray, pose: SupportMotion) -> SupportSolution:
    """Newton with step halving on piece and supports; finished probes are removed.

    During one step the edges are those of the last one: the lift of a body about a fixed edge is
    smooth at its upright position, the lift about the present edge is not.
    """
    ends = SupportSolution(q, pose, np.full(len(q), np.inf))
    rows = np.arange(len(q))
    rest = _ResidualTrial.at(held, q, pose, held.stand.area.foremost(pose.rock_rad))
    before = np.full(len(q), np.inf)
    for number in range(MAX_ITERATIONS):
        edge = rest.law.corner_mm
        rest = _ResidualTrial.at(held, rest.q, rest.pose, edge)
        going = rest.size > TOLERANCE
        if number % PATIENCE == 0:
            going &= rest.size < PROGRESS * before
            before = rest.size
        busy = np.flatnonzero(going)
        if len(busy) < len(rows):
            ends = ends.replaced(rows, rest.settled)
            if not len(busy):
                return ends
            rows, held, rest = rows[busy], held.take(busy), rest.take(busy)
            edge, before = edge[busy], before[busy]
        rest = _newton_step(held, edge, rest)
    return ends.replaced(rows, rest.settled)


def _newton_step(held: SolutionInputs, edge_mm: FloatArray, rest: _ResidualTrial) -> _ResidualTrial:
    """Apply one Newton step, halved for each probe until its residual falls."""
    count, m = rest.law.load_n.shape
    matrix = _jacobian(held, rest.q, rest.now, rest.law, edge_mm)
    laws = np.concatenate([rest.law.rock, rest.law.slide], axis=1).reshape(count, 4 * m)
    right = np.concatenate([rest.force, laws], axis=1)
    step = np.linalg.solve(matrix, -right[:, :, None])[:, :, 0]
    after = _ResidualTrial.at(held, *rest.gone(step), edge_mm)

    def at(rows: NDArray[np.intp], share: FloatArray) -> _ResidualTrial:
        tried = rest.take(rows).gone(share[:, None] * step[rows])
        return _ResidualTrial.at(held.take(rows), *tried, edge_mm[rows])

    halve_steps(after, rest.size, np.flatnonzero(~(after.size < rest.size)), HALVINGS, at)
    return after


@dataclass(frozen=True, slots=True)
class _ResidualTrial(BatchTrial):
    """A trial and its residuals: ``force`` (B, 6) of the piece in N and N·mm, and ``law``.

    ``size`` (B,): norm of both in N.
    """

    q: FloatArray
    pose: SupportMotion
    now: ContactForces
    law: SupportLaw
    force: FloatArray
    size: FloatArray

    @classmethod
    def at(
        cls, held: SolutionInputs, q: FloatArray, pose: SupportMotion, edge_mm: FloatArray
    ) -> _ResidualTrial:
        now = contact_forces(held.cells, held.anchor, q - carried_motion(held, pose, edge_mm))
        law = SupportLaw.at(held, q, pose, now)
        force = now.wrench - held.stiffness * (q - held.zero)
        size = np.sqrt(((force * RESIDUAL_SCALE) ** 2).sum(axis=1) + law.size**2)
        return cls(q, pose, now, law, force, size)

    @property
    def settled(self) -> SupportSolution:
        return SupportSolution(self.q, self.pose, self.size)

    def gone(self, step: FloatArray) -> tuple[FloatArray, SupportMotion]:
        """Return motion and supports after ``step`` (B, 6 + 4m)."""
        m = step.shape[1] // 4 - 1
        rock, slide = step[:, 6 : 6 + 2 * m], step[:, 6 + 2 * m :]
        return self.q + step[:, :6], SupportMotion(
            self.pose.rock_rad + rock.reshape(-1, m, 2),
            self.pose.slide_mm + slide.reshape(-1, m, 2),
        )


def _jacobian(
    held: SolutionInputs, q: FloatArray, now: ContactForces, law: SupportLaw, edge_mm: FloatArray
) -> FloatArray:
    """Return d(residuals)/d(q, rock, slide), (B, 6 + 4m, 6 + 4m)."""
    stand, count, m = held.stand, len(q), held.stand.interfaces
    width = 6 + 4 * m
    rock, slide = slice(6, 6 + 2 * m), slice(6 + 2 * m, width)
    # Only motion relative to the support changes the wrench on the piece.
    relative = np.zeros((count, 6, width))
    relative[:, :, :6] = np.eye(6)
    relative[:, :, rock] = -_carried_slope(held, edge_mm)
    relative[:, :2, slide] = -np.tile(AXES, (1, m))
    wrench = tangent_stiffness(held.cells, now) @ relative
    matrix = np.zeros((count, width, width))
    matrix[:, :6] = wrench
    matrix[:, range(6), range(6)] -= held.stiffness
    at = _resultant_slope(held, q, now, law, wrench)
    away = AXES - law.corner_slope
    rows = away @ at
    rows[..., rock] -= ROCK_MM_RAD * _block_diagonal(law.corner_slope)
    rigid = np.zeros((count, m, 2, width))
    rigid[..., rock] = ROCK_MM_RAD * _block_diagonal(np.broadcast_to(AXES, (count, m, 2, 2)))
    rows = np.where(stand.rocks[..., None, None], rows, rigid)
    matrix[:, rock] = rows.reshape(count, 2 * m, width)
    lateral = -wrench[:, None, :2]
    rows = (AXES - law.reach) @ lateral
    rows -= law.reach_load[..., None] * wrench[:, None, 2:3]
    rows[..., slide] -= SLIDE_N_MM * _block_diagonal(law.reach + VISCOUS * AXES)
    matrix[:, slide] = rows.reshape(count, 2 * m, width)
    return matrix


def _resultant_slope(
    held: SolutionInputs, q: FloatArray, now: ContactForces, law: SupportLaw, wrench: FloatArray
) -> FloatArray:
    """Return d(``at_mm``)/d(q, rock, slide), (B, m, 2, 6 + 4m); ``wrench``: that of the wrench."""
    stand, m = held.stand, held.stand.interfaces
    slope: FloatArray = moment_arms(held) @ wrench[:, None]
    spare = face_motion(held.cells, q)[:, None] - law.centre_mm
    slope += spare[..., None] * wrench[:, None, 2:3]
    face = np.zeros((len(q), 2, 6))
    face[:, :, :2] = AXES
    face[:, 0, 4], face[:, 1, 3] = held.cells.r_z, -held.cells.r_z
    slope[..., :6] += (now.wrench[:, 2, None, None] * face)[:, None]
    slope[..., 6 : 6 + 2 * m] += _for_both_axes(stand.rocked_nmm)
    slope[..., 6 + 2 * m :] += _for_both_axes(stand.moved_n)
    slope /= law.load_n[..., None, None]
    slope[..., 6 : 6 + 2 * m] -= _for_both_axes(
        interface_heights_mm(stand) + held.drag_mm_rad[:, None, None] * np.eye(m)
    )
    slope[..., 6 + 2 * m :] -= _for_both_axes(np.broadcast_to(np.tri(m), (len(q), m, m)))
    return slope


def _carried_slope(held: SolutionInputs, edge_mm: FloatArray) -> FloatArray:
    """Return d(``carried``)/d(rock), (B, 6, 2m)."""
    m = held.stand.interfaces
    up = held.stand.height_mm - held.cells.r_z[:, None]
    slope = np.zeros((len(up), 6, m, 2))
    slope[:, 0, :, 0] = slope[:, 1, :, 1] = up
    slope[:, 2] = edge_mm - held.pivot_mm[:, None]
    slope[:, 3, :, 1], slope[:, 4, :, 0] = -1.0, 1.0
    return slope.reshape(len(up), 6, 2 * m)


def _for_both_axes(per_pair: FloatArray) -> FloatArray:
    """Return (B, m, 2, 2m): the value of each pair of interfaces, for both axes."""
    m = per_pair.shape[1]
    both = per_pair[:, :, None, :, None] * AXES[None, None, :, None, :]
    return np.asarray(both.reshape(-1, m, 2, 2 * m))


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """Return (B, m, 2, 2m) with the block (2, 2) of each interface under its own unknowns."""
    m = blocks.shape[1]
    wide = np.eye(m)[None, :, None, :, None] * blocks[:, :, :, None, :]
    return np.asarray(wide.reshape(-1, m, 2, 2 * m))
