"""Grip slip seen by the arm: loading and unloading must follow one line of height against force.

While the piece sticks in the grasp, gel and arm are springs: on the way back the press force is the
same at the same height. If the piece slipped while pressed, the force vanishes at a lower height;
the distance between the two lines is the slip.
"""

from __future__ import annotations

import numpy as np

from backend.core.flow import Recording

FIT_N = (0.5, 4.0)
"""Range of press force in which the loading line is fitted."""
FEWEST_SAMPLES = 20


def slip_since_loading(
    recording: Recording, onset_s: float, height_mm: float, press_n: float
) -> float:
    """Return the slip in mm, NaN if the loading line cannot be fitted.

    ``recording`` holds the press; ``height_mm`` and ``press_n`` are the measured height of ``G``
    and the press force after unloading.
    """
    force_n = recording.wrench[:, 2]
    rising = recording.wrench_t_s <= onset_s + 1.5
    inside = (force_n >= FIT_N[0]) & (force_n <= FIT_N[1]) & rising
    inside &= (recording.wrench_t_s >= onset_s) & np.isfinite(force_n)
    if int(inside.sum()) < FEWEST_SAMPLES or not len(recording.pose_t_s):
        return float("nan")
    loading_mm = np.interp(
        recording.wrench_t_s[inside], recording.pose_t_s, recording.pose_mm[:, 2]
    )
    # Height is nearly free of noise and force is not: fit force over height, then invert.
    slope, intercept = np.polyfit(loading_mm, force_n[inside], 1)
    if not slope < 0:
        return float("nan")
    return float(abs(height_mm - (press_n - intercept) / slope))
