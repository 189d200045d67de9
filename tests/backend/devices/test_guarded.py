"""What the guarded arm passes on and what it refuses, on an arm that only notes its orders."""

from __future__ import annotations

from dataclasses import replace

import pytest

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock, Limits
from touchdown.backend.devices.protocols import ArmStatus, PressCommand, RobotMode, SafetyMode

SURFACE_MM = 40.0
HERE = Pose(12.0, -7.0, 90.0)
LEANT = replace(HERE, rx_rad=0.1, ry_rad=-0.05)
PRESS = PressCommand(1.5, 0.5, 2.0, 2.0, 1.0, 10.0, (5.0, 7.0, 19.0))
JOINTS = (0.1, -0.2, 0.3, 0.0, 0.5, -0.4)
GOAL = (0.5, -0.2, 0.3, 0.0, 0.5, -0.4)
"""From ``JOINTS`` the first joint turns by 0.4 rad."""


class NotedArm:
    """Stands at ``here``; ``leans_at``: angle of the first joint at which the hand leans far."""

    name, rotates = "arm", True
    here = HERE
    leans_at: float | None = None

    def __init__(self) -> None:
        self.orders: list[tuple[object, ...]] = []

    def status(self) -> ArmStatus:
        return ArmStatus(RobotMode.READY, SafetyMode.NORMAL, 1.0, 0)

    def pose(self, max_age_s: float) -> Pose:
        return self.here

    def joints_rad(self, max_age_s: float) -> tuple[float, ...]:
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


def test_the_nominal_force_of_a_press_is_that_along_z() -> None:
    guard = Guard(probe_n=30.0)
    hard = replace(PRESS, stiffness_n_mm=(5.0, 7.0, 20.1))
    assert guard.refusal("press", hard) == "PRESS-FORCE"
    assert guard.refusal("press", replace(hard, stiffness_n_mm=(25.0, 30.0, 19.9))) is None


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
