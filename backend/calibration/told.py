"""What a calibration found in words for people: names, and angles in degrees.

Files and ``--json`` keep the names and units of the estimate.
"""

from __future__ import annotations

import math

from backend.calibration.kinds import MIRRORS

NAMES = {
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
}
_MIRRORED = tuple({"none": "no", "both": "in x and y"}.get(one, f"in {one}") for one in MIRRORS)
_CODES = {"exchanged": ("no", "yes"), "left_mirror": _MIRRORED, "right_mirror": _MIRRORED}
_UNITS: dict[str, tuple[str, float]] = {"rad": ("°", math.degrees(1.0))}
"""What people read in place of a unit, and how much of it one is."""


def name_words(name: str) -> str:
    """Return the name of a quantity for people."""
    return NAMES.get(name, name)


def value_words(name: str, value: float, sigma: float, unit: str) -> str:
    """Write a value with as many digits as its uncertainty leaves, and a true minus; a code of
    ``name`` by its word.
    """
    if not unit:
        return _CODES[name][round(value)] if name in _CODES else f"{value:.0f}"
    shown_unit, each = _UNITS.get(unit, (f" {unit}", 1.0))
    value, sigma = each * value, each * sigma
    digits = 4 if sigma < 0.01 else 3 if sigma < 0.1 else 2
    minus = "\N{MINUS SIGN}"
    shown = f"{value:.{digits}f}".replace("-", minus)
    # A degree sign stands with each number, any other unit once.
    first = shown_unit if shown_unit == "°" else ""
    return f"{shown}{first} \N{PLUS-MINUS SIGN} {sigma:.{digits}f}{shown_unit}"


def residual_words(residual: float, limit: float, unit: str) -> str:
    """Hold a residual against its limit."""
    side = "within" if residual <= limit else "beyond"
    return f"{residual:.2g} {unit}, {side} the limit of {limit:g} {unit}"
