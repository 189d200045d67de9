"""Gel law of the second world: stiffens with strain, creeps in the grip, is seen late.

On the bench a pad is a linear spring with a Maxwell branch, slips at a sharp limit, and the markers
show its strain at once. Here the spring hardens, the piece creeps along the pad at any load and
ever faster towards the limit of friction, and the markers follow a strain that saturates, with a
delay.
"""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray
from backend.simulation.conditions import Conditions
from backend.simulation.grasp import SIGN, elastic_zero

HARDENING_MM = 3.0
"""Shear at which a pad is twice as stiff as unstrained [U]."""
SATURATION_MM, SEEN_LATE_S = 2.0, 0.12
"""The markers show at most this much shear, and follow it with this delay [U]."""
CREEP_MM_S, CREEP_POWER, CREEP_CAP = 0.1, 12, 1.3
"""Speed of the creep at the limit of friction, how steeply it grows with the load, and the load
beyond which it grows no more [U]."""


class Pads:
    """Both pads of one gripping. ``slip`` (2, 3): finger; x, z in mm, torsion in rad.

    ``seen`` (2, 3): the strain that the markers show. ``normal_n`` (2,).
    """

    def __init__(self, conditions: Conditions, slip: FloatArray) -> None:
        self.slip = slip.copy()
        self._half_mm = 0.5 * float(conditions.width_mm[0])
        self._shear_n_mm = float(conditions.shear_n_mm[0])
        self._normal_n_mm = float(conditions.normal_n_mm[0])
        self._torsion_nmm = float(conditions.torsion_nmm[0])
        self._grip_n = float(conditions.grip_force_n[0])
        self._limit = float(conditions.mu_grip[0])
        self._radius_mm = float(conditions.limit_radius_mm[0])
        self._slips = bool(conditions.slips[0])
        self.hardening = 1.0
        """Stiffness of shear and torsion over that of an unstrained gel."""
        self.normal_n = np.full(2, self._grip_n)
        self.strain = self._strain(self.rest())
        self.seen = _saturated(self.strain)

    def rest(self) -> FloatArray:
        """Return (6,) displacement of the piece in the hand at which the pads are unloaded."""
        unloaded = np.concatenate([self.slip, np.zeros((2, 1))], axis=1)[None]
        zero = elastic_zero(np.zeros((1, 3)), unloaded, np.array([2.0 * self._half_mm]))
        return np.asarray(zero[0])

    def follow(self, held: FloatArray, dt_s: float) -> None:
        """Let ``dt_s`` pass with the piece at ``held`` (6,) in the hand, mm and rad."""
        self.strain = self._strain(held)
        self.normal_n = np.maximum(self._grip_n + SIGN * self._normal_n_mm * held[1], 0.0)
        size2 = float((self.strain[:, :2] ** 2).sum(axis=1).mean())
        self.hardening = 1.0 + size2 / HARDENING_MM**2
        if self._slips:
            self._creep(dt_s)
        late = dt_s / (dt_s + SEEN_LATE_S)
        self.seen += late * (_saturated(self.strain) - self.seen)

    def _strain(self, held: FloatArray) -> FloatArray:
        swing = self._half_mm * SIGN
        d_x = held[0] - held[5] * swing
        d_z = held[2] + held[3] * swing
        return np.stack([d_x, d_z, np.full(2, held[4])], axis=1) - self.slip

    def _creep(self, dt_s: float) -> None:
        stiffness = self.hardening * np.array([self._shear_n_mm] * 2 + [self._torsion_nmm])
        lever = np.array([1.0, 1.0, self._radius_mm])
        limit = np.maximum(self._limit * self.normal_n, 1e-9)[:, None]
        load = stiffness * self.strain / (limit * lever)
        size = np.linalg.norm(load, axis=1, keepdims=True)
        speed = CREEP_MM_S * np.minimum(size, CREEP_CAP) ** CREEP_POWER
        self.slip += dt_s * speed * load / np.maximum(size, 1e-9) / lever


def _saturated(strain: FloatArray) -> FloatArray:
    """Return strain (2, 3) as markers show it; the torsion of small angles does not saturate."""
    shown = strain.copy()
    size = np.linalg.norm(strain[:, :2], axis=1, keepdims=True)
    shown[:, :2] *= SATURATION_MM * np.tanh(size / SATURATION_MM) / np.maximum(size, 1e-9)
    return shown
