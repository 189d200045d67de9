# ruff: noqa: N802
"""A Universal Robots arm as its package shows it, on a hand-wound clock: no robot, no socket."""

import math
import threading
from collections.abc import Callable

import numpy as np

from tests.backend.devices.melfa.emulated_arm import _Follow
from touchdown.backend.config.hardware import HardwareSettings, UrSettings
from touchdown.backend.core.rotations import IDENTITY_ROTATION, rotation_from_vector
from touchdown.backend.devices.ur.driver import UrArm, UrPlacement
from touchdown.backend.devices.ur.rtde import UrConnections
from touchdown.backend.simulation.devices.bench import SimulatedBench

CYCLE_US = 8000
LAG_S = 0.012
DOWN = (math.pi, 0.0, 0.0)  # the rotation vector of a hand that points straight down


class Robot:
    """Answers as the control, receive and dashboard interfaces of ``ur_rtde`` do."""

    def __init__(self, place_m, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self.place_m, self.target_m = np.array(place_m), np.array(place_m)
        self.rotation = np.array(DOWN)
        self.mode, self.safety, self.estop, self.program = 7, 1, False, True
        self.told, self.connected, self.mute = 0.0, True, False
        self.servoing = False
        self.commands: list[tuple[float, tuple[float, ...]]] = []
        self.stops: list[float] = []
        self.kicks = 0
        self.ended: list[float] = []
        self.hangs: threading.Event | None = None
        """While it is not set, the control interface answers nothing."""
        self.tcp: list[float] = []

    def advance(self, step_s: float) -> None:
        """Follow the target with a lag; the controller goes on telling."""
        share = 1.0 - math.exp(-step_s / LAG_S)
        if self.servoing and self.mode == 7 and self.safety == 1:
            self.place_m = self.place_m + share * (self.target_m - self.place_m)
        self.told += 0.0 if self.mute else step_s

    # -- control ----------------------------------------------------------------------------------

    def servoL(self, pose, speed, acceleration, time, lookahead_time, gain, /):
        assert 0.03 <= lookahead_time <= 0.2
        assert 100 <= gain <= 2000
        if self.hangs is not None:
            self.hangs.wait()
        if not self.program:
            return False
        self.commands.append((self._now_s(), tuple(pose)))
        self.target_m, self.servoing = np.array(pose[:3]), True
        return self.program

    def servoStop(self, a=10.0):
        self.stops.append(self._now_s())
        self.servoing = False
        return True

    def setTcp(self, offset, /):
        self.tcp = list(offset)
        return True

    def isPoseWithinSafetyLimits(self, pose, /):
        return bool(np.linalg.norm(pose[:3]) < 1.3)

    def isProgramRunning(self):
        return self.program

    def reuploadScript(self):
        self.program = True
        return True

    def setWatchdog(self, min_frequency=10.0):
        return True

    def kickWatchdog(self):
        self.kicks += 1
        return True

    def stopScript(self):
        self.servoing = False

    def disconnect(self):
        """Nothing."""

    # -- receive ----------------------------------------------------------------------------------

    def getActualTCPPose(self):
        return [*self.place_m.tolist(), *self.rotation.tolist()]

    def getTimestamp(self):
        return self.told

    def getRobotMode(self):
        return self.mode

    def getSafetyMode(self):
        return self.safety

    def isEmergencyStopped(self):
        return self.estop

    def getSpeedScaling(self):
        return 1.0

    def isConnected(self):
        return self.connected

    # -- dashboard --------------------------------------------------------------------------------

    def connect(self, timeout_ms=2000):
        """Nothing."""

    def getSerialNumber(self):
        return "20235500001"

    def getRobotModel(self):
        return "UR5"

    def polyscopeVersion(self):
        return "PolyScope 5.13"

    def powerOn(self):
        self.mode = 5

    def brakeRelease(self):
        self.mode = 7

    def stop(self):
        self.ended.append(self._now_s())
        if not self.program:
            raise RuntimeError("Failed to execute: stop")
        self.program = self.servoing = False

    def powerOff(self):
        self.mode, self.program = 3, False


class SteppedUr(UrArm):
    """Its cycles are called by whoever winds the clock."""

    def _start_thread(self):
        """Nothing."""


class UrWires:
    """Moves robot, bench and driver on together."""

    def __init__(self, bench: SimulatedBench) -> None:
        self.bench, self.clock = bench, bench.clock
        settings = UrSettings(arm_lag_ms=1e3 * LAG_S, sensor_lag_ms=0.0, yaw_deg=30.0)
        self.placing = UrPlacement(settings)
        world = bench._world
        start = self.placing.pose(world.drive.command_mm, np.array(DOWN))
        self.robot = Robot(start[:3], self.clock.now_s)
        samples, hardware = bench.force_torque.samples, HardwareSettings(ur=settings)
        self.arm = SteppedUr(hardware, self.clock.now_s, samples, open_with=self.open)
        follow = _Follow(self.true_mm, lambda: IDENTITY_ROTATION, world)
        world.drive.run(follow)
        self._next_us = self.clock.now_us + CYCLE_US

    def open(self, host: str, rate_hz: float) -> UrConnections:
        assert rate_hz == 1e6 / CYCLE_US
        return UrConnections(self.robot, self.robot, self.robot, self.robot)

    def true_mm(self):
        return self.placing.pivot_mm(np.array(self.robot.getActualTCPPose()))

    def advance(self, step_us: int) -> None:
        end_us = self.clock.now_us + step_us
        while self._next_us <= end_us:
            self.bench.advance(self._next_us - self.clock.now_us)
            self._next_us += CYCLE_US
            self.robot.advance(1e-6 * CYCLE_US)
            self.arm.cycle(self.clock.now_s())
        self.bench.advance(end_us - self.clock.now_us)


def hand_leaning(degrees: float):
    """Return the rotation vector of a hand that leans by so much about the base's x."""
    assert np.allclose(rotation_from_vector(np.array(DOWN))[2, 2], -1.0)
    return np.array([math.pi - math.radians(degrees), 0.0, 0.0])
