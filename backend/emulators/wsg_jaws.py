"""The jaws of an emulated WSG: width, part, grasping state and motion as functions of time."""

from __future__ import annotations

from dataclasses import dataclass

from backend.wire.wsg_words import Command, GraspState, Status, SystemFlag

CLAMPING_TRAVEL_MM = 3.0
"""How far grasp closes beyond the nominal width before it gives up."""


@dataclass(frozen=True, slots=True)
class Profile:
    """What a gripper can do: mm, mm/s, mm/s², N as the sum over both fingers."""

    kind: int = 0
    stroke_mm: float = 66.0
    speed_mm_s: tuple[float, float] = (5.0, 400.0)
    acceleration_mm_s2: tuple[float, float] = (100.0, 5000.0)
    force_sum_n: tuple[float, float] = (5.0, 50.0)


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion under way, from ``start_mm`` at ``begun_s``; speed signed, closing below 0."""

    command: Command
    start_mm: float
    target_mm: float
    begun_s: float
    velocity_mm_s: float

    def width_mm(self, now_s: float) -> float:
        """Width at a time; the target once it is reached."""
        width = self.start_mm + self.velocity_mm_s * (now_s - self.begun_s)
        return max(width, self.target_mm) if self.velocity_mm_s < 0 else min(width, self.target_mm)


class Jaws:
    """``part_mm`` is the width of a part between the fingers; None if there is none."""

    def __init__(self, profile: Profile, part_mm: float | None = None) -> None:
        self.profile, self.part_mm = profile, part_mm
        self.width_mm = profile.stroke_mm
        self.force_limit_n = profile.force_sum_n[0]
        self.state = GraspState.IDLE
        self.flags = SystemFlag(0)
        self.motion: Motion | None = None
        self.statistics = (0, 0, 0)
        """Grasps in all, without a part, with a part that was lost."""

    def count(self, *, missed: int = 0, lost: int = 0) -> None:
        """Count a grasp that ended (``missed``: without a part), or a part that was ``lost``."""
        total, no_part, lost_parts = self.statistics
        self.statistics = (total + 1 - lost, no_part + missed, lost_parts + lost)

    @property
    def force_n(self) -> float:
        """Sum over both fingers."""
        return self.force_limit_n if self.state is GraspState.HOLDING else 0.0

    def begin(self, now_s: float, command: Command, target_mm: float, speed_mm_s: float) -> None:
        """Start a motion; width and speed are clamped to what the gripper can do."""
        slowest, fastest = self.profile.speed_mm_s
        speed = min(max(speed_mm_s, slowest), fastest)
        target = min(max(target_mm, 0.0), self.profile.stroke_mm)
        velocity = speed if target >= self.width_mm else -speed
        self.motion = Motion(command, self.width_mm, target, now_s, velocity)
        self.flags &= ~(
            SystemFlag.BLOCKED_MINUS | SystemFlag.AXIS_STOPPED | SystemFlag.TARGET_POS_REACHED
        )
        self.flags |= SystemFlag.MOVING
        self.state = {
            Command.GRASP: GraspState.GRASPING,
            Command.RELEASE: GraspState.RELEASING,
        }.get(command, GraspState.POSITIONING)

    def halt(self) -> Motion | None:
        """Stop where they are; return the motion that this ended."""
        motion, self.motion = self.motion, None
        self.flags = (self.flags & ~SystemFlag.MOVING) | SystemFlag.AXIS_STOPPED
        self.state = GraspState.IDLE
        return motion

    def let_go(self) -> None:
        """Hold nothing any more, without a motion: the fingers have no force."""
        self.state = GraspState.IDLE

    def advance(self, now_s: float) -> tuple[Command, Status] | None:
        """Move on to ``now_s``; return command and result of a motion that ended."""
        if self.state is GraspState.HOLDING and self.part_mm is None:
            self.state = GraspState.PART_LOST
            self.count(lost=1)
        motion = self.motion
        if motion is None:
            return None
        width, part = motion.width_mm(now_s), self.part_mm
        if part is not None and motion.velocity_mm_s < 0 and width <= part <= motion.start_mm:
            self.width_mm = part
            return self._end(motion, blocked=True)
        self.width_mm = width
        return self._end(motion, blocked=False) if width == motion.target_mm else None

    def _end(self, motion: Motion, *, blocked: bool) -> tuple[Command, Status]:
        self.motion = None
        self.flags &= ~SystemFlag.MOVING
        if motion.command is Command.GRASP:
            self.state = GraspState.HOLDING if blocked else GraspState.NO_PART_FOUND
            self.count(missed=not blocked)
            return motion.command, Status.SUCCESS if blocked else Status.CMD_FAILED
        self.state = GraspState.IDLE
        if blocked:
            self.flags |= SystemFlag.BLOCKED_MINUS
            return motion.command, Status.AXIS_BLOCKED
        self.flags |= SystemFlag.TARGET_POS_REACHED
        if motion.command is Command.HOME:
            self.flags |= SystemFlag.REFERENCED
        return motion.command, Status.SUCCESS
