"""Silent, raving and trembling sensors on a hand-wound clock."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, TactileFrame
from touchdown.backend.devices.cameras.frames import dark_fault
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import DeviceState, GripStatus, Health
from touchdown.backend.devices.supervision import GRACE_S, DegradedDevice, RateMonitor, Supervision

IMAGES = np.random.default_rng(5).integers(0, 2, (8, 240, 320, 3), dtype=np.uint8)
"""Pictures of the least noise: one grey level."""


class Watched:
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

    def codes(self) -> list[tuple[str, str]]:
        return [(fault.code, fault.device) for fault in self.interlock.faults]


def test_healthy_sensors_raise_nothing() -> None:
    bench = Watched()
    bench.run(5.0, 8.0)
    assert not bench.interlock.latched


@pytest.mark.promise("C7")
def test_a_camera_that_told_why_it_gives_no_picture_is_not_called_silent_too() -> None:
    bench = Watched()
    bench.run(2.0)
    bench.run(0.3, silent="left")
    bench.interlock.raise_fault(dark_fault("tactile_left"))
    bench.run(1.0, silent="left")
    assert bench.codes() == [("CAMERA-DARK", "tactile_left")]


@pytest.mark.promise("C1")
@pytest.mark.parametrize("finger", FINGERS)
def test_a_silent_camera_is_named_after_half_a_second(finger: str) -> None:
    bench = Watched()
    bench.run(2.0)
    bench.run(0.44, silent=finger)
    assert not bench.interlock.latched
    bench.run(0.12, silent=finger)
    assert bench.codes() == [("CAMERA-STALE", f"tactile_{finger}")]


@pytest.mark.promise("C3")
@pytest.mark.parametrize("finger", FINGERS)
def test_the_third_equal_picture_is_a_frozen_camera(finger: str) -> None:
    bench = Watched()
    bench.run(2.0)
    bench.run(0.04, frozen=finger)
    bench.run(0.04)
    bench.run(0.08, frozen=finger)
    assert not bench.interlock.latched
    bench.run(0.04, frozen=finger)
    assert bench.codes() == [("CAMERA-FROZEN", f"tactile_{finger}")]


def test_a_camera_is_not_taken_for_frozen_across_scenes() -> None:
    bench = Watched()
    bench.run(0.08, frozen="left")
    bench.supervision.begin(bench.now_s)
    bench.run(0.08, frozen="left")
    assert not bench.interlock.latched


@pytest.mark.promise("S4")
@pytest.mark.parametrize("value", [None, float("nan"), float("inf")])
def test_no_valid_wrench_for_300_ms_is_a_fault(value: float | None) -> None:
    bench = Watched()
    bench.run(2.0)
    bench.run(0.28, value)
    assert not bench.interlock.latched
    bench.run(0.06, value)
    assert bench.codes() == [("FT-STALE", "force_torque")]


def test_sensors_get_time_to_start_and_then_no_more() -> None:
    bench = Watched()
    bench.run(GRACE_S - 0.04, None, silent="left")
    assert not bench.interlock.latched
    bench.run(0.1, None, silent="left")
    assert ("FT-STALE", "force_torque") in bench.codes()
    assert ("CAMERA-STALE", "tactile_left") in bench.codes()


@pytest.mark.promise("G3")
def test_the_trip_needs_two_samples_or_one_huge_one() -> None:
    bench = Watched()
    bench.run(1.5)
    one = np.zeros((20, 6))
    one[7, 2] = 45.0
    bench.wrench.put(bench.now_s + 0.001 * np.arange(1, 21), one)
    bench.supervision.check(bench.now_s + 0.02)
    assert not bench.interlock.latched
    one[8, 2] = 45.0
    bench.wrench.put(bench.now_s + 0.021 + 0.001 * np.arange(1, 21), one)
    bench.supervision.check(bench.now_s + 0.05)
    assert bench.codes() == [("FT-TRIP", "force_torque")]
    huge = Watched()
    huge.run(1.5)
    single = np.zeros((20, 6))
    single[3, 0] = 61.0
    huge.wrench.put(huge.now_s + 0.001 * np.arange(1, 21), single)
    huge.supervision.check(huge.now_s + 0.02)
    assert huge.codes() == [("FT-TRIP", "force_torque")]


def test_a_moment_trips_as_well_though_no_force_does() -> None:
    """1.61 N·m from three parts below the limit of 1.5 N·m each; once is not enough."""
    bench = Watched()
    bench.run(1.5)
    twisted = np.zeros((20, 6))
    twisted[7, 3:] = (1.2, -1.0, 0.4)
    bench.wrench.put(bench.now_s + 0.001 * np.arange(1, 21), twisted)
    bench.supervision.check(bench.now_s + 0.02)
    assert not bench.interlock.latched
    twisted[8, 3:] = (-1.2, 1.0, 0.4)
    bench.wrench.put(bench.now_s + 0.021 + 0.001 * np.arange(1, 21), twisted)
    bench.supervision.check(bench.now_s + 0.05)
    assert bench.codes() == [("FT-TRIP", "force_torque")]
    assert "1.61 N·m" in bench.interlock.faults[0].what


@pytest.mark.promise("C1")
def test_a_sensor_is_degraded_before_it_is_a_fault_and_well_again_by_itself() -> None:
    bench = Watched()
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


def test_a_scene_that_begins_forgets_what_was_degraded() -> None:
    bench = Watched()
    bench.run(2.0)
    bench.run(0.2, None)
    assert bench.supervision.degraded
    bench.supervision.begin(bench.now_s)
    assert bench.supervision.unwell() is None


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
def test_a_sensor_that_is_slow_from_its_start_is_known_by_the_rate_that_it_tells() -> None:
    class Wrist:
        def describe(self) -> dict[str, str | float]:
            return {"kind": "wrist", "usual_hz": 2500.0}

    bench = Watched()
    bench.supervision.begin(0.0, wrist=Wrist())  # type: ignore[arg-type]
    bench.run(0.9)
    assert bench.supervision.degraded == ()
    bench.run(0.3)
    (slow,) = bench.supervision.degraded
    assert (slow.device, slow.how) == ("force_torque", "slow")
    assert bench.interlock.degraded.startswith("The wrist sensor has delivered less than half")
    assert not bench.interlock.latched
    bench.supervision.begin(bench.now_s)
    bench.run(1.5)
    assert bench.supervision.degraded == (), "it tells no rate, and never had another"
    assert bench.interlock.degraded == ""


def test_a_camera_below_half_of_its_pictures_is_slow() -> None:
    bench = Watched()
    bench.run(2.5)
    for _ in range(25):
        bench.run(0.08)
        bench.run(0.04, silent="right")
    assert [(one.device, one.how) for one in bench.supervision.degraded] == []
    for _ in range(25):
        bench.run(0.04)
        bench.run(0.08, silent="right")
    assert [(one.device, one.how) for one in bench.supervision.degraded] == [
        ("tactile_right", "slow")
    ]
    bench.run(2.1)
    assert bench.supervision.degraded == ()


class Jaws:
    """A gripper that was last heard at ``heard_s``."""

    heard_s, holding = 0.0, True
    state, grips, letting_go = DeviceState.READY, 1, False
    width_mm = 20.0

    def __init__(self, bench: Watched) -> None:
        self._bench = bench

    def status(self) -> GripStatus:
        return GripStatus(self.width_mm, 10.0, self.holding)

    @property
    def health(self) -> Health:
        return Health(20.0, self._bench.now_s - self.heard_s, 9, 0)


@pytest.mark.promise("G9", "G2")
def test_a_gripper_that_holds_a_piece_is_degraded_after_300_ms_and_a_fault_after_1_s() -> None:
    bench = Watched()
    jaws = Jaws(bench)
    bench.supervision.begin(0.0, jaws)  # type: ignore[arg-type]
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
    bench = Watched()
    jaws = Jaws(bench)
    bench.supervision.begin(0.0, jaws)  # type: ignore[arg-type]
    for _ in range(60):
        jaws.heard_s = bench.now_s
        bench.run(0.02)
    jaws.width_mm = float("nan")
    for _ in range(15):
        jaws.heard_s = bench.now_s
        bench.run(0.02)
    assert not bench.interlock.latched
    jaws.holding, jaws.heard_s = False, bench.now_s
    bench.run(0.02)
    assert [(one.device, one.how) for one in bench.supervision.degraded] == [("gripper", "silent")]
    for _ in range(36):
        jaws.heard_s = bench.now_s
        bench.run(0.02)
    assert bench.codes() == [("GRIP-STALE", "gripper")]
    bench.interlock.reset()
    jaws.width_mm, jaws.holding = 20.0, True
    bench.run(0.04)
    assert (bench.supervision.degraded, bench.codes()) == ((), []), "well again"
