"""What an arm answers whose hand stays level: it is not turned, and no joint is driven alone."""

from __future__ import annotations

from backend.core.flow import Pose
from backend.devices.motion import CommandedMotion
from backend.devices.protocols import Joints, Vector

NO_TURNS = "this arm does not turn its hand"


class LevelHand:
    """The part of an arm that turns nothing: all of it raises ``ValueError``."""

    rotates = False
    joint_limits_rad: tuple[tuple[float, float], ...] = ()

    def refuse_turning(self, turn_rad_s: Vector) -> None:
        """Raise for any turn."""
        if any(turn_rad_s):
            raise ValueError(NO_TURNS)

    def joints_rad(self, max_age_s: float) -> Joints:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def place_of(self, joints_rad: Joints) -> Pose:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Refuse."""
        raise ValueError(NO_TURNS)

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> CommandedMotion:
        """Refuse."""
        raise ValueError(NO_TURNS)
