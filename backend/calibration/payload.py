"""What hangs below the wrist sensor: its mass and centre of mass, and the sensor's own bias.

In pose k gravity points along g_k in the axes of the hand, so that f_k = m g_k + b and
t_k = (m c) x g_k + d: linear in the ten unknowns m, m c, b, d.
"""

from __future__ import annotations

import numpy as np

from backend.calibration.estimate import Estimate, quantities, solve
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray

GRAVITY_M_S2 = 9.80665
LIMIT_N = 0.3
POSES = 6
FORCE_SIGMA_N, MOMENT_SIGMA_NM = 0.02, 0.0008
"""Standard uncertainty of a mean over one rest: noise, creep and cables."""
_NAMES = (
    "mass_kg", "com_x_mm", "com_y_mm", "com_z_mm",
    "bias_fx_n", "bias_fy_n", "bias_fz_n", "bias_tx_nm", "bias_ty_nm", "bias_tz_nm",
)  # fmt: skip
_UNITS = ("kg", "mm", "mm", "mm", "N", "N", "N", "N·m", "N·m", "N·m")
LEVEL_NOTE = (
    "The hand stayed level: the sensor's own zero counts as true, and the height of the centre of "
    "mass is not known."
)


def estimate_payload(turns: FloatArray, wrenches: FloatArray) -> Estimate:
    """Return mass, centre of mass from the sensor, and bias.

    ``turns`` (n, 3, 3): from the axes of the hand to those of the bench; ``wrenches`` (n, 6): mean
    untared readings at rest, N and N·m in the axes of the hand. The residual is the largest force
    that the model leaves over. Raises ``RefusedError`` "POSES" for fewer than six poses,
    "DEGENERATE" if they do not turn the hand about two axes.
    """
    count = len(wrenches)
    if count < POSES:
        raise RefusedError("POSES", f"{count} poses are too few: take {POSES}.")
    gravity = np.einsum("nji,j->ni", turns, [0.0, 0.0, -GRAVITY_M_S2])
    design = np.zeros((count, 6, 10))
    design[:, :3, 0] = gravity
    design[:, :3, 4:7] = np.eye(3)
    design[:, 3:, 1:4] = -_cross(gravity)
    design[:, 3:, 7:] = np.eye(3)
    sigma = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)
    found = solve(
        design.reshape(-1, 10),
        wrenches.ravel(),
        np.tile(sigma, count),
        "The poses do not turn the hand enough: lean it by 15 degrees or more about two axes.",
    )
    values, covariance = _centred(found.x, found.covariance)
    left_n = np.linalg.norm(found.residuals.reshape(count, 6)[:, :3], axis=1)
    obstacle = "" if values[0] > 0.0 else "The mass comes out negative: check ft.sign."
    return Estimate(
        quantities(_NAMES, _UNITS, values, covariance),
        covariance, left_n, float(left_n.max()), LIMIT_N, "N", obstacle=obstacle,
    )  # fmt: skip


def estimate_level_payload(wrenches: FloatArray) -> Estimate:
    """Return mass and centre of mass in the plane, of an arm that keeps its hand level.

    ``wrenches`` (n, 6) as in ``estimate_payload``. Weight and bias cannot be told apart in one
    pose, so the bias counts as zero: a sensor that was not zeroed shows as sideways force in the
    residual. Raises ``RefusedError`` "POSES" for fewer than six readings.
    """
    count = len(wrenches)
    if count < POSES:
        raise RefusedError("POSES", f"{count} readings are too few: take {POSES}.")
    if not np.isfinite(wrenches).all():
        raise RefusedError("NOT-FINITE", "A measurement is not a finite number.")
    mean = wrenches.mean(axis=0)
    weight_n = -float(mean[2])
    if weight_n <= 3.0 * FORCE_SIGMA_N:
        raise RefusedError("NO-WEIGHT", f"The sensor carries {weight_n:.2f} N: check ft.sign.")
    x_mm, y_mm = 1e3 * float(mean[4]) / weight_n, -1e3 * float(mean[3]) / weight_n
    change = np.zeros((3, 3))
    # Of (mass, x, y) by (Fz, Tx, Ty).
    change[0, 0] = -1.0 / GRAVITY_M_S2
    change[1] = x_mm / weight_n, 0.0, 1e3 / weight_n
    change[2] = y_mm / weight_n, -1e3 / weight_n, 0.0
    spread = np.diag([FORCE_SIGMA_N, MOMENT_SIGMA_NM, MOMENT_SIGMA_NM]) ** 2 / count
    covariance = change @ spread @ change.T
    left_n = np.linalg.norm(wrenches[:, :3] - [0.0, 0.0, -weight_n], axis=1)
    return Estimate(
        quantities(
            (_NAMES[0], *_NAMES[1:3]),
            _UNITS[:3],
            np.array([weight_n / GRAVITY_M_S2, x_mm, y_mm]),
            covariance,
        ),
        covariance, left_n, float(left_n.max()), LIMIT_N, "N", note=LEVEL_NOTE,
    )  # fmt: skip


def _cross(vectors: FloatArray) -> FloatArray:
    """Return (n, 3, 3): the matrices of v x."""
    x, y, z = vectors.T
    o = np.zeros_like(x)
    return np.stack([np.stack([o, -z, y], 1), np.stack([z, o, -x], 1), np.stack([-y, x, o], 1)], 1)


def _centred(x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change m c (kg·m) into c (mm), in values (10,) and covariance (10, 10)."""
    mass = float(x[0])
    centre_mm = 1e3 * x[1:4] / mass
    change = np.eye(10)
    change[1:4, 1:4] *= 1e3 / mass
    change[1:4, 0] = -centre_mm / mass
    values = x.copy()
    values[1:4] = centre_mm
    return values, change @ covariance @ change.T
