"""Where the face of a held piece is in the hand: its centre from the axis of the tool.

The piece feels the edges of a bottom whose place is known, grip by grip.
"""

from __future__ import annotations

import numpy as np

from backend.calibration.estimate import Estimate, quantities, rms, solve
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray

LIMIT_MM = 0.2
FELT_SIGMA_MM = 0.06
"""Standard uncertainty of a felt centre of the bottom."""
_NAMES, _UNITS = ("face_x_mm", "face_y_mm"), ("mm", "mm")
KNOWN_NOTE = "The centre of the bottom counts as known; its error is in the face centre."
GRIPS = 3


def estimate_tool(bottom_mm: FloatArray, bottom_sigma_mm: float, felt_mm: FloatArray) -> Estimate:
    """Return the mean face centre over several grips against a known bottom.

    ``felt_mm`` (n, 2): where the hand stood, grip by grip, with the face over the centre of the
    bottom at ``bottom_mm`` (2,), known to ``bottom_sigma_mm`` per axis. The residual is the spread
    of the grips. Raises ``RefusedError`` "GRIPS" for fewer than three.
    """
    count = len(felt_mm)
    if count < GRIPS:
        raise RefusedError("GRIPS", f"{count} grips are too few: take {GRIPS} or more.")
    face_mm = bottom_mm - felt_mm
    design = np.tile(np.eye(2), (count, 1))
    sigma = np.full(2 * count, FELT_SIGMA_MM)
    found = solve(design, face_mm.ravel(), sigma, "The grips tell nothing.")
    residual_mm = rms(found.residuals, 2)
    spread = max(residual_mm, FELT_SIGMA_MM) ** 2 / count
    covariance = (spread + bottom_sigma_mm**2) * np.eye(2)
    return Estimate(
        quantities(_NAMES, _UNITS, found.x, covariance),
        covariance, found.residuals, residual_mm, LIMIT_MM, "mm", note=KNOWN_NOTE,
    )  # fmt: skip
