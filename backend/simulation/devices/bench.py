"""The simulated bench: the devices of one scene on one manual clock."""

from __future__ import annotations

import threading
from collections.abc import Mapping

import numpy as np

from touchdown.backend import core
from touchdown.backend.devices import Device, DeviceState
from touchdown.backend.emulation import DisturbanceScript
from touchdown.backend.simulation.devices.arm import SimArm
from touchdown.backend.simulation.devices.end_effector import SimForceTorque, SimGripper, SimTactile
from touchdown.backend.simulation.ground_truth import Scene, SceneTruth
from touchdown.backend.simulation.scene_camera import render_scene
from touchdown.backend.simulation.world import CycleRecord, World

JUMP_N = 50.0
CYCLES_AT_ONCE = 10  # of a bench at rest: rates are counted by when samples arrive


class SimulatedBench:
    """Five devices, a clock, and the ground truth. Time moves only by ``advance``."""

    def __init__(
        self,
        scene: Scene,
        script: DisturbanceScript | None = None,
        streams: core.RawStreams | None = None,
    ) -> None:
        self.scene = scene
        self._script = script or DisturbanceScript()
        streams = streams or core.RawStreams.new()
        streams.clear()
        self.clock = core.ManualClock()
        self._world = World(scene, self._script)
        now_s = self.clock.now_s
        self.arm = SimArm(self._world, streams.poses, streams.commands, now_s)
        self.gripper = SimGripper(self._world, now_s)
        self._thinned = core.Decimator()
        self.force_torque = SimForceTorque(streams.samples, now_s, scene.settings.wrist.rate_hz)
        self.tactile: Mapping[core.Finger, SimTactile] = {
            finger: SimTactile(finger, streams.frames[finger], now_s, self._script)
            for finger in core.FINGERS
        }

    @property
    def devices(self) -> Mapping[str, Device]:
        """All devices by name."""
        return {
            "arm": self.arm,
            "gripper": self.gripper,
            "force_torque": self.force_torque,
            "tactile_left": self.tactile["left"],
            "tactile_right": self.tactile["right"],
        }

    def connect(self) -> None:
        """Connect all devices."""
        cancel = threading.Event()
        for device in self.devices.values():
            device.connect(1.0, cancel)

    def advance(self, step_us: int) -> None:
        """Advance time by ``step_us``; the world moves at the boundaries of its cycles."""
        end_us = self.clock.now_us + step_us
        while (cycles := (end_us - self._world.now_us) // self._world.cycle_us) > 0:
            watched = [f for f in core.FINGERS if self.tactile[f].state is DeviceState.READY]
            cycles = min(cycles, CYCLES_AT_ONCE) if self._world.rests else 1
            sensed = self._world.step(watched, cycles)
            self.clock.advance(sensed.end_us - self.clock.now_us)
            self._deliver(sensed, cycles)
        self.clock.advance(end_us - self.clock.now_us)

    def rests(self) -> bool:
        """Return True if nothing is held, nothing moves and nothing was asked to fail."""
        return self._world.rests

    def truth(self, *, animate: bool = False) -> SceneTruth:
        """Return the ground truth; ``animate`` adds the motion of a fall if possible."""
        return self._world.truth(animate=animate)

    def scene_picture(self) -> core.ImageArray:
        """Return the present image of the scene camera: (h, w, 3) BGR."""
        truth, holding = self._world.truth(), self._world.holding
        height_mm = self.scene.start_height_mm
        if holding is not None:
            height_mm = holding.gap_mm(self._world.drive.command_mm)
        return render_scene(self.scene, truth.offset_mm, truth.yaw_rad, height_mm)

    def _deliver(self, sensed: CycleRecord, cycles: int) -> None:
        t_s = sensed.end_us * 1e-6
        before_us = self._world.cycle_us * np.arange(cycles)[::-1]
        ends_s = np.array(1e-6 * (sensed.end_us - before_us), dtype=np.float64)
        silent = self._script.active("arm", "silent", t_s)
        self.arm.deliver(ends_s, sensed.pose_mm, silent=silent)
        silent = self._script.active("gripper", "silent", t_s)
        self.gripper.deliver(t_s, cycles, silent=silent)
        times_s, wrench = self._disturbed(sensed, t_s)
        heard = self.force_torque.deliver(times_s, wrench)
        for part in np.arange(len(times_s)).reshape(cycles, -1):
            part = part if heard else part[:0]
            self._world.hear(times_s[part], wrench[part, 2])
        for finger in core.FINGERS:
            self.tactile[finger].deliver(sensed.shots[finger])

    def _disturbed(
        self, sensed: CycleRecord, t_s: float
    ) -> tuple[core.FloatArray, core.FloatArray]:
        """Return times and values of the wrist samples with the scripted disturbances."""
        script, name = self._script, "force_torque"
        if not script.disturbances:
            return sensed.t_s, sensed.wrench
        if script.active(name, "stop", t_s):
            return sensed.t_s[:0], sensed.wrench[:0]
        times_s, wrench = sensed.t_s, sensed.wrench
        if (rate_hz := script.rate_hz(name, t_s)) is not None:
            taken = [self._thinned.takes(at_s, rate_hz) for at_s in times_s.tolist()]
            times_s, wrench = times_s[taken], wrench[taken]
        if script.active(name, "nan", t_s):
            return times_s, np.full_like(wrench, np.nan)
        moved_n = script.drift_n(t_s) + (JUMP_N if script.active(name, "jump", t_s) else 0.0)
        if moved_n:
            wrench = wrench.copy()
            wrench[:, 2] += moved_n
        return times_s, wrench
