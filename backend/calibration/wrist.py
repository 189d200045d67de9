"""How the wrist sensor is turned about the axis of the tool, from presses beside the middle.

A press of F at r beside the axis makes the moment (r_y F, -r_x F). The sensor tells it in its own
axes, turned by the yaw; how far the pressure really lies off the middle is found with it.
"""

from __future__ import annotations

import math

import numpy as np

from backend.calibration.estimate import Estimate, Quantity, rms, solve
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray

LIMIT_NM = 0.02
MOMENT_SIGMA_NM = 0.008
"""Standard uncertainty of a moment while pressed: noise, offset since the tare, centre of pressure
off the middle of the overlap."""
LEAST_PUSHES = 4
LARGEST_YAW_RAD = math.radians(2.0)


def estimate_wrist(centres_mm: FloatArray, wrenches: FloatArray, lever_mm: float) -> Estimate:
    """Return the yaw of the sensor against the tool; positive turns its x towards the tool's y.

    ``centres_mm`` (n, 2): middle of the overlap from the axis of the tool, in its axes;
    ``wrenches`` (n, 6): tared, N and N·m, while pressed; ``lever_mm`` from the sensor down to the
    face. Raises ``RefusedError`` "PUSHES" for fewer than four, "DEGENERATE" if all lie on one line
    with the axis, "WEAK-PUSH" without a force.
    """
    count = len(wrenches)
    if count < LEAST_PUSHES:
        raise RefusedError("PUSHES", f"{count} presses are too few: take {LEAST_PUSHES} or more.")
    force_n = wrenches[:, 2]
    if not (force_n > 1.0).all():
        raise RefusedError("WEAK-PUSH", "A press was felt with less than 1 N.")
    # Sideways forces act at the face: what they add over the lever is taken off.
    lever_m = 1e-3 * lever_mm
    moment = wrenches[:, 3:5] - lever_m * np.column_stack([wrenches[:, 1], -wrenches[:, 0]])
    arm = 1e-3 * force_n[:, None] * np.column_stack([centres_mm[:, 1], -centres_mm[:, 0]])
    design = np.zeros((count, 2, 4))
    # R(-yaw) arm, with c = s cos(yaw) and d = s sin(yaw).
    design[:, 0, 0], design[:, 0, 1] = arm[:, 0], arm[:, 1]
    design[:, 1, 0], design[:, 1, 1] = arm[:, 1], -arm[:, 0]
    design[:, :, 2:] = np.eye(2)
    found = solve(
        design.reshape(-1, 4),
        moment.ravel(),
        np.full(2 * count, MOMENT_SIGMA_NM),
        "Press beside the middle on different sides.",
    )
    c, d = found.x[:2].tolist()
    share = math.hypot(c, d)
    change = np.array([[-d, c], [c * share, d * share]]) / share**2
    covariance = change @ found.covariance[:2, :2] @ change.T
    sigma, share_sigma = np.sqrt(np.diag(covariance)).tolist()
    yaw = math.atan2(d, c)
    return Estimate(
        (Quantity("yaw_rad", yaw, sigma, "rad"), Quantity("lever_share", share, share_sigma, "")),
        covariance, found.residuals, rms(found.residuals, 4), LIMIT_NM, "N·m",
        note="The yaw is what is left after ft.rotation.",
        obstacle=_obstacle(yaw, sigma),
    )  # fmt: skip


def _obstacle(yaw: float, sigma: float) -> str:
    if abs(yaw) <= LARGEST_YAW_RAD + 2.0 * sigma:
        return ""
    return f"The sensor is turned by {math.degrees(yaw):.1f} degrees: turn ft.rotation by that."
