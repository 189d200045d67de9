"""The simulated wrist sensor: contact wrench, weights and lever arms, noise, offset and drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.backend.config import WristSettings
from touchdown.backend.core import IDENTITY_ROTATION, FloatArray

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class Load:
    """A weight below the sensor: ``mass_kg`` at ``position_mm`` relative to the pivot ``G``."""

    mass_kg: float
    position_mm: tuple[float, float, float]

    def wrench_g(self, turn: FloatArray = IDENTITY_ROTATION) -> FloatArray:
        """Return (6,) weight at ``G`` in N and N·mm, in the axes of a hand rotated by (3, 3)."""
        force = np.array([0.0, 0.0, -self.mass_kg * GRAVITY_M_S2]) @ turn
        return np.concatenate([force, np.cross(self.position_mm, force)])


def held_piece_load(
    mass_g: float,
    com_mm: tuple[float, float, float],
    grip_height_mm: float,
    grasp_offset_mm: tuple[float, float],
) -> Load:
    """Return the load of a held piece; ``com_mm`` relative to its face centre ``F``."""
    g_x, g_z = grasp_offset_mm
    position = (com_mm[0] - g_x, com_mm[1], com_mm[2] - grip_height_mm - g_z)
    return Load(1e-3 * mass_g, position)


def wrist_wrench(
    wrench_g: FloatArray,
    height_mm: float,
    yaw_rad: float | FloatArray = 0.0,
    lever_mm: FloatArray | None = None,
) -> FloatArray:
    """Return (..., 6) in N and N·m at the sensor ``height_mm`` above ``G``.

    ``wrench_g`` (..., 6) in N and N·mm, axes of ``G``; the sensor is rotated by ``yaw_rad``.
    ``lever_mm`` (..., 3): ``G`` is this far along x and y, and farther below the sensor.
    """
    w = np.array(wrench_g, dtype=np.float64)
    w[..., 3] += height_mm * wrench_g[..., 1]
    w[..., 4] -= height_mm * wrench_g[..., 0]
    if lever_mm is not None:
        w[..., 3:] += np.cross(lever_mm * (1.0, 1.0, -1.0), wrench_g[..., :3])
    w[..., 3:] *= 1e-3
    if not np.any(yaw_rad):
        return w
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turned = w.copy()
    for first in (0, 3):
        turned[..., first] = cos * w[..., first] + sin * w[..., first + 1]
        turned[..., first + 1] = cos * w[..., first + 1] - sin * w[..., first]
    return turned


def cable_wrench(cable_n_mm: FloatArray, travel_mm: FloatArray, height_mm: float) -> FloatArray:
    """Return (..., 6) pull of the cables at ``G``, N and N·mm, ``height_mm`` above ``G``.

    ``cable_n_mm`` (..., 3, 3): force per travel; ``travel_mm`` (..., 3) of the hand since the force
    was zero.
    """
    force = (cable_n_mm @ travel_mm[..., None])[..., 0]
    return np.concatenate([force, np.cross((0.0, 0.0, height_mm), force)], axis=-1)


@dataclass(frozen=True, slots=True)
class WristLoad:
    """Load below the sensor over a cycle: (6,) at ``G`` in N and N·mm, weights included."""

    before_g: FloatArray
    after_g: FloatArray
    offset: FloatArray  # (6,) slow error of the present probe, N and N·m


class WristSampler:
    """Produces untared samples block by block.

    ``yaw_rad`` and ``lever_mm`` (3,): errors of the place of the sensor, beside the settings.
    """

    def __init__(
        self,
        settings: WristSettings,
        cycle_us: int,
        seed: int,
        yaw_rad: float = 0.0,
        lever_mm: tuple[float, ...] = (0.0, 0.0, 0.0),
    ) -> None:
        self._yaw_rad = settings.yaw_rad + yaw_rad
        self._lever_mm = np.array(lever_mm) if any(lever_mm) else None
        # Rows: the wrench at the sensor for each component of the wrench at ``G``.
        self._at_sensor = wrist_wrench(np.eye(6), settings.height_mm, self._yaw_rad, self._lever_mm)
        self._cycle_us, self._count = cycle_us, round(settings.rate_hz * cycle_us * 1e-6)
        self._rng = np.random.default_rng([seed, 4])
        self._white = np.repeat([settings.white_n, settings.white_nm], 3)
        per_minute = np.repeat([settings.drift_n_sqrt_min, settings.drift_nm_sqrt_min], 3)
        self._walk = per_minute * np.sqrt(cycle_us * 1e-6 / 60.0)
        self._drift = np.zeros(6)
        self.payload = Load(settings.payload_kg, settings.payload_com_mm)
        self.payload_g = self.payload.wrench_g()  # (6,) weight of the gripper at ``G``, N and N·mm
        self._share = np.arange(1, self._count + 1)[:, None] / self._count

    def samples(
        self, start_us: int, end_us: int, strain: WristLoad
    ) -> tuple[FloatArray, FloatArray]:
        """Return times (n,) in s and samples (n, 6) in N and N·m of one cycle.

        Under a constant load it may be several cycles.
        """
        before = strain.before_g @ self._at_sensor
        load = before + self._share * (strain.after_g @ self._at_sensor - before)
        starts_us = np.arange(start_us, end_us, self._cycle_us)[:, None]
        scores = self._rng.standard_normal((len(starts_us), 1 + self._count, 6))
        drift = np.cumsum(np.vstack([self._drift, self._walk * scores[:, 0]]), axis=0)[1:]
        self._drift = drift[-1]
        values = load + (strain.offset + drift)[:, None]
        values += self._white * scores[:, 1:]
        t_us = starts_us + self._share[:, 0] * self._cycle_us
        return np.round(t_us.ravel()) * 1e-6, values.reshape(-1, 6)
