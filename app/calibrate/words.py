"""The wizard in words: steps and conditions of each calibration, names of what it finds."""

from __future__ import annotations

from backend.calibration.kinds import What

STEPS: dict[What, tuple[str, ...]] = {
    "payload": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand rises, leans 14° in six poses and is weighed in each.",
        "It levels again. Compare mass and centre with the data sheet, then accept.",
    ),
    "wrist": (
        "Empty the gripper and leave 60 mm of free height above it.",
        "The hand leans in six poses: gravity shows how the sensor is turned.",
        "Beyond 2° the settings are wrong: correct ft.rotation, then repeat.",
    ),
    "board": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece touches the bottom in five places and feels each edge twice.",
        "It goes back. The residual tells whether anything moved meanwhile.",
    ),
    "tool": (
        "Fix a bottom whose place is known and give it as the origin.",
        "The piece feels its four edges; three grips.",
        "It goes back. The residual is the spread of the grips.",
    ),
    "camera": (
        "Fix the bottom. The piece waits in its jig, or is handed over.",
        "The piece is pressed at the rim on four sides: it leans, the dots follow.",
        "Exchanged fingers and mirrored pictures are put right from the next start on.",
    ),
}

AFTER: dict[What, str] = {
    "camera": ". The pictures stay as they are until the bench is started again: close the window "
    "and open it anew."
}
"""What is said once a result is accepted that does not hold at once."""

COUNTS: dict[What, str] = {
    "payload": "largest",
    "wrist": "largest",
    "board": "rms",
    "tool": "rms",
    "camera": "rms",
}
"""Which figure of the residuals is held against the limit."""
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
    "left_mirror": "Left mirror (x 1, y 2)",
    "right_mirror": "Right mirror (x 1, y 2)",
    "left_u_mm_px": "Left camera, across",
    "left_v_mm_px": "Left camera, down",
    "right_u_mm_px": "Right camera, across",
    "right_v_mm_px": "Right camera, down",
}


def value_words(value: float, sigma: float, unit: str) -> str:
    """Write a value with as many digits as its uncertainty leaves, and a true minus."""
    if not unit:
        return f"{value:.0f}"
    digits = 4 if sigma < 0.01 else 3 if sigma < 0.1 else 2
    minus = "\N{MINUS SIGN}"
    shown = f"{value:.{digits}f}".replace("-", minus)
    return f"{shown} \N{PLUS-MINUS SIGN} {sigma:.{digits}f} {unit}"


def days_words(days_left: float) -> str:
    """Say for how long a calibration still holds."""
    days = int(days_left)
    return "less than a day" if days < 1 else "1 day" if days == 1 else f"{days} days"
