"""Least-squares estimators of board, tool, payload, and sensor yaw.

Board: height and tilt from touches; x, y and yaw from its edges. Tool: centre of the face of a held
piece relative to the tool axis; in each grip the piece touches the edges of a bottom at a known
position. Payload: mass and centre of mass below the wrist sensor, and the bias of the sensor. In
pose k gravity points along g_k in the axes of the hand, so that f_k = m g_k + b and t_k = (m c) x
g_k + d: linear in the ten unknowns m, m c, b, d. Sensor yaw about the tool axis: a tilted hand
projects part of the known direction of gravity into the plane of the sensor; with a = m cos(yaw)
and b = m sin(yaw) the readings are linear in a, b, the mass m and the bias.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from touchdown.backend.calibration.result import (
    CalibrationEstimate,
    LeastSquaresSolution,
    Quantity,
    quantities,
    rms,
    solve_least_squares,
)
from touchdown.backend.core import FloatArray, RefusedError

BOARD_LIMIT_MM = 0.1
# A corner 12 mm from the centre is then 0.4 mm off, less than the error of a label.
MAX_YAW_RAD = math.radians(2.0)
TOUCH_SIGMA_MM = 0.05
# Standard uncertainty of one touch and one edge: arm, search resolution, onset.
EDGE_SIGMA_MM = 0.06
MIN_TOUCHES = 4
YawOf = Literal["board", "piece", ""]


@dataclass(frozen=True, slots=True)
class TouchedEdge:
    """One measured edge, in mm of the arm.

    ``axis`` 0 (x) or 1 (y) across the edge, ``side`` -1 or 1; contact begins at ``at_mm`` of that
    axis, with the piece ``along_mm`` off the centre along the edge.
    """

    axis: int
    side: float
    along_mm: float
    at_mm: float


def fit_plane(touches_mm: FloatArray) -> LeastSquaresSolution:
    """Fit z = h + a x + b y to ``touches_mm`` (n, 3); return height over (0, 0) and slopes.

    Raises ``RefusedError`` "TOUCHES" for fewer than four, "DEGENERATE" if they lie on one line.
    """
    count = len(touches_mm)
    if count < MIN_TOUCHES:
        raise RefusedError("TOUCHES", f"{count} touches are too few: take {MIN_TOUCHES} or more.")
    design = np.column_stack([np.ones(count), touches_mm[:, :2]])
    sigma = np.full(count, TOUCH_SIGMA_MM)
    return solve_least_squares(
        design, touches_mm[:, 2], sigma, "All touches lie on one line: spread them."
    )


def fit_edges(edges: Sequence[TouchedEdge], *, yaw: bool) -> LeastSquaresSolution:
    """Return (x, y, reach x, reach y[, yaw]) of the measured edges, mm and rad.

    An edge across x is measured at x + side * reach - yaw * along, one across y at
    y + side * reach + yaw * along; the reach is that of piece and board together. Raises
    ``RefusedError`` "EDGES" without a surplus of edges, "DEGENERATE" if a side is missing.
    """
    unknowns = 5 if yaw else 4
    if len(edges) <= unknowns:
        raise RefusedError(
            "EDGES", f"{len(edges)} edges are too few: measure more than {unknowns}."
        )
    design = np.zeros((len(edges), unknowns))
    for row, edge in zip(design, edges, strict=True):
        row[edge.axis], row[2 + edge.axis] = 1.0, edge.side
        if yaw:
            row[4] = edge.along_mm * (1.0 if edge.axis else -1.0)
    at_mm = np.array([edge.at_mm for edge in edges])
    sigma = np.full(len(edges), EDGE_SIGMA_MM)
    return solve_least_squares(
        design, at_mm, sigma, "Measure each edge on both sides, and for the yaw at two positions."
    )


def estimate_board(
    touches_mm: FloatArray, edges: Sequence[TouchedEdge], yaw_of: YawOf
) -> CalibrationEstimate:
    """Return height, tilt, x, y and yaw of the board.

    ``touches_mm`` (n, 3): positions and heights of contact; ``yaw_of``: part whose yaw the edges
    determine, "" for round ones. The residual is the larger of those of plane and edges. Raises as
    ``fit_plane`` and ``fit_edges``.
    """
    plane, felt = fit_plane(touches_mm), fit_edges(edges, yaw=bool(yaw_of))
    x, y = felt.x[:2].tolist()
    height, slope_x, slope_y = plane.x
    over = np.array([1.0, x, y])
    z_sigma = float(np.sqrt(over @ plane.covariance @ over))
    found = [
        *quantities(("x_mm", "y_mm"), ("mm", "mm"), felt.x[:2], felt.covariance[:2, :2]),
        Quantity("z_mm", float(height + slope_x * x + slope_y * y), z_sigma, "mm"),
        *quantities(
            ("slope_x_rad", "slope_y_rad"), ("rad", "rad"), plane.x[1:], plane.covariance[1:, 1:]
        ),
    ]
    if yaw_of:
        found += quantities(("yaw_rad",), ("rad",), felt.x[4:], felt.covariance[4:, 4:])
    return CalibrationEstimate(
        tuple(found),
        np.diag([q.sigma**2 for q in found]),
        np.concatenate([plane.residuals, felt.residuals]),
        max(rms(plane.residuals, 3), rms(felt.residuals, len(felt.x))), BOARD_LIMIT_MM, "mm",
        note=YAW_NOTES[yaw_of], obstacle=_bottom_obstacle(found[-1]) if yaw_of == "board" else "",
    )  # fmt: skip


def _bottom_obstacle(yaw: Quantity) -> str:
    """Return the correction of the bottom's yaw if it is too large, else "".

    Labels and maps assume no yaw, since the hand does not rotate while it presses.
    """
    if abs(yaw.value) <= MAX_YAW_RAD + 2.0 * yaw.sigma:
        return ""
    way = "clockwise" if yaw.value > 0.0 else "counter-clockwise"
    turned = math.degrees(yaw.value)
    return (
        f"The bottom is rotated by {turned:.1f}°, but labels and maps assume no rotation: turn it "
        f"{way}, seen from above, by this angle. On a MELFA arm {turned:.1f} may be added to "
        "melfa.yaw_deg of the lab file instead, which rotates bench and hand. Then measure again."
    )


YAW_NOTES: dict[YawOf, str] = {
    "board": "The yaw is that of the board: its edges are longer than the piece.",
    "piece": "The yaw is that of the piece in the hand: its edges are longer than the board.",
    "": "No yaw: an edge is round, or piece and board are of the same length.",
}


TOOL_LIMIT_MM = 0.2
FELT_SIGMA_MM = 0.06  # standard uncertainty of a measured centre of the bottom
_TOOL_NAMES, _TOOL_UNITS = ("face_x_mm", "face_y_mm"), ("mm", "mm")
KNOWN_NOTE = "The centre of the bottom is assumed known; its error is in the face centre."
TOOL_GRIPS = 3


def estimate_tool(
    bottom_mm: FloatArray, bottom_sigma_mm: float, felt_mm: FloatArray
) -> CalibrationEstimate:
    """Return the mean face centre over several grips against a known bottom.

    ``felt_mm`` (n, 2): position of the hand in each grip with the face over the centre of the
    bottom at ``bottom_mm`` (2,), known to ``bottom_sigma_mm`` per axis. The residual is the spread
    of the grips. Raises ``RefusedError`` "GRIPS" for fewer than three.
    """
    count = len(felt_mm)
    if count < TOOL_GRIPS:
        raise RefusedError("GRIPS", f"{count} grips are too few: take {TOOL_GRIPS} or more.")
    face_mm = bottom_mm - felt_mm
    design = np.tile(np.eye(2), (count, 1))
    sigma = np.full(2 * count, FELT_SIGMA_MM)
    found = solve_least_squares(
        design, face_mm.ravel(), sigma, "The grips do not determine the face centre."
    )
    residual_mm = rms(found.residuals, 2)
    spread = max(residual_mm, FELT_SIGMA_MM) ** 2 / count
    covariance = (spread + bottom_sigma_mm**2) * np.eye(2)
    return CalibrationEstimate(
        quantities(_TOOL_NAMES, _TOOL_UNITS, found.x, covariance),
        covariance, found.residuals, residual_mm, TOOL_LIMIT_MM, "mm", note=KNOWN_NOTE,
    )  # fmt: skip


GRAVITY_M_S2 = 9.80665
PAYLOAD_LIMIT_N = 0.3
PAYLOAD_POSES = 6
# Standard uncertainty of a mean at rest: noise, creep and cables.
FORCE_SIGMA_N, MOMENT_SIGMA_NM = 0.02, 0.0008
_PAYLOAD_NAMES = (
    "mass_kg", "com_x_mm", "com_y_mm", "com_z_mm",
    "bias_fx_n", "bias_fy_n", "bias_fz_n", "bias_tx_nm", "bias_ty_nm", "bias_tz_nm",
)  # fmt: skip
_PAYLOAD_UNITS = ("kg", "mm", "mm", "mm", "N", "N", "N", "N·m", "N·m", "N·m")
LEVEL_NOTE = (
    "The hand stayed level: the zero of the sensor is assumed correct, and the height of the "
    "centre of mass is unknown."
)


def estimate_payload(turns: FloatArray, wrenches: FloatArray) -> CalibrationEstimate:
    """Return mass, centre of mass from the sensor, and bias.

    ``turns`` (n, 3, 3): from the axes of the hand to those of the bench; ``wrenches`` (n, 6): mean
    untared readings at rest, N and N·m in the axes of the hand. The residual is the largest force
    that the model leaves over. Raises ``RefusedError`` "POSES" for fewer than six poses,
    "DEGENERATE" if they do not turn the hand about two axes.
    """
    count, gravity = _count_poses(wrenches), _gravity(turns)
    design = np.zeros((count, 6, 10))
    design[:, :3, 0] = gravity
    design[:, :3, 4:7] = np.eye(3)
    # (m c) x g = -M (m c) with the rows e_k x g of M
    design[:, 3:, 1:4] = -np.cross(np.eye(3), gravity[:, None])
    design[:, 3:, 7:] = np.eye(3)
    sigma = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)
    found = solve_least_squares(
        design.reshape(-1, 10),
        wrenches.ravel(),
        np.tile(sigma, count),
        "The poses do not turn the hand enough: lean it by 15 degrees or more about two axes.",
    )
    values, covariance = _centre_from_moments(found.x, found.covariance)
    return _force_estimate(
        quantities(_PAYLOAD_NAMES, _PAYLOAD_UNITS, values, covariance),
        covariance,
        found.residuals.reshape(count, 6)[:, :3],
        obstacle="" if values[0] > 0.0 else "The mass is negative: check ft.sign.",
    )


def estimate_level_payload(wrenches: FloatArray) -> CalibrationEstimate:
    """Return mass and horizontal centre of mass for an arm that keeps its hand level.

    ``wrenches`` (n, 6) as in ``estimate_payload``. One pose cannot separate weight and bias, so the
    bias is assumed zero; the residual contains the lateral force of a sensor that was not zeroed.
    Raises ``RefusedError`` "POSES" for fewer than six readings.
    """
    count = _count_poses(wrenches, "readings")
    if not np.isfinite(wrenches).all():
        raise RefusedError("NOT-FINITE", "A measurement is not a finite number.")
    mean = wrenches.mean(axis=0)
    weight_n = -float(mean[2])
    if weight_n <= 3.0 * FORCE_SIGMA_N:
        raise RefusedError("NO-WEIGHT", f"The sensor carries {weight_n:.2f} N: check ft.sign.")
    x_mm, y_mm = 1e3 * float(mean[4]) / weight_n, -1e3 * float(mean[3]) / weight_n
    change = np.zeros((3, 3))
    # Derivative of (mass, x, y) by (Fz, Tx, Ty).
    change[0, 0] = -1.0 / GRAVITY_M_S2
    change[1] = x_mm / weight_n, 0.0, 1e3 / weight_n
    change[2] = y_mm / weight_n, -1e3 / weight_n, 0.0
    spread = np.diag([FORCE_SIGMA_N, MOMENT_SIGMA_NM, MOMENT_SIGMA_NM]) ** 2 / count
    covariance = change @ spread @ change.T
    values = np.array([weight_n / GRAVITY_M_S2, x_mm, y_mm])
    return _force_estimate(
        quantities(_PAYLOAD_NAMES[:3], _PAYLOAD_UNITS[:3], values, covariance),
        covariance,
        wrenches[:, :3] - [0.0, 0.0, -weight_n],
        note=LEVEL_NOTE,
    )


def _count_poses(wrenches: FloatArray, noun: str = "poses") -> int:
    count = len(wrenches)
    if count < PAYLOAD_POSES:
        raise RefusedError("POSES", f"{count} {noun} are too few: take {PAYLOAD_POSES}.")
    return count


def _gravity(turns: FloatArray) -> FloatArray:
    """Return gravity (n, 3) in the axes of the hand, N/kg."""
    return np.asarray(np.einsum("nji,j->ni", turns, [0.0, 0.0, -GRAVITY_M_S2]))


def _force_estimate(
    found: tuple[Quantity, ...],
    covariance: FloatArray,
    left_n: FloatArray,
    note: str = "",
    obstacle: str = "",
) -> CalibrationEstimate:
    """Return the estimate whose residual is the largest of the forces ``left_n`` (n, 3)."""
    norm_n = np.linalg.norm(left_n, axis=1)
    worst_n, limit_n = float(norm_n.max()), PAYLOAD_LIMIT_N
    return CalibrationEstimate(
        found, covariance, norm_n, worst_n, limit_n, "N", note=note, obstacle=obstacle
    )


def _centre_from_moments(x: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Change m c (kg·m) into c (mm), in values (10,) and covariance (10, 10)."""
    mass = float(x[0])
    centre_mm = 1e3 * x[1:4] / mass
    change = np.eye(10)
    change[1:4, 1:4] *= 1e3 / mass
    change[1:4, 0] = -centre_mm / mass
    values = x.copy()
    values[1:4] = centre_mm
    return values, change @ covariance @ change.T


@dataclass(frozen=True, slots=True)
class PoseReadings:
    """Mean untared readings at rest in several poses of the hand.

    ``t_s`` (n,): middle of each mean; ``turns`` (n, 3, 3): from the axes of the hand to those of
    the bench; ``wrenches`` (n, 6): N and N·m in the axes of the hand; ``sigmas`` (n, 6): standard
    uncertainty of each mean by the noise of its samples.
    """

    t_s: FloatArray
    turns: FloatArray
    wrenches: FloatArray
    sigmas: FloatArray


@dataclass(frozen=True, slots=True)
class WeighedPiece:
    """Mass and centre of mass of a held piece with standard uncertainties.

    ``com_mm`` (3,): x and y from the middle of the face, z above it; ``covariance`` (3, 3), mm².
    """

    mass_g: float
    mass_sigma_g: float
    com_mm: FloatArray
    covariance: FloatArray

    @property
    def sigma_mm(self) -> FloatArray:
        """(3,) standard uncertainty of the centre of mass."""
        return np.sqrt(np.diag(self.covariance))

    def words(self) -> str:
        """Return the displayed form."""
        (x, y, _), (x_sigma, y_sigma, _) = self.com_mm, self.sigma_mm
        return (
            f"The piece weighs {self.mass_g:.1f} ± {self.mass_sigma_g:.1f} g; its centre of mass "
            f"is {x:+.2f} ± {x_sigma:.2f} mm along x and {y:+.2f} ± {y_sigma:.2f} mm along y from "
            "the middle of the face"
        )


WEIGHED_COM_LIMIT_MM = 1.0
# Standard uncertainties: drift of the sensor per square root of a minute, repeated tilt of the
# hand, yaw of the sensor, and face in the grasp (along and across the pads; its height).
DRIFT_SIGMA = (0.012, 0.0005)
TILT_SIGMA_RAD, YAW_SIGMA_RAD = 2e-4, 0.0087
GRASP_SIGMA_MM = (0.5, 0.1, 0.5)


def estimate_held_piece(empty: PoseReadings, held: PoseReadings, lever_mm: float) -> WeighedPiece:
    """Return mass and centre of mass of a held piece from readings without and with it.

    Both readings are taken in the same poses. Their differences hold the weight of the piece and
    the drift between them, a random walk: generalised least squares in the four unknowns m, m c,
    with f = m g and t = (m c) x g. The gripper's share of small differences of the poses is
    subtracted.

    Parameters
    ----------
    empty, held : PoseReadings
        Readings of n poses, six or more, in the same order.
    lever_mm : float
        Height of the sensor above the face.

    Returns
    -------
    WeighedPiece
        The covariance also holds the uncertainty of yaw and grasp. It is scaled up if the
        readings scatter more than expected.

    Raises
    ------
    RefusedError
        "POSES" for fewer than six poses or unequal ones, "DEGENERATE" if they do not tilt the
        hand about two axes, "TOO-LIGHT" if the centre of mass is uncertain by more than 1 mm.

    """
    count = _count_poses(empty.wrenches)
    if len(held.wrenches) != count:
        raise RefusedError("POSES", "The piece was weighed in other poses than the empty gripper.")
    gripper = estimate_payload(empty.turns, empty.wrenches)
    mass_kg = gripper.value("mass_kg")
    moment = 1e-3 * mass_kg * np.array([gripper.value(f"com_{axis}_mm") for axis in "xyz"])
    gravity, change = _gravity(held.turns), _gravity(held.turns) - _gravity(empty.turns)
    left = held.wrenches - empty.wrenches
    left = left - np.hstack([mass_kg * change, np.cross(moment, change)])
    design = np.zeros((count, 6, 4))
    design[:, :3, 0] = gravity
    design[:, 3:, 1:] = -np.cross(np.eye(3), gravity[:, None])
    weight_n = mass_kg * GRAVITY_M_S2
    tilted = np.repeat([weight_n, GRAVITY_M_S2 * float(np.linalg.norm(moment))], 3)
    walk = _shared_drift(empty.t_s, held.t_s)
    rows, values = [], []
    for channel in range(6):
        noise = held.sigmas[:, channel] ** 2 + empty.sigmas[:, channel] ** 2
        noise = noise + 2.0 * (TILT_SIGMA_RAD * tilted[channel]) ** 2
        drift = DRIFT_SIGMA[channel // 3] ** 2 / 60.0
        lower = np.linalg.cholesky(np.diag(noise) + drift * walk)
        rows.append(np.linalg.solve(lower, design[:, channel]))
        values.append(np.linalg.solve(lower, left[:, channel]))
    found = solve_least_squares(
        np.concatenate(rows), np.concatenate(values), np.ones(6 * count),
        "The poses do not turn the hand enough: lean it by 10 degrees or more about two axes.",
    )  # fmt: skip
    scatter = max(1.0, float(found.residuals @ found.residuals) / (6 * count - 4))
    return _weighed_piece(found.x, scatter * found.covariance, lever_mm)


def _shared_drift(empty_s: FloatArray, held_s: FloatArray) -> FloatArray:
    """Return the covariance (n, n) of the differences of a random walk of unit rate, in s."""
    start = min(float(empty_s.min()), float(held_s.min()))
    times = np.concatenate([held_s, empty_s]) - start
    walk = np.minimum(times[:, None], times)
    n = len(held_s)
    return np.asarray(walk[:n, :n] - walk[:n, n:] - walk[n:, :n] + walk[n:, n:])


def _weighed_piece(x: FloatArray, covariance: FloatArray, lever_mm: float) -> WeighedPiece:
    """Return mass and centre of mass of m and m c, ``x`` (4,), in kg and kg·m."""
    mass_kg = float(x[0])
    mass_sigma_kg = math.sqrt(float(covariance[0, 0]))
    if mass_kg <= 3.0 * mass_sigma_kg:
        what = f"The hand carries {1e3 * mass_kg:.0f} g more than empty: nothing can be weighed."
        raise RefusedError("TOO-LIGHT", what)
    centre_mm = 1e3 * x[1:] / mass_kg
    change = np.column_stack([-centre_mm / mass_kg, np.eye(3) * 1e3 / mass_kg])
    spread = change @ covariance @ change.T
    felt_mm = math.sqrt(float(np.diag(spread)[:2].max()))
    across = YAW_SIGMA_RAD * np.array([-centre_mm[1], centre_mm[0], 0.0])
    spread = spread + np.outer(across, across) + np.diag(GRASP_SIGMA_MM) ** 2
    sigma_mm = math.sqrt(float(np.diag(spread)[:2].max()))
    if not sigma_mm <= WEIGHED_COM_LIMIT_MM:
        noise_nmm = felt_mm * mass_kg * GRAVITY_M_S2
        raise RefusedError(
            "TOO-LIGHT",
            f"The piece weighs {1e3 * mass_kg:.0f} g: moments uncertain by {noise_nmm:.2f} N·mm "
            f"leave its centre of mass uncertain by {sigma_mm:.1f} mm, more than "
            f"{WEIGHED_COM_LIMIT_MM:g} mm.",
        )
    com_mm = centre_mm + np.array([0.0, 0.0, lever_mm])
    return WeighedPiece(1e3 * mass_kg, 1e3 * mass_sigma_kg, com_mm, spread)


def estimate_wrist(turns: FloatArray, wrenches: FloatArray) -> CalibrationEstimate:
    """Return the yaw of the sensor relative to the tool; positive from its x to the tool's y.

    ``turns`` (n, 3, 3) and ``wrenches`` (n, 6) as in ``estimate_payload``. The residual is the
    largest force that the model leaves over. Raises ``RefusedError`` "POSES" for fewer than six,
    "DEGENERATE" if the hand hardly leans.
    """
    count, (g_x, g_y, g_z) = _count_poses(wrenches), _gravity(turns).T
    design = np.zeros((count, 3, 6))
    design[:, 0, 0], design[:, 0, 1] = g_x, g_y
    design[:, 1, 0], design[:, 1, 1] = g_y, -g_x
    design[:, 2, 2] = g_z
    design[:, :, 3:] = np.eye(3)
    found = solve_least_squares(
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
    turned = f"The sensor is rotated by {math.degrees(yaw):.1f}°: rotate ft.rotation by this angle."
    return _force_estimate(
        (Quantity("yaw_rad", yaw, sigma, "rad"), Quantity("mass_kg", mass, mass_sigma, "kg")),
        covariance,
        found.residuals.reshape(count, 3),
        note="The yaw is the remainder after ft.rotation.",
        obstacle=turned if abs(yaw) > MAX_YAW_RAD + 2.0 * sigma else "",
    )
