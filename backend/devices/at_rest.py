"""Whether an arm stands, by the places that it told: one place alone is no evidence of rest."""

from __future__ import annotations

import math

import numpy as np

from backend.core.flow import FloatArray
from backend.core.stream import SampleStream

STILL_S = 0.2
"""So long an arm has stood before jaws may open."""
TOLD_S = 0.8
"""An arm whose controller holds it by a program of its own tells its place some ten times a second,
and later while variables are written: then the last two places of this time count."""


def last_places_mm(poses: SampleStream, now_s: float) -> FloatArray:
    """Return the places (n, 3) of the last ``STILL_S``, mm; the last two at least, or none."""
    told = poses.window(now_s - TOLD_S, now_s)
    recent = int((told.t_s >= now_s - STILL_S).sum())
    count = len(told.t_s)
    return told.values[count - max(recent, 2) :] if count >= 2 else np.empty((0, 3))


def travelled_mm(places_mm: FloatArray) -> float:
    """Return the largest travel on one axis between ``places_mm`` (n, 3); NaN of fewer than two."""
    return float(np.ptp(places_mm, axis=0).max()) if len(places_mm) > 1 else math.nan
