"""Estimates with intervals, and the parameters that each recording plan identifies.

``resources/identification.toml`` lists unit, stage, plan, prior range and name of every parameter.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy.stats import chi2
from scipy.stats import t as student_t

from touchdown.backend.config import read_toml
from touchdown.backend.core import FloatArray

PLANS = tuple(f"collect --plan {plan}" for plan in ("rest", "gel", "contact", "drag"))
REST, GEL, CONTACT, DRAG = PLANS
_LISTS = read_toml(Path(str(files("touchdown.resources"))) / "identification.toml")
# Key: unit, stage, recording, prior range, name
PARAMETERS: dict[str, tuple[str, int, str, float, float, str]] = {
    key: (unit, stage, f"collect --plan {plan}", low, high, name)
    for key, (unit, stage, plan, low, high, name) in _LISTS["parameters"].items()
}
# Parameters that no plan identifies, with the recording that would.
OTHER_RECORDINGS: tuple[tuple[str, str], ...] = tuple(_LISTS["others"].items())
# Parameters that imported presses do not identify, with what would.
NOT_IMPORTED: dict[str, str] = _LISTS["imported"]


def identifiable(plan: str) -> tuple[str, ...]:
    """Return the keys that a recording with ``plan`` identifies."""
    return tuple(key for key, row in PARAMETERS.items() if row[2] == plan)


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
    def name(self) -> str:
        """Displayed name."""
        return PARAMETERS[self.key][5]

    @property
    def unit(self) -> str:
        """Unit of the value."""
        return PARAMETERS[self.key][0]

    @property
    def stage(self) -> int:
        """Number of the stage that gives it."""
        return PARAMETERS[self.key][1]

    @property
    def prior(self) -> tuple[float, float]:
        """Range considered beforehand."""
        return PARAMETERS[self.key][3:5]

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
