"""Equilibrium of a piece pressed on bottoms that may rock and slide, batched over probes.

Unknowns: the motion q of the piece, and at each interface the rocking a and the sliding s. Both
obey the same law: the resultant c lies in the support polygon and a is normal to it there; the
lateral force T lies in the friction disc and s is normal to it there. Each is written as
``c = nearest point to (c + a)`` and solved together with the piece by Newton's method. Probes whose
supports stay as they are cost one check.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation.contact import Touch, tangent, touch
from backend.simulation.equilibrium import RESIDUAL_LIMIT, SCALE, TOLERANCE, balance
from backend.simulation.halving import fall
from backend.simulation.support import Pose, below_mm
from backend.simulation.support_law import (
    AXES,
    ROCK_MM_RAD,
    SLIDE_N_MM,
    Held,
    Law,
    face_motion,
    levers,
)

MAX_ITERATIONS = 40
HALVINGS = 12
PATIENCE, PROGRESS = 8, 0.5
"""A search whose residual has not fallen to this share in so many iterations is given up."""
DRAGS_MM_RAD = (1e8, 1e7, 1e6, 1e5, 1e4, 1e3, 1e2, 1e1)
VISCOUS = 1e-6
"""Keeps the matrix regular where face and table slide at once; the residual is without it."""


@dataclass(frozen=True, slots=True)
class Settled:
    """A trial solution: motion ``q`` (B, 6), supports, scaled ``residual`` (B,)."""

    q: FloatArray
    pose: Pose
    residual: FloatArray

    def replaced(self, rows: NDArray[np.intp], by: Settled) -> Settled:
        """Return a copy in which the probes ``rows`` are those of ``by``."""
        q, residual = self.q.copy(), self.residual.copy()
        q[rows], residual[rows] = by.q, by.residual
        return Settled(q, self.pose.replaced(rows, by.pose), residual)

    def take(self, rows: NDArray[np.intp]) -> Settled:
        """Return the probes ``rows``."""
        return Settled(self.q[rows], self.pose.take(rows), self.residual[rows])


def settle(
    held: Held, q: FloatArray, pose: Pose, alive: NDArray[np.bool_], *, eased: bool
) -> Settled:
    """Return the equilibrium nearest to the guess ``q`` (B, 6), ``pose``.

    The supports of probes that are no longer ``alive`` (B,) stay, with a residual of infinity.
    ``eased``: search harder where nothing was found.
    """
    start = _kept(held, q, pose)
    rows = np.flatnonzero(alive & ~(start.residual <= TOLERANCE))
    if not len(rows):
        return start
    loose = held.take(rows)
    found = _together(loose, start.q[rows], start.pose.take(rows))
    lost = np.flatnonzero(~(found.residual <= TOLERANCE))
    if eased and len(lost):
        again = _eased(loose.take(lost), start.q[rows[lost]], start.pose.take(rows[lost]))
        found = found.replaced(lost, again)
    # A press without balance goes on as on rigid supports: no forces out of a lost search.
    usable = np.flatnonzero(found.residual <= RESIDUAL_LIMIT)
    return start.replaced(rows[usable], found.take(usable))


def _kept(held: Held, q: FloatArray, pose: Pose) -> Settled:
    """Return the equilibrium on supports that stay; residual infinity where they may not."""
    q, now, residual = _fixed(held, q, pose)
    law = Law.at(held, q, pose, now)
    return Settled(q, pose, np.where(law.size <= TOLERANCE, residual, np.inf))


def carried(held: Held, pose: Pose, edge_mm: FloatArray | None = None) -> FloatArray:
    """Return (B, 6): motion of the touched face as a motion about the pivot, like q.

    ``edge_mm`` (B, m, 2): points that stay down; None: those that the rocking leaves down.
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


def _eased(held: Held, q: FloatArray, pose: Pose) -> Settled:
    """Let the supports give way against a drag, and take it away by and by.

    Between sticking and sliding of the faces lies a way of 0.001 mm, a micro-radian of a tower:
    without drag the search leaps over it.
    """
    now = Settled(q, pose, np.full(len(q), np.inf))
    for drag in DRAGS_MM_RAD:
        slowly = replace(held, leaned_rad=now.pose.rock_rad, drag_mm_rad=drag)
        found = _together(slowly, now.q, now.pose)
        there = np.flatnonzero(found.residual <= TOLERANCE)
        now = now.replaced(there, found.take(there))
    return _together(held, now.q, now.pose)


def _fixed(held: Held, q: FloatArray, pose: Pose) -> tuple[FloatArray, Touch, FloatArray]:
    """Return q (B, 6), forces and residual of the equilibrium on supports that stay at ``pose``."""
    ride = carried(held, pose)
    relative, now, residual = balance(
        held.cells, held.anchor, q - ride, held.zero - ride, held.stiffness
    )
    return relative + ride, now, residual


def _together(held: Held, q: FloatArray, pose: Pose) -> Settled:
    """Newton with step halving on piece and supports at once; finished probes are laid aside.

    During one step the edges stay where the last one found them: the lift of a body about a given
    edge is smooth through its upright position, that about the edge it happens to lean on is not.
    """
    ends = Settled(q, pose, np.full(len(q), np.inf))
    rows = np.arange(len(q))
    rest = _Rest.at(held, q, pose, held.stand.area.foremost(pose.rock_rad))
    before = np.full(len(q), np.inf)
    for number in range(MAX_ITERATIONS):
        edge = rest.law.corner_mm
        rest = _Rest.at(held, rest.q, rest.pose, edge)
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
        rest = _stepped(held, edge, rest)
    return ends.replaced(rows, rest.settled)


def _stepped(held: Held, edge_mm: FloatArray, rest: _Rest) -> _Rest:
    """Go one Newton step, halved for each probe until its residual falls."""
    count, m = rest.law.load_n.shape
    matrix = _matrix(held, rest.q, rest.now, rest.law, edge_mm)
    laws = np.concatenate([rest.law.rock, rest.law.slide], axis=1).reshape(count, 4 * m)
    right = np.concatenate([rest.force, laws], axis=1)
    step = np.linalg.solve(matrix, -right[:, :, None])[:, :, 0]
    after = _Rest.at(held, *rest.gone(step), edge_mm)

    def at(rows: NDArray[np.intp], share: FloatArray) -> _Rest:
        tried = rest.take(rows).gone(share[:, None] * step[rows])
        return _Rest.at(held.take(rows), *tried, edge_mm[rows])

    fall(after, rest.size, np.flatnonzero(~(after.size < rest.size)), HALVINGS, at)
    return after


@dataclass(frozen=True, slots=True)
class _Rest:
    """A trial, and what is missing there to balance: of the piece ``force`` (B, 6) in N and N·mm,
    of the ``law``. ``size`` (B,): both as one number in N.
    """

    q: FloatArray
    pose: Pose
    now: Touch
    law: Law
    force: FloatArray
    size: FloatArray

    @classmethod
    def at(cls, held: Held, q: FloatArray, pose: Pose, edge_mm: FloatArray) -> _Rest:
        now = touch(held.cells, held.anchor, q - carried(held, pose, edge_mm))
        law = Law.at(held, q, pose, now)
        force = now.wrench - held.stiffness * (q - held.zero)
        size = np.sqrt(((force * SCALE) ** 2).sum(axis=1) + law.size**2)
        return cls(q, pose, now, law, force, size)

    @property
    def settled(self) -> Settled:
        return Settled(self.q, self.pose, self.size)

    def gone(self, step: FloatArray) -> tuple[FloatArray, Pose]:
        """Return motion and supports one ``step`` (B, 6 + 4m) further."""
        m = step.shape[1] // 4 - 1
        rock, slide = step[:, 6 : 6 + 2 * m], step[:, 6 + 2 * m :]
        return self.q + step[:, :6], Pose(
            self.pose.rock_rad + rock.reshape(-1, m, 2),
            self.pose.slide_mm + slide.reshape(-1, m, 2),
        )

    def take(self, rows: NDArray[np.intp]) -> _Rest:
        """Return the probes ``rows``."""
        now, law = self.now.take(rows), self.law.take(rows)
        return _Rest(
            self.q[rows], self.pose.take(rows), now, law, self.force[rows], self.size[rows]
        )

    def put(self, rows: NDArray[np.intp], by: _Rest) -> None:
        """Overwrite the probes ``rows``."""
        self.q[rows], self.force[rows], self.size[rows] = by.q, by.force, by.size
        self.pose.rock_rad[rows] = by.pose.rock_rad
        self.pose.slide_mm[rows] = by.pose.slide_mm
        self.now.put(rows, by.now)
        self.law.put(rows, by.law)


def _matrix(held: Held, q: FloatArray, now: Touch, law: Law, edge_mm: FloatArray) -> FloatArray:
    """Return d(residuals)/d(q, rock, slide), (B, 6 + 4m, 6 + 4m)."""
    stand, count, m = held.stand, len(q), held.stand.interfaces
    width = 6 + 4 * m
    rock, slide = slice(6, 6 + 2 * m), slice(6 + 2 * m, width)
    # Only motion relative to the support changes the wrench on the piece.
    relative = np.zeros((count, 6, width))
    relative[:, :, :6] = np.eye(6)
    relative[:, :, rock] = -_ride_rock(held, edge_mm)
    relative[:, :2, slide] = -np.tile(AXES, (1, m))
    wrench = tangent(held.cells, now) @ relative
    matrix = np.zeros((count, width, width))
    matrix[:, :6] = wrench
    matrix[:, range(6), range(6)] -= held.stiffness
    at = _resultant_slope(held, q, now, law, wrench)
    away = AXES - law.corner_slope
    rows = away @ at
    rows[..., rock] -= ROCK_MM_RAD * _each(law.corner_slope)
    rigid = np.zeros((count, m, 2, width))
    rigid[..., rock] = ROCK_MM_RAD * _each(np.broadcast_to(AXES, (count, m, 2, 2)))
    rows = np.where(stand.rocks[..., None, None], rows, rigid)
    matrix[:, rock] = rows.reshape(count, 2 * m, width)
    lateral = -wrench[:, None, :2]
    rows = (AXES - law.reach) @ lateral
    rows -= law.reach_load[..., None] * wrench[:, None, 2:3]
    rows[..., slide] -= SLIDE_N_MM * _each(law.reach + VISCOUS * AXES)
    matrix[:, slide] = rows.reshape(count, 2 * m, width)
    return matrix


def _resultant_slope(
    held: Held, q: FloatArray, now: Touch, law: Law, wrench: FloatArray
) -> FloatArray:
    """Return d(``at_mm``)/d(q, rock, slide), (B, m, 2, 6 + 4m); ``wrench``: that of the wrench."""
    stand, m = held.stand, held.stand.interfaces
    slope: FloatArray = levers(held) @ wrench[:, None]
    spare = face_motion(held.cells, q)[:, None] - law.centre_mm
    slope += spare[..., None] * wrench[:, None, 2:3]
    face = np.zeros((len(q), 2, 6))
    face[:, :, :2] = AXES
    face[:, 0, 4], face[:, 1, 3] = held.cells.r_z, -held.cells.r_z
    slope[..., :6] += (now.wrench[:, 2, None, None] * face)[:, None]
    slope[..., 6 : 6 + 2 * m] += _spread(stand.rocked_nmm)
    slope[..., 6 + 2 * m :] += _spread(stand.moved_n)
    slope /= law.load_n[..., None, None]
    slope[..., 6 : 6 + 2 * m] -= _spread(below_mm(stand) + held.drag_mm_rad * np.eye(m))
    slope[..., 6 + 2 * m :] -= _spread(np.broadcast_to(np.tri(m), (len(q), m, m)))
    return slope


def _ride_rock(held: Held, edge_mm: FloatArray) -> FloatArray:
    """Return d(``carried``)/d(rock), (B, 6, 2m)."""
    m = held.stand.interfaces
    up = held.stand.height_mm - held.cells.r_z[:, None]
    slope = np.zeros((len(up), 6, m, 2))
    slope[:, 0, :, 0] = slope[:, 1, :, 1] = up
    slope[:, 2] = edge_mm - held.pivot_mm[:, None]
    slope[:, 3, :, 1], slope[:, 4, :, 0] = -1.0, 1.0
    return slope.reshape(len(up), 6, 2 * m)


def _spread(per_pair: FloatArray) -> FloatArray:
    """Return (B, m, 2, 2m): the number of each pair of interfaces, for both axes."""
    m = per_pair.shape[1]
    both = per_pair[:, :, None, :, None] * AXES[None, None, :, None, :]
    return np.asarray(both.reshape(-1, m, 2, 2 * m))


def _each(blocks: FloatArray) -> FloatArray:
    """Return (B, m, 2, 2m) with the block (2, 2) of each interface under its own unknowns."""
    m = blocks.shape[1]
    wide = np.eye(m)[None, :, None, :, None] * blocks[:, :, :, None, :]
    return np.asarray(wide.reshape(-1, m, 2, 2 * m))
