"""The wizard in words: steps and conditions of each calibration."""

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


def days_words(days_left: float) -> str:
    """Say for how long a calibration still holds."""
    days = int(days_left)
    return "less than a day" if days < 1 else "1 day" if days == 1 else f"{days} days"
