"""Batched equilibrium of an elastic face contact, solved by a damped Newton method.

Elastic foundation on the true overlap, with sliders that store friction. The face below the pivot
has the constant height r_z, so the six motions q act on it through three in the plane (p, t,
rotation about z) and three out of it (q_z, rot_x, rot_y); all sums over cells are moments of
{1, x, y, x², xy, y²}. Newton's method solves R(q) = contact wrench - K (q - q°) = 0. Each probe
uses the first halving of its step that lowers its residual. For the last few probes several
halvings are evaluated at once; the result does not depend on their number.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.simulation.rows import Rows

TINY = 1e-12


@dataclass(frozen=True, slots=True)
class ContactCells(Rows):
    """Overlap cells of B probes, packed to the widest of them (n), absent ones with area 0.

    ``x``, ``y`` (B, n): lever arms r_x, r_y from the pivot, mm; ``gap_mm`` z0 (B, n);
    ``normal``, ``tangential`` (B, n): stiffness k a in N/mm; ``basis`` (B, n, 6); ``r_z`` (B,);
    ``mu`` (B, 1); ``count`` (B,): number of overlap cells.
    """

    x: FloatArray
    y: FloatArray
    gap_mm: FloatArray
    normal: FloatArray
    tangential: FloatArray
    basis: FloatArray
    r_z: FloatArray
    mu: FloatArray
    count: NDArray[np.intp]


@dataclass(slots=True)
class ContactForces(Rows):
    """Motion (mm) and forces (N) of the cells at one trial, all (B, n); their resultant (B, 6).

    ``size``: of the pull, at least ``TINY``; ``share`` of it that friction bears.
    """

    u_x: FloatArray
    u_y: FloatArray
    normal_n: FloatArray
    pull_x: FloatArray
    pull_y: FloatArray
    size: FloatArray
    share: FloatArray
    wrench: FloatArray


def pack_cells(
    points_mm: FloatArray, inside: NDArray[np.bool_]
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Move the cells ``inside`` (B, N) to the front; return (B, n, 2) and (B, n) existing."""
    count = inside.sum(axis=1)
    width = max(int(count.max(initial=0)), 1)
    order = np.argsort(~inside, axis=1, kind="stable")[:, :width]
    packed = np.take_along_axis(points_mm, order[..., None], axis=1)
    return packed, np.arange(width) < count[:, None]


def merge_points(
    points_mm: FloatArray, cell_mm: float, placed_mm: FloatArray, inside: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Merge the points of each lattice cell; return centres (B, n, 2) and numbers of points (B, n).

    ``points_mm`` (N, 2) on the face belong to the cells of ``cell_mm`` around whole multiples of
    it. ``placed_mm`` (B, N, 2): the same points of each probe; those ``inside`` (B, N) count. The
    centre of a cell is that of its points. Cells without points are packed last.
    """
    cell = np.round(points_mm / cell_mm)
    order = np.lexsort(cell.T)
    first = np.flatnonzero(np.append(True, np.diff(cell[order], axis=0).any(axis=1)))
    weight = inside[:, order].astype(np.float64)
    number = np.add.reduceat(weight, first, axis=1)
    total = np.add.reduceat(weight[..., None] * placed_mm[:, order], first, axis=1)
    packed, exists = pack_cells(total / np.maximum(number, 1.0)[..., None], number > 0.0)
    front = np.argsort(number == 0.0, axis=1, kind="stable")[:, : exists.shape[1]]
    return packed, np.take_along_axis(number, front, axis=1)


def surface_motion(cells: ContactCells, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return u_x, u_y, u_z (B, n) of every cell."""
    p = (q[:, 0] + q[:, 4] * cells.r_z)[:, None]
    t = (q[:, 1] - q[:, 3] * cells.r_z)[:, None]
    u_x, u_y = q[:, 5:6] * cells.y, q[:, 5:6] * cells.x
    np.subtract(p, u_x, out=u_x)
    u_y += t
    u_z = q[:, 3:4] * cells.y
    u_z += q[:, 2:3]
    u_z -= q[:, 4:5] * cells.x
    return u_x, u_y, u_z


def contact_forces(cells: ContactCells, anchor: FloatArray, q: FloatArray) -> ContactForces:
    """Return the cell forces for motion ``q`` (B, 6) with slider anchors ``anchor`` (2, B, n)."""
    # In place where it can be: a batch of episodes spends most of its time here.
    u_x, u_y, normal_n = surface_motion(cells, q)
    np.subtract(cells.gap_mm, normal_n, out=normal_n)
    np.maximum(normal_n, 0.0, out=normal_n)
    normal_n *= cells.normal
    pull_x, pull_y = u_x - anchor[0], u_y - anchor[1]
    pull_x *= cells.tangential
    pull_y *= cells.tangential
    size, spare = pull_x * pull_x, pull_y * pull_y
    size += spare
    np.sqrt(size, out=size)
    np.maximum(size, TINY, out=size)
    share = cells.mu * normal_n
    share /= size
    np.minimum(share, 1.0, out=share)
    forces = np.empty((len(q), 3, normal_n.shape[1]))
    np.negative(share, out=spare)
    np.multiply(pull_x, spare, out=forces[:, 0])
    np.multiply(pull_y, spare, out=forces[:, 1])
    forces[:, 2] = normal_n
    sums = forces @ cells.basis[:, :, :3]
    wrench = np.empty((len(q), 6))
    wrench[:, :3] = sums[:, :, 0]
    wrench[:, 3] = sums[:, 2, 2] - cells.r_z * sums[:, 1, 0]
    wrench[:, 4] = cells.r_z * sums[:, 0, 0] - sums[:, 2, 1]
    wrench[:, 5] = sums[:, 1, 1] - sums[:, 0, 2]
    return ContactForces(u_x, u_y, normal_n, pull_x, pull_y, size, share, wrench)


def tangent_stiffness(cells: ContactCells, now: ContactForces) -> FloatArray:
    """Return d(wrench)/dq (B, 6, 6), the unsymmetric friction-normal coupling included."""
    slides = now.share < 1.0
    touching = now.normal_n > 0.0
    direction_x, direction_y = now.pull_x / now.size, now.pull_y / now.size
    stiff = cells.tangential * now.share
    along = slides * stiff
    rows = np.empty((len(cells.x), 6, cells.x.shape[1]))
    along_x = along * direction_x
    np.subtract(np.multiply(along_x, direction_x, out=rows[:, 0]), stiff, out=rows[:, 0])
    np.multiply(along_x, direction_y, out=rows[:, 1])
    along *= direction_y
    np.subtract(np.multiply(along, direction_y, out=along), stiff, out=rows[:, 2])
    normal = np.multiply(cells.normal, touching, out=stiff)
    np.negative(normal, out=rows[:, 5])
    normal *= slides
    normal *= cells.mu
    np.multiply(normal, direction_x, out=rows[:, 3])
    np.multiply(normal, direction_y, out=rows[:, 4])
    return _assemble(rows @ cells.basis, cells.r_z)


def _assemble(m: FloatArray, r_z: FloatArray) -> FloatArray:
    """Assemble the (B, 6, 6) matrix from the moments ``m`` (B, 6 rows, 6 basis functions)."""
    one, x, y, xx, xy, yy = range(6)
    d_xx, d_xy, d_yy, c_x, c_y, d_n = (m[:, k] for k in range(6))
    j = np.zeros((len(m), 6, 6))
    j[:, 0, 0], j[:, 1, 1] = d_xx[:, one], d_yy[:, one]
    j[:, 0, 1] = j[:, 1, 0] = d_xy[:, one]
    j[:, 0, 5] = j[:, 5, 0] = d_xy[:, x] - d_xx[:, y]
    j[:, 1, 5] = j[:, 5, 1] = d_yy[:, x] - d_xy[:, y]
    j[:, 5, 5] = d_xx[:, yy] - 2.0 * d_xy[:, xy] + d_yy[:, xx]
    j[:, 0, 2], j[:, 0, 3], j[:, 0, 4] = c_x[:, one], c_x[:, y], -c_x[:, x]
    j[:, 1, 2], j[:, 1, 3], j[:, 1, 4] = c_y[:, one], c_y[:, y], -c_y[:, x]
    j[:, 5, 2] = c_y[:, x] - c_x[:, y]
    j[:, 5, 3] = c_y[:, xy] - c_x[:, yy]
    j[:, 5, 4] = c_x[:, xy] - c_y[:, xx]
    j[:, 2, 2], j[:, 3, 3], j[:, 4, 4] = d_n[:, one], d_n[:, yy], d_n[:, xx]
    j[:, 2, 3] = j[:, 3, 2] = d_n[:, y]
    j[:, 2, 4] = j[:, 4, 2] = -d_n[:, x]
    j[:, 3, 4] = j[:, 4, 3] = -d_n[:, xy]
    lever = r_z[:, None]
    # From face to pivot motions: p = q_x + r_z rot_y, t = q_y - r_z rot_x
    j[:, :, 4] += lever * j[:, :, 0]
    j[:, :, 3] -= lever * j[:, :, 1]
    j[:, 4, :] += lever * j[:, 0, :]
    j[:, 3, :] -= lever * j[:, 1, :]
    return j


def updated_anchor(cells: ContactCells, now: ContactForces) -> FloatArray:
    """Return the anchors (2, B, n) after the step: dragged where sliding, free where lifted."""
    back = now.share / np.maximum(cells.tangential, TINY)
    anchor = np.empty((2, *back.shape))
    np.subtract(now.u_x, back * now.pull_x, out=anchor[0])
    np.subtract(now.u_y, back * now.pull_y, out=anchor[1])
    return anchor


TRIALS_PER_CALL = 48  # trials solved in one call; fewer do not pay its fixed cost


class BatchTrial(Rows):
    """Trial solution of B probes with residuals ``size`` (B,)."""

    __slots__ = ()
    size: FloatArray


AnyTrial = TypeVar("AnyTrial", bound=BatchTrial)


def halve_steps(
    now: AnyTrial,
    before: FloatArray,
    rows: NDArray[np.intp],
    most: int,
    at: Callable[[NDArray[np.intp], FloatArray], AnyTrial],
) -> None:
    """Replace in ``now`` the full steps of ``rows``, which did not lower their residuals.

    ``before`` (B,): residuals to be lowered. ``at``: evaluates fractions (k,) of the steps of the
    probes (k,). At most ``most`` steps are tried, the full one included; the last is kept if none
    is better.
    """
    done = 1
    while len(rows) and done < most:
        count = min(most - done, max(1, TRIALS_PER_CALL // len(rows)))
        each = np.repeat(rows, count)
        tried = at(each, np.tile(0.5 ** np.arange(done, done + count), len(rows)))
        better = (tried.size < before[each]).reshape(-1, count)
        fell = better.any(axis=1)
        first = np.where(fell, better.argmax(axis=1), count - 1)
        now.put(rows, tried.take(first + count * np.arange(len(rows))))
        rows = rows[~fell]
        done += count


# Forces in N; moments divided by 20 mm.
RESIDUAL_SCALE = np.array([1.0, 1.0, 1.0, 1 / 20.0, 1 / 20.0, 1 / 20.0])
TOLERANCE = 1e-6
RESIDUAL_LIMIT = 1e-4  # largest scaled residual of a usable step
MAX_ITERATIONS = 60
HALVINGS = 10
COMPRESS_BELOW_SHARE = 0.6  # unfinished probes are solved separately below this share


def solve_equilibrium(
    cells: ContactCells,
    anchor: FloatArray,
    start: FloatArray,
    zero: FloatArray,
    stiffness: FloatArray,
    iterations: int = MAX_ITERATIONS,
) -> tuple[FloatArray, ContactForces, FloatArray]:
    """Return (q (B, 6), cell forces there, scaled residual (B,)).

    ``start`` (B, 6): first guess; ``zero`` q° (B, 6); ``stiffness`` (B, 6): diagonal of K.
    Steps that do not lower the residual of a probe are halved for that probe alone.
    """
    spring = _SpringLoad(cells, anchor, zero, stiffness)
    now = spring.at(start + 0.0)
    ends, rows = now, np.arange(len(start))  # ``now`` holds the probes ``rows`` of ``ends``
    for _ in range(iterations):
        busy = now.size > TOLERANCE
        count = np.count_nonzero(busy)
        if not count:
            break
        if count <= COMPRESS_BELOW_SHARE * len(rows):
            # Solve the unfinished probes separately.
            few = np.flatnonzero(busy)
            if now is not ends:
                ends.put(rows, now)
            rows, spring, now, busy = rows[few], spring.take(few), now.take(few), busy[few]
        matrix = tangent_stiffness(spring.cells, now.touch)
        matrix[:, _DIAGONAL, _DIAGONAL] -= spring.stiffness
        step = np.asarray(np.linalg.solve(matrix, -now.left[:, :, None])[:, :, 0], np.float64)
        step[~busy] = 0.0
        whole = now is ends
        now = _newton_step(spring, now, step, busy)
        ends = now if whole else ends
    if now is not ends:
        ends.put(rows, now)
    return ends.q, ends.touch, ends.size


@dataclass(slots=True)
class _MotionTrial(BatchTrial):
    """Motion ``q`` (B, 6), contact forces, residual ``left`` (B, 6) and its norm ``size`` (B,)."""

    q: FloatArray
    touch: ContactForces
    left: FloatArray
    size: FloatArray


@dataclass(frozen=True, slots=True)
class _SpringLoad(Rows):
    """Inputs of ``solve_equilibrium``."""

    cells: ContactCells
    anchor: FloatArray
    zero: FloatArray
    stiffness: FloatArray

    def at(self, q: FloatArray) -> _MotionTrial:
        there = contact_forces(self.cells, self.anchor, q)
        left = there.wrench - self.stiffness * (q - self.zero)
        scaled = left * RESIDUAL_SCALE
        return _MotionTrial(q, there, left, np.sqrt((scaled * scaled).sum(axis=1)))


def _newton_step(
    spring: _SpringLoad, now: _MotionTrial, step: FloatArray, busy: NDArray[np.bool_]
) -> _MotionTrial:
    """Apply one Newton step, halved for each probe until its residual falls."""
    after = spring.at(now.q + step)

    def at(rows: NDArray[np.intp], share: FloatArray) -> _MotionTrial:
        return spring.take(rows).at(now.q[rows] + share[:, None] * step[rows])

    worse = np.flatnonzero(busy & ~(after.size < now.size))
    halve_steps(after, now.size, worse, HALVINGS, at)
    return after


_DIAGONAL = np.arange(6)
