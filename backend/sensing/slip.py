"""Slip of the piece in the grasp, from marker motion and from the height of the arm.

A held piece that rotates or slides moves the markers under it as one rigid body; the rest is shear
of the gel. While the piece sticks, gel shear is linear in the height of the gripper: gel, wrist and
contact are springs in series. After slip the gel is relaxed and the shear is below that line; the
difference, in mm of gripper travel, is the slip. The arm shows slip too: while unloading, a
sticking piece has the same press force at the same height as while loading; after slip the force
vanishes at a lower height, and the distance of the two lines is the slip. Torsion slip (reliability
G1) rotates the markers of both gels at once. A press rotates them slowly by a few milliradians; a
piece that rotates by a degree does so from one frame to the next.
"""

from __future__ import annotations

import cmath
import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import (
    FINGERS,
    Finger,
    FloatArray,
    MarkerField,
    MarkerState,
    Recording,
    SampleStream,
    Stream,
)


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """``shift_px`` (2,) of the grid's centre, ``turn_rad`` (u towards v), rms ``residual_px``."""

    shift_px: FloatArray
    turn_rad: float
    residual_px: float


def fit_rigid(rest_px: FloatArray, displacement_px: FloatArray) -> RigidMotion:
    """Fit a rotation and a shift to ``displacement_px`` (n, 2) at ``rest_px`` (n, 2).

    Least squares in the plane (Kabsch 1976, two dimensions). Zero without markers.
    """
    if not len(rest_px):
        return RigidMotion(np.zeros(2), 0.0, 0.0)
    # With complex numbers a rotation is one product.
    before, moved = _complex(rest_px), _complex(displacement_px)
    shift = moved.mean()
    before = before - before.mean()
    after = before + (moved - shift)
    turn = cmath.phase(complex(np.vdot(before, after)))
    left = after - before * cmath.rect(1.0, turn)
    residual = math.sqrt(float(np.vdot(left, left).real) / len(left))
    return RigidMotion(np.array([shift.real, shift.imag]), turn, residual)


def _complex(points_px: FloatArray) -> NDArray[np.complex128]:
    """Return (n,) u + iv of (n, 2) points."""
    return np.ascontiguousarray(points_px).view(np.complex128)[:, 0]


FIT_RANGE = (0.15, 0.6)  # part of the travel used for the line: after settling, before likely slip
MIN_FRAMES = 5
MIN_TRAVEL_MM = 0.1
MIN_SLOPE_PX_MM = 1.0  # below this marker motion per mm of travel, slip cannot be judged


def press_slip_mm(recording: Recording, onset_s: float, end_s: float) -> float:
    """Return the larger slip of the two fingers in mm between ``onset_s`` and ``end_s``.

    NaN without arm positions, with too few frames, or too little travel.
    """
    slips = [_finger_slip_mm(recording, finger, onset_s, end_s) for finger in FINGERS]
    return math.nan if any(map(math.isnan, slips)) else max(slips)


def _finger_slip_mm(recording: Recording, finger: Finger, onset_s: float, end_s: float) -> float:
    fields = [
        field
        for field in recording.fields
        if field.finger == finger and onset_s <= field.t_s <= end_s
    ]
    if len(fields) < MIN_FRAMES or not np.isfinite(recording.pose_mm).all():
        return math.nan
    if len(recording.pose_t_s) < 2 or recording.pose_t_s[0] > onset_s:
        return math.nan
    shear_px = np.array([field.displacement_px[:, 1] for field in fields]).mean(axis=1)
    whole = np.isfinite(shear_px)
    shear_px, t_s = shear_px[whole], np.array([field.t_s for field in fields])[whole]
    height_mm = np.interp([onset_s, *t_s], recording.pose_t_s, recording.pose_mm[:, 2])
    return shortfall_mm(height_mm[0] - height_mm[1:], shear_px)


def shortfall_mm(travel_mm: FloatArray, shear_px: FloatArray) -> float:
    """Return by how much the shear of one gel stays behind the travel of the arm, in mm.

    ``travel_mm`` (n,) measured, downwards from the onset; ``shear_px`` (n,) mean over the markers,
    at the same instants. NaN with too few values, or too little travel.
    """
    deepest_mm = float(travel_mm.max(initial=0.0))
    if not deepest_mm >= MIN_TRAVEL_MM:
        return math.nan
    part = travel_mm / deepest_mm
    fitted = (part >= FIT_RANGE[0]) & (part <= FIT_RANGE[1])
    if int(fitted.sum()) < MIN_FRAMES:
        return math.nan
    slope, start = _fit_line(travel_mm[fitted], shear_px[fitted])
    if not abs(slope) >= MIN_SLOPE_PX_MM:
        return math.nan
    behind_mm = travel_mm - (shear_px - start) / slope
    return float(max(0.0, np.median(behind_mm[-MIN_FRAMES:])))


def _fit_line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and start of the least-squares line through (x, y), both (n,); NaN if none."""
    from_mean = x - x.mean()
    spread = float(from_mean @ from_mean)
    if not spread > 0:
        return math.nan, math.nan
    slope = float(from_mean @ y) / spread
    return slope, float(y.mean() - slope * x.mean())


# A piece rotates if the markers of both gels turn by MIN_TURN_RAD within TURN_WINDOW_S, at most
# MAX_FINGER_LAG_S apart. In 1,900 simulated presses (pot and mushroom, presets mixed and hard) the
# gel that turned less turned by at most 0.0026 rad within 0.1 s; a piece that rotated by 1.5
# degrees turned both by 0.006 rad or more.
MIN_TURN_RAD, TURN_WINDOW_S, MAX_FINGER_LAG_S = 0.005, 0.1, 0.15


class TorsionSlipDetector:
    """Detects rotation of the piece in the marker fields of both fingers during one press."""

    def __init__(self, fields: Mapping[Finger, Stream[MarkerField]]) -> None:
        self._fields = fields
        self._cursors = {finger: fields[finger].count for finger in FINGERS}
        self._recent = {finger: deque[tuple[float, float]]() for finger in FINGERS}
        self._jumps = {finger: (float("-inf"), 0.0) for finger in FINGERS}
        # By how much the markers turned as the piece slipped; 0 while it sticks.
        self.turned_rad = 0.0

    def update(self) -> bool:
        """Process fields since the last call; return True if the piece has rotated."""
        for finger in FINGERS:
            fields, self._cursors[finger], _ = self._fields[finger].since(self._cursors[finger])
            for field in fields:
                self._note(finger, field)
        return self.turned_rad > 0.0

    def _note(self, finger: Finger, field: MarkerField) -> None:
        motion = _marker_motion(field)
        if motion is None:
            return
        turn_rad, recent = motion.turn_rad, self._recent[finger]
        recent.append((field.t_s, turn_rad))
        # At least two fields are compared, also if they are further apart.
        while len(recent) > 2 and recent[0][0] < field.t_s - TURN_WINDOW_S:
            recent.popleft()
        jump_rad = max(abs(turn_rad - before_rad) for _, before_rad in recent)
        if jump_rad < MIN_TURN_RAD:
            return
        self._jumps[finger] = field.t_s, jump_rad
        (one_s, one_rad), (other_s, other_rad) = self._jumps.values()
        if abs(one_s - other_s) <= MAX_FINGER_LAG_S:
            self.turned_rad = max(self.turned_rad, min(one_rad, other_rad))


FIT_RANGE_N = (0.5, 4.0)  # range of press force used for the loading line
MIN_SAMPLES = 20


def slip_since_loading(
    recording: Recording, onset_s: float, height_mm: float, press_n: float
) -> float:
    """Return the slip in mm, NaN if the loading line cannot be fitted.

    ``recording`` holds the press; ``height_mm`` and ``press_n`` are the measured height of ``G``
    and the press force after unloading.
    """
    force_n = recording.wrench[:, 2]
    rising = recording.wrench_t_s <= onset_s + 1.5
    inside = (force_n >= FIT_RANGE_N[0]) & (force_n <= FIT_RANGE_N[1]) & rising
    inside &= (recording.wrench_t_s >= onset_s) & np.isfinite(force_n)
    if int(inside.sum()) < MIN_SAMPLES or not len(recording.pose_t_s):
        return float("nan")
    loading_mm = np.interp(
        recording.wrench_t_s[inside], recording.pose_t_s, recording.pose_mm[:, 2]
    )
    # Height has hardly any noise, force has: fit force over height, then invert.
    slope, intercept = np.polyfit(loading_mm, force_n[inside], 1)
    if not slope < 0:
        return float("nan")
    return float(abs(height_mm - (press_n - intercept) / slope))


FIRST_FRAMES = 3  # frames after a step of the jaws that later ones are compared with
LEAST_REST_FRAMES, LEAST_HOLD_FRAMES = 15, 8
FREE_STEPS = 5  # the last steps of an opening in stages, in which the pads are free
# Random walks of a whole marker field (px) and of the wrist (N, N·m) in a second: docs/bench-v1.md
FIELD_WALK_PX, FORCE_WALK_N, MOMENT_WALK_NM = 0.02, 0.0013, 0.00006
FIELD_PX, TURN_RAD = 0.015, 2e-4  # errors of the tracker that do not average out


class TurnDetector:
    """Detects a standing piece that turns while the jaws open in held steps.

    Signals are shift and rotation of the markers of both fingers, and the wrench. Within a hold the
    mean of all frames is compared with the first ones. Once the pads are free of a piece that
    stands, nothing changes any more: a piece that leans on a finger follows it, so that the last
    hold differs from an earlier one, and it loads the hand. Scores are in standard deviations:
    those measured at rest, and the known random walks of the sensors.
    """

    def __init__(self, fields: Mapping[Finger, Stream[MarkerField]], wrench: SampleStream) -> None:
        self._fields, self._wrench = fields, wrench
        self._sd: FloatArray | None = None
        self._holds: list[FloatArray] = []  # signals of each hold

    def learn(self, start_s: float, end_s: float) -> bool:
        """Measure the noise at rest between two bench times; False with too few frames."""
        rows = self._signals(start_s, end_s)
        if len(rows) < LEAST_REST_FRAMES:
            return False
        self._sd = rows[:, 1:].std(axis=0, ddof=1)
        return bool((self._sd > 0.0).all())

    def hold(self, since_s: float, now_s: float) -> float:
        """Return the change since the jaws stood still at ``since_s``; 0 with too few frames."""
        rows = self._signals(since_s, now_s)
        return self._change(rows[:FIRST_FRAMES], rows[FIRST_FRAMES:])

    def keep(self, since_s: float, now_s: float) -> bool:
        """Keep the signals of the hold that ends now, for ``growth``; False with too few frames."""
        self._holds.append(self._signals(since_s, now_s))
        return len(self._holds[-1]) >= LEAST_HOLD_FRAMES

    def growth(self) -> float:
        """Return the change from an earlier hold, with free pads, to the last one kept."""
        if len(self._holds) <= FREE_STEPS:
            return 0.0
        return self._change(self._holds[-1 - FREE_STEPS], self._holds[-1])

    def load(self) -> FloatArray:
        """Return the mean wrench (6,) of the last hold kept; NaN without samples."""
        rows = self._holds[-1] if self._holds else np.empty((0, 13))
        return np.asarray(rows[:, 7:].mean(axis=0)) if len(rows) else np.full(6, np.nan)

    def _change(self, before: FloatArray, after: FloatArray) -> float:
        if self._sd is None or not len(before) or not len(after):
            return 0.0
        change = after[:, 1:].mean(axis=0) - before[:, 1:].mean(axis=0)
        # Means over times t of a random walk differ by the time between their middles, less a sixth
        # of both times.
        apart_s = after[:, 0].mean() - before[:, 0].mean()
        apart_s -= (np.ptp(after[:, 0]) + np.ptp(before[:, 0])) / 6.0
        walk = np.repeat([FIELD_WALK_PX, 0.0, FORCE_WALK_N, MOMENT_WALK_NM], (4, 2, 3, 3))
        fixed = np.repeat([FIELD_PX, TURN_RAD, 0.0], (4, 2, 6))
        variance = (1.0 / len(after) + 1.0 / len(before)) * self._sd**2 + fixed**2
        variance = variance + max(apart_s, 0.0) * walk**2
        return math.sqrt(float((change**2 / variance).sum()))

    def _signals(self, start_s: float, end_s: float) -> FloatArray:
        """Return (n, 13): time of a frame, shifts (u, v of both fingers, px), turns (rad), wrench.

        The wrench is the mean since the frame before. Frames without visible markers are left out.
        """
        moved = ([(f.t_s, _marker_motion(f)) for f in self._fields[finger].between(start_s, end_s)]
                 for finger in FINGERS)  # fmt: skip
        left, right = ([(t_s, one) for t_s, one in rows if one is not None] for rows in moved)
        samples = self._wrench.window(start_s, end_s)
        ends = np.searchsorted(samples.t_s, [t_s for t_s, _ in left], side="right")
        rows, begin = [], 0
        for (t_s, one), (_, other), end in zip(left, right, ends.tolist(), strict=False):
            felt = samples.values[begin:end]
            felt, begin = felt[np.isfinite(felt).all(axis=1)], end
            if len(felt):
                turns = one.turn_rad, other.turn_rad
                rows.append([t_s, *one.shift_px, *other.shift_px, *turns, *felt.mean(axis=0)])
        return np.array(rows, dtype=np.float64).reshape(-1, 13)


def _marker_motion(field: MarkerField) -> RigidMotion | None:
    seen = field.state == MarkerState.SEEN
    moved_px = field.displacement_px[seen]
    if not len(moved_px) or not np.isfinite(moved_px).all():
        return None
    return fit_rigid(field.position_px[seen] - moved_px, moved_px)
