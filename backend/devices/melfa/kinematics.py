"""Kinematics of the MELFA RV-5AS-D with its joint limits.

Closed form for a hand that points straight down. The arm has no offsets and a spherical wrist; the
posture is always Right, Above, NonFlip. A command outside joint range, step or distance to a
singularity is refused, never changed; every check is a positive comparison, so that NaN is refused.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import IDENTITY_ROTATION, FloatArray, RefusedError
from touchdown.backend.devices.melfa.realtime_protocol import FLANGE_MM, JOINTS

SHOULDER_MM = JOINTS[1].rise_mm
UPPER_MM = JOINTS[2].rise_mm
FORE_MM = JOINTS[4].rise_mm
LIMITS_RAD = np.array([joint.limit_rad for joint in JOINTS])
STEPS_RAD = np.array([joint.step_rad for joint in JOINTS])


def turn_y(angle_rad: float) -> FloatArray:
    """Return the (3, 3) rotation about y."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def turn_z(angle_rad: float) -> FloatArray:
    """Return the (3, 3) rotation about z."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def turn_x(angle_rad: float) -> FloatArray:
    """Return the (3, 3) rotation about x."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def hand_of(a_rad: float, b_rad: float, c_rad: float, euler: str) -> FloatArray:
    """Return the rotation (3, 3) of A, B, C; ``euler`` as in the settings."""
    x, y, z = turn_x(a_rad), turn_y(b_rad), turn_z(c_rad)
    return np.asarray(z @ y @ x if euler.startswith("Rz") else x @ y @ z)


def flange(joints_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return position (3,) mm and rotation (3, 3) of the flange in the base for (6,) joints."""
    q1, q2, q3, q4, q5, q6 = joints_rad.tolist()
    fore = turn_z(q1) @ turn_y(q2 + q3)
    hand = fore @ turn_z(q4) @ turn_y(q5) @ turn_z(q6)
    elbow = turn_z(q1) @ turn_y(q2) @ np.array([0.0, 0.0, UPPER_MM])
    wrist = np.array([0.0, 0.0, SHOULDER_MM]) + elbow + FORE_MM * fore[:, 2]
    return wrist + FLANGE_MM * hand[:, 2], hand


def joints_for(position_mm: FloatArray, hand: FloatArray, near_rad: FloatArray) -> FloatArray:
    """Return the joints (6,) for a flange pose; J1, J4 and J6 in the turn nearest to ``near_rad``.
    Raises ``RefusedError`` REACH without a solution, SINGULAR if it is not unique.
    """
    # Called once per cycle and written out: small arrays take ten times as long.
    (xx, yx, zx), (xy, yy, zy), (xz, yz, zz) = hand.tolist()
    x, y, z = position_mm.tolist()
    x, y, up = x - FLANGE_MM * zx, y - FLANGE_MM * zy, z - FLANGE_MM * zz - SHOULDER_MM
    across = math.hypot(x, y)
    bend = (across**2 + up**2 - UPPER_MM**2 - FORE_MM**2) / (2.0 * UPPER_MM * FORE_MM)
    if not abs(bend) < 1.0:
        raise RefusedError("REACH", "The arm is too short for this place.")
    if not across > 1.0:
        raise RefusedError("SINGULAR", "The wrist is on the axis of J1: J1 is undefined.")
    q1, q3 = math.atan2(y, x), math.acos(bend)
    q2 = math.atan2(across, up) - math.atan2(
        FORE_MM * math.sin(q3), UPPER_MM + FORE_MM * math.cos(q3)
    )
    c, s = math.cos(q1), math.sin(q1)
    sine, cosine = math.sin(q2 + q3), math.cos(q2 + q3)
    # Hand in forearm axes: all of its z, the components of x and y along the forearm.
    out = c * zx + s * zy
    ahead, aside = cosine * out - sine * zz, c * zy - s * zx
    along = sine * out + cosine * zz
    q5 = math.acos(min(max(along, -1.0), 1.0))
    if not abs(math.sin(q5)) > 1e-6:
        raise RefusedError("SINGULAR", "J4 and J6 are in line.")
    q4 = math.atan2(aside, ahead)
    along_x = sine * (c * xx + s * xy) + cosine * xz
    along_y = sine * (c * yx + s * yy) + cosine * yz
    q6 = math.atan2(along_y, -along_x)
    n1, _, _, n4, _, n6 = near_rad.tolist()
    return np.array([_nearest(q1, n1), q2, q3, _nearest(q4, n4), q5, _nearest(q6, n6)])


def _nearest(angle_rad: float, near_rad: float) -> float:
    """Return the angle by whole turns nearest to another."""
    return angle_rad + 2.0 * math.pi * round((near_rad - angle_rad) / (2.0 * math.pi))


@dataclass(frozen=True, slots=True)
class MelfaPlacement:
    """Placement of the bench in the arm's base, and length of the tool.

    ``origin_mm``: bench origin in the base. ``yaw_rad``: turn of the bench about z.
    ``hand_rad``: turn of the flange's x against that of the bench, about z (half a turn leaves J6
    in the middle of its range). ``tool_mm``: from the flange down to the grasp pivot ``G``.
    """

    origin_mm: tuple[float, float, float]
    yaw_rad: float
    hand_rad: float
    tool_mm: float

    @property
    def hand(self) -> FloatArray:
        """Rotation (3, 3) of the flange in the base: z down."""
        c, s = math.cos(self.yaw_rad + self.hand_rad), math.sin(self.yaw_rad + self.hand_rad)
        return np.array([[c, s, 0.0], [s, -c, 0.0], [0.0, 0.0, -1.0]])

    def joints(
        self, pivot_mm: FloatArray, near_rad: FloatArray, turn: FloatArray = IDENTITY_ROTATION
    ) -> FloatArray:
        """Return the (6,) joints that put ``G`` at (3,) mm of the bench, hand down.

        ``turn`` (3, 3): turn of the hand from straight down, in the bench frame.
        """
        bench = turn_z(self.yaw_rad)
        hand = self.hand if turn is IDENTITY_ROTATION else bench @ turn @ bench.T @ self.hand
        at = self.origin_mm + bench @ pivot_mm
        return joints_for(at - self.tool_mm * hand[:, 2], hand, near_rad)

    def turn(self, joints_rad: FloatArray) -> FloatArray:
        """Return the turn of the hand from straight down, (3, 3) in the bench frame."""
        bench = turn_z(self.yaw_rad)
        _, hand = flange(joints_rad)
        return np.asarray(bench.T @ hand @ self.hand.T @ bench)

    def pivot_mm(self, joints_rad: FloatArray) -> FloatArray:
        """Return the position of ``G`` in the bench frame, (3,) mm."""
        # Called three times per cycle and written out: small arrays take ten times as long.
        q1, q2, q3, q4, q5, _ = joints_rad.tolist()
        lean, tilt = q2 + q3, math.sin(q5)
        sine, cosine = math.sin(lean), math.cos(lean)
        x, y, z = math.cos(q4) * tilt, math.sin(q4) * tilt, math.cos(q5)
        reach = FLANGE_MM + self.tool_mm
        out = UPPER_MM * math.sin(q2) + FORE_MM * sine + reach * (cosine * x + sine * z)
        aside = reach * y
        up = SHOULDER_MM + UPPER_MM * math.cos(q2) + FORE_MM * cosine
        up += reach * (cosine * z - sine * x)
        c, s = math.cos(q1), math.sin(q1)
        from_x = c * out - s * aside - self.origin_mm[0]
        from_y = s * out + c * aside - self.origin_mm[1]
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.array([c * from_x + s * from_y, c * from_y - s * from_x, up - self.origin_mm[2]])

    def from_flange(self, position_mm: FloatArray, hand: FloatArray) -> FloatArray:
        """Return the position of ``G`` in the bench frame for a flange position in the base."""
        at = position_mm + self.tool_mm * hand[:, 2]
        return np.asarray(turn_z(-self.yaw_rad) @ (at - np.array(self.origin_mm)))


RANGE_MARGIN_RAD = math.radians(2.0)  # margin of these limits within those of the controller
# Lowest and highest angle of each joint, rad.
JOINT_RANGES: tuple[tuple[float, float], ...] = tuple(
    (-limit, limit) for limit in (LIMITS_RAD - RANGE_MARGIN_RAD).tolist()
)
WRIST_RAD = math.radians(8.0)  # J5 nearer to zero than this: J4 and J6 turn fast for small moves
ELBOW_RAD = math.radians(8.0)  # J3 nearer to straight than this: at the end of the reach


def check_joints(joints_rad: FloatArray) -> None:
    """Raise ``RefusedError`` unless the (6,) joints are in range and away from singularities."""
    inside = np.abs(joints_rad) <= LIMITS_RAD - RANGE_MARGIN_RAD
    if not inside.all():
        joint = int(np.argmin(inside)) + 1
        degrees = math.degrees(float(joints_rad[joint - 1]))
        raise RefusedError("JOINT-RANGE", f"J{joint} would be at {degrees:.1f}°.")
    if not abs(float(joints_rad[4])) >= WRIST_RAD:
        raise RefusedError("SINGULAR", "The axes of J4 and J6 would align.")
    if not abs(float(joints_rad[2])) >= ELBOW_RAD:
        raise RefusedError("SINGULAR", "The elbow would be straight.")


def check_step(before_rad: FloatArray, after_rad: FloatArray, fraction: float) -> None:
    """Raise ``RefusedError`` if a joint turns by more than ``fraction`` of its largest step."""
    share = np.abs(after_rad - before_rad) / STEPS_RAD
    if not (share <= fraction).all():
        joint = int(np.argmax(share)) + 1
        raise RefusedError(
            "STEP", f"J{joint} would turn at {100 * share[joint - 1]:.0f} % of its top speed."
        )
