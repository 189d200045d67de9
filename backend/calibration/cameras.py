"""Calibration of the tactile cameras: scale, mirroring, finger, and gel fingerprint.

The scale follows from the known pitch of the printed dots. Orientation and finger of a picture
follow from presses off the centre: the dots move up in every picture, more on the finger nearer to
the contact, and rotate in opposite directions on the left and on the right.

The fingerprint of a gel is the rest position of its 63 dots in the raw picture, independent of the
mirroring in the settings. Five recordings of one real gel with a held piece differ by 0.6 to 1.5 px
(rms), two real gels by 5.2 px or more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from touchdown.backend.calibration.result import (
    MIRROR_CODES,
    CalibrationEstimate,
    LeastSquaresSolution,
    Quantity,
    rms,
    solve_least_squares,
)
from touchdown.backend.core import (
    FINGERS,
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    Finger,
    FloatArray,
    RefusedError,
)
from touchdown.backend.sensing import HEIGHT_PX, WIDTH_PX

# The dots of a real gel lie 1.7 px (rms) off a straight lattice (lens, curved gel). A dot confused
# with its neighbour is 32 px off.
LATTICE_LIMIT_PX = 3.0
DOT_SIGMA_PX = 0.1  # standard uncertainty of the mean position of a dot: tracker and print
MIN_MOTION_PX = 1.0
MIN_LEAD_PX = 0.4
MIN_TURN_RAD = 0.001  # smaller differences between two presses do not distinguish fingers or turns
# Smallest difference between the fingers in standard errors, over repeated presses.
MIN_LEAD_ERRORS = 2.5
MIN_SPREAD_PX = 0.6  # lower bound of the standard deviation, which three presses determine poorly
AXES = {"x": "x", "y": "y", "both": "x and y"}
Side = Literal["+x", "-x", "+y", "-y"]
SIDES: tuple[Side, ...] = ("+x", "-x", "+y", "-y")
_ROW, _COL = np.divmod(np.arange(MARKERS), GRID_COLS)


@dataclass(frozen=True, slots=True)
class SidePress:
    """One press with the face displaced to ``side`` of the bottom; fields (2, 63, 2) in px.

    ``rest_px``: dots before it, ``moved_px``: their motion; the first is the camera configured as
    left.
    """

    side: Side
    rest_px: FloatArray
    moved_px: FloatArray


@dataclass(frozen=True, slots=True)
class MarkerLattice:
    """Straight lattice through (63, 2) dots: origin, step by column and by row (px)."""

    solution: tuple[LeastSquaresSolution, LeastSquaresSolution]

    def scale_mm_px(self, pitch_mm: float) -> tuple[Quantity, Quantity]:
        """Return mm per px along the columns and along the rows, unnamed."""
        u, v = self.solution
        found = []
        for k, axis in ((1, "u"), (2, "v")):
            step = np.array([u.x[k], v.x[k]])
            length = float(np.linalg.norm(step))
            along = step / length
            variance = along[0] ** 2 * u.covariance[k, k] + along[1] ** 2 * v.covariance[k, k]
            # Deviations from a straight lattice increase the uncertainty of its steps.
            spread = max(1.0, rms(np.concatenate([u.residuals, v.residuals]), 6) / DOT_SIGMA_PX)
            scale = pitch_mm / length
            sigma = spread * scale * float(np.sqrt(variance)) / length
            found.append(Quantity(axis, scale, sigma, "mm/px"))
        return found[0], found[1]

    @property
    def residuals_px(self) -> FloatArray:
        """(63,) distance of each dot from its lattice point."""
        u, v = self.solution
        return np.asarray(np.hypot(u.residuals, v.residuals))


def fit_lattice(position_px: FloatArray) -> MarkerLattice:
    """Fit the 7 x 9 lattice to ``position_px`` (63, 2); ``RefusedError`` where a dot is missing."""
    if position_px.shape != (MARKERS, 2):
        raise RefusedError("MARKERS", f"The lattice has {GRID_ROWS} x {GRID_COLS} dots.")
    middle = np.column_stack([np.ones(MARKERS), _COL - GRID_COLS // 2, _ROW - GRID_ROWS // 2])
    sigma = np.full(MARKERS, DOT_SIGMA_PX)
    u, v = (solve_least_squares(middle, position_px[:, k], sigma, "No lattice.") for k in range(2))
    return MarkerLattice((u, v))


def image_motion(rest_px: FloatArray, moved_px: FloatArray) -> tuple[FloatArray, float]:
    """Return mean shift (2,) in px and rotation in rad (u to v) of a field (63, 2)."""
    arm = rest_px - rest_px.mean(axis=0)
    shift = moved_px.mean(axis=0)
    across = arm[:, 0] * moved_px[:, 1] - arm[:, 1] * moved_px[:, 0]
    return shift, float(across.sum() / (arm**2).sum())


@dataclass(frozen=True, slots=True)
class CameraArrangement:
    """Actual mounting of the cameras: ``exchanged``, and mirroring needed for each picture."""

    exchanged: bool
    mirror: dict[Finger, str]

    def words(self) -> str:
        """Return the arrangement as a sentence."""
        said = ["left and right are exchanged"] if self.exchanged else []
        for finger in FINGERS:
            mirror = self.mirror[finger]
            if mirror != "none":
                said.append(f"the {finger} picture is mirrored in {AXES[mirror]}")
        if not said:
            return "Finger and mirroring agree with the settings."
        text = ", ".join(said)
        return f"{text[0].upper()}{text[1:]}: corrected from the next start on."

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """``exchanged`` (0, 1) and the mirror of each finger by its code in ``MIRROR_CODES``."""
        mirrors = (
            Quantity(f"{finger}_mirror", float(MIRROR_CODES.index(self.mirror[finger])), 0.0, "")
            for finger in FINGERS
        )
        return (Quantity("exchanged", float(self.exchanged), 0.0, ""), *mirrors)


def finger_lead_px(pushes: Sequence[SidePress]) -> FloatArray:
    """Return (n,) excess motion of the second picture, +y minus -y press, for n pairs.

    Creep of the gels between presses is of similar size, so that presses must be repeated.
    """
    there, back = (np.abs(_motions(pushes, side)[..., 1]) for side in ("+y", "-y"))
    pairs = min(len(there), len(back))
    excess = there[:pairs] - back[:pairs]
    return np.asarray(excess[:, 1] - excess[:, 0])


def fingers_distinguishable(pushes: Sequence[SidePress]) -> bool:
    """Return True if the difference between the fingers is significant."""
    leads = finger_lead_px(pushes)
    lead_px = abs(float(leads.mean()))
    if len(leads) < 2:
        return lead_px >= MIN_LEAD_PX
    spread_px = max(float(leads.std(ddof=1)), MIN_SPREAD_PX)
    error_px = spread_px / math.sqrt(len(leads))
    return lead_px >= max(MIN_LEAD_PX, MIN_LEAD_ERRORS * error_px)


def find_arrangement(pushes: Sequence[SidePress]) -> CameraArrangement:
    """Return the arrangement of the cameras, from at least one press to each side.

    Raises ``RefusedError`` "PUSHES" if a side is missing, "WEAK-PUSH" if the dots hardly move,
    "EVEN-PUSH" if both fingers move equally.
    """
    if {push.side for push in pushes} != set(SIDES):
        raise RefusedError("PUSHES", "Press at least once on each of the four sides.")
    mean = {side: _motions(pushes, side).mean(axis=0) for side in SIDES}
    along_v = np.mean([motion[:, 1] for motion in mean.values()], axis=0)
    if np.abs(along_v).min() < MIN_MOTION_PX:
        raise RefusedError("WEAK-PUSH", "The dots hardly move: press harder, or clean the gels.")
    flipped = along_v > 0.0
    # Displaced to +y the face touches on its -y side, the side of the right finger.
    lead_px = float(finger_lead_px(pushes).mean())
    # Displaced to +x the contact lifts the -x side: the left picture rotates from u to v.
    turned = mean["+x"][:, 2] - mean["-x"][:, 2]
    if not fingers_distinguishable(pushes) or np.abs(turned).min() < MIN_TURN_RAD:
        raise RefusedError("EVEN-PUSH", "Both fingers move equally: press farther off the centre.")
    exchanged = lead_px < 0.0
    expected = np.array([-1.0, 1.0]) if exchanged else np.array([1.0, -1.0])
    reversed_u = np.sign(turned) * np.where(flipped, -1.0, 1.0) != expected
    names = reversed(FINGERS) if exchanged else iter(FINGERS)
    mirror: dict[Finger, str] = {}
    for finger, u, v in zip(names, reversed_u.tolist(), flipped.tolist(), strict=True):
        mirror[finger] = {(0, 0): "none", (1, 0): "x", (0, 1): "y", (1, 1): "both"}[u, v]
    return CameraArrangement(exchanged, mirror)


def estimate_cameras(pushes: Sequence[SidePress], pitch_mm: float) -> CalibrationEstimate:
    """Return arrangement and scale (mm/px) of both cameras.

    ``exchanged`` and mirrors are relative to the settings in use. The residual is the larger rms
    distance of the dots from a straight lattice. Raises as ``find_arrangement``.
    """
    setting = find_arrangement(pushes)
    found, left_px = list(setting.quantities), []
    order = tuple(reversed(FINGERS)) if setting.exchanged else FINGERS
    for index, finger in enumerate(order):
        lattice = fit_lattice(np.mean([push.rest_px[index] for push in pushes], axis=0))
        left_px.append(lattice.residuals_px)
        for axis in lattice.scale_mm_px(pitch_mm):
            found.append(Quantity(f"{finger}_{axis.name}_mm_px", axis.value, axis.sigma, axis.unit))
    residual_px = max(rms(left, 6) for left in left_px)
    return CalibrationEstimate(
        tuple(found),
        np.diag([q.sigma**2 for q in found]),
        np.concatenate(left_px), residual_px, LATTICE_LIMIT_PX, "px",
        note=setting.words(),
    )  # fmt: skip


def _motions(pushes: Sequence[SidePress], side: Side) -> FloatArray:
    """Return (n, 2, 3): shift in u and v, and rotation of both pictures in each press to a side."""
    rows = []
    for push in pushes:
        if push.side == side:
            both = (image_motion(push.rest_px[k], push.moved_px[k]) for k in range(2))
            rows.append([[*shift, turn] for shift, turn in both])
    return np.array(rows, dtype=np.float64).reshape(-1, 2, 3)


FINGERPRINT_LIMIT_PX = 1.0  # the same gel rests within this (rms) of its fingerprint
# The same with a held piece, which presses the gel out of its rest by at most 1.5 px.
HELD_LIMIT_PX = 3.0
CREEP_PX = 2.0  # common motion that is ignored: creep, and expansion of the warm housing
MIN_DOTS = 48  # smallest number of seen dots for identification
FINGERPRINT_VALUES = 2 * MARKERS


def fingerprint_distance_px(now_px: FloatArray, then_px: FloatArray) -> float:
    """Return the rms distance of dots (63, 2) from a fingerprint (63, 2), px; NaN: not seen.

    A common shift of up to ``CREEP_PX`` is ignored. Infinite if too few dots are seen.
    """
    seen = np.isfinite(now_px).all(axis=1)
    if np.count_nonzero(seen) < MIN_DOTS:
        return float("inf")
    moved = (now_px - then_px)[seen]
    whole = moved.mean(axis=0)
    length = float(np.linalg.norm(whole))
    crept = whole * min(1.0, CREEP_PX / length) if length > 0.0 else whole
    return float(np.sqrt(((moved - crept) ** 2).sum(axis=1).mean()))


def mirrored_dots(position_px: FloatArray, mirror: str) -> FloatArray:
    """Return the dots (63, 2) of the mirrored picture, row-major."""
    code = MIRROR_CODES.index(mirror)
    grid = position_px.reshape(GRID_ROWS, GRID_COLS, 2).copy()
    if code & 1:
        grid = grid[:, ::-1]
        grid[..., 0] = WIDTH_PX - 1 - grid[..., 0]
    if code & 2:
        grid = grid[::-1]
        grid[..., 1] = HEIGHT_PX - 1 - grid[..., 1]
    return grid.reshape(MARKERS, 2)


def dots_to_numbers(position_px: FloatArray) -> tuple[float, ...]:
    """Return dots (63, 2) as stored in a file: u, v of each dot, rounded to 0.001 px."""
    return tuple(np.round(position_px, 3).ravel().tolist())


def numbers_to_dots(numbers: Sequence[float]) -> FloatArray:
    """Return the dots (63, 2) of a file."""
    return np.array(numbers, dtype=np.float64).reshape(MARKERS, 2)


def identify_gel(
    now_px: FloatArray, known: Mapping[str, FloatArray], own: str, limit_px: float
) -> tuple[str, str]:
    """Return the name in ``known`` whose fingerprint fits the dots, and the mirroring.

    Both are "" if none fits. Gels of two fingers may be mirror images: exchange is tried before
    mirroring, and both at once last.
    """
    names = sorted(known, key=lambda name: name != own)
    tries = [(name, "none") for name in names]
    tries += [(name, mirror) for name in names for mirror in MIRROR_CODES[1:]]
    for name, mirror in tries:
        if fingerprint_distance_px(mirrored_dots(now_px, mirror), known[name]) < limit_px:
            return name, mirror
    return "", ""
