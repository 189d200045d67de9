"""What a calibration found: quantities with their uncertainty, and a residual with its limit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from backend.core.facts import CalibrationMeasured
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray, read_only

LEAST_CONDITION = 1e-3
"""Below this ratio of singular values (columns scaled) the measurements do not tell all unknowns
apart."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """One number that was found, with its standard uncertainty."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, slots=True)
class Estimate:
    """What was found: ``residual`` and ``limit`` in ``unit``, ``residuals`` (n,) per measurement.

    ``covariance`` (k, k) of the quantities, in their units. ``obstacle``: why it cannot be accepted
    whatever the residual, "" if nothing stands against it; ``note``: what it does not tell.
    ``gels_px``: as of the fact.
    """

    quantities: tuple[Quantity, ...]
    covariance: FloatArray
    residuals: FloatArray
    residual: float
    limit: float
    unit: str
    note: str = ""
    obstacle: str = ""
    gels_px: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        read_only(self.covariance)
        read_only(self.residuals)

    def told(self, t_s: float, what: str, about: str = "") -> CalibrationMeasured:
        """Return it as a fact of calibration ``what``; ``about``: which piece on which bottom."""
        return CalibrationMeasured(
            t_s,
            what,
            names=tuple(q.name for q in self.quantities),
            values=tuple(q.value for q in self.quantities),
            sigmas=tuple(q.sigma for q in self.quantities),
            units=tuple(q.unit for q in self.quantities),
            residuals=tuple(self.residuals.tolist()),
            residual=self.residual,
            limit=self.limit,
            unit=self.unit,
            note=self.note,
            obstacle=self.obstacle,
            about=about,
            gels_px=self.gels_px,
        )

    @property
    def acceptable(self) -> bool:
        """Whether the residual is within its limit and nothing stands against it."""
        return self.told(0.0, "").acceptable

    def value(self, name: str) -> float:
        """Return the value of a quantity; raises KeyError."""
        return {q.name: q.value for q in self.quantities}[name]


@dataclass(frozen=True, slots=True)
class Solution:
    """Least squares: ``x`` (k,), its ``covariance`` (k, k), ``residuals`` (n,) unweighted."""

    x: FloatArray
    covariance: FloatArray
    residuals: FloatArray


def solve(design: FloatArray, values: FloatArray, sigma: FloatArray, missing: str) -> Solution:
    """Return the weighted least-squares solution of ``design`` (n, k) x = ``values`` (n,).

    ``sigma`` (n,): standard uncertainty of each value. Raises ``RefusedError`` "DEGENERATE" with
    ``missing`` if the measurements do not determine all unknowns, "NOT-FINITE" for NaN.
    """
    if not (np.isfinite(values).all() and np.isfinite(design).all()):
        raise RefusedError("NOT-FINITE", "A measurement is not a finite number.")
    weighted = design / sigma[:, None]
    scale = np.linalg.norm(weighted, axis=0)
    if len(values) < design.shape[1] or not (scale > 0.0).all():
        raise RefusedError("DEGENERATE", missing)
    u, s, vt = np.linalg.svd(weighted / scale, full_matrices=False)
    if s[-1] < LEAST_CONDITION * s[0]:
        raise RefusedError("DEGENERATE", missing)
    back = (vt.T / s) / scale[:, None]
    x = back @ (u.T @ (values / sigma))
    return Solution(x, back @ back.T, values - design @ x)


def quantities(
    names: Sequence[str], units: Sequence[str], values: FloatArray, covariance: FloatArray
) -> tuple[Quantity, ...]:
    """Return one quantity per value (k,), with the uncertainties of ``covariance`` (k, k)."""
    sigmas = np.sqrt(np.diag(covariance))
    rows = zip(names, values.tolist(), sigmas.tolist(), units, strict=True)
    return tuple(Quantity(*row) for row in rows)


def rms(residuals: FloatArray, unknowns: int) -> float:
    """Return the root mean square of ``residuals`` (n,) per degree of freedom."""
    freedom = max(len(residuals) - unknowns, 1)
    return float(np.sqrt((residuals**2).sum() / freedom))
