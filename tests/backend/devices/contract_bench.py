"""The sets of devices that the contract is asked of, and how their time passes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import pytest

from backend.core.flow import Finger
from backend.devices.protocols import (
    Arm,
    Device,
    ForceTorqueSensor,
    Gripper,
    Motion,
    PressCommand,
    TactileSensor,
)
from backend.devices.sim.bench import SimulatedBench
from backend.objects.catalogue import load_catalogue
from backend.objects.tower import Tower
from backend.simulation.scene import Scene
from tests.backend.brisk import brisk_settings
from tests.backend.devices.emulated_arm import on_bench

PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0))


@dataclass
class DevicesUnderTest:
    """A full set of devices, and the way its time passes."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorqueSensor
    tactile: Mapping[Finger, TactileSensor]
    now_s: Callable[[], float]
    advance: Callable[[int], None]
    still_s: float = 0.02
    """After a stop the arm stands within this time."""
    still_mm: float = 1e-3
    """As exactly as its position is told while it stands stopped."""

    @property
    def all(self) -> list[Device]:
        return [self.arm, self.gripper, self.force_torque, *self.tactile.values()]

    def connect(self) -> None:
        for device in self.all:
            device.connect(1.0, threading.Event())

    def rest(self, seconds: float) -> None:
        self.advance(round(seconds * 1e6))

    def finish(self, motion: Motion, limit_s: float = 20.0) -> None:
        until_s = self.now_s() + limit_s
        while not motion.done:
            assert self.now_s() < until_s, "the motion does not end"
            self.advance(10_000)

    def lifted_and_gripped(self) -> None:
        self.connect()
        self.finish(self.gripper.grip(10.0))
        self.rest(0.3)


FEW_HZ = 2.0
"""Pictures a second where nobody looks at them: drawing them took longer than all else."""


def _scene(rate_hz: float) -> Scene:
    catalogue = load_catalogue()
    bottoms = Tower((catalogue.bottom("short").body(),))
    settings = brisk_settings(rate_hz=rate_hz)
    return Scene(catalogue.top("pot"), bottoms, (6.0, 3.0), 11, settings)


def simulated(rate_hz: float = FEW_HZ) -> DevicesUnderTest:
    bench = SimulatedBench(_scene(rate_hz))
    return DevicesUnderTest(
        bench.arm,
        bench.gripper,
        bench.force_torque,
        bench.tactile,
        bench.clock.now_s,
        bench.advance,
    )


def simulated_at_its_rates() -> DevicesUnderTest:
    return simulated(25.0)


def emulated_arm() -> DevicesUnderTest:
    """The driver of the arm on an emulated controller; all else is simulated."""
    bench = SimulatedBench(_scene(FEW_HZ))
    arm, wires = on_bench(bench)
    return DevicesUnderTest(
        arm,
        bench.gripper,
        bench.force_torque,
        bench.tactile,
        bench.clock.now_s,
        wires.advance,
        still_s=0.2,
        still_mm=0.02,
    )


EVERY = pytest.mark.parametrize(
    "bench", [simulated, emulated_arm], ids=["simulated", "emulated arm"], indirect=True
)
ONLY_SIMULATED = pytest.mark.parametrize(
    "bench", [simulated_at_its_rates], ids=["simulated"], indirect=True
)
"""For what does not concern the arm."""
