"""Samples of the simulated wrist sensor: what it carries, its noise, offset and drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.config.simulation import WristSettings
from backend.core.flow import FloatArray
from backend.simulation.wrench import Load, wrist_wrench


@dataclass(frozen=True, slots=True)
class Strain:
    """What acts below the sensor over a cycle: (6,) at ``G`` in N and N·mm, weights included."""

    before_g: FloatArray
    after_g: FloatArray
    offset: FloatArray
    """(6,) slow error of the present probe, N and N·m."""


class Wrist:
    """Produces untared samples block by block."""

    def __init__(self, settings: WristSettings, cycle_us: int, seed: int) -> None:
        self._settings = settings
        self._count = round(settings.rate_hz * cycle_us * 1e-6)
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 4])))
        scale = np.repeat([settings.white_n, settings.white_nm], 3)
        self._white = scale
        per_minute = np.repeat([settings.drift_n_sqrt_min, settings.drift_nm_sqrt_min], 3)
        self._walk = per_minute * np.sqrt(cycle_us * 1e-6 / 60.0)
        self._drift = np.zeros(6)
        self.payload = Load(settings.payload_kg, settings.payload_com_mm)
        self.payload_g = self.payload.wrench_g()
        """(6,) weight of the gripper at ``G``, N and N·mm."""
        self._share = np.arange(1, self._count + 1)[:, None] / self._count

    def samples(self, start_us: int, end_us: int, strain: Strain) -> tuple[FloatArray, FloatArray]:
        """Return times (n,) in s and samples (n, 6) in N and N·m of one cycle."""
        settings = self._settings
        wrench_g = strain.before_g + self._share * (strain.after_g - strain.before_g)
        values = wrist_wrench(wrench_g, settings.height_mm, settings.yaw_rad)
        self._drift = self._drift + self._walk * self._rng.standard_normal(6)
        values += strain.offset + self._drift
        values += self._white * self._rng.standard_normal((self._count, 6))
        t_us = start_us + self._share[:, 0] * (end_us - start_us)
        return np.round(t_us) * 1e-6, values
