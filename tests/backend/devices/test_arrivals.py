"""A sensor that becomes slow is told at once, and none because its samples came in lumps."""

from __future__ import annotations

import random

import pytest

from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.streams import Stream
from touchdown.backend.core.values import FINGERS
from touchdown.backend.devices.dynpick.driver import DynpickDriver
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.force_torque.driver import SensorDescription
from touchdown.backend.devices.force_torque.reader import ForceTorqueReader
from touchdown.backend.devices.ft300.driver import Ft300Driver
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.devices.supervision import ArrivalMonitor, Supervision
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults, hanging_gripper

USUAL_S = 1.3


class Watched:
    """The real reader and the supervision, by hand: bytes every ``lump_s``, a look every 20 ms."""

    first_s: float | None = None
    """When something was told for the first time."""

    def __init__(self, make: str, hz: float, lump_s: float) -> None:
        self.now_s, self._lump_s = 0.0, lump_s
        self.faults = Faults("force_torque")
        self.faults.begin(0.0)
        emulated = {"dynpick": EmulatedDynpick, "ft300": EmulatedFt300}[make]
        self.sensor = emulated(apply_faults(add_noise(hanging_gripper), self.faults))
        self.sensor.pace.faults = self.faults
        self.sensor.pace.begin(0.0, 1.0 / hz)
        settings = HardwareSettings()
        made = {"dynpick": DynpickDriver, "ft300": Ft300Driver}[make]
        self.language = made(settings, "")
        self.reader = ForceTorqueReader(
            lambda: self.language, lambda _: None, ForceTorqueSettings(), lambda: self.now_s,
            late_s=0.016,
        )  # fmt: skip
        self.reader._greeting = SensorDescription(
            Identity("", make, "", ""), (200.0,) * 6, 1.0 / hz
        )
        self.reader._forget()
        frames = {finger: Stream(f"tactile_{finger}", 4) for finger in FINGERS}
        self.interlock = Interlock()
        self.watch = Supervision(self.interlock, self.reader.samples, frames)
        self.watch.begin(0.0, wrist=self.reader)

    def go(self, seconds: float) -> tuple[float, list[str]]:
        """Let time pass; return how old the newest sample became, and what was told of it."""
        told, oldest_s, until_s = list[str](), 0.0, self.now_s + seconds
        next_lump_s, next_look_s = self.now_s, self.now_s
        while self.now_s < until_s:
            self.now_s += 0.002
            if self.now_s >= next_lump_s:
                self.reader._deliver(self.language, self.now_s, self.sensor.due(self.now_s))
                next_lump_s = self.now_s + self._lump_s
            if self.now_s >= next_look_s:
                next_look_s += 0.02
                self.watch.check(self.now_s)
                found = [one for one in self.watch.degraded if one.device == "force_torque"]
                told += [one.how for one in found if one.how not in told]
                newest_s, _ = self.reader.samples.latest(self.now_s, 9.0)
                oldest_s = max(oldest_s, self.now_s - newest_s)
                if found and self.first_s is None:
                    self.first_s = self.now_s
        return oldest_s, told


@pytest.mark.promise("S6")
@pytest.mark.parametrize(
    ("make", "hz", "slow_hz", "lump_s", "within_s"),
    [
        ("dynpick", 1000.0, 450.0, 0.004, 0.08),
        ("dynpick", 1000.0, 200.0, 0.004, 0.08),
        ("dynpick", 1000.0, 400.0, 0.016, 0.1),
        ("ft300", 100.0, 45.0, 0.004, 0.1),
        ("ft300", 100.0, 40.0, 0.004, 0.1),
        ("ft300", 100.0, 40.0, 0.016, 0.12),
    ],
)
def test_a_slow_sensor_is_told_at_once_and_its_samples_are_stamped_when_they_come(
    make: str, hz: float, slow_hz: float, lump_s: float, within_s: float
) -> None:
    bench = Watched(make, hz, lump_s)
    assert bench.go(USUAL_S)[1] == []
    begun_s = bench.now_s
    bench.faults.inject(begun_s, "slow", 0.8, hz=slow_hz)
    oldest_s, told = bench.go(0.8)
    assert told[-1] == "slow"
    assert bench.first_s is not None
    assert bench.first_s - begun_s <= within_s + 1e-9
    assert oldest_s < 0.15, "no fault: that is twice as much"
    assert bench.go(1.4)[1] == ["slow"]
    assert bench.watch.degraded == () or bench.watch.degraded[0].device != "force_torque"


@pytest.mark.promise("S6")
def test_a_tenth_of_the_rate_is_degraded_before_anything_is_a_fault() -> None:
    bench = Watched("ft300", 100.0, 0.004)
    bench.go(USUAL_S)
    bench.faults.inject(bench.now_s, "slow", hz=20.0)
    oldest_s, told = bench.go(1.0)
    assert told, "50 ms apart: silent or slow, whichever is known first"
    assert oldest_s < 0.3
    assert "FT-STALE" not in {fault.code for fault in bench.interlock.faults}


@pytest.mark.promise("S6")
@pytest.mark.parametrize("adapter_s", [0.0, 0.016])
@pytest.mark.parametrize("hz", [100.0, 333.0, 1000.0])
def test_adapters_losses_and_a_busy_computer_make_no_sensor_slow(
    hz: float, adapter_s: float
) -> None:
    """1 % lost, an adapter that collects, and every second a wait of up to 0.5 s; 30 s of it."""
    rng, arrivals = random.Random(5), ArrivalMonitor(1.0 / hz)
    flush_s = last_s = wait_end_s = 0.0
    next_wait_s = 1.0
    for k in range(round(30.0 * hz)):
        if rng.random() < 0.01:
            continue
        if adapter_s and k / hz > flush_s:
            flush_s = k / hz + rng.uniform(0.0, adapter_s)
        came_s = max(k / hz, flush_s)
        if came_s > next_wait_s:
            wait_end_s = came_s + rng.uniform(0.0, 0.5)
            next_wait_s = wait_end_s + rng.expovariate(1.0)
        if came_s < wait_end_s:
            # What waited is read piece by piece, and now and then the computer is busy again.
            pause_s = rng.uniform(0.002, 0.006) if rng.random() < 0.02 else 5e-5
            came_s = max(last_s, wait_end_s) + pause_s
        last_s = max(came_s, last_s + 1e-6)
        arrivals.note(last_s, 1)
        assert arrivals.slow_since_s is None, k / hz
    for k in range(30):
        arrivals.note(last_s + 2.5 * (k + 1) / hz, 1)
    assert arrivals.slow_since_s is not None, "and yet a slow one is"
