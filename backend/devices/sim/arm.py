"""The simulated arm as a device."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

import numpy as np

from backend.core.flow import FloatArray, Pose
from backend.core.stream import SampleStream
from backend.devices.motion import CommandedMotion, replaced_fault, stopped_fault
from backend.devices.protocols import (
    ArmStatus,
    PressCommand,
    RobotMode,
    SafetyMode,
)
from backend.devices.sim.connection import Connection, SimDevice
from backend.devices.sim.motion import SimPressMotion
from backend.simulation.arm import Jog, PressLaw, Program
from backend.simulation.world import World


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
        self._lock = threading.Lock()
        self._motion: CommandedMotion | None = None
        self._program: Program | None = None

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
        return ArmStatus(mode, SafetyMode.NORMAL, 1.0, 0)

    def pose(self, max_age_s: float) -> Pose:
        """Return the measured pose; raises ``StaleSampleError`` if it is older."""
        _, values = self._poses.latest(self._now_s(), max_age_s)
        x, y, z = values.tolist()
        return Pose(x, y, z)

    def move_to(self, target: Pose, speed_mm_s: float) -> CommandedMotion:
        """Move straight to ``target``; raises ValueError for a rotation or a senseless number."""
        self._connection.require_ready()
        if (target.rx_rad, target.ry_rad, target.rz_rad) != (0.0, 0.0, 0.0):
            raise ValueError("the simulated arm keeps its orientation")
        goal = np.array([target.x_mm, target.y_mm, target.z_mm])
        if not (np.isfinite(goal).all() and 0.0 < speed_mm_s < float("inf")):
            raise ValueError("target and speed must be finite, the speed positive")
        sent = {
            "x_mm": target.x_mm,
            "y_mm": target.y_mm,
            "z_mm": target.z_mm,
            "speed_mm_s": speed_mm_s,
        }
        with self._lock:
            return self._take(CommandedMotion(sent), self._world.travel(goal, speed_mm_s))

    @property
    def rotates(self) -> bool:
        """Never: the simulated hand keeps its orientation."""
        return False

    def jog(self, velocity_mm_s: tuple[float, float, float], for_s: float) -> CommandedMotion:
        """Follow a velocity for ``for_s``; a renewal goes on without a jerk."""
        self._connection.require_ready()
        velocity = np.array(velocity_mm_s)
        if not (np.isfinite(velocity).all() and 0.0 < for_s < float("inf")):
            raise ValueError("velocity and time must be finite, the time positive")
        with self._lock:
            program, motion = self._program, self._motion
            if not isinstance(program, Jog) or program.done or motion is None:
                x, y, z = velocity_mm_s
                program = self._world.jog()
                motion = self._take(
                    CommandedMotion({"x_mm_s": x, "y_mm_s": y, "z_mm_s": z}), program
                )
            program.renew(velocity, self._now_s() + for_s)
            return motion

    def press(self, command: PressCommand) -> SimPressMotion:
        """Press compliantly from here straight down."""
        self._connection.require_ready()
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
        self._connection.require_ready()
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

    def _take(self, motion: CommandedMotion, program: Program) -> CommandedMotion:
        if self._motion is not None:
            self._motion.end(replaced_fault(self.name))
        self._motion, self._program = motion, program
        return motion
