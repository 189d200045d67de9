"""Where the bottom or board is: its height and tilt from touches, x, y and yaw from its edges."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from backend.calibration.estimate import Estimate, Quantity, Solution, quantities, rms, solve
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray

LIMIT_MM = 0.1
LARGEST_YAW_RAD = math.radians(2.0)
"""A corner 12 mm from the centre is then 0.4 mm off: less than a label is known to."""
TOUCH_SIGMA_MM = 0.05
EDGE_SIGMA_MM = 0.06
"""Standard uncertainty of one touch and one edge: arm, resolution of the search, onset."""
LEAST_TOUCHES = 4
YawOf = Literal["board", "piece", ""]


@dataclass(frozen=True, slots=True)
class Edge:
    """One edge as it was felt, in mm for the arm.

    ``axis`` 0 (x) or 1 (y) across the edge, ``side`` -1 or 1; contact begins at ``at_mm`` of that
    axis, with the piece ``along_mm`` off the centre along the edge.
    """

    axis: int
    side: float
    along_mm: float
    at_mm: float


@dataclass(frozen=True, slots=True)
class Plane:
    """Height over (0, 0) and slopes of a board, with the residuals (n,) of the touches, mm."""

    solution: Solution

    @property
    def residual_mm(self) -> float:
        """Root mean square of the residuals per degree of freedom."""
        return rms(self.solution.residuals, 3)


def fit_plane(touches_mm: FloatArray) -> Plane:
    """Fit z = h + a x + b y to ``touches_mm`` (n, 3).

    Raises ``RefusedError`` "TOUCHES" for fewer than four, "DEGENERATE" if they lie on one line.
    """
    count = len(touches_mm)
    if count < LEAST_TOUCHES:
        raise RefusedError("TOUCHES", f"{count} touches are too few: take {LEAST_TOUCHES} or more.")
    design = np.column_stack([np.ones(count), touches_mm[:, :2]])
    sigma = np.full(count, TOUCH_SIGMA_MM)
    found = solve(design, touches_mm[:, 2], sigma, "All touches lie on one line: spread them.")
    return Plane(found)


def fit_edges(edges: Sequence[Edge], *, yaw: bool) -> Solution:
    """Return (x, y, reach x, reach y[, yaw]) of the felt edges, mm and rad.

    An edge across x is felt at x + side * reach - yaw * along, one across y at
    y + side * reach + yaw * along; the reach is that of piece and board together. Raises
    ``RefusedError`` "EDGES" without a surplus of edges, "DEGENERATE" if a side is missing.
    """
    unknowns = 5 if yaw else 4
    if len(edges) <= unknowns:
        raise RefusedError("EDGES", f"{len(edges)} edges are too few: feel more than {unknowns}.")
    design = np.zeros((len(edges), unknowns))
    for row, edge in zip(design, edges, strict=True):
        row[edge.axis], row[2 + edge.axis] = 1.0, edge.side
        if yaw:
            row[4] = edge.along_mm * (1.0 if edge.axis else -1.0)
    at_mm = np.array([edge.at_mm for edge in edges])
    sigma = np.full(len(edges), EDGE_SIGMA_MM)
    return solve(design, at_mm, sigma, "Feel every edge on both sides, and yaw at two places.")


def estimate_board(touches_mm: FloatArray, edges: Sequence[Edge], yaw_of: YawOf) -> Estimate:
    """Return height, tilt, x, y and yaw of the board.

    ``touches_mm`` (n, 3): places and heights of contact; ``yaw_of``: whose turn the edges told, ""
    for round ones. The residual is the larger of those of plane and edges. Refused as ``fit_plane``
    and ``fit_edges``.
    """
    plane, felt = fit_plane(touches_mm), fit_edges(edges, yaw=bool(yaw_of))
    x, y = felt.x[:2].tolist()
    height, slope_x, slope_y = plane.solution.x
    over = np.array([1.0, x, y])
    found = [
        Quantity("x_mm", x, float(np.sqrt(felt.covariance[0, 0])), "mm"),
        Quantity("y_mm", y, float(np.sqrt(felt.covariance[1, 1])), "mm"),
        Quantity(
            "z_mm",
            float(height + slope_x * x + slope_y * y),
            float(np.sqrt(over @ plane.solution.covariance @ over)),
            "mm",
        ),
    ]
    found += quantities(
        ("slope_x_rad", "slope_y_rad"),
        ("rad", "rad"),
        plane.solution.x[1:],
        plane.solution.covariance[1:, 1:],
    )
    if yaw_of:
        sigma = float(np.sqrt(felt.covariance[4, 4]))
        found.append(Quantity("yaw_rad", float(felt.x[4]), sigma, "rad"))
    edge_mm = rms(felt.residuals, 5 if yaw_of else 4)
    return Estimate(
        tuple(found),
        np.diag([q.sigma**2 for q in found]),
        np.concatenate([plane.solution.residuals, felt.residuals]),
        max(plane.residual_mm, edge_mm), LIMIT_MM, "mm",
        note=_note(yaw_of), obstacle=_obstacle(found[-1]) if yaw_of == "board" else "",
    )  # fmt: skip


def _obstacle(yaw: Quantity) -> str:
    """Return how the bottom is to be turned if it does not lie straight enough, else "".

    Labels and maps take it as straight: the hand does not turn while it presses.
    """
    if abs(yaw.value) <= LARGEST_YAW_RAD + 2.0 * yaw.sigma:
        return ""
    way = "clockwise" if yaw.value > 0.0 else "counter-clockwise"
    turned = math.degrees(yaw.value)
    return (
        f"The bottom is turned by {turned:.1f}°, and labels and maps take it as straight: turn it "
        f"{way}, seen from above, by as much. On a MELFA arm {turned:.1f} may be added to "
        "melfa.yaw_deg of the lab file instead: bench and hand turn with it. Then measure again."
    )


def _note(yaw_of: YawOf) -> str:
    if yaw_of == "board":
        return "The yaw is that of the board: its edges are longer than the piece."
    if yaw_of == "piece":
        return "The yaw is that of the piece in the hand: its edges are longer than the board."
    return "No yaw: an edge is round, or piece and board are of the same length."
