"""Result of a calibration: its kind, quantities with uncertainty, residual and limit.

A kind defines how long a calibration holds. Display text uses names, and degrees for angles; files
and ``--json`` keep the names and units of the estimate.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from touchdown.backend.calibration.day_checks import NAMES, quantity
from touchdown.backend.core import CalibrationMeasured, FloatArray, RefusedError, read_only

CalibrationName = Literal["payload", "board", "tool", "wrist", "camera", "day"]
MIRROR_CODES = ("none", "x", "y", "both")  # mirroring of an image by code: bit 0 in x, bit 1 in y
ON_BOTTOM = " on "  # separates piece and bottom in ``about`` of a board
MEASUREMENT_NAMES: tuple[CalibrationName, ...] = get_args(CalibrationName)
CALIBRATION_NAMES = MEASUREMENT_NAMES[:-1]  # the daily check is no calibration


@dataclass(frozen=True, slots=True)
class CalibrationKind:
    """Kind of calibration, valid for ``days`` and for ``devices``, by their names.

    ``values``: names of the values that are applied; a file without one of them is damaged.
    """

    what: CalibrationName
    title: str
    days: int
    devices: tuple[str, ...]
    values: tuple[str, ...]


CALIBRATION_KINDS: dict[CalibrationName, CalibrationKind] = {
    kind.what: kind
    for kind in (
        CalibrationKind(
            "payload",
            "Payload",
            90,
            ("force_torque", "gripper"),
            ("mass_kg", "com_x_mm", "com_y_mm"),
        ),
        CalibrationKind(
            "board", "Board", 1, ("arm",), ("x_mm", "y_mm", "z_mm", "slope_x_rad", "slope_y_rad")
        ),
        CalibrationKind(
            "tool", "Tool and face centre", 30, ("arm", "gripper"), ("face_x_mm", "face_y_mm")
        ),
        CalibrationKind("wrist", "Wrist sensor yaw", 180, ("force_torque",), ()),
        CalibrationKind(
            "camera",
            "Tactile cameras",
            90,
            ("tactile_left", "tactile_right"),
            ("left_u_mm_px", "left_v_mm_px", "right_u_mm_px", "right_v_mm_px"),
        ),
        CalibrationKind("day", "Daily check", 1, (), ()),
    )
}


# Smallest ratio of singular values (scaled columns) at which all unknowns are determined.
MIN_CONDITION = 1e-3


@dataclass(frozen=True, slots=True)
class Quantity:
    """An estimated value with its standard uncertainty."""

    name: str
    value: float
    sigma: float
    unit: str


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """Result: ``residual`` and ``limit`` in ``unit``, ``residuals`` (n,) per measurement.

    ``covariance`` (k, k) of the quantities, in their units. ``obstacle``: reason for refusal
    independent of the residual, or ""; ``note``: limitations. ``gels_px``: as in
    ``CalibrationMeasured``.
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

    def to_event(self, t_s: float, what: str, about: str = "") -> CalibrationMeasured:
        """Return the event of calibration ``what``; ``about``: piece and bottom."""
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
        """True if the residual is within its limit and there is no obstacle."""
        return self.to_event(0.0, "").acceptable

    def value(self, name: str) -> float:
        """Return the value of a quantity; raises KeyError."""
        return {q.name: q.value for q in self.quantities}[name]


@dataclass(frozen=True, slots=True)
class LeastSquaresSolution:
    """Least squares: ``x`` (k,), its ``covariance`` (k, k), ``residuals`` (n,) unweighted."""

    x: FloatArray
    covariance: FloatArray
    residuals: FloatArray


def solve_least_squares(
    design: FloatArray, values: FloatArray, sigma: FloatArray, missing: str
) -> LeastSquaresSolution:
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
    if s[-1] < MIN_CONDITION * s[0]:
        raise RefusedError("DEGENERATE", missing)
    back = (vt.T / s) / scale[:, None]
    x = back @ (u.T @ (values / sigma))
    return LeastSquaresSolution(x, back @ back.T, values - design @ x)


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


QUANTITY_NAMES = {
    "mass_kg": "Mass",
    "com_x_mm": "Centre of mass, x",
    "com_y_mm": "Centre of mass, y",
    "com_z_mm": "Centre of mass, z",
    "bias_fx_n": "Bias Fx",
    "bias_fy_n": "Bias Fy",
    "bias_fz_n": "Bias Fz",
    "bias_tx_nm": "Bias Tx",
    "bias_ty_nm": "Bias Ty",
    "bias_tz_nm": "Bias Tz",
    "x_mm": "x",
    "y_mm": "y",
    "z_mm": "z",
    "slope_x_rad": "Slope along x",
    "slope_y_rad": "Slope along y",
    "yaw_rad": "Yaw",
    "face_x_mm": "Face centre, x",
    "face_y_mm": "Face centre, y",
    "exchanged": "Fingers exchanged",
    "left_mirror": "Left picture mirrored",
    "right_mirror": "Right picture mirrored",
    "left_u_mm_px": "Left camera, across",
    "left_v_mm_px": "Left camera, down",
    "right_u_mm_px": "Right camera, across",
    "right_v_mm_px": "Right camera, down",
    **{name: quantity(name).title for name in NAMES},
}
_MIRRORED = tuple(
    {"none": "no", "both": "in x and y"}.get(one, f"in {one}") for one in MIRROR_CODES
)
_CODES = {"exchanged": ("no", "yes"), "left_mirror": _MIRRORED, "right_mirror": _MIRRORED}
# Displayed unit and factor in place of a unit.
_DISPLAY_UNITS: dict[str, tuple[str, float]] = {"rad": ("°", math.degrees(1.0))}


def quantity_name(name: str) -> str:
    """Return the displayed name of a quantity."""
    return QUANTITY_NAMES.get(name, name)


def format_value(name: str, value: float, sigma: float, unit: str) -> str:
    """Write a value with as many digits as its uncertainty leaves, and a true minus; a code of
    ``name`` by its word.
    """
    if not unit:
        return _CODES[name][round(value)] if name in _CODES else f"{value:.0f}"
    shown_unit, each = _DISPLAY_UNITS.get(unit, (f" {unit}", 1.0))
    value, sigma = each * value, each * sigma
    digits = 4 if sigma < 0.01 else 3 if sigma < 0.1 else 2
    minus = "\N{MINUS SIGN}"
    shown = f"{value:.{digits}f}".replace("-", minus)
    # A degree sign stands with each number, any other unit once.
    first = shown_unit if shown_unit == "°" else ""
    return f"{shown}{first} \N{PLUS-MINUS SIGN} {sigma:.{digits}f}{shown_unit}"


def format_residual(residual: float, limit: float, unit: str) -> str:
    """Return a residual and its limit as text."""
    side = "within" if residual <= limit else "beyond"
    return f"{residual:.2g} {unit}, {side} the limit of {limit:g} {unit}"
