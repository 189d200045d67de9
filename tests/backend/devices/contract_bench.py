"""The sets of devices that the contract is asked of, and how their time passes."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import pytest

from tests.backend.bench.brisk import brisk_settings
from tests.backend.devices.melfa.emulated_arm import on_bench
from tests.backend.rig.inline import ROUND_US, InlineLink
from touchdown.backend.core import Fault, FaultError, Finger, Pose, RefusedError
from touchdown.backend.devices.interlock import Interlock, Limits
from touchdown.backend.devices.protocols import (
    Arm,
    Device,
    ForceTorqueSensor,
    Gripper,
    Motion,
    PressCommand,
    TactileSensor,
)
from touchdown.backend.geometry import Tower, load_pieces
from touchdown.backend.rig.host import Devices
from touchdown.backend.rig.remote_devices import RigArm, RigForceTorque, RigGripper
from touchdown.backend.simulation.devices.bench import SimulatedBench
from touchdown.backend.simulation.ground_truth import Scene

PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0))


def place(pose: Pose) -> tuple[float, float, float]:
    return (pose.x_mm, pose.y_mm, pose.z_mm)


@dataclass
class DevicesUnderTest:
    """A full set of devices, and the way its time passes."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorqueSensor
    tactile: Mapping[Finger, TactileSensor]
    now_s: Callable[[], float]
    advance: Callable[[int], None]
    still_s: float = 0.02  # after a stop the arm stands within this time
    still_mm: float = 1e-3  # as exactly as its position is told while it stands stopped
    told_s: float = 0.0  # so late it is told that a motion ended, or in which state a device is
    senseless: type[Exception] | tuple[type[Exception], ...] = ValueError
    """What is raised for an order with a number that makes no sense."""
    truly_holding: Callable[[], bool] | None = None
    close: Callable[[], None] = lambda: None

    @property
    def all(self) -> list[Device]:
        return [self.arm, self.gripper, self.force_torque, *self.tactile.values()]

    def connect(self) -> None:
        for device in self.all:
            device.connect(1.0, threading.Event())

    def hear(self) -> None:
        """Wait until what has just happened is told."""
        self.rest(self.told_s)

    def holds(self) -> bool:
        """True if the piece is in the jaws, even if the gripper is closed."""
        return (self.truly_holding or (lambda: self.gripper.status().holding))()

    def rest(self, seconds: float) -> None:
        self.advance(round(seconds * 1e6))

    def succeed(self, motion: Motion) -> None:
        self.finish(motion)
        motion.result()

    def finish(self, motion: Motion, limit_s: float = 20.0) -> None:
        until_s = self.now_s() + limit_s
        while not motion.done:
            assert self.now_s() < until_s, "the motion does not end"
            self.advance(10_000)

    def stand_still(self) -> None:
        """Hold that the arm stands as soon as it must after a stop."""
        self.rest(self.still_s)
        before = self.arm.pose(0.1)
        self.rest(0.5)
        after = self.arm.pose(0.1)
        assert place(before) == pytest.approx(place(after), abs=self.still_mm)

    def fail(self, motion: Motion) -> Fault:
        """Return the fault of a motion that must have ended with one."""
        assert motion.done
        with pytest.raises(FaultError) as raised:
            motion.result()
        return raised.value.fault

    def lifted_and_gripped(self) -> None:
        self.connect()
        self.finish(self.gripper.grip(10.0))
        self.rest(0.3)


FEW_HZ = 2.0  # pictures a second where nobody looks at them: drawing them took longer than all else


def _scene(rate_hz: float) -> Scene:
    catalogue = load_pieces()
    bottoms = Tower((catalogue.bottom("short").body(),))
    settings = brisk_settings(rate_hz=rate_hz)
    return Scene(catalogue.top("pot"), bottoms, (6.0, 3.0), 11, settings)


def devices_of(
    bench: SimulatedBench,
    arm: Arm | None = None,
    advance: Callable[[int], None] | None = None,
    **more: Any,
) -> DevicesUnderTest:
    """Return the devices of ``bench``, with another arm whose time passes by ``advance``."""
    own = bench.gripper, bench.force_torque, bench.tactile, bench.clock.now_s
    return DevicesUnderTest(arm or bench.arm, *own, advance or bench.advance, **more)


def simulated(rate_hz: float = FEW_HZ) -> DevicesUnderTest:
    return devices_of(SimulatedBench(_scene(rate_hz)))


def simulated_at_its_rates() -> DevicesUnderTest:
    return simulated(25.0)


def emulated_arm() -> DevicesUnderTest:
    """The driver of the arm on an emulated controller; all else is simulated."""
    bench = SimulatedBench(_scene(FEW_HZ))
    arm, wires = on_bench(bench)
    return devices_of(bench, arm, wires.advance, still_s=0.2, still_mm=0.02)


def over_the_link() -> DevicesUnderTest:
    """The simulated ones behind a rig: orders, answers, states and samples cross its link."""
    bench = SimulatedBench(_scene(FEW_HZ))
    now_s = bench.clock.now_s
    # Wide: what the rig refuses by its limits has tests of its own.
    interlock = Interlock(Limits(turn_rad_s=10.0))
    interlock.renew_lease(now_s())
    devices = Devices(
        bench.arm, bench.gripper, bench.force_torque, bench.force_torque.samples, bench.arm.poses
    )
    link = InlineLink(interlock, devices, now_s)
    link.hello["joint_ranges"] = bench.arm.joint_limits_rad
    open_ones: set[str] = set()

    def advance(step_us: int) -> None:
        while step_us > 0:
            part_us = min(step_us, ROUND_US)
            step_us -= part_us
            bench.advance(part_us)
            interlock.renew_lease(now_s())
            link.round()

    return DevicesUnderTest(
        RigArm("arm", link, now_s, open_ones),
        RigGripper("gripper", link, now_s, open_ones),
        RigForceTorque("force_torque", link, now_s, open_ones),
        bench.tactile,
        now_s,
        advance,
        told_s=0.02,
        senseless=(ValueError, RefusedError),
        truly_holding=lambda: bench.gripper.status().holding,
        close=link.host.leave,
    )


EVERY = pytest.mark.parametrize(
    "bench",
    [simulated, emulated_arm, over_the_link],
    ids=["simulated", "emulated arm", "over the link"],
    indirect=True,
)
ONLY_SIMULATED = pytest.mark.parametrize(
    "bench", [simulated_at_its_rates], ids=["simulated"], indirect=True
)
"""For what does not concern the arm."""
