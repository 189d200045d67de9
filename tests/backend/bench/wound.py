"""First press of a scene, simulated and over the emulated wires, without threads and images.

Time is advanced by the test; the delay of the world is a function. Ticks are (20, 6), N and N·m.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np

from tests.backend.devices.melfa.emulated_arm import CYCLE_US, SteppedWires
from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.bench.emulated_scene import LATENCY_S, EmulatedScene, SceneDynpick
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.config.method import SAMPLES_PER_PROBE, TICK_S, StackSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core import FloatArray, ManualClock, SampleStream
from touchdown.backend.devices.dynpick.driver import PERIOD_S, DynpickDriver
from touchdown.backend.devices.dynpick.protocol import DynpickCommand
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.melfa.driver import MelfaArm
from touchdown.backend.devices.protocols import PressCommand
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.sensing.episode import wrench_on_ticks
from touchdown.backend.simulation import Scene, World

PROBE = StackSettings().probe
LAW = PressCommand(
    PROBE.depth_mm,
    PROBE.ramp_fraction * PROBE.duration_s,
    PROBE.duration_s,
    PROBE.approach_mm_s,
    PROBE.threshold_n,
    PROBE.start_height_mm + PROBE.max_travel_mm,
    PROBE.stiffness_n_mm,
)
AIR_S = 0.2
AFTER_S = 0.15
LONGEST_S = 10.0
POLL_US = 2000  # how often the front of the sensor looks what is due
HARDWARE = HardwareSettings.model_validate(
    {
        "melfa": {
            "servo_delay_s": 0.3,
            "idle_check_s": 0.0,
            "realtime_priority": 0,
            "mxt": {"mxttout": 57},
        },
        "ft": {"driver": "dynpick", "address": "wound", "latency_ms": 1e3 * LATENCY_S},
    }
)


def scene_of(seed: int, settings: SimulationSettings) -> Scene:
    """Return the scene of a stacking trial: pot on Short or Long."""
    choice = SceneChoice("pot", (("short", "long")[seed % 2],), seed)
    return make_scene(load_pieces(), choice, settings)


def simulated_press(seed: int, settings: SimulationSettings, rest_s: float = 1.5) -> FloatArray:
    """Return the ticks of a press in process; another ``rest_s`` before it gives other noise."""
    world = World(scene_of(seed, settings))
    _take_piece(world)
    samples = SampleStream("force_torque", 6, 32_768)

    def step() -> None:
        sensed = world.step(watched=())
        world.hear(sensed.t_s, sensed.wrench[:, 2])
        samples.put(sensed.t_s, sensed.wrench)

    for _ in range(round(1e6 * rest_s / world.cycle_us)):
        step()
    tare = _air(samples, 1e-6 * world.now_us)
    press = world.press(LAW)
    while not press.done:
        step()
    for _ in range(round(1e6 * AFTER_S / world.cycle_us)):
        step()
    assert press.onset_s is not None
    return _on_ticks(samples, press.onset_s, tare)


class WoundWires:
    """Arm driver and sensor reading on the emulated devices of one scene."""

    def __init__(self, seed: int, settings: SimulationSettings, late_s: Callable[[float], float]):
        """``late_s`` returns the delay of the world at the end of a cycle."""
        self.joined = EmulatedScene(scene_of(seed, settings), HARDWARE.melfa)
        _take_piece(self.joined.world)
        self.clock, self._late_s = ManualClock(), late_s
        self._sensor = SceneDynpick(self.joined)
        self._language = DynpickDriver(HARDWARE, "wound")
        self._readout = WrenchStamper(HARDWARE.ft, PERIOD_S, 1e-3 * HARDWARE.serial.latency_ms)
        self.samples = SampleStream("force_torque", 6, 32_768)
        self._sensor.receive(0.0, DynpickCommand.START.value)
        self.wires = SteppedWires(self.joined.melfa, self.clock)
        self.wires.also = self._pass
        self.arm = MelfaArm(self.wires, self.samples, HARDWARE.melfa, self.clock.now_s)

    def press(self) -> FloatArray:
        """Connect, rest, press; return the ticks."""
        self.arm.connect(1.0, threading.Event())
        self.wires.advance(1_200_000)
        tare = _air(self.samples, self.clock.now_s())
        motion = self.arm.press(LAW)
        for _ in range(round(1e6 * LONGEST_S / CYCLE_US)):
            if motion.done:
                break
            self.wires.advance(CYCLE_US)
        motion.result()
        self.wires.advance(round(1e6 * AFTER_S))
        assert motion.onset_s is not None
        return _on_ticks(self.samples, motion.onset_s, tare)

    def _pass(self, step_us: int) -> None:
        end_us = self.clock.now_us + step_us
        while (next_us := (self.clock.now_us // 500 + 1) * 500) <= end_us:
            self.clock.advance(next_us - self.clock.now_us)
            self._serve_due()
        self.clock.advance(end_us - self.clock.now_us)

    def _serve_due(self) -> None:
        now_s, world = self.clock.now_s(), self.joined.world
        while True:
            over_s = 1e-6 * (world.now_us + world.cycle_us)
            if now_s < over_s + self._late_s(over_s) - 1e-9:
                break
            self.joined.step(behind_s=math.inf)  # without pictures
        if self.clock.now_us % POLL_US == 0:
            readings = self._language.take(self._sensor.due(now_s))
            self.samples.put(*self._readout.accept(now_s, readings))


def force_apart(wanted: FloatArray, found: FloatArray) -> float:
    """Return the difference of the mean forces of the hold (ticks 16 to 20), in %."""
    first, second = (ticks[15:, :3].mean(axis=0) for ticks in (wanted, found))
    return 100.0 * float(np.linalg.norm(second - first) / np.linalg.norm(first))


def bursts(longest_s: float) -> Callable[[float], float]:
    """Return the delay of a world that falls behind every 0.7 s, up to a maximum."""
    return lambda t_s: longest_s * max(0.0, float(np.sin(2.0 * np.pi * t_s / 0.7))) ** 2


def _take_piece(world: World) -> None:
    world.jaws.width_mm = world.scene.piece.width_mm
    world.jaws.close(PROBE.grip_force_n)


def _air(samples: SampleStream, now_s: float) -> FloatArray:
    return np.asarray(samples.window(now_s - AIR_S, now_s).values.mean(axis=0))


def _on_ticks(samples: SampleStream, onset_s: float, tare: FloatArray) -> FloatArray:
    felt = samples.since(0)
    tick_s = onset_s + TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    return wrench_on_ticks(felt.t_s, felt.values - tare, tick_s)
