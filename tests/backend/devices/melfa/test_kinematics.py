"""Closed-form places of the hand against the emulator's chain of joint frames."""

import math

import numpy as np
import pytest

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.devices.melfa import emulated_controller
from touchdown.backend.devices.melfa.emulated_controller import READY_RAD
from touchdown.backend.devices.melfa.kinematics import (
    LIMITS_RAD,
    STEPS_RAD,
    MelfaPlacement,
    check_joints,
    check_step,
    flange,
    hand_of,
    joints_for,
)

PLACING = MelfaPlacement((450.0, 20.0, -30.0), 0.3, math.pi, 180.0)


def any_joints(count, share=1.0):
    rng = np.random.default_rng(7)
    return rng.uniform(-1.0, 1.0, (count, 6)) * LIMITS_RAD * share


def test_the_flange_is_where_the_chain_of_frames_puts_it():
    for joints in any_joints(200):
        frame = emulated_controller.frame_of(joints)
        position, hand = flange(joints)
        assert position == pytest.approx(frame[:3, 3], abs=1e-9)
        assert hand == pytest.approx(frame[:3, :3], abs=1e-12)
        assert PLACING.pivot_mm(joints) == pytest.approx(
            PLACING.from_flange(position, hand), abs=1e-9
        )


def test_straight_up_it_is_as_long_as_its_links():
    position, hand = flange(np.zeros(6))
    assert position == pytest.approx([0.0, 0.0, 254.0 + 410.0 + 500.0 + 125.0])
    assert hand == pytest.approx(np.eye(3))


def test_joints_for_a_place_reach_it():
    rng = np.random.default_rng(3)
    for _ in range(60):
        pivot = rng.uniform([-120.0, -120.0, 0.0], [120.0, 120.0, 250.0])
        joints = PLACING.joints(pivot, READY_RAD)
        check_joints(joints)
        assert PLACING.pivot_mm(joints) == pytest.approx(pivot, abs=1e-8)
        assert PLACING.turn(joints) == pytest.approx(np.eye(3), abs=1e-7)
        solved = emulated_controller.solve(emulated_controller.frame_of(joints), joints + 0.05)
        assert solved == pytest.approx(joints, abs=1e-7)


def test_the_turn_nearest_the_present_one_is_taken():
    joints = PLACING.joints(np.array([10.0, 5.0, 100.0]), READY_RAD)
    near = joints + np.array([0.0, 0.0, 0.0, 2 * math.pi, 0.0, -2 * math.pi])
    assert PLACING.joints(np.array([10.0, 5.0, 100.0]), near) == pytest.approx(near)


@pytest.mark.promise("G8")
@pytest.mark.parametrize(
    ("at", "reason"),
    [((1500.0, 0.0, 300.0), "REACH"), ((0.0, 0.0, 500.0), "SINGULAR"), ((math.nan,) * 3, "REACH")],
)
def test_what_cannot_be_reached_is_refused_by_name(at, reason):
    with pytest.raises(RefusedError) as raised:
        joints_for(np.array(at), np.diag([1.0, -1.0, -1.0]), READY_RAD)
    assert raised.value.reason == reason


@pytest.mark.parametrize(
    ("joint", "value", "reason"),
    [
        (1, LIMITS_RAD[1] - 0.01, "JOINT-RANGE"),
        (5, math.nan, "JOINT-RANGE"),
        (4, 0.05, "SINGULAR"),
        (2, 0.05, "SINGULAR"),
    ],
)
def test_the_guard_names_what_it_refuses(joint, value, reason):
    joints = READY_RAD.copy()
    check_joints(joints)
    joints[joint] = value
    with pytest.raises(RefusedError) as raised:
        check_joints(joints)
    assert raised.value.reason == reason


@pytest.mark.promise("R7")
def test_a_step_over_the_share_of_the_top_speed_is_refused():
    check_step(READY_RAD, READY_RAD + 0.499 * STEPS_RAD, 0.5)
    for factor in (0.501, math.nan):
        with pytest.raises(RefusedError, match="top speed"):
            check_step(READY_RAD, READY_RAD + factor * STEPS_RAD, 0.5)


@pytest.mark.parametrize("euler", ["Rz(C) Ry(B) Rx(A)", "Rx(A) Ry(B) Rz(C)"])
def test_angles_of_the_controller_mean_the_same_on_both_sides(euler):
    rng = np.random.default_rng(1)
    for angles in rng.uniform(-1.4, 1.4, (50, 3)):
        hand = hand_of(*angles, euler)
        assert hand == pytest.approx(emulated_controller.hand_of(*angles, euler))
        assert emulated_controller.angles_of(hand, euler) == pytest.approx(tuple(angles))
