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
from touchdown.backend.geometry import interface_overlap
from touchdown.backend.simulation.conditions import Conditions
from touchdown.backend.simulation.ground_truth import Scene, tower_with_piece, true_margin_mm
from touchdown.backend.simulation.mechanics import SIGN
from touchdown.backend.simulation.rows import Rows

FALLEN_RAD = np.radians(12.0)  # the motion ends there
MM_PER_M = 1e3  # 1 N is 1000 kg mm/s²
STILL_RAD_S = 1e-7  # slower motion ends with the step of the jaws that caused it
GEL_LOSS_S = 1e-3  # damping of the pads over their stiffness
GRAVITY_M_S2 = 9.80665
# Closing jaws set a piece upright that has turned by less; a release within it is stable
CATCH_RAD = np.radians(5.0)
DIRECTIONS_RAD = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
NO_SUPPORT_MM = -20.0  # margin of a piece without support below it


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
        mass_kg = self.weight_n / GRAVITY_M_S2
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


class TurningPiece:
    """Motion of B pieces while their jaws open: angle and rate (B,), slip of the pads (B, 2, 3).

    Parameters
    ----------
    piece, pads : StandingPiece, LoosePads
        Pieces and their grips, at rest and flat on the support.
    dt_s : float
        Step of the integration (semi-implicit Euler).

    """

    def __init__(self, piece: StandingPiece, pads: LoosePads, dt_s: float = 2e-4) -> None:
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


def standing_piece(
    scene: Scene,
    offset_mm: tuple[float, float],
    yaw_rad: float,
    kick_mm: tuple[float, float] = (0.0, 0.0),
) -> StandingPiece:
    """Return the held piece of a scene on its support, as one row.

    It turns about the edge of the face below; ``margin_mm`` is that of the whole tower.
    ``kick_mm``: shift of the centre of mass by the opening fingers.
    """
    tower, piece = tower_with_piece(scene, offset_mm, yaw_rad), scene.piece
    body = tower.bodies[-1]
    edges = interface_overlap(tower, len(tower.bodies) - 1)
    centre = np.add(body.centre_mm, kick_mm)
    normals = np.stack([np.cos(DIRECTIONS_RAD), np.sin(DIRECTIONS_RAD)])
    beyond = ((edges.start_mm[edges.kept] - centre) @ normals).max(axis=0, initial=-np.inf)
    k = int(beyond.argmin())
    span_mm = beyond[k] + beyond[(k + len(beyond) // 2) % len(beyond)]
    margin_mm = max(true_margin_mm(scene, offset_mm, yaw_rad, kick_mm), NO_SUPPORT_MM)
    normal, mass_kg = normals[:, k], 1e-3 * body.mass_g
    x, y = piece.face.half_extents_mm
    share = 1 / 4 if piece.face.kind == "circle" else 1 / 3
    across_mm2 = share * (x if abs(normal[0]) > np.sqrt(0.5) else y) ** 2
    # The pads hold the piece in the middle of its face.
    pads = np.subtract(body.at_mm, centre) + 0.5 * piece.width_mm * np.outer(SIGN, (0.0, 1.0))
    return StandingPiece(
        margin_mm=np.array([margin_mm]),
        span_mm=np.array([span_mm if np.isfinite(span_mm) else 0.0]),
        axis_rad=DIRECTIONS_RAD[k : k + 1],
        com_height_mm=np.array([body.com_height_mm]),
        weight_n=np.array([GRAVITY_M_S2 * mass_kg]),
        inertia_kg_mm2=np.array([mass_kg * (across_mm2 + piece.height_mm**2 / 12.0)]),
        grip_height_mm=np.array([scene.grip_height_mm]),
        pads_mm=margin_mm - (pads @ normal)[None],
    )


class LooseGrip:
    """One grip while its jaws open in steps, from the equilibrium ``values`` (14,) of a timeline.

    ``conditions`` are those of the grip, as one row; ``weight_g`` (6,): weight of the held piece at
    ``G``. What the springs here do not explain of ``values``, such as hysteresis, vanishes with the
    normal force.
    """

    def __init__(
        self, piece: StandingPiece, conditions: Conditions, values: FloatArray, weight_g: FloatArray
    ) -> None:
        shear = conditions.shear_n_mm
        strain = values[None, 6:12].reshape(1, 2, 3).copy()
        # The strain of an equilibrium counts from the piece in air, which hangs on the pads.
        strain[:, :, 1] -= (0.5 * piece.weight_n / shear)[:, None]
        pads = LoosePads(
            stiffness=np.stack([shear, shear, conditions.torsion_nmm], axis=1),
            normal_n_mm=conditions.normal_n_mm,
            mu_grip=conditions.mu_grip,
            limit_radius_mm=conditions.limit_radius_mm,
            half_width_mm=0.5 * conditions.width_mm,
            force_n=values[None, 12:].mean(axis=1),
            strain=strain,
        )
        self._turning = TurningPiece(piece, pads)
        self._weight_g = weight_g
        self._turning.advance(0.0)
        first = self._sample()
        self._left, self._normal_n = values - first, first[12:].mean()

    @property
    def turned_rad(self) -> float:
        """Angle by which the piece has turned about an edge of its support."""
        return float(np.abs(self._turning.angle_rad[0]))

    def advance(self, opened_mm: float, dt_s: float) -> FloatArray:
        """Return the values (14,) after ``dt_s`` with the jaws opened by ``opened_mm`` in all."""
        for _ in range(round(dt_s / self._turning.dt_s)):
            self._turning.advance(0.5 * opened_mm)
        now = self._sample()
        return np.asarray(now + self._left * (now[12:].mean() / self._normal_n))

    def _sample(self) -> FloatArray:
        _, strain, normal, wrench = self._turning.sample()
        return np.concatenate([wrench[0] - self._weight_g, strain.ravel(), normal[0]])
