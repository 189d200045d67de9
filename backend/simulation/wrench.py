"""What the wrist sensor feels: contact, weights, lever arms. Source: bench reference 4."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.core.flow import FloatArray
from backend.core.turning import UNTURNED

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class Load:
    """A weight below the sensor: ``mass_kg`` at ``position_mm`` relative to the pivot ``G``."""

    mass_kg: float
    position_mm: tuple[float, float, float]

    def wrench_g(self, turn: FloatArray = UNTURNED) -> FloatArray:
        """Return (6,) weight at ``G`` in N and N·mm, in the axes of a hand turned by (3, 3)."""
        force = np.array([0.0, 0.0, -self.mass_kg * GRAVITY_M_S2]) @ turn
        return np.concatenate([force, np.cross(self.position_mm, force)])


def held_piece(
    mass_g: float,
    com_mm: tuple[float, float, float],
    grip_height_mm: float,
    grasp_offset_mm: tuple[float, float],
) -> Load:
    """Return the load of a held piece; ``com_mm`` relative to its face centre ``F``."""
    g_x, g_z = grasp_offset_mm
    position = (com_mm[0] - g_x, com_mm[1], com_mm[2] - grip_height_mm - g_z)
    return Load(1e-3 * mass_g, position)


def wrist_wrench(wrench_g: FloatArray, height_mm: float, yaw_rad: float = 0.0) -> FloatArray:
    """Return (..., 6) in N and N·m at the sensor ``height_mm`` above ``G``.

    ``wrench_g`` (..., 6) in N and N·mm, axes of ``G``; the sensor is turned by ``yaw_rad`` about z.
    """
    w = np.array(wrench_g, dtype=np.float64)
    w[..., 3] += height_mm * wrench_g[..., 1]
    w[..., 4] -= height_mm * wrench_g[..., 0]
    w[..., 3:] *= 1e-3
    if yaw_rad == 0.0:
        return w
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = w.copy()
    for first in (0, 3):
        turned[..., first] = cos * w[..., first] + sin * w[..., first + 1]
        turned[..., first + 1] = cos * w[..., first + 1] - sin * w[..., first]
    return turned


def centre_of_pressure_mm(wrench_w: FloatArray, lever_mm: float) -> FloatArray:
    """Return (..., 2) centre of pressure in the face plane, relative to G's vertical axis.

    ``wrench_w`` (..., 6) in N and N·m; ``lever_mm`` from sensor to face. NaN where Fz <= 0.
    """
    f_z = np.where(wrench_w[..., 2] > 0.0, wrench_w[..., 2], np.nan)
    x = -(1e3 * wrench_w[..., 4] + lever_mm * wrench_w[..., 0]) / f_z
    y = (1e3 * wrench_w[..., 3] - lever_mm * wrench_w[..., 1]) / f_z
    return np.stack([x, y], axis=-1)
