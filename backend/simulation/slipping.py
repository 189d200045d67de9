"""Equilibrium of one time step with slip in the grasp: return mapping round the balance.

On rigid supports all probes of a batch take equally many passes. Where supports give way a pass
costs far more, and each probe ends with its own last one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation import grasp
from backend.simulation.conditions import Conditions
from backend.simulation.contact import Cells, Touch, touch
from backend.simulation.equilibrium import RESIDUAL_LIMIT, balance
from backend.simulation.support import Pose, Stand
from backend.simulation.support_law import Held
from backend.simulation.supported import carried, settle

SLIP_TOLERANCE = 1e-5
SLIP_PASSES = 200


@dataclass(frozen=True, slots=True)
class Step:
    """What a time step of B probes is given.

    ``commanded_mm`` (B, 3); ``stand``: what carries the touched face, None if that is rigid;
    ``pivot_mm`` (B, 2): ``G`` over ``O``; ``pose`` of the supports at its beginning. ``last``: the
    step is not split any further.
    """

    cells: Cells
    anchor: FloatArray
    conditions: Conditions
    spring: grasp.Springs
    commanded_mm: FloatArray
    stand: Stand | None
    pivot_mm: FloatArray
    pose: Pose
    last: bool

    def take(self, rows: NDArray[np.intp]) -> Step:
        """Return the probes ``rows``."""
        return Step(
            self.cells.take(rows),
            self.anchor[:, rows],
            self.conditions.take(rows),
            self.spring.take(rows),
            self.commanded_mm[rows],
            None if self.stand is None else self.stand.take(rows),
            self.pivot_mm[rows],
            self.pose.take(rows),
            self.last,
        )

    def held(self, zero: FloatArray, stand: Stand) -> Held:
        """Return the grasp with the elastic zero ``zero`` (B, 6) on ``stand``."""
        return Held(
            self.cells,
            self.anchor,
            zero,
            self.spring.matrix_diagonal,
            stand,
            self.pivot_mm,
            self.pose.slide_mm,
            self.pose.rock_rad,
        )


@dataclass(frozen=True, slots=True)
class Grip:
    """A trial solution of B probes.

    ``q`` (B, 6); ``pose`` of the supports; ``slip`` (B, 2, 3), for which everything is in balance;
    ``d`` (B, 2, 4): motion relative to the pads; ``normal_n`` (B, 2); ``residual`` (B,);
    ``alive`` (B,): probes whose supports have found their balance so far.
    """

    q: FloatArray
    pose: Pose
    slip: FloatArray
    d: FloatArray
    normal_n: FloatArray
    residual: FloatArray
    alive: NDArray[np.bool_]

    @classmethod
    def begun(cls, q: FloatArray, pose: Pose, slip: FloatArray, alive: NDArray[np.bool_]) -> Grip:
        """Return where to begin the search."""
        count = len(q)
        return cls(
            q, pose, slip, np.zeros((count, 2, 4)), np.zeros((count, 2)), np.zeros(count), alive
        )

    def take(self, rows: NDArray[np.intp]) -> Grip:
        """Return the probes ``rows``."""
        return Grip(
            self.q[rows],
            self.pose.take(rows),
            self.slip[rows],
            self.d[rows],
            self.normal_n[rows],
            self.residual[rows],
            self.alive[rows],
        )

    def replaced(self, rows: NDArray[np.intp], by: Grip) -> Grip:
        """Return a copy in which the probes ``rows`` are those of ``by``."""
        parts = {}
        for name in ("q", "slip", "d", "normal_n", "residual", "alive"):
            parts[name] = getattr(self, name).copy()
            parts[name][rows] = getattr(by, name)
        return Grip(pose=self.pose.replaced(rows, by.pose), **parts)


def gripped(step: Step, start: Grip) -> tuple[Grip, Touch]:
    """Return the equilibrium near ``start`` in which no pad slips any more, and its cell forces.

    Never raises for lack of convergence: the residual is infinite then.
    """
    if step.stand is None:
        return _together(step, start)
    return _each_for_itself(step, step.stand, start)


def _together(step: Step, start: Grip) -> tuple[Grip, Touch]:
    now = start
    for _ in range(SLIP_PASSES):
        zero = _zero(step, now.slip)
        q, there, residual = balance(
            step.cells, step.anchor, now.q, zero, step.spring.matrix_diagonal
        )
        now, mapped = _mapped(step, replace(now, q=q, residual=residual), zero)
        if np.abs(mapped - now.slip).max(initial=0.0) < SLIP_TOLERANCE:
            return now, there
        now = replace(now, slip=mapped)
    return replace(now, residual=np.full_like(now.residual, np.inf)), there


def _each_for_itself(step: Step, stand: Stand, start: Grip) -> tuple[Grip, Touch]:
    rows = np.arange(len(start.q))
    ends, part, now = start, step, start
    for _ in range(SLIP_PASSES):
        assert part.stand is not None
        zero = _zero(part, now.slip)
        held = part.held(zero, part.stand)
        settled = settle(held, now.q, now.pose, now.alive, eased=step.last)
        now = replace(
            now,
            q=settled.q,
            pose=settled.pose,
            residual=settled.residual,
            alive=now.alive & (settled.residual <= RESIDUAL_LIMIT),
        )
        now, mapped = _mapped(part, now, zero)
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
    ride = carried(step.held(np.zeros_like(ends.q), stand), ends.pose)
    return ends, touch(step.cells, step.anchor, ends.q - ride)


def _zero(step: Step, slip: FloatArray) -> FloatArray:
    unloaded = step.spring.hidden.copy()
    unloaded[:, :, :3] += slip
    return grasp.elastic_zero(step.commanded_mm, unloaded, step.conditions.width_mm)


def _mapped(step: Step, now: Grip, zero: FloatArray) -> tuple[Grip, FloatArray]:
    """Return ``now`` with the motion of the pads, and the slip mapped back."""
    conditions, spring = step.conditions, step.spring
    d = grasp.pad_motion(now.q, zero, step.commanded_mm, spring.give, conditions.width_mm)
    normal_n = grasp.normal_force_n(d, spring, conditions.grip_force_n)
    mapped = grasp.returned_slip(now.slip, d, spring, normal_n, conditions)
    return replace(now, d=d, normal_n=normal_n), mapped
