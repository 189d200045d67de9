"""Jaws that open in small held steps around a piece that its support carries, in time.

The piece turns about one edge of its support: a rigid pendulum with the angle ``a``, positive away
from the support. Its foot does not slide. The pads are springs with the limit surface of
``mechanics``; their capacity falls with the normal force. As long as they hold, the motion is
quasi-static (an overdamped spring); once they slip, it is that of the pendulum under gravity, the
friction of the pads and the fingers that it leans on. The support stops it inelastically.

Finger index 0 is left (y = +w/2), 1 is right. Strains are x (mm), z (mm) and rotation about the jaw
axis (rad), as in ``mechanics``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.simulation.mechanics import SIGN
from touchdown.backend.simulation.rows import Rows

FALLEN_RAD = np.radians(12.0)  # the motion ends there
MM_PER_M = 1e3  # 1 N is 1000 kg mm/s²
STILL_RAD_S = 1e-7  # slower motion ends with the step of the jaws that caused it
GEL_LOSS_S = 1e-3  # damping of the pads over their stiffness
SUPPORTED_S = 0.5  # time between the unloading and the first step


@dataclass(frozen=True, slots=True)
class StandingPiece(Rows):
    """B pieces on their supports; each may turn about the edge nearest to its centre of mass.

    ``margin_mm`` (B,): distance of the centre of mass inside this edge, negative outside;
    ``span_mm`` (B,): width of the support at right angles to it; ``axis_rad`` (B,): direction from
    x in which the piece falls; ``com_height_mm`` (B,); ``weight_n`` (B,); ``inertia_kg_mm2`` (B,)
    about the centre of mass; ``grip_height_mm`` (B,) of the pads; ``pads_mm`` (B, 2): distance of
    the pads inside the edge.
    """

    margin_mm: FloatArray
    span_mm: FloatArray
    axis_rad: FloatArray
    com_height_mm: FloatArray
    weight_n: FloatArray
    inertia_kg_mm2: FloatArray
    grip_height_mm: FloatArray
    pads_mm: FloatArray

    def gravity_nmm(self, angle_rad: FloatArray, side: FloatArray) -> FloatArray:
        """Return the moment (B,) of the weight that increases the angle.

        ``side`` (B,): 1 about the edge, -1 about the opposite edge of the support.
        """
        lever = np.where(side > 0.0, -self.margin_mm, self.span_mm - self.margin_mm)
        swing = self.com_height_mm * np.sin(angle_rad) + lever * np.cos(angle_rad)
        return np.asarray(self.weight_n * swing, dtype=np.float64)

    def edge_inertia_kg_mm2(self, side: FloatArray) -> FloatArray:
        """Return the inertia (B,) about the edge of ``side``."""
        lever = np.where(side > 0.0, self.margin_mm, self.span_mm - self.margin_mm)
        mass_kg = self.weight_n / 9.80665
        return self.inertia_kg_mm2 + mass_kg * (lever**2 + self.com_height_mm**2)


@dataclass(frozen=True, slots=True)
class LoosePads(Rows):
    """Pads of B grips: stiffness of one gel, friction, and what the unloading left in them.

    ``stiffness`` (B, 3): x and z (N/mm), torsion (N·mm/rad); ``normal_n_mm`` (B,); ``mu_grip``
    (B,); ``limit_radius_mm`` (B,); ``half_width_mm`` (B,); ``force_n`` (B,): normal force before
    the first step; ``strain`` (B, 2, 3): strain of the piece standing flat.
    """

    stiffness: FloatArray
    normal_n_mm: FloatArray
    mu_grip: FloatArray
    limit_radius_mm: FloatArray
    half_width_mm: FloatArray
    force_n: FloatArray
    strain: FloatArray


@dataclass(frozen=True, slots=True)
class OpeningPlan:
    """Opening in steps of the width: ``step_mm`` at ``speed_mm_s``, each held for ``hold_s``.

    ``steps``: number of them. Times count from the start; the first step begins at ``SUPPORTED_S``.
    """

    step_mm: float = 0.1
    hold_s: float = 1.0
    speed_mm_s: float = 5.0
    steps: int = 8

    @property
    def starts_s(self) -> FloatArray:
        """(steps,) times at which the steps begin."""
        return np.asarray(SUPPORTED_S + self.hold_s * np.arange(self.steps), dtype=np.float64)

    @property
    def end_s(self) -> float:
        """End of the last hold."""
        return SUPPORTED_S + self.hold_s * self.steps

    def opened_mm(self, t_s: float) -> float:
        """Return how far the width has grown."""
        if t_s < SUPPORTED_S:
            return 0.0
        whole, rest_s = divmod(t_s - SUPPORTED_S, self.hold_s)
        within = min(self.step_mm, self.speed_mm_s * rest_s)
        return min(self.steps * self.step_mm, whole * self.step_mm + within)


@dataclass(frozen=True, slots=True)
class OpeningCourse:
    """The motion, sampled at ``t_s`` (T,).

    ``angle_rad`` (B, T), constant after the fall; ``strain`` (B, T, 2, 3); ``normal_n`` (B, T, 2);
    ``wrench_g`` (B, T, 6): force (N) and moment (N·mm at the pivot ``G``) of the piece on the hand.
    """

    t_s: FloatArray
    angle_rad: FloatArray
    strain: FloatArray
    normal_n: FloatArray
    wrench_g: FloatArray

    def reached_s(self, angle_rad: float) -> FloatArray:
        """Return the time (B,) at which the angle first has this size; infinite if never."""
        beyond = np.abs(self.angle_rad) >= angle_rad
        return np.where(beyond.any(axis=1), self.t_s[beyond.argmax(axis=1)], np.inf)


def open_in_steps(
    piece: StandingPiece,
    pads: LoosePads,
    plan: OpeningPlan,
    dt_s: float = 2e-4,
    sample_s: float = 0.01,
) -> OpeningCourse:
    """Simulate the opening.

    Parameters
    ----------
    piece, pads : StandingPiece, LoosePads
        B pieces and their grips, at rest and flat on the support.
    plan : OpeningPlan
        Motion of the jaws.
    dt_s : float
        Step of the integration (semi-implicit Euler).
    sample_s : float
        Interval of the result, a multiple of ``dt_s``.

    Returns
    -------
    OpeningCourse

    """
    moving = _Motion(piece, pads, dt_s)
    every = round(sample_s / dt_s)
    times, samples = [], []
    for k in range(round(plan.end_s / dt_s) + 1):
        if k % every == 0:
            times.append(k * dt_s)
            samples.append(moving.sample())
        moving.advance(0.5 * plan.opened_mm(k * dt_s))
    angle, strain, normal, wrench = (np.stack(part, axis=1) for part in zip(*samples, strict=True))
    return OpeningCourse(np.array(times), angle, strain, normal, wrench)


class _Motion:
    """State of the integration: angle and its rate (B,), slip of the pads (B, 2, 3)."""

    def __init__(self, piece: StandingPiece, pads: LoosePads, dt_s: float) -> None:
        self.piece, self.pads, self.dt_s = piece, pads, dt_s
        count = len(piece.margin_mm)
        self.angle_rad, self.rate = np.zeros(count), np.zeros(count)
        self.slip = np.zeros((count, 2, 3))
        along, across = np.cos(piece.axis_rad), np.sin(piece.axis_rad)
        # Motion of the piece at the pads per radian, about the edge and about the opposite one.
        self._turns: dict[float, FloatArray] = {}
        for side, shift_mm in ((1.0, 0.0), (-1.0, piece.span_mm)):
            turn = np.empty((count, 2, 3))
            turn[:, :, 0] = (along * piece.grip_height_mm)[:, None]
            turn[:, :, 1] = piece.pads_mm - np.broadcast_to(shift_mm, count)[:, None]
            turn[:, :, 2] = along[:, None]
            self._turns[side] = turn
        self._push = (across * piece.grip_height_mm)[:, None] * SIGN
        self._inertia = {side: piece.edge_inertia_kg_mm2(np.full(count, side)) for side in (1, -1)}
        self._force = np.zeros((count, 2, 3))
        self._normal_n = np.repeat(pads.force_n[:, None], 2, axis=1)
        self._opened_mm, self._still = -1.0, False

    def advance(self, opened_mm: float) -> None:
        """Advance by one step with each finger opened by ``opened_mm``."""
        if self._still and opened_mm == self._opened_mm:
            return
        self._opened_mm = opened_mm
        pads = self.pads
        squeezed = (pads.force_n / pads.normal_n_mm)[:, None] - opened_mm
        squeezed = squeezed + self._push * self.angle_rad[:, None]
        self._normal_n = np.maximum(pads.normal_n_mm[:, None] * squeezed, 0.0)
        outward = self.angle_rad >= 0.0
        turn = np.where(outward[:, None, None], self._turns[1.0], self._turns[-1.0])
        strain = pads.strain + turn * self.angle_rad[:, None, None] - self.slip
        force = pads.stiffness[:, None] * strain
        limit = np.maximum(pads.mu_grip[:, None] * self._normal_n, 1e-9)
        phi = (force[..., 0] ** 2 + force[..., 1] ** 2) / limit**2
        phi += (force[..., 2] / (limit * pads.limit_radius_mm[:, None])) ** 2
        share = 1.0 / np.sqrt(np.maximum(phi, 1.0))
        self.slip += (1.0 - share)[..., None] * strain
        self._force = share[..., None] * force
        lean = (self._push * self._normal_n).sum(axis=1)
        out, back = (self._moment(side, lean) for side in (1.0, -1.0))
        resting = self.angle_rad == 0.0
        side = np.where(resting, np.sign((out > 0.0) * 1.0 - (back < 0.0)), np.sign(self.angle_rad))
        sticks = (phi <= 1.0)[..., None] * pads.stiffness[:, None] * turn**2
        touching = pads.normal_n_mm[:, None] * (self._normal_n > 0.0) * self._push**2
        loss = GEL_LOSS_S * (sticks.sum(axis=(1, 2)) + touching.sum(axis=1))
        moment = np.where(side > 0.0, out, back) - loss * self.rate
        inertia = np.where(side > 0.0, self._inertia[1], self._inertia[-1])
        moves = (side != 0.0) & (np.abs(self.angle_rad) < FALLEN_RAD)
        self.rate = np.where(moves, self.rate + self.dt_s * MM_PER_M * moment / inertia, 0.0)
        after = self.angle_rad + self.dt_s * self.rate
        speed = np.maximum(np.abs(self.rate), np.abs(moves * moment / inertia))
        self._still = bool((speed < STILL_RAD_S).all())
        landed = after * self.angle_rad < 0.0
        self.angle_rad = np.where(landed, 0.0, after)
        self.rate = np.where(landed, 0.0, self.rate)

    def _moment(self, side: float, lean: FloatArray) -> FloatArray:
        piece = self.piece
        gravity = piece.gravity_nmm(self.angle_rad, np.full(len(lean), side))
        held = (self._force * self._turns[side]).sum(axis=(1, 2))
        return np.asarray(gravity - held - lean, dtype=np.float64)

    def sample(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return angle, strain, normal force and wrench on the hand."""
        force, arm = self._force, self.pads.half_width_mm[:, None] * SIGN
        wrench = np.stack(
            [
                force[..., 0].sum(axis=1),
                (SIGN * self._normal_n).sum(axis=1),
                force[..., 1].sum(axis=1),
                (arm * force[..., 1]).sum(axis=1),
                force[..., 2].sum(axis=1),
                -(arm * force[..., 0]).sum(axis=1),
            ],
            axis=1,
        )
        strain = force / self.pads.stiffness[:, None]
        return self.angle_rad.copy(), strain, self._normal_n.copy(), wrench
