"""Rotation vectors (rad) and rotation matrices of the hand, in the bench frame.

The unrotated hand points straight down; a (3, 3) rotation maps its axes to their directions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import FloatArray, Pose

IDENTITY_ROTATION = np.eye(3)
IDENTITY_ROTATION.flags.writeable = False
LEVEL_TOLERANCE_RAD = math.radians(0.2)  # A hand rotated by less than this counts as level


def rotation_from_vector(vector_rad: FloatArray) -> FloatArray:
    """Return the (3, 3) rotation matrix of a rotation vector (3,), in rad."""
    angle = math.sqrt(float(vector_rad @ vector_rad))
    if angle == 0.0:
        return IDENTITY_ROTATION
    x, y, z = (vector_rad / angle).tolist()
    c, s = math.cos(angle), math.sin(angle)
    k = 1.0 - c
    return np.array(
        [
            [c + k * x * x, k * x * y - s * z, k * x * z + s * y],
            [k * x * y + s * z, c + k * y * y, k * y * z - s * x],
            [k * x * z - s * y, k * y * z + s * x, c + k * z * z],
        ]
    )


def rotation_from_quaternion(quaternion: Sequence[float] | FloatArray) -> FloatArray:
    """Return the (3, 3) rotation matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def rotation_vector(turn: FloatArray) -> FloatArray:
    """Return the rotation vector (3,), in rad, of a (3, 3) matrix; its length is 0 to pi."""
    odd = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    size, even = math.sqrt(float(odd @ odd)), float(np.trace(turn)) - 1.0
    angle = math.atan2(size, even)
    if size > 1e-6:
        return np.asarray(odd * (angle / size))
    if even > 0.0:
        return np.asarray(0.5 * odd)
    # Half a turn: the axis is the longest column of R + I.
    left = turn + IDENTITY_ROTATION
    axis = left[:, int(np.argmax(np.diag(left)))]
    return np.asarray(axis * (angle / math.sqrt(float(axis @ axis))))


def pose_rotation(pose: Pose) -> FloatArray:
    """Return the (3, 3) rotation matrix of a pose."""
    return rotation_from_vector(np.array([pose.rx_rad, pose.ry_rad, pose.rz_rad]))


def rotation_angle_rad(pose: Pose) -> float:
    """Return the rotation angle of the hand."""
    return math.hypot(pose.rx_rad, pose.ry_rad, pose.rz_rad)


def tilt_rad(turn: FloatArray) -> float:
    """Return the angle between the hand, rotated by (3, 3) ``turn``, and straight down."""
    return math.atan2(math.hypot(turn[0, 2], turn[1, 2]), float(turn[2, 2]))


def tilt_margin_rad(turn: FloatArray, axis: FloatArray, most_rad: float) -> float:
    """Return the rotation about ``axis`` at which the tilt of the hand reaches ``most_rad``.

    ``axis`` (3,): unit vector in the bench frame. Infinite if the tilt never gets so large; 0 if
    it is already exceeded and would grow.
    """
    down = turn[:, 2]
    along = float(axis[2]) * float(axis @ down)
    even = float(down[2]) - along
    odd = float(axis[0] * down[1] - axis[1] * down[0])
    swing = math.hypot(even, odd)
    if swing < 1e-12:
        return math.inf
    share = (math.cos(most_rad) - along) / swing
    if share <= -1.0:
        return math.inf
    begin = math.atan2(odd, even)
    if share >= 1.0:
        return 0.0
    return max(begin + math.acos(share), 0.0)


def require_unrotated(turn: FloatArray) -> None:
    """Raise ``RefusedError`` unless the hand points straight down without rotation."""
    vector = rotation_vector(turn)
    angle = math.sqrt(float(vector @ vector))
    if not angle <= LEVEL_TOLERANCE_RAD:
        raise RefusedError(
            "TURNED",
            f"The hand is turned by {math.degrees(angle):.1f}°: level it first (Operate, Level).",
        )
