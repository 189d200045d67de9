"""A sensor that becomes slow is told at once, and none because its samples came in lumps."""

import math
import random
from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core import (
    FINGERS,
    Pose,
    RefusedError,
    SampleStream,
    StaleSampleError,
    Stream,
    TactileFrame,
)
from touchdown.backend.devices.cameras.frames import dark_fault
from touchdown.backend.devices.dynpick.driver import DynpickDriver
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.force_torque import ForceTorqueReader, SensorDescription
from touchdown.backend.devices.ft300.driver import Ft300Driver
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import (
    ArmPress,
    CommandedMotion,
    DeviceState,
    GripStatus,
    Health,
    Identity,
    PressCommand,
)
from touchdown.backend.devices.safety_trips import GRACE_S, Supervision
from touchdown.backend.devices.sensor_faults import ArrivalMonitor, DegradedDevice, RateMonitor
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults, hanging_gripper

USUAL_S = 1.3


class Watched:
    """The real reader and the supervision, by hand: bytes every ``lump_s``, a look every 20 ms."""

    first_s: float | None = None  # when something was told for the first time

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
        self.reader._description = SensorDescription(
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


IMAGES = np.random.default_rng(5).integers(90, 92, (8, 240, 320, 3), dtype=np.uint8)
"""Pictures of the least noise: one grey level."""


class SupervisionWatched:
    """Sensors that deliver what they are told, supervised every 20 ms."""

    def __init__(self) -> None:
        self.interlock = Interlock()
        self.wrench = SampleStream("wrench", 6, 10_000)
        self.frames = {finger: Stream(f"tactile_{finger}", 64) for finger in FINGERS}
        self.supervision = Supervision(self.interlock, self.wrench, self.frames)
        self.supervision.begin(0.0)
        self.now_s, self.sequence = 0.0, 0

    def run(
        self, seconds: float, value: float | None = 0.0, silent: str = "", frozen: str = ""
    ) -> None:
        for _ in range(round(seconds / 0.02)):
            t_s = self.now_s + 0.001 * np.arange(1, 21)
            self.now_s += 0.02
            if value is not None:
                wrench = np.zeros((20, 6))
                wrench[:, 2] = value
                self.wrench.put(t_s, wrench)
            self.sequence += 1
            if self.sequence % 2:
                for finger in FINGERS:
                    if finger != silent:
                        image = IMAGES[0 if finger == frozen else self.sequence // 2 % len(IMAGES)]
                        frame = TactileFrame(finger, self.sequence, self.now_s, image.copy())
                        self.frames[finger].put(self.now_s, frame)
            self.supervision.check(self.now_s)

    def wait(self, seconds: float) -> None:
        """Let time pass in which no sensor delivers."""
        for _ in range(round(seconds / 0.02)):
            self.now_s += 0.02
            self.supervision.check(self.now_s)

    def codes(self) -> list[tuple[str, str]]:
        return [(fault.code, fault.device) for fault in self.interlock.faults]

    def degraded(self) -> list[tuple[str, str]]:
        return [(one.device, one.how) for one in self.supervision.degraded]


@pytest.mark.promise("C7")
def test_a_camera_that_told_why_it_gives_no_picture_is_not_called_silent_too() -> None:
    bench = SupervisionWatched()
    bench.run(2.0)
    bench.run(0.3, silent="left")
    bench.interlock.raise_fault(dark_fault("tactile_left"))
    bench.run(1.0, silent="left")
    assert bench.codes() == [("CAMERA-DARK", "tactile_left")]


@pytest.mark.promise("C7")
@pytest.mark.parametrize("finger", FINGERS)
def test_the_fifth_dark_picture_in_a_row_is_a_dark_camera(finger: str) -> None:
    bench = SupervisionWatched()

    def shown(*levels: int) -> None:
        for level in levels:
            bench.now_s += 0.04
            image = np.full((240, 320, 3), level, np.uint8)
            bench.sequence += 1
            frame = TactileFrame(finger, bench.sequence, bench.now_s, image)
            bench.frames[finger].put(bench.now_s, frame)
            bench.supervision.check(bench.now_s)

    shown(9, 8, 9, 8, 60, 9, 8, 9, 8)
    assert not bench.interlock.latched
    shown(9)
    assert bench.codes() == [("CAMERA-DARK", f"tactile_{finger}")]


class CommandedArm:
    """An arm with one motion, at ``pose_mm``."""

    def __init__(self) -> None:
        self.commanded: CommandedMotion | None = None
        self.commanded_speed = (2.0, math.inf)
        self.press_command: PressCommand | None = None
        self.force_n = 0.0
        self.poses = SampleStream("poses", 3, 10)
        self.place = Pose(0.0, 0.0, 60.0)

    def pose(self, max_age_s: float) -> Pose:
        return self.place

    def press_n(self) -> float:
        return self.force_n


class SilentArm(CommandedArm):
    """An arm without a position."""

    def pose(self, max_age_s: float) -> Pose:
        raise StaleSampleError("arm: no sample yet")


@pytest.mark.promise("R16")
@pytest.mark.parametrize(
    ("step", "turn", "stalled"), [(0.0, 0.0, True), (0.002, 0.0, False), (0.0, 1e-4, False)]
)
def test_an_arm_that_stands_during_a_motion_is_named_within_2_s(
    step: float, turn: float, stalled: bool
) -> None:
    bench, arm = SupervisionWatched(), CommandedArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    bench.run(3.0)
    arm.commanded = CommandedMotion({})
    begun_s = bench.now_s
    while bench.now_s - begun_s < 4.0 and not bench.interlock.latched:
        old = arm.place
        arm.place = Pose(0.0, 0.0, old.z_mm - step, old.rx_rad + turn, 0.0, 0.0)
        bench.run(0.02)
    assert bench.codes() == ([("ARM-STALLED", "arm")] if stalled else [])
    assert not stalled or bench.now_s - begun_s <= 2.0
    assert not stalled or "motion is under way" in bench.interlock.faults[0].what


@pytest.mark.promise("R16")
@pytest.mark.parametrize(
    ("speed", "step", "turn", "within_s"),
    [
        ((0.02, math.inf), 0.0004, 0.0, None),  # as slow as commanded
        ((0.1, math.inf), 0.001, 0.0, None),  # in contact, slower than commanded
        ((math.inf, 1e-3), 0.0, 1e-5, None),
        ((0.1, math.inf), 0.0, 0.0, 2.1),
        ((2.0, math.inf), 0.0, 0.0, 1.1),
        ((math.inf, 0.01), 0.0, 0.0, 1.1),
    ],
)
def test_a_slow_motion_is_no_stall(
    speed: tuple[float, float], step: float, turn: float, within_s: float | None
) -> None:
    bench, arm = SupervisionWatched(), CommandedArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    arm.commanded_speed = speed
    begun_s = bench.now_s
    while bench.now_s - begun_s < 6.0 and not bench.interlock.latched:
        # A held jog: every renewal is a motion of its own.
        arm.commanded = CommandedMotion({})
        arm.place = replace(arm.place, z_mm=arm.place.z_mm - step, rx_rad=arm.place.rx_rad + turn)
        bench.run(0.02)
    assert bench.codes() == ([] if within_s is None else [("ARM-STALLED", "arm")])
    assert within_s is None or bench.now_s - begun_s <= within_s


@pytest.mark.promise("R5")
@pytest.mark.parametrize("leased", [True, False])
def test_a_silent_arm_is_named_while_it_may_be_moved(leased: bool) -> None:
    bench, arm = SupervisionWatched(), SilentArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    until_s = bench.now_s + GRACE_S + 0.1
    while bench.now_s < until_s:
        if leased:
            bench.interlock.renew_lease(bench.now_s)
        bench.run(0.02)
    assert bench.codes() == ([("ARM-STALE", "arm")] if leased else [])


def test_time_without_a_check_is_no_stall() -> None:
    bench, arm = SupervisionWatched(), CommandedArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    arm.commanded = CommandedMotion({})
    bench.run(0.4)
    bench.now_s += 2.0
    bench.run(0.4)
    assert "ARM-STALLED" not in [code for code, _ in bench.codes()]


def test_an_arm_may_stand_after_its_motion() -> None:
    bench, arm = SupervisionWatched(), CommandedArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    arm.commanded = CommandedMotion({})
    arm.commanded.end()
    bench.run(3.0)
    assert not bench.interlock.latched


@pytest.mark.promise("R16")
@pytest.mark.parametrize("ramp_s", [1.5, 7.5])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("at", [None, 0.0, 0.2, 0.5, 0.9, 1.1])
def test_an_arm_that_stands_in_contact_is_named(
    ramp_s: float, share: float, at: float | None
) -> None:
    """``share`` of the ramp moves the arm, the rest raises the force; it stalls ``at`` a time."""
    bench, arm = SupervisionWatched(), CommandedArm()
    bench.supervision.begin(bench.now_s, arm=arm)
    arm.commanded_speed = (2.0, math.inf)
    arm.press_command = press = PressCommand(1.5, ramp_s, ramp_s / 0.75, 2.0, 1.0, 8.0, (15.0,) * 3)
    arm.commanded = motion = ArmPress({})
    motion.onset_s, motion.detected_s = bench.now_s, bench.now_s + 0.1
    while bench.now_s < motion.onset_s + press.hold_s + 2.0 and not bench.interlock.latched:
        passed_s = bench.now_s - motion.onset_s
        if at is None and passed_s >= press.hold_s:
            break
        if at is None or passed_s < at * ramp_s:
            # The descent ends 0.2 mm deep and waits there for the ramp.
            depth_mm = max(0.2, press.depth_mm * min(1.0, passed_s / ramp_s))
            arm.place = replace(arm.place, z_mm=60.0 - share * depth_mm)
            arm.force_n = (1.0 - share) * 15.0 * depth_mm
        bench.run(0.02)
    assert bench.codes() == ([] if at is None else [("ARM-STALLED", "arm")])
    if at is not None and ramp_s == 1.5:
        assert bench.now_s - motion.onset_s - at * ramp_s <= 2.0


@pytest.mark.promise("C1")
@pytest.mark.parametrize("finger", FINGERS)
def test_a_silent_camera_is_named_after_half_a_second(finger: str) -> None:
    bench = SupervisionWatched()
    bench.run(2.0)
    bench.run(0.44, silent=finger)
    assert not bench.interlock.latched
    bench.run(0.12, silent=finger)
    assert bench.codes() == [("CAMERA-STALE", f"tactile_{finger}")]


@pytest.mark.promise("C3")
@pytest.mark.parametrize("finger", FINGERS)
def test_the_third_equal_picture_is_a_frozen_camera(finger: str) -> None:
    bench = SupervisionWatched()
    bench.run(2.0)
    bench.run(0.04, frozen=finger)
    bench.run(0.04)
    bench.run(0.08, frozen=finger)
    assert not bench.interlock.latched
    bench.run(0.04, frozen=finger)
    assert bench.codes() == [("CAMERA-FROZEN", f"tactile_{finger}")]


def test_a_camera_is_not_taken_for_frozen_across_scenes() -> None:
    bench = SupervisionWatched()
    bench.run(0.08, frozen="left")
    bench.supervision.begin(bench.now_s)
    bench.run(0.08, frozen="left")
    assert not bench.interlock.latched


@pytest.mark.promise("S4")
@pytest.mark.parametrize("value", [None, float("nan"), float("inf")])
def test_no_valid_wrench_for_300_ms_is_a_fault(value: float | None) -> None:
    bench = SupervisionWatched()
    bench.run(2.0)
    bench.run(0.28, value)
    assert not bench.interlock.latched
    bench.run(0.06, value)
    assert bench.codes() == [("FT-STALE", "force_torque")]


def test_sensors_get_time_to_start_and_then_no_more() -> None:
    bench = SupervisionWatched()
    bench.run(GRACE_S - 0.04, None, silent="left")
    assert not bench.interlock.latched
    bench.run(0.1, None, silent="left")
    assert ("FT-STALE", "force_torque") in bench.codes()
    assert ("CAMERA-STALE", "tactile_left") in bench.codes()


def after_samples(bench: SupervisionWatched, *spikes: tuple[int, int, float]) -> None:
    """Deliver 20 samples, zero but for (sample, channel, value)."""
    wrench = np.zeros((20, 6))
    for sample, channel, value in spikes:
        wrench[sample, channel] = value
    bench.wrench.put(bench.now_s + 0.001 * np.arange(1, 21), wrench)
    bench.now_s += 0.02
    bench.supervision.check(bench.now_s)


# 1.61 N·m from three parts below the limit of 1.5 N·m each; once is not enough.
TWIST, TURNED = ((7, 3, 1.2), (7, 4, -1.0), (7, 5, 0.4)), ((8, 3, -1.2), (8, 4, 1.0), (8, 5, 0.4))


@pytest.mark.promise("G3")
@pytest.mark.parametrize(
    ("once", "more", "what"),
    [
        (((7, 2, 45.0),), ((7, 2, 45.0), (8, 2, 45.0)), "45.0 N"),
        (((3, 0, 59.0),), ((3, 0, 61.0),), "61.0 N"),
        (TWIST, (*TWIST, *TURNED), "1.61 N·m"),
    ],
)
def test_the_trip_needs_two_samples_or_one_huge_force(once, more, what) -> None:
    bench = SupervisionWatched()
    bench.run(1.5)
    after_samples(bench, *once)
    assert not bench.interlock.latched
    after_samples(bench, *more)
    assert bench.codes() == [("FT-TRIP", "force_torque")]
    assert what in bench.interlock.faults[0].what


@pytest.mark.promise("C1")
def test_a_sensor_is_degraded_before_it_is_a_fault_and_well_again_by_itself() -> None:
    bench = SupervisionWatched()
    bench.run(2.0)
    bench.run(0.08, None)
    assert bench.supervision.degraded == ()
    bench.run(0.04, None)
    assert bench.supervision.degraded == (
        DegradedDevice("force_torque", "silent", pytest.approx(2.0)),
    )
    assert bench.supervision.unwell().what == "The wrist sensor has been silent for 0.1 s."
    bench.run(0.02)
    assert bench.supervision.degraded == ()
    last_s = bench.frames["left"].newest().t_s
    bench.run(0.08, silent="left")
    assert bench.supervision.degraded == ()
    bench.run(0.06, silent="left")
    assert bench.supervision.degraded == (
        DegradedDevice("tactile_left", "silent", pytest.approx(last_s)),
    )
    bench.run(0.04)
    assert bench.supervision.degraded == ()
    assert not bench.interlock.latched


@pytest.mark.promise("S6")
@pytest.mark.parametrize(("share", "slow"), [(0.4, True), (0.6, False)])
def test_less_than_half_of_the_usual_rate_is_degraded_until_it_is_back(
    share: float, slow: bool
) -> None:
    rate, now_s = RateMonitor(), 0.0

    def deliver(seconds: float, hz: float) -> None:
        nonlocal now_s
        for _ in range(round(10 * seconds)):
            now_s += 0.1
            rate.note(now_s, round(0.1 * hz))

    deliver(3.0, 1000.0)
    deliver(3.0, 1000.0 * share)
    assert (rate.slow_since_s is not None) == slow
    assert not slow or 2.0 <= rate.slow_since_s <= 4.0
    deliver(2.2, 1000.0)
    assert rate.slow_since_s is None


@pytest.mark.promise("S6")
@pytest.mark.parametrize("phase_s", [0.0, 0.2, 0.4, 0.6, 0.8])
def test_a_low_rate_is_known_within_a_second_whenever_it_begins(phase_s: float) -> None:
    rate, begun_s = RateMonitor(), 3.0 + phase_s
    for ms in range(0, round(1000 * (begun_s + 1.0)), 20):
        rate.note(ms / 1000, 20 if ms < 1000 * begun_s else 6)
    assert rate.slow_since_s == pytest.approx(begun_s, abs=0.5)


@pytest.mark.promise("S6")
def test_a_sensor_that_is_slow_from_its_start_is_known_by_the_rate_that_it_tells() -> None:
    class Wrist:
        def describe(self) -> dict[str, str | float]:
            return {"kind": "wrist", "usual_hz": 2500.0}

    bench = SupervisionWatched()
    bench.supervision.begin(0.0, wrist=Wrist())  # type: ignore[arg-type]
    bench.run(0.9)
    assert bench.supervision.degraded == ()
    bench.run(0.3)
    assert bench.degraded() == [("force_torque", "slow")]
    assert bench.interlock.degraded.startswith("The wrist sensor has delivered less than half")
    assert not bench.interlock.latched
    bench.supervision.begin(bench.now_s)
    bench.run(1.5)
    assert bench.supervision.degraded == (), "it tells no rate, and never had another"
    assert bench.interlock.degraded == ""


def test_a_camera_below_half_of_its_pictures_is_slow() -> None:
    bench = SupervisionWatched()
    bench.run(2.5)
    for _ in range(25):
        bench.run(0.08)
        bench.run(0.04, silent="right")
    assert bench.degraded() == []
    for _ in range(25):
        bench.run(0.04)
        bench.run(0.08, silent="right")
    assert bench.degraded() == [("tactile_right", "slow")]
    bench.run(2.1)
    assert bench.supervision.degraded == ()


class Jaws:
    """A gripper that was last heard at ``heard_s``."""

    heard_s, holding = 0.0, True
    state, grips, letting_go = DeviceState.READY, 1, False
    width_mm = 20.0

    def __init__(self, bench: SupervisionWatched) -> None:
        self._bench = bench
        bench.supervision.begin(0.0, self)  # type: ignore[arg-type]

    def heard(self, seconds: float) -> None:
        """Let time pass in which the gripper is heard."""
        for _ in range(round(seconds / 0.02)):
            self.heard_s = self._bench.now_s
            self._bench.run(0.02)

    def status(self) -> GripStatus:
        return GripStatus(self.width_mm, 10.0, self.holding)

    @property
    def health(self) -> Health:
        return Health(20.0, self._bench.now_s - self.heard_s, 9, 0)


@pytest.mark.promise("G9", "G2")
def test_a_gripper_that_holds_a_piece_is_degraded_after_300_ms_and_a_fault_after_1_s() -> None:
    bench = SupervisionWatched()
    jaws = Jaws(bench)
    bench.run(2.0)
    assert bench.codes() == [("GRIP-STALE", "gripper")]
    bench.interlock.reset()
    jaws.heard_s = bench.now_s
    bench.run(0.28)
    assert bench.supervision.degraded == ()
    bench.run(0.06)
    assert bench.supervision.degraded == (DegradedDevice("gripper", "silent", pytest.approx(2.0)),)
    bench.run(0.64)
    assert not bench.interlock.latched
    bench.run(0.06)
    assert bench.codes() == [("GRIP-STALE", "gripper")]
    bench.interlock.reset()
    jaws.letting_go, jaws.holding = True, False
    bench.run(0.1)
    assert (bench.supervision.degraded, bench.codes()) == ((), []), "empty jaws let nothing fall"


@pytest.mark.promise("G1")
def test_a_gripper_that_tells_no_width_while_it_holds_is_as_good_as_silent() -> None:
    bench = SupervisionWatched()
    jaws = Jaws(bench)
    jaws.heard(1.2)
    jaws.width_mm = float("nan")
    jaws.heard(0.3)
    assert not bench.interlock.latched
    jaws.holding, jaws.heard_s = False, bench.now_s
    bench.run(0.02)
    assert bench.degraded() == [("gripper", "silent")]
    jaws.heard(0.72)
    assert bench.codes() == [("GRIP-STALE", "gripper")]
    bench.interlock.reset()
    jaws.width_mm, jaws.holding = 20.0, True
    bench.run(0.04)
    assert (bench.supervision.degraded, bench.codes()) == ((), []), "well again"


@pytest.mark.promise("S12")
def test_the_first_fault_names_every_device_that_was_lost_at_once() -> None:
    bench = SupervisionWatched()
    jaws = Jaws(bench)
    jaws.heard_s = 1.5
    arm = CommandedArm()
    bench.supervision.begin(bench.now_s, jaws, arm=arm)
    arm.poses.put(np.array([1.5]), np.zeros((1, 3)))
    bench.run(1.5)
    bench.wait(0.4)
    (fault,) = bench.interlock.faults
    assert fault.code == "FT-STALE"
    for name in ("force/torque", "left tactile camera", "right tactile camera", "gripper", "arm"):
        assert name in fault.what, name
    bench.wait(1.2)
    codes = ["FT-STALE", "CAMERA-STALE", "CAMERA-STALE", "GRIP-STALE"]
    assert [code for code, _ in bench.codes()] == codes
    assert bench.interlock.faults[-1].what.count("gripper") == 1
    with pytest.raises(RefusedError, match=r"force/torque.*left.*right.*gripper"):
        bench.interlock.refuse_latched()
