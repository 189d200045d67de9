"""Compliant grasp: series springs, elastic zero, limit surface, optional Maxwell branch.

Source: bench reference 3.1, 3.2, 3.5, 3.6. Finger index 0 is left (y = +w/2), 1 is right.
Axes of ``slip`` and ``strain``: x (mm), z (mm), rotation about the jaw axis (rad).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray
from backend.simulation.conditions import Conditions

SIGN = np.array([1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Springs:
    """Stiffness during one time step of B grasps, and where the springs are unloaded.

    ``finger`` (B, 4): x, z, torsion, y of one finger, Maxwell branch included. ``series`` (B, 3)
    k̄ and ``matrix_diagonal`` (B, 6) of K. ``give`` (B, 3) = k̄ / K_r. ``hidden`` (B, 2, 4): shift
    of the unloaded position that the Maxwell branches add to the slip.
    """

    finger: FloatArray
    series: FloatArray
    matrix_diagonal: FloatArray
    give: FloatArray
    hidden: FloatArray

    def take(self, rows: NDArray[np.intp]) -> Springs:
        """Return the grasps ``rows``."""
        return Springs(
            self.finger[rows],
            self.series[rows],
            self.matrix_diagonal[rows],
            self.give[rows],
            self.hidden[rows],
        )


def springs(conditions: Conditions, relaxed: FloatArray, dt_s: float | FloatArray) -> Springs:
    """Return the equivalent springs of one implicit step of ``dt_s``.

    ``relaxed`` (B, 2, 4): inner states v of the Maxwell branches (x, z, torsion, y).
    """
    b = 1.0 / (1.0 + dt_s / conditions.relax_s)
    share = conditions.alpha * b
    stiffer = 1.0 + share
    shear, normal = conditions.shear_n_mm * stiffer, conditions.normal_n_mm * stiffer
    torsion = conditions.torsion_nmm * stiffer
    finger = np.stack([shear, shear, torsion, normal], axis=1)
    both = 2.0 * np.stack([shear, normal, shear], axis=1)
    series = both * conditions.robot_n_mm / (both + conditions.robot_n_mm)
    lever = 2.0 * shear * (0.5 * conditions.width_mm) ** 2
    rotation = np.stack([lever, 2.0 * torsion, lever], axis=1)
    hidden = (share / stiffer)[:, None, None] * relaxed
    return Springs(
        finger,
        series,
        np.concatenate([series, rotation], axis=1),
        series / conditions.robot_n_mm,
        hidden,
    )


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
    """Return the Maxwell states v (B, 2, 4) after an implicit step of ``dt_s``."""
    b = (1.0 / (1.0 + dt_s / conditions.relax_s))[:, None, None]
    return np.asarray(b * relaxed + (1.0 - b) * strain, dtype=np.float64)
