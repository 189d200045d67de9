"""Which way a jog goes, how long a command may last, and what the servo may do after a stop."""

from __future__ import annotations

import math

import numpy as np
import pytest

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import LEASE_S, Interlock, Limits
from touchdown.backend.devices.jog import Jog, JogOrder, JogSurroundings, direction_of
from touchdown.backend.devices.protocols import ArmStatus, RobotMode, SafetyMode

JOINTS = (0.1, -0.2, 0.3, 0.0, 0.5, -0.4)


class WatchedArm:
    """Notes its orders and how old its measured values may be."""

    name, rotates = "arm", True

    def __init__(self) -> None:
        self.orders: list[tuple[object, ...]] = []
        self.ages_s: list[float] = []

    def status(self) -> ArmStatus:
        return ArmStatus(RobotMode.READY, SafetyMode.NORMAL, 1.0, 0)

    def pose(self, max_age_s: float) -> Pose:
        self.ages_s.append(max_age_s)
        return Pose(12.0, -7.0, 90.0)

    def joints_rad(self, max_age_s: float) -> tuple[float, ...]:
        self.ages_s.append(max_age_s)
        return JOINTS

    def place_of(self, joints_rad: tuple[float, ...]) -> Pose:
        return Pose(12.0, -7.0, 90.0)

    def stop(self) -> None:
        pass

    def __getattr__(self, order: str) -> object:
        return lambda *told: self.orders.append((order, *told))


@pytest.fixture
def noted() -> WatchedArm:
    return WatchedArm()


@pytest.fixture
def interlock() -> Interlock:
    found = Interlock(Limits())
    found.renew_lease(3.0)
    return found


@pytest.fixture
def arm(noted: WatchedArm, interlock: Interlock) -> GuardedArm:
    return GuardedArm(noted, interlock, lambda: 3.0, lambda: 0.0, lambda: 40.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("axis", "frame", "way"),
    [
        ("x", "TOOL", (1.0, 0.0, 0.0)),
        ("y", "TOOL", (0.0, -1.0, 0.0)),
        ("z", "TOOL", (0.0, 0.0, -1.0)),
        ("rx", "TOOL", (1.0, 0.0, 0.0)),
        ("ry", "TOOL", (0.0, -1.0, 0.0)),
        ("rz", "TOOL", (0.0, 0.0, -1.0)),
        ("y", "XYZ", (0.0, 1.0, 0.0)),
        ("z", "XYZ", (0.0, 0.0, 1.0)),
    ],
)
def test_a_jog_goes_along_the_axes_of_a_hand_that_points_down(axis, frame, way) -> None:
    assert direction_of(axis, frame, 2.5) == way
    assert direction_of(axis, frame, -2.5) == tuple(-part for part in way)


def test_the_axes_of_the_tool_are_right_handed_and_turn_with_the_hand() -> None:
    x, y, z = (np.array(direction_of(axis, "TOOL", 1.0)) for axis in ("x", "y", "z"))
    np.testing.assert_array_equal(np.cross(x, y), z)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert direction_of("y", "TOOL", 4.0, quarter) == (1.0, 0.0, 0.0)


def test_after_a_stop_the_servo_goes_off_but_not_on(
    arm: GuardedArm, noted: WatchedArm, interlock: Interlock
) -> None:
    interlock.stop("operator")
    with pytest.raises(RefusedError, match="operator"):
        arm.servo(True)
    arm.servo(False)
    assert noted.orders == [("servo", False)]


@pytest.mark.parametrize("for_s", [0.0, -0.1, 1.01 * LEASE_S, math.nan])
def test_no_jog_lasts_no_time_or_longer_than_a_lease(
    arm: GuardedArm, noted: WatchedArm, for_s: float
) -> None:
    for jog in (
        lambda: arm.jog((3.0, -4.0, 5.0), for_s),
        lambda: arm.jog_joints((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), for_s),
    ):
        with pytest.raises(RefusedError) as refused:
            jog()
        assert refused.value.reason == "JOG-TIME"
    assert noted.orders == []


def test_a_jog_may_last_as_long_as_a_lease(arm: GuardedArm, noted: WatchedArm) -> None:
    arm.jog((3.0, -4.0, 5.0), LEASE_S)
    assert [name for name, *_ in noted.orders] == ["jog"]


def test_a_turn_of_joints_is_judged_by_fresh_values(arm: GuardedArm, noted: WatchedArm) -> None:
    arm.move_joints((0.3, *JOINTS[1:]), 0.2)
    assert len(noted.ages_s) >= 2
    assert max(noted.ages_s) <= 0.2


def test_a_jog_that_ended_tells_the_time_in_milliseconds(
    arm: GuardedArm, interlock: Interlock
) -> None:
    wall_s, told = [7.0], list[RefusedError]()
    around = JogSurroundings(lambda: 3.0, lambda: wall_s[0], lambda: 0.0, lambda: 40.0, bool)
    jog = Jog(arm, interlock, around, told.append)
    jog.renew(JogOrder(1, 1, 3.0, "x", "XYZ", 5.0))
    wall_s[0] += 0.312
    jog.tick()
    assert [cause.reason for cause in told] == ["JOG-LEASE"]
    assert "renewed it for 312 ms" in told[0].detail
    assert "late as well, by 312 ms" in told[0].detail
