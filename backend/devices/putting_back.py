"""When the jaws may open over the jig: putting a piece back is no placement, needs no verdict."""

from __future__ import annotations

from dataclasses import dataclass

NEAR_JIG_MM = 0.5
"""The arm is back at the taught place of the jig within this distance on each axis."""
STILL_MM = 0.05
JAMMED_N = 2.0
"""More force than this along any axis: the piece does not sit freely in the jig."""


@dataclass(frozen=True, slots=True)
class JigEvidence:
    """What was measured over the jig.

    ``from_jig_mm``: largest distance on one axis from the taught place; ``moved_mm``: largest
    travel as it stands (``travelled_mm``); ``force_n``: largest force beyond gripper and piece.
    """

    from_jig_mm: float
    moved_mm: float
    force_n: float
    holding: bool


def jig_refusal(evidence: JigEvidence) -> tuple[str, str] | None:
    """Return None if the piece may be put back, else (name, sentence); NaN refuses."""
    e = evidence
    rows = (
        (
            "NOT-AT-JIG",
            0 <= e.from_jig_mm <= NEAR_JIG_MM,
            f"The arm is {e.from_jig_mm:.2f} mm from the taught place of the jig.",
        ),
        ("ARM-MOVING", 0 <= e.moved_mm <= STILL_MM, "The arm is not standing still."),
        ("JAMMED", 0 <= e.force_n <= JAMMED_N, f"{e.force_n:.1f} N on the piece in the jig."),
        ("NOT-HOLDING", e.holding, "The gripper does not hold a piece."),
    )
    return next(((name, sentence) for name, holds, sentence in rows if not holds), None)
