"""The simulated arm as a device, with the kinematics of an RV-5AS."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import numpy as np

from touchdown.backend import core
from touchdown.backend.config import MelfaSettings
from touchdown.backend.devices import (
    RETREAT_MM,
    RETREAT_MM_S,
    STILL,
    TURN_RAD_S,
    ArmPress,
    ArmStatus,
    CommandedMotion,
    Joints,
    PressCommand,
    RobotMode,
    SafetyMode,
    Vector,
    servo_off_fault,
    stopped_fault,
)
from touchdown.backend.devices.melfa import JOINT_RANGES, MelfaPlacement, check_joints
from touchdown.backend.devices.streamed import press_fields
from touchdown.backend.simulation.arm import (
    HandPose,
    JointKinematics,
    SimJog,
    SimJointJog,
    SimJointTravel,
    SimPress,
    SimProgram,
    SimRotationJog,
    SimRotationTravel,
)
from touchdown.backend.simulation.devices.connection import SimDevice
from touchdown.backend.simulation.world import World

# Lowest height of a rotated hand; contact is simulated for a level face only.
MIN_TURNED_HEIGHT_MM = 10.0


class SimJoints:
    """Forward and inverse kinematics of the hand, and check of poses."""

    def __init__(self, world: World) -> None:
        arm = MelfaSettings()
        yaw_rad, hand_rad = math.radians(arm.yaw_deg), math.radians(arm.hand_deg)
        self._placing = MelfaPlacement(arm.origin_mm, yaw_rad, hand_rad, arm.tool_mm)
        self._world = world
        self._last = np.zeros(6)

    def of(self, place: HandPose) -> core.FloatArray:
        """Return the (6,) joints, rad, of a pose, near the last ones; raises ``RefusedError``."""
        self._last = self._placing.joints(place[0], self._last, place[1])
        return self._last.copy()

    def place(self, joints_rad: core.FloatArray) -> HandPose:
        """Return the pose of the hand for (6,) joints."""
        return self._placing.pivot_mm(joints_rad), self._placing.turn(joints_rad)

    def allowed(self, place: HandPose) -> core.Fault | None:
        """Return the reason why ``place`` is not allowed, or None."""
        try:
            check_joints(self.of(place))
        except core.RefusedError as error:
            return _pose_fault(error.reason, error.detail, "Choose another path or pose.")
        turned = float(np.linalg.norm(core.rotation_vector(place[1]))) > core.LEVEL_TOLERANCE_RAD
        if turned and not self._world.clear_mm(place[0]) >= MIN_TURNED_HEIGHT_MM:
            what = (
                f"The hand is turned (tilted by {math.degrees(core.tilt_rad(place[1])):.1f}°): "
                f"it would come within {MIN_TURNED_HEIGHT_MM:.0f} mm of the surface."
            )
            return _pose_fault("TURNED-LOW", what, "Go up, or level the hand first.")
        return None


def _pose_fault(code: str, what: str, next_step: str) -> core.Fault:
    return core.Fault(code, what, "The arm stands still.", next_step, "arm")


_INF = math.inf
_P = TypeVar("_P", bound=SimProgram)


class SimArm(SimDevice):
    """Moves the pivot of a ``World``. ``stop`` works from any thread and in every state.

    ``poses``: measured position of ``G``, mm, once per cycle.
    """

    def __init__(
        self,
        world: World,
        poses: core.SampleStream,
        commands: core.SampleStream,
        now_s: Callable[[], float],
    ) -> None:
        super().__init__("arm", "simulated arm", now_s)
        self._world, self.poses, self._commands = world, poses, commands
        self._joints = SimJoints(world)
        self._driving = JointKinematics(self._joints.place, self._joints.allowed)
        self._program: SimProgram | None = None
        self._powered = True

    def close(self) -> None:
        """Stop and close; the jaws stay as they are."""
        self.stop()
        super().close()

    def describe(self) -> Mapping[str, str | float]:
        """Return the commanded position."""
        x, y, z = self._world.drive.command_mm.tolist()
        return {"kind": "simulated", "x_mm": x, "y_mm": y, "z_mm": z}

    def status(self) -> ArmStatus:
        """Return the status words."""
        if not self.ready:
            return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
        mode = RobotMode.MOVING if self._world.drive.moving else RobotMode.READY
        return ArmStatus(mode if self._powered else RobotMode.SERVO_OFF, SafetyMode.NORMAL, 1.0, 0)

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately, with the motors on."""
        super().connect(timeout_s, cancel)
        self._powered = True

    def servo(self, on: bool) -> None:
        """Switch the motors immediately; off ends the present motion."""
        self.require_ready()
        if not on:
            self.stop()
        self._powered = on

    def _require_power(self) -> None:
        self.require_ready()
        if not self._powered:
            raise core.FaultError(servo_off_fault(self.name))

    def pose(self, max_age_s: float) -> core.Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        _, values = self.poses.latest(self._now_s(), max_age_s)
        return _pose(values, self._world.drive.turn)

    # -- moves ------------------------------------------------------------------------------------

    def move_to(
        self, target: core.Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S
    ) -> CommandedMotion:
        """Move straight to ``target`` with rotation; ValueError for invalid numbers."""
        self._require_power()
        goal, turn = np.array([target.x_mm, target.y_mm, target.z_mm]), core.pose_rotation(target)
        speeds = (speed_mm_s, turn_rad_s)
        if not (np.isfinite([*goal, *turn.ravel()]).all() and all(0.0 < v < _INF for v in speeds)):
            raise ValueError("target and speed must be finite, the speed positive")
        sent = {"x_mm": target.x_mm, "y_mm": target.y_mm, "z_mm": target.z_mm,
                "speed_mm_s": speed_mm_s}  # fmt: skip
        with self._lock:
            drive = self._world.drive
            if turn is core.IDENTITY_ROTATION and drive.turn is core.IDENTITY_ROTATION:
                return self._take(CommandedMotion(sent), self._world.travel(goal, speed_mm_s))
            sent |= {"rx_rad": target.rx_rad, "ry_rad": target.ry_rad, "rz_rad": target.rz_rad,
                     "turn_rad_s": turn_rad_s}  # fmt: skip
            end = (goal, turn)
            program = SimRotationTravel(self._place(), end, speeds, self._joints.allowed)
            return self._begin(sent, program, self._joints.allowed(end))

    def jog(
        self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL
    ) -> CommandedMotion:
        """Follow a velocity and a rotation rate for ``for_s``; a renewal does not jerk."""
        self._require_power()
        velocity, turning = np.array(velocity_mm_s), np.array(turn_rad_s)
        if not (np.isfinite([*velocity, *turning]).all() and 0.0 < for_s < _INF):
            raise ValueError("velocity and time must be finite, the time positive")
        until_s = self._now_s() + for_s
        sent = dict(zip(("x_mm_s", "y_mm_s", "z_mm_s"), velocity_mm_s, strict=True))
        with self._lock:
            if turning.any() or self._world.drive.turn is not core.IDENTITY_ROTATION:
                sent |= dict(zip(("rx_rad_s", "ry_rad_s", "rz_rad_s"), turn_rad_s, strict=True))
                make = partial(SimRotationJog, self._place(), self._joints.allowed)
                turned, motion = self._going_on(SimRotationJog, make, sent)
                turned.renew(velocity, turning, until_s)
                return motion
            program, motion = self._going_on(SimJog, SimJog, sent)
            program.renew(velocity, until_s)
            return motion

    # -- joints -----------------------------------------------------------------------------------

    @property
    def rotates(self) -> bool:
        """The hand turns in free air."""
        return True

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the joints; raises ``StaleSampleError`` if the position is older."""
        _, values = self.poses.latest(self._now_s(), max_age_s)
        return tuple(self._joints.of((values, self._world.drive.turn)).tolist())

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint."""
        return JOINT_RANGES

    def place_of(self, joints_rad: Joints) -> core.Pose:
        """Return the pose of the hand for these joints."""
        return _pose(*self._joints.place(np.array(joints_rad)))

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Rotate the joints for ``for_s``; a renewal continues without a jerk."""
        self._require_power()
        speeds = np.array(speeds_rad_s)
        if not (speeds.shape == (6,) and np.isfinite(speeds).all() and 0.0 < for_s < _INF):
            raise ValueError("six speeds and the time must be finite, the time positive")
        sent = {f"j{k}_rad_s": speed for k, speed in enumerate(speeds_rad_s, 1)}
        with self._lock:
            make = partial(SimJointJog, self._joints.of(self._place()), self._driving)
            program, motion = self._going_on(SimJointJog, make, sent)
            program.renew(speeds, self._now_s() + for_s)
            return motion

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> CommandedMotion:
        """Rotate all joints to ``target_rad`` with at most ``speed_rad_s``."""
        self._require_power()
        target = np.array(target_rad)
        if not (target.shape == (6,) and np.isfinite(target).all() and 0.0 < speed_rad_s < _INF):
            raise ValueError("six joints and the speed must be finite, the speed positive")
        sent = {f"j{k}_rad": angle for k, angle in enumerate(target_rad, 1)}
        with self._lock:
            start = self._joints.of(self._place())
            program = SimJointTravel(start, target, speed_rad_s, self._driving)
            end = self._joints.place(target)
            return self._begin(sent, program, self._joints.allowed(end))

    # -- contact ----------------------------------------------------------------------------------

    def press(self, command: PressCommand) -> ArmPress:
        """Press compliantly straight down; refused if the hand is rotated."""
        self._require_power()
        core.require_unrotated(self._world.drive.turn)
        with self._lock:
            program = self._world.press(command)
            motion = ArmPress(press_fields(command))
            self._take(motion, program)
            return motion

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Rise until the press force is ``force_n``."""
        self._require_power()
        sent = {"force_n": force_n, "speed_mm_s": speed_mm_s}
        with self._lock:
            return self._take(CommandedMotion(sent), self._world.unload(force_n, speed_mm_s))

    def stop(self) -> None:
        """Stop in the next cycle; the present motion ends with a fault."""
        with self._lock:
            self._world.drive.drop()
            self._end_motion(stopped_fault(self.name))
            self._program = None

    def retreat(self) -> None:
        """Rise straight from the present position, then stop; without motors, stop."""
        self.stop()
        if not (self.ready and self._powered):
            return
        with self._lock:
            up_mm = self._world.drive.command_mm + np.array([0.0, 0.0, RETREAT_MM])
            motion = CommandedMotion({"z_mm": float(up_mm[2])})
            self._take(motion, self._world.travel(up_mm, RETREAT_MM_S))

    def halt(self) -> None:
        """Stop in the next cycle; equal to ``stop`` in the simulation."""
        self.stop()

    def deliver(self, ends_s: core.FloatArray, pose_mm: core.FloatArray, *, silent: bool) -> None:
        """Process the position measured at the end of each cycle, and the end of a motion."""
        if self.ready and not silent:
            rows = len(ends_s), 3
            self.poses.put(ends_s, np.broadcast_to(pose_mm, rows))
            self._commands.put(ends_s, np.broadcast_to(self._world.drive.command_mm, rows))
            self.arrived(float(ends_s[-1]), len(ends_s))
        with self._lock:
            program, motion = self._program, self._motion
            if isinstance(program, SimPress) and isinstance(motion, ArmPress):
                motion.detected_s, motion.onset_s = program.detected_s, program.onset_s
            if motion is not None and program is not None and program.done:
                self._end_motion(program.failure)
                self._program = None

    def _place(self) -> HandPose:
        return self._world.drive.command_mm, self._world.drive.turn

    def _begin(
        self, sent: Mapping[str, float], program: SimProgram, fault: core.Fault | None
    ) -> CommandedMotion:
        """Start a move with rotation; it fails at once if its end is not allowed."""
        motion = CommandedMotion(sent)
        if fault is not None:
            motion.end(fault)
            return motion
        self._world.drive.run(program)
        return self._take(motion, program)

    def _going_on(
        self, kind: type[_P], make: Callable[[], _P], sent: Mapping[str, float]
    ) -> tuple[_P, CommandedMotion]:
        """Return the running program of this kind, or a new one, and its motion."""
        program, motion = self._program, self._motion
        if isinstance(program, kind) and not program.done and motion is not None:
            return program, motion
        made = make()
        self._world.drive.run(made)
        return made, self._take(CommandedMotion(sent), made)

    def _take(self, motion: CommandedMotion, program: SimProgram) -> CommandedMotion:
        self._program = program
        return self._start_motion(motion)


def _pose(position_mm: core.FloatArray, turn: core.FloatArray) -> core.Pose:
    x, y, z = position_mm.tolist()
    if turn is core.IDENTITY_ROTATION:
        return core.Pose(x, y, z)
    return core.Pose(x, y, z, *core.rotation_vector(turn).tolist())
