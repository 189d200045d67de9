"""What of a streamed command may reach the wire: joint range, step, and distance to a singularity.

A command outside is refused, never bent into another motion. Every row is a positive comparison,
so that NaN refuses.
"""

from __future__ import annotations

import math

import numpy as np

from backend.core.faults import RefusedError
from backend.core.flow import FloatArray
from backend.devices.melfa.kinematics import LIMITS_RAD, STEPS_RAD

RANGE_MARGIN_RAD = math.radians(2.0)
"""Our limits lie inside those of the controller by this much."""
JOINT_RANGES: tuple[tuple[float, float], ...] = tuple(
    (-limit, limit) for limit in (LIMITS_RAD - RANGE_MARGIN_RAD).tolist()
)
"""Lowest and highest angle of each joint, rad."""
WRIST_RAD = math.radians(8.0)
"""J5 nearer to zero than this: J4 and J6 turn fast for small moves."""
ELBOW_RAD = math.radians(8.0)
"""J3 nearer to straight than this: at the end of the reach."""


def check_joints(joints_rad: FloatArray) -> None:
    """Raise ``RefusedError`` unless the (6,) joints are in range and away from singularities."""
    inside = np.abs(joints_rad) <= LIMITS_RAD - RANGE_MARGIN_RAD
    if not inside.all():
        joint = int(np.argmin(inside)) + 1
        degrees = math.degrees(float(joints_rad[joint - 1]))
        raise RefusedError("JOINT-RANGE", f"J{joint} would be at {degrees:.1f}°.")
    if not abs(float(joints_rad[4])) >= WRIST_RAD:
        raise RefusedError("SINGULAR", "J4 and J6 would come in line.")
    if not abs(float(joints_rad[2])) >= ELBOW_RAD:
        raise RefusedError("SINGULAR", "The arm would be stretched.")


def check_step(before_rad: FloatArray, after_rad: FloatArray, fraction: float) -> None:
    """Raise ``RefusedError`` if a joint turns by more than ``fraction`` of its largest step."""
    share = np.abs(after_rad - before_rad) / STEPS_RAD
    if not (share <= fraction).all():
        joint = int(np.argmax(share)) + 1
        raise RefusedError(
            "STEP", f"J{joint} would turn at {100 * share[joint - 1]:.0f} % of its top speed."
        )
