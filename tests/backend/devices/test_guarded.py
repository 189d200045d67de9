"""What the guarded arm passes on and what it refuses, on an arm that only notes its orders."""

import math
from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.core import Pose, RefusedError
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import LEASE_S, Interlock, Limits, StagedOpening
from touchdown.backend.devices.jog import Jog, JogOrder, JogSurroundings, direction_of
from touchdown.backend.devices.protocols import ArmStatus, PressCommand, RobotMode, SafetyMode

SURFACE_MM = 40.0
HERE = Pose(12.0, -7.0, 90.0)
LEANT = replace(HERE, rx_rad=0.1, ry_rad=-0.05)
PRESS = PressCommand(1.5, 0.5, 2.0, 2.0, 1.0, 10.0, (5.0, 7.0, 19.0))
JOINTS = (0.1, -0.2, 0.3, 0.0, 0.5, -0.4)
GOAL = (0.5, -0.2, 0.3, 0.0, 0.5, -0.4)  # from ``JOINTS`` the first joint turns by 0.4 rad


class NotedArm:
    """Stands at ``here``; ``leans_at``: angle of the first joint at which the hand leans far."""

    name, rotates = "arm", True
    here = HERE
    leans_at: float | None = None

    def __init__(self) -> None:
        self.orders: list[tuple[object, ...]] = []
        self.ages_s: list[float] = []

    def status(self) -> ArmStatus:
        return ArmStatus(RobotMode.READY, SafetyMode.NORMAL, 1.0, 0)

    def pose(self, max_age_s: float) -> Pose:
        self.ages_s.append(max_age_s)
        return self.here

    def joints_rad(self, max_age_s: float) -> tuple[float, ...]:
        self.ages_s.append(max_age_s)
        return JOINTS

    def place_of(self, joints_rad: tuple[float, ...]) -> Pose:
        far = self.leans_at is not None and abs(joints_rad[0] - self.leans_at) < 1e-6
        return replace(HERE, rx_rad=0.5) if far else HERE

    def stop(self) -> None:
        self.orders.append(("stop",))

    def __getattr__(self, order: str) -> object:
        return lambda *told: self.orders.append((order, *told))


class Guard:
    """The guarded arm with a live lease, no force at the wrist, and a known surface."""

    def __init__(self, **limits: float) -> None:
        self.noted, self.interlock = NotedArm(), Interlock(Limits(**limits))
        self.interlock.renew_lease(3.0)
        self.arm = GuardedArm(
            self.noted,  # type: ignore[arg-type]
            self.interlock,
            lambda: 3.0,
            lambda: 0.0,
            lambda: SURFACE_MM,
        )

    def refusal(self, order: str, *told: object) -> str | None:
        """Return why ``order`` was refused; None if it reached the arm, and it alone."""
        self.noted.orders.clear()
        try:
            getattr(self.arm, order)(*told)
        except RefusedError as cause:
            assert self.noted.orders == []
            return cause.reason
        assert [name for name, *_ in self.noted.orders] == [order]
        return None


MOTIONS = {
    "move_to": (replace(HERE, z_mm=95.0), 20.0),
    "jog": ((3.0, -4.0, 5.0), 0.2),
    "jog_joints": ((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), 0.2),
    "move_joints": (GOAL, 0.2),
    "press": (PRESS,),
    "unload": (1.0, 2.0),
}


@pytest.mark.parametrize("order", MOTIONS)
def test_every_motion_needs_a_lease_and_no_latch(order: str) -> None:
    guard = Guard()
    assert guard.refusal(order, *MOTIONS[order]) is None
    guard.interlock.drop_lease()
    assert guard.refusal(order, *MOTIONS[order]) == "NO-LEASE"
    guard.interlock.renew_lease(3.0)
    guard.interlock.stop("operator")
    assert guard.refusal(order, *MOTIONS[order]) == "STOPPED"


@pytest.mark.parametrize("at", [0.2, 0.3, 0.4, 0.5])
def test_a_turn_of_joints_is_refused_for_a_quarter_of_its_way_that_is_not_allowed(
    at: float,
) -> None:
    guard = Guard()
    assert guard.refusal("move_joints", GOAL, 0.2) is None
    guard.noted.leans_at = at
    assert guard.refusal("move_joints", GOAL, 0.2) == "TILT"


def test_the_override_slows_every_move() -> None:
    guard = Guard()
    guard.interlock.override_speed(0.4)
    there = Pose(15.0, -11.0, 80.0)
    guard.arm.move_to(there, 30.0)
    turned = replace(there, ry_rad=0.1)
    guard.arm.move_to(turned, 30.0, 0.2)
    guard.arm.move_joints(GOAL, 0.2)
    assert guard.noted.orders == [
        ("move_to", there, pytest.approx(12.0)),
        ("move_to", turned, pytest.approx(12.0), pytest.approx(0.08)),
        ("move_joints", GOAL, pytest.approx(0.08)),
    ]


def test_the_nominal_force_of_a_press_is_that_along_z_and_of_its_drag() -> None:
    guard = Guard(probe_n=30.0)
    hard = replace(PRESS, stiffness_n_mm=(5.0, 7.0, 20.1))
    assert guard.refusal("press", hard) == "PRESS-FORCE"
    soft = replace(hard, stiffness_n_mm=(25.0, 30.0, 12.0))
    assert guard.refusal("press", replace(soft, stiffness_n_mm=(25.0, 30.0, 19.9))) is None
    # 18 N down and 24 N to the side
    assert guard.refusal("press", replace(soft, drag_mm=-0.79)) is None
    assert guard.refusal("press", replace(soft, drag_mm=-0.81)) == "PRESS-FORCE"
    with pytest.raises(ValueError, match="drag_mm"):
        replace(PRESS, stiffness_n_mm=(5.0, 0.0, 19.0), drag_mm=-3.1)


def test_a_press_approaches_no_faster_than_contact_allows() -> None:
    guard = Guard()
    assert guard.refusal("press", replace(PRESS, approach_mm_s=2.0)) is None
    assert guard.refusal("press", replace(PRESS, approach_mm_s=2.01)) == "APPROACH-SPEED"
    assert guard.refusal("press", replace(PRESS, approach_mm_s=0.0)) == "APPROACH-SPEED"


def test_a_turned_hand_is_not_jogged_down_to_the_surface() -> None:
    guard = Guard(turn_clear_mm=20.0)
    down = ((1.0, -2.0, -3.0), 0.2)
    for height_mm, refusal in ((61.0, None), (60.0, "LIMIT"), (50.0, "LIMIT")):
        guard.noted.here = replace(LEANT, z_mm=height_mm)
        assert guard.refusal("jog", *down) == refusal
        assert guard.refusal("jog", (1.0, -2.0, 3.0), 0.2) is None
        guard.noted.here = replace(HERE, z_mm=height_mm)
        assert guard.refusal("jog", *down) is None


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


def test_after_a_stop_the_servo_goes_off_but_not_on() -> None:
    guard = Guard()
    guard.interlock.stop("operator")
    assert guard.refusal("servo", True) == "STOPPED"
    assert guard.refusal("servo", False) is None
    assert guard.noted.orders == [("servo", False)]


@pytest.mark.parametrize("order", ["jog", "jog_joints"])
@pytest.mark.parametrize("for_s", [0.0, -0.1, 1.01 * LEASE_S, math.nan])
def test_no_jog_lasts_no_time_or_longer_than_a_lease(order: str, for_s: float) -> None:
    guard, (way, _) = Guard(), MOTIONS[order]
    assert guard.refusal(order, way, for_s) == "JOG-TIME"
    assert guard.refusal(order, way, LEASE_S) is None


def test_a_turn_of_joints_is_judged_by_fresh_values() -> None:
    guard = Guard()
    guard.arm.move_joints(GOAL, 0.2)
    assert len(guard.noted.ages_s) >= 2
    assert max(guard.noted.ages_s) <= 0.2


def test_a_jog_that_ended_tells_the_time_in_milliseconds() -> None:
    guard, wall_s, told = Guard(), [7.0], list[RefusedError]()
    around = JogSurroundings(
        lambda: 3.0, lambda: wall_s[0], lambda: 0.0, lambda: SURFACE_MM, lambda: False
    )
    jog = Jog(guard.arm, guard.interlock, around, told.append)
    jog.renew(JogOrder(1, 1, 3.0, "x", "XYZ", 5.0))
    wall_s[0] += 0.312
    jog.tick()
    assert [cause.reason for cause in told] == ["JOG-LEASE"]
    assert "renewed it for 312 ms" in told[0].detail
    assert "late as well, by 312 ms" in told[0].detail


def test_the_arm_stands_still_while_the_jaws_open_in_stages():
    guard = Guard()
    guard.interlock.staged = StagedOpening(30.0, 8.0)
    assert guard.refusal("move_to", replace(HERE, z_mm=100.0), 20.0) == "JAWS-LOOSE"
    assert guard.refusal("jog", (0.0, 0.0, 5.0), 0.1) == "JAWS-LOOSE"
    assert guard.refusal("press", PRESS) == "JAWS-LOOSE"
    guard.interlock.staged = None
    assert guard.refusal("move_to", replace(HERE, z_mm=100.0), 20.0) is None
