"""How the wrist sensor is turned about the axis of the tool, by the weight of a leaning hand.

Leaning sends a part of the known direction of gravity into the plane of the sensor: with
a = m cos(yaw) and b = m sin(yaw) the readings are linear in a, b, the mass m and the bias.
"""

from __future__ import annotations

import math

import numpy as np

from backend.calibration.estimate import Estimate, Quantity, solve
from backend.calibration.payload import FORCE_SIGMA_N, GRAVITY_M_S2, LIMIT_N, POSES
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray

LARGEST_YAW_RAD = math.radians(2.0)


def estimate_wrist(turns: FloatArray, wrenches: FloatArray) -> Estimate:
    """Return the yaw of the sensor against the tool; positive turns its x towards the tool's y.

    ``turns`` (n, 3, 3) and ``wrenches`` (n, 6) as in ``estimate_payload``. The residual is the
    largest force that the model leaves over. Raises ``RefusedError`` "POSES" for fewer than six,
    "DEGENERATE" if the hand hardly leans.
    """
    count = len(wrenches)
    if count < POSES:
        raise RefusedError("POSES", f"{count} poses are too few: take {POSES}.")
    g_x, g_y, g_z = np.einsum("nji,j->in", turns, [0.0, 0.0, -GRAVITY_M_S2])
    design = np.zeros((count, 3, 6))
    design[:, 0, 0], design[:, 0, 1] = g_x, g_y
    design[:, 1, 0], design[:, 1, 1] = g_y, -g_x
    design[:, 2, 2] = g_z
    design[:, :, 3:] = np.eye(3)
    found = solve(
        design.reshape(-1, 6),
        wrenches[:, :3].ravel(),
        np.full(3 * count, FORCE_SIGMA_N),
        "The poses do not lean the hand enough: 10 degrees or more about two axes.",
    )
    a, b = found.x[:2].tolist()
    mass = math.hypot(a, b)
    change = np.array([[-b / mass**2, a / mass**2], [a / mass, b / mass]])
    covariance = change @ found.covariance[:2, :2] @ change.T
    yaw = math.atan2(b, a)
    sigma, mass_sigma = np.sqrt(np.diag(covariance)).tolist()
    left_n = np.linalg.norm(found.residuals.reshape(count, 3), axis=1)
    return Estimate(
        (Quantity("yaw_rad", yaw, sigma, "rad"), Quantity("mass_kg", mass, mass_sigma, "kg")),
        covariance, left_n, float(left_n.max()), LIMIT_N, "N",
        note="The yaw is what is left after ft.rotation.",
        obstacle=_obstacle(yaw, sigma),
    )  # fmt: skip


def _obstacle(yaw: float, sigma: float) -> str:
    if abs(yaw) <= LARGEST_YAW_RAD + 2.0 * sigma:
        return ""
    return f"The sensor is turned by {math.degrees(yaw):.1f}°: turn ft.rotation by that."
