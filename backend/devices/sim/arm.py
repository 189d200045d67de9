"""The simulated arm as a device."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from functools import partial
from typing import TypeVar

import numpy as np

from backend.core.faults import Fault, FaultError
from backend.core.flow import FloatArray, Pose
from backend.core.stream import SampleStream
from backend.core.turning import UNTURNED, refuse_turned, turn_of, vector_of
from backend.devices.melfa.guard import JOINT_RANGES
from backend.devices.motion import CommandedMotion, replaced_fault, servo_off_fault, stopped_fault
from backend.devices.protocols import (
    STILL,
    TURN_RAD_S,
    ArmStatus,
    Joints,
    PressCommand,
    RobotMode,
    SafetyMode,
    Vector,
)
from backend.devices.retreating import RETREAT_MM, RETREAT_MM_S
from backend.devices.sim.connection import Connection, SimDevice
from backend.devices.sim.joints import SimJoints
from backend.devices.sim.motion import SimPressMotion
from backend.simulation.arm import Jog, PressLaw, Program
from backend.simulation.turning import (
    Driving,
    JointJog,
    JointTravel,
    Place,
    TurningJog,
    TurningTravel,
)
from backend.simulation.world import World

INF = math.inf
_P = TypeVar("_P", bound=Program)


class SimArm(SimDevice):
    """Moves the pivot of a ``World``. ``stop`` works from any thread and in every state."""

    def __init__(
        self,
        world: World,
        poses: SampleStream,
        commands: SampleStream,
        now_s: Callable[[], float],
    ) -> None:
        self._world, self._poses, self._now_s = world, poses, now_s
        self._commands = commands
        super().__init__(Connection("arm", "simulated arm", now_s))
        self._joints = SimJoints(world)
        self._driving = Driving(self._joints.place, self._joints.allowed)
        self._lock = threading.Lock()
        self._motion: CommandedMotion | None = None
        self._program: Program | None = None
        self._powered = True

    @property
    def poses(self) -> SampleStream:
        """Measured position of ``G``, mm, once per cycle."""
        return self._poses

    def close(self) -> None:
        """Stop and close; the jaws stay as they are."""
        self.stop()
        self._connection.close()

    def describe(self) -> Mapping[str, str | float]:
        """Return the commanded position."""
        x, y, z = self._world.drive.command_mm.tolist()
        return {"kind": "simulated", "x_mm": x, "y_mm": y, "z_mm": z}

    def status(self) -> ArmStatus:
        """Return the status words."""
        if not self._connection.ready:
            return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
        mode = RobotMode.MOVING if self._world.drive.moving else RobotMode.READY
        return ArmStatus(mode if self._powered else RobotMode.SERVO_OFF, SafetyMode.NORMAL, 1.0, 0)

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect at once, with the motors on."""
        super().connect(timeout_s, cancel)
        self._powered = True

    def servo(self, on: bool) -> None:
        """Switch the motors at once; off ends the motion under way."""
        self._connection.require_ready()
        if not on:
            self.stop()
        self._powered = on

    def _require_power(self) -> None:
        self._connection.require_ready()
        if not self._powered:
            raise FaultError(servo_off_fault(self.name))

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        _, values = self._poses.latest(self._now_s(), max_age_s)
        return _pose(values, self._world.drive.turn)

    # -- moves ------------------------------------------------------------------------------------

    def move_to(
        self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S
    ) -> CommandedMotion:
        """Move straight to ``target``, turning on the way; ValueError for a senseless number."""
        self._require_power()
        goal, turn = np.array([target.x_mm, target.y_mm, target.z_mm]), turn_of(target)
        speeds = (speed_mm_s, turn_rad_s)
        if not (np.isfinite([*goal, *turn.ravel()]).all() and all(0.0 < v < INF for v in speeds)):
            raise ValueError("target and speed must be finite, the speed positive")
        sent = {"x_mm": target.x_mm, "y_mm": target.y_mm, "z_mm": target.z_mm,
                "speed_mm_s": speed_mm_s}  # fmt: skip
        with self._lock:
            drive = self._world.drive
            if turn is UNTURNED and drive.turn is UNTURNED:
                return self._take(CommandedMotion(sent), self._world.travel(goal, speed_mm_s))
            sent |= {"rx_rad": target.rx_rad, "ry_rad": target.ry_rad, "rz_rad": target.rz_rad,
                     "turn_rad_s": turn_rad_s}  # fmt: skip
            end = (goal, turn)
            program = TurningTravel(self._place(), end, speeds, self._joints.allowed)
            return self._begin(sent, program, self._joints.allowed(end))

    def jog(
        self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL
    ) -> CommandedMotion:
        """Follow a velocity and a turn for ``for_s``; a renewal goes on without a jerk."""
        self._require_power()
        velocity, turning = np.array(velocity_mm_s), np.array(turn_rad_s)
        if not (np.isfinite([*velocity, *turning]).all() and 0.0 < for_s < INF):
            raise ValueError("velocity and time must be finite, the time positive")
        until_s = self._now_s() + for_s
        sent = dict(zip(("x_mm_s", "y_mm_s", "z_mm_s"), velocity_mm_s, strict=True))
        with self._lock:
            if turning.any() or self._world.drive.turn is not UNTURNED:
                sent |= dict(zip(("rx_rad_s", "ry_rad_s", "rz_rad_s"), turn_rad_s, strict=True))
                make = partial(TurningJog, self._place(), self._joints.allowed)
                turned, motion = self._going_on(TurningJog, make, sent)
                turned.renew(velocity, turning, until_s)
                return motion
            program, motion = self._going_on(Jog, Jog, sent)
            program.renew(velocity, until_s)
            return motion

    # -- joints -----------------------------------------------------------------------------------

    @property
    def rotates(self) -> bool:
        """The hand turns in free air."""
        return True

    def joints_rad(self, max_age_s: float) -> Joints:
        """Return the joints; raises ``StaleSampleError`` if the position is older."""
        _, values = self._poses.latest(self._now_s(), max_age_s)
        return tuple(self._joints.of((values, self._world.drive.turn)).tolist())

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint."""
        return JOINT_RANGES

    def place_of(self, joints_rad: Joints) -> Pose:
        """Return the pose that these joints give the hand."""
        return _pose(*self._joints.place(np.array(joints_rad)))

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> CommandedMotion:
        """Turn the joints for ``for_s``; a renewal goes on without a jerk."""
        self._require_power()
        speeds = np.array(speeds_rad_s)
        if not (speeds.shape == (6,) and np.isfinite(speeds).all() and 0.0 < for_s < INF):
            raise ValueError("six speeds and the time must be finite, the time positive")
        sent = {f"j{k}_rad_s": speed for k, speed in enumerate(speeds_rad_s, 1)}
        with self._lock:
            make = partial(JointJog, self._joints.of(self._place()), self._driving)
            program, motion = self._going_on(JointJog, make, sent)
            program.renew(speeds, self._now_s() + for_s)
            return motion

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> CommandedMotion:
        """Turn all joints to ``target_rad``; none goes faster than ``speed_rad_s``."""
        self._require_power()
        target = np.array(target_rad)
        if not (target.shape == (6,) and np.isfinite(target).all() and 0.0 < speed_rad_s < INF):
            raise ValueError("six joints and the speed must be finite, the speed positive")
        sent = {f"j{k}_rad": angle for k, angle in enumerate(target_rad, 1)}
        with self._lock:
            start = self._joints.of(self._place())
            program = JointTravel(start, target, speed_rad_s, self._driving)
            end = self._joints.place(target)
            return self._begin(sent, program, self._joints.allowed(end))

    # -- contact ----------------------------------------------------------------------------------

    def press(self, command: PressCommand) -> SimPressMotion:
        """Press compliantly from here straight down; refused while the hand is turned."""
        self._require_power()
        refuse_turned(self._world.drive.turn)
        law = PressLaw(
            depth_mm=command.depth_mm,
            ramp_s=command.ramp_s,
            hold_s=command.hold_s,
            approach_mm_s=command.approach_mm_s,
            threshold_n=command.threshold_n,
            max_travel_mm=command.max_travel_mm,
        )
        sent = {
            "depth_mm": law.depth_mm,
            "ramp_s": law.ramp_s,
            "hold_s": law.hold_s,
            "approach_mm_s": law.approach_mm_s,
            "threshold_n": law.threshold_n,
            "max_travel_mm": law.max_travel_mm,
            "stiffness_z_n_mm": command.stiffness_n_mm[2],
        }
        with self._lock:
            program = self._world.press(law, command.stiffness_n_mm)
            motion = SimPressMotion(sent, program)
            self._take(motion, program)
            return motion

    def unload(self, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Rise until the press force is ``force_n``."""
        self._require_power()
        sent = {"force_n": force_n, "speed_mm_s": speed_mm_s}
        with self._lock:
            return self._take(CommandedMotion(sent), self._world.unload(force_n, speed_mm_s))

    def stop(self) -> None:
        """Stand still from the next cycle on; the motion under way ends with a fault."""
        with self._lock:
            self._world.drive.drop()
            if self._motion is not None:
                self._motion.end(stopped_fault(self.name))
            self._motion = self._program = None

    def retreat(self) -> None:
        """Rise straight from where the arm is, then stand; without motors, stop."""
        self.stop()
        if not (self._connection.ready and self._powered):
            return
        with self._lock:
            up_mm = self._world.drive.command_mm + np.array([0.0, 0.0, RETREAT_MM])
            motion = CommandedMotion({"z_mm": float(up_mm[2])})
            self._take(motion, self._world.travel(up_mm, RETREAT_MM_S))

    def halt(self) -> None:
        """Stand still from the next cycle on: in a simulation the same as ``stop``."""
        self.stop()

    def deliver(self, t_s: float, pose_mm: FloatArray, *, silent: bool) -> None:
        """Take the measured position of one cycle and see whether the motion ended."""
        if self._connection.ready and not silent:
            at_s = np.array([t_s])
            self._poses.put(at_s, pose_mm[None])
            self._commands.put(at_s, self._world.drive.command_mm[None])
            self._connection.arrived(t_s, 1)
        with self._lock:
            if self._motion is not None and self._program is not None and self._program.done:
                self._motion.end(self._program.failure)
                self._motion = self._program = None

    def _place(self) -> Place:
        return self._world.drive.command_mm, self._world.drive.turn

    def _begin(
        self, sent: Mapping[str, float], program: Program, fault: Fault | None
    ) -> CommandedMotion:
        """Begin a move that turns; one whose end is not allowed has failed before it began."""
        motion = CommandedMotion(sent)
        if fault is not None:
            motion.end(fault)
            return motion
        self._world.follow(program)
        return self._take(motion, program)

    def _going_on(
        self, kind: type[_P], make: Callable[[], _P], sent: Mapping[str, float]
    ) -> tuple[_P, CommandedMotion]:
        """Return the program of this kind that goes on, or a new one, and its motion."""
        program, motion = self._program, self._motion
        if isinstance(program, kind) and not program.done and motion is not None:
            return program, motion
        made = make()
        self._world.follow(made)
        return made, self._take(CommandedMotion(sent), made)

    def _take(self, motion: CommandedMotion, program: Program) -> CommandedMotion:
        if self._motion is not None:
            self._motion.end(replaced_fault(self.name))
        self._motion, self._program = motion, program
        return motion


def _pose(position_mm: FloatArray, turn: FloatArray) -> Pose:
    x, y, z = position_mm.tolist()
    if turn is UNTURNED:
        return Pose(x, y, z)
    return Pose(x, y, z, *vector_of(turn).tolist())
