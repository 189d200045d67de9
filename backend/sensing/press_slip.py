"""Slip in the grasp during a press, seen by the gels.

While the piece sticks, gel shear follows the height of the gripper along one straight line: gel,
wrist and contact are springs in series. A piece that slips leaves the gel relaxed, so that the
shear falls short of that line. The shortfall, in mm of gripper travel, is the slip.
"""

from __future__ import annotations

import math

import numpy as np

from backend.core.flow import FINGERS, Finger, FloatArray, Recording

FITTED_PART = (0.15, 0.6)
"""Part of the travel in which the line is fitted: after settling, before a likely slip."""
LEAST_FRAMES = 5
LEAST_TRAVEL_MM = 0.1
LEAST_SLOPE_PX_MM = 1.0
"""A press that moves the markers less than this per mm shows nothing about slip."""


def press_slip_mm(recording: Recording, onset_s: float, end_s: float) -> float:
    """Return the larger slip of the two fingers in mm between ``onset_s`` and ``end_s``.

    NaN if it cannot be judged: no arm positions, too few frames, or hardly any travel.
    """
    slips = [_finger_slip_mm(recording, finger, onset_s, end_s) for finger in FINGERS]
    return math.nan if any(map(math.isnan, slips)) else max(slips)


def _finger_slip_mm(recording: Recording, finger: Finger, onset_s: float, end_s: float) -> float:
    fields = [
        field
        for field in recording.fields
        if field.finger == finger and onset_s <= field.t_s <= end_s
    ]
    if len(fields) < LEAST_FRAMES or not np.isfinite(recording.pose_mm).all():
        return math.nan
    shear_px = np.array([field.displacement_px[:, 1] for field in fields]).mean(axis=1)
    whole = np.isfinite(shear_px)
    shear_px = shear_px[whole]
    travel_mm = _travel_mm(recording, onset_s, np.array([field.t_s for field in fields])[whole])
    deepest_mm = float(travel_mm.max()) if len(travel_mm) else 0.0
    if not deepest_mm >= LEAST_TRAVEL_MM:
        return math.nan
    part = travel_mm / deepest_mm
    fitted = (part >= FITTED_PART[0]) & (part <= FITTED_PART[1])
    if int(fitted.sum()) < LEAST_FRAMES:
        return math.nan
    slope, start = _line(travel_mm[fitted], shear_px[fitted])
    if not abs(slope) >= LEAST_SLOPE_PX_MM:
        return math.nan
    shortfall_mm = travel_mm - (shear_px - start) / slope
    return float(max(0.0, np.median(shortfall_mm[-LEAST_FRAMES:])))


def _line(x: FloatArray, y: FloatArray) -> tuple[float, float]:
    """Return slope and start of the least-squares line through (x, y), both (n,); NaN if none."""
    from_mean = x - x.mean()
    spread = float(from_mean @ from_mean)
    if not spread > 0:
        return math.nan, math.nan
    slope = float(from_mean @ y) / spread
    return slope, float(y.mean() - slope * x.mean())


def _travel_mm(recording: Recording, onset_s: float, t_s: FloatArray) -> FloatArray:
    """Return how far ``G`` has gone down since the onset at the times ``t_s``, empty if unknown."""
    if len(recording.pose_t_s) < 2 or recording.pose_t_s[0] > onset_s:
        return np.zeros(0)
    height_mm = np.interp(t_s, recording.pose_t_s, recording.pose_mm[:, 2])
    onset_mm = np.interp(onset_s, recording.pose_t_s, recording.pose_mm[:, 2])
    return np.asarray(onset_mm - height_mm, dtype=np.float64)
