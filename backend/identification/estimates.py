"""Estimates with intervals, and the parameters that each recording plan identifies.

The list is fixed beforehand: unit, stage, prior range and plan of every parameter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student_t

from touchdown.backend.core import FloatArray

REST, GEL, CONTACT = (f"collect --plan {plan}" for plan in ("rest", "gel", "contact"))
# Key, unit, stage, plan, prior range
_TABLE: tuple[tuple[str, str, int, str, float, float], ...] = (
    ("wrist.white_n", "N", 1, REST, 0.005, 0.4),
    ("wrist.white_nm", "N·m", 1, REST, 0.0002, 0.02),
    ("wrist.drift_n_sqrt_min", "N/√min", 1, REST, 0.0, 0.1),
    ("wrist.drift_nm_sqrt_min", "N·m/√min", 1, REST, 0.0, 0.004),
    ("wrist.rate_hz", "Hz", 1, REST, 50.0, 8000.0),
    ("tactile.white_px", "px", 1, REST, 0.005, 0.3),
    ("tactile.drift_px_sqrt_s", "px/√s", 1, REST, 0.0, 0.1),
    ("tactile.rate_hz", "Hz", 1, REST, 10.0, 60.0),
    ("tactile.jitter_s", "s", 1, REST, 0.0, 0.02),
    ("tactile.drop_share", "1", 1, REST, 0.0, 0.05),
    ("tactile.lost_share", "1", 1, REST, 0.0, 0.02),
    ("wrist.offset_n", "N", 1, GEL, 0.0, 0.8),
    ("wrist.offset_nm", "N·m", 1, GEL, 0.0, 0.04),
    ("tactile.bias_px", "px", 1, GEL, 0.0, 1.0),
    ("delay.command_pose", "s", 2, GEL, -0.05, 0.25),
    ("delay.pose_wrench", "s", 2, GEL, -0.05, 0.25),
    ("delay.wrench_markers", "s", 2, GEL, -0.05, 0.25),
    ("arm.stiffness_x", "N/mm", 2, GEL, 5.0, 1000.0),
    ("arm.stiffness_y", "N/mm", 2, GEL, 5.0, 1000.0),
    ("arm.stiffness_z", "N/mm", 2, GEL, 5.0, 1000.0),
    ("arm.repeatability_mm", "mm", 2, GEL, 0.0, 0.5),
    ("spread.tilt_rad", "rad", 2, GEL, 0.0, 0.03),
    ("spread.print_offset_mm", "mm", 2, GEL, 0.0, 0.6),
    ("spread.jig_mm", "mm", 2, GEL, 0.0, 0.5),
    ("spread.grasp_offset_mm", "mm", 2, f"{GEL} --hand-over", 0.0, 2.0),
    ("grasp.shear_n_mm", "N/mm", 3, GEL, 1.0, 16.0),
    ("grasp.normal_n_mm", "N/mm", 3, GEL, 4.0, 24.0),
    ("grasp.torsion_nmm_rad", "N·mm/rad", 3, GEL, 40.0, 500.0),
    ("grasp.hysteresis_share", "1", 3, GEL, 0.0, 0.5),
    ("grasp.hysteresis_s", "s", 3, GEL, 0.1, 2.5),
    ("face.foundation_n_mm3", "N/mm³", 3, GEL, 2.0, 100.0),
    ("tactile.roll_off_mm.0", "mm", 3, GEL, 3.0, 12.0),
    ("tactile.roll_off_mm.1", "mm", 3, GEL, 3.0, 12.0),
    ("tactile.mm_per_px.0", "mm/px", 3, GEL, 0.045, 0.08),
    ("tactile.mm_per_px.1", "mm/px", 3, GEL, 0.045, 0.08),
    ("spread.gel", "1", 3, GEL, 0.0, 0.3),
    ("spread.gain", "1", 3, GEL, 0.0, 0.2),
    ("mu_grip", "1", 4, CONTACT, 0.3, 1.2),
    ("spread.mu_grip", "1", 4, CONTACT, 0.0, 0.4),
)
PARAMETERS = {row[0]: row for row in _TABLE}
# Parameters that no plan identifies, with the recording that would.
OTHER_RECORDINGS = (
    ("mu, spread.mu, face.tangential_n_mm3", "a lateral drag under load, which no plan does yet"),
    ("grasp.limit_radius_mm", "a twist of the held piece under a low grip force"),
    ("tactile.dilation, spread.grip_force_n", "a change of the grip force with the piece held"),
    ("spread.yaw_rad", "presses of a piece whose face is not round"),
    ("spread.label_error_mm", "an outside measurement of the position of the arm"),
    ("wrist.height_mm, yaw_rad, payload_kg", "`calibrate payload` and `calibrate wrist`"),
    ("support", "presses on a bottom that is free to rock and slide"),
    ("release_disturbance_mm", "releases beside the edge of a support"),
)


def identifiable(plan: str) -> tuple[str, ...]:
    """Return the keys that a recording with ``plan`` identifies."""
    return tuple(row[0] for row in _TABLE if row[3] == plan)


@dataclass(frozen=True, slots=True)
class Estimate:
    """An identified parameter: a setting of the bench, or a figure for the report.

    ``sigma`` is the standard uncertainty, ``low`` and ``high`` are the 95 % interval.
    """

    key: str
    value: float
    sigma: float
    low: float
    high: float

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return PARAMETERS[self.key][1]

    @property
    def stage(self) -> int:
        """Number of the stage that gives it."""
        return PARAMETERS[self.key][2]

    @property
    def prior(self) -> tuple[float, float]:
        """Range considered beforehand."""
        return PARAMETERS[self.key][4:]

    @property
    def sharpness(self) -> float:
        """Standard uncertainty relative to that of the prior range."""
        low, high = self.prior
        return float(self.sigma * np.sqrt(12.0) / (high - low))


def estimate(key: str, value: float, sigma: float, freedom: int = 1000) -> Estimate:
    """Return an estimate with a Student interval of ``freedom`` degrees."""
    half = float(student_t.ppf(0.975, max(freedom, 1))) * sigma
    return Estimate(key, float(value), float(sigma), float(value - half), float(value + half))


def log_estimate(key: str, value: float, relative: float, freedom: int = 1000) -> Estimate:
    """Return an estimate whose logarithm has the standard uncertainty ``relative``."""
    factor = float(np.exp(float(student_t.ppf(0.975, max(freedom, 1))) * relative))
    return Estimate(key, float(value), float(value * relative), value / factor, value * factor)


def mean_estimate(key: str, values: FloatArray, errors: FloatArray) -> Estimate:
    """Return the mean of ``values``, whose scatter contains their ``errors``."""
    count = len(values)
    variance = max(float(values.var(ddof=1)), float((errors**2).mean()))
    return estimate(key, float(values.mean()), float(np.sqrt(variance / count)), count - 1)


def spread_estimate(key: str, deviations: FloatArray, errors: FloatArray, freedom: int) -> Estimate:
    """Return the standard deviation of draws from their ``deviations`` with ``errors``.

    ``freedom``: degrees of freedom of the sum of squares.
    """
    freedom = max(freedom, 1)
    total, noise = float((deviations**2).sum() / freedom), float((errors**2).mean())
    value = float(np.sqrt(max(total - noise, 0.0)))
    sigma = total * np.sqrt(2.0 / freedom) / (2.0 * max(value, np.sqrt(noise), 1e-12))
    low, high = (
        float(np.sqrt(max(total * freedom / float(chi2.ppf(q, freedom)) - noise, 0.0)))
        for q in (0.975, 0.025)
    )
    return Estimate(key, value, float(sigma), low, high)
