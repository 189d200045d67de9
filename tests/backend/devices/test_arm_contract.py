"""The part of the contract that every arm is held to: moves, presses, jogs, stops, retreats."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.contract_bench import EVERY, PRESS, DevicesUnderTest, place
from touchdown.backend.core import FaultError, Pose, RefusedError
from touchdown.backend.devices.protocols import STILL, Motion, RetreatingArm, RobotMode, SafetyMode


def rising(bench: DevicesUnderTest) -> tuple[Pose, Motion]:
    """Begin to move up by 60 mm; return the place and the motion."""
    here = bench.arm.pose(0.1)
    return here, bench.arm.move_to(replace(here, z_mm=here.z_mm + 60.0), 20.0)


@EVERY
def test_a_move_arrives_reports_what_was_sent_and_keeps_its_speed(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    start = bench.arm.pose(0.1)
    target = Pose(start.x_mm + 6.0, start.y_mm - 2.0, start.z_mm + 10.0)
    begun_s = bench.now_s()
    motion = bench.arm.move_to(target, 20.0)
    with pytest.raises(ValueError, match="under way"):
        motion.result()
    bench.rest(0.05)
    assert bench.arm.status().robot_mode is RobotMode.MOVING
    bench.succeed(motion)
    assert motion.sent["speed_mm_s"] == 20.0
    assert motion.sent["z_mm"] == target.z_mm
    end = bench.arm.pose(0.1)
    assert place(end) == pytest.approx(place(target), abs=0.05)
    length = float(np.sqrt(6.0**2 + 2.0**2 + 10.0**2))
    assert bench.now_s() - begun_s >= length / 20.0
    poses = bench.arm.poses.window(begun_s, bench.now_s())
    speed = np.linalg.norm(np.diff(poses.values, axis=0), axis=1) / np.diff(poses.t_s)
    assert speed.max() <= 20.0 * 1.05
    bench.hear()
    assert bench.arm.status().robot_mode is RobotMode.READY
    assert bench.arm.status().safety_mode is SafetyMode.NORMAL


@EVERY
def test_a_press_finds_contact_holds_and_unloads(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    samples = bench.force_torque.samples
    air = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)
    motion = bench.arm.press(PRESS)
    assert motion.onset_s is None
    assert motion.sent["depth_mm"] == 1.5
    bench.succeed(motion)
    assert motion.onset_s is not None
    assert motion.detected_s is not None
    assert motion.onset_s <= motion.detected_s
    assert bench.now_s() == pytest.approx(motion.onset_s + PRESS.hold_s, abs=0.011)
    held = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 4.0 < held[2] < 11.0
    unload = bench.arm.unload(1.0, 2.0)
    bench.succeed(unload)
    bench.rest(0.2)
    left = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 0.3 <= left[2] <= 2.0
    assert unload.sent["force_n"] == 1.0


@EVERY
def test_a_press_drags_the_piece_along_y_in_step_with_its_ramp(bench: DevicesUnderTest) -> None:
    drag_mm = -0.9
    bench.lifted_and_gripped()
    start = place(bench.arm.pose(0.1))
    samples = bench.force_torque.samples
    air = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)
    motion = bench.arm.press(replace(PRESS, depth_mm=0.8, drag_mm=drag_mm))
    bench.succeed(motion)
    assert motion.sent["drag_mm"] == drag_mm
    assert motion.onset_s is not None
    poses = bench.arm.poses.window(motion.onset_s, bench.now_s())
    moved = poses.values - start
    # The arm yields to friction, which is less than half of the press force.
    assert 0.75 < moved[-1, 1] / drag_mm < 1.0
    half = np.interp(motion.onset_s + 0.5 * PRESS.ramp_s, poses.t_s, moved[:, 1])
    assert half / drag_mm == pytest.approx(0.5 * moved[-1, 1] / drag_mm, abs=0.1)
    assert abs(moved[:, 0]).max() < 0.05
    held = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 0.2 < held[1] / held[2] < 0.6


@pytest.mark.promise("G4")
@EVERY
def test_a_press_into_nothing_fails_with_a_fault(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 20.0), 20.0))
    motion = bench.arm.press(PRESS)
    bench.finish(motion)
    assert bench.fail(motion).code == "NO-CONTACT"
    assert motion.onset_s is None


@pytest.mark.promise("R14")
@EVERY
@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.5, 2.5])
def test_stop_ends_a_press_in_every_phase(bench: DevicesUnderTest, after_s: float) -> None:
    bench.lifted_and_gripped()
    motion = bench.arm.press(PRESS)
    bench.rest(after_s)
    assert not motion.done
    bench.arm.stop()
    bench.hear()
    bench.fail(motion)
    bench.stand_still()
    assert bench.gripper.status().holding


@pytest.mark.promise("R14")
@EVERY
def test_stop_is_legal_in_every_state(bench: DevicesUnderTest) -> None:
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()
    bench.connect()
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()
        stop()
    grip = bench.gripper.grip(10.0)
    bench.rest(0.1)
    bench.gripper.stop()
    bench.hear()
    bench.fail(grip)
    assert not bench.gripper.status().holding
    for device in bench.all:
        device.close()
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()


@EVERY
def test_stop_comes_through_from_another_thread(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here, motion = rising(bench)
    bench.rest(0.2)
    thread = threading.Thread(target=bench.arm.stop)
    thread.start()
    thread.join(60.0)
    bench.hear()
    assert motion.done
    bench.rest(1.0)
    assert bench.arm.pose(0.1).z_mm < here.z_mm + 10.0


@EVERY
def test_a_newer_command_ends_the_older_one(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    first = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 30.0), 20.0)
    bench.rest(0.1)
    second = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 5.0), 20.0)
    bench.hear()
    bench.fail(first)
    bench.succeed(second)


@EVERY
def test_closing_the_connection_stops_motion_and_keeps_the_grip(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    _, motion = rising(bench)
    bench.rest(0.1)
    bench.arm.close()
    bench.gripper.close()
    bench.hear()
    assert motion.done
    assert bench.holds()


@pytest.mark.promise("P1")
@EVERY
@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_numbers_are_refused(bench: DevicesUnderTest, speed: float) -> None:
    bench.lifted_and_gripped()
    with pytest.raises(bench.senseless):
        bench.arm.move_to(Pose(0.0, 0.0, 50.0), speed)
    with pytest.raises(bench.senseless):
        bench.arm.move_to(Pose(float("nan"), 0.0, 50.0), 10.0)
    with pytest.raises(bench.senseless):
        bench.gripper.open_to(50.0, speed)


@EVERY
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("turning", [False, True])
def test_a_jog_or_turn_without_a_number_is_refused(
    bench: DevicesUnderTest, turning: bool, bad: float
) -> None:
    bench.connect()
    arm = bench.arm
    jogs = (lambda: arm.jog((bad, 0.0, 0.0), 0.1),)
    turns = (
        lambda: arm.jog(STILL, 0.1, (0.0, bad, 0.0)),
        lambda: arm.jog_joints((bad,) * 6, 0.1),
        lambda: arm.move_joints((0.0,) * 6, bad),
    )
    for order in turns if turning else jogs:
        with pytest.raises(bench.senseless):
            order()


@EVERY
def test_a_jog_ends_by_itself_and_a_renewal_is_the_same_motion(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    first = bench.arm.jog((0.0, 0.0, 10.0), 0.14)
    bench.rest(0.1)
    assert bench.arm.jog((0.0, 0.0, 10.0), 0.14) is first
    assert bench.arm.status().robot_mode is RobotMode.MOVING
    bench.rest(0.4)
    assert first.done
    first.result()
    assert bench.arm.status().robot_mode is RobotMode.READY
    gone = bench.arm.pose(0.1).z_mm - before.z_mm
    assert gone == pytest.approx(0.24 * 10.0, abs=0.2)


@EVERY
def test_a_jog_turns_without_an_end_and_stop_ends_it(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    motion = bench.arm.jog((20.0, 0.0, 0.0), 0.14)
    bench.rest(0.1)
    assert bench.arm.jog((0.0, 20.0, 0.0), 0.14) is motion
    bench.rest(0.1)
    bench.arm.stop()
    bench.rest(bench.still_s)
    after = bench.arm.pose(0.1)
    assert motion.done
    assert after.x_mm - before.x_mm > 1.0
    assert after.y_mm - before.y_mm > 0.5
    bench.rest(0.2)
    still = bench.arm.pose(0.1)
    assert place(still) == pytest.approx(place(after), abs=bench.still_mm)


@EVERY
def test_halt_ends_a_move_and_the_next_one_begins_at_once(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    here, motion = rising(bench)
    bench.rest(0.3)
    bench.arm.halt()
    bench.hear()
    bench.fail(motion)
    bench.rest(0.2)
    still = bench.arm.pose(0.02)
    bench.rest(0.1)
    assert bench.arm.pose(0.02).z_mm == pytest.approx(still.z_mm, abs=1e-3)
    before_s = bench.now_s()
    again = bench.arm.move_to(here, 20.0)
    assert bench.now_s() == before_s
    bench.rest(0.1)
    assert bench.arm.pose(0.02).z_mm < still.z_mm - 0.5
    assert not again.done


def high(bench: DevicesUnderTest) -> Pose:
    """Connect and go up to where the hand may turn."""
    bench.connect()
    bench.rest(0.1)
    here = bench.arm.pose(0.1)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 30.0), 50.0))
    bench.rest(0.1)
    return bench.arm.pose(0.1)


def vector(pose: Pose) -> tuple[float, float, float]:
    return (pose.rx_rad, pose.ry_rad, pose.rz_rad)


@EVERY
def test_the_hand_turns_on_the_way_and_back_and_presses_only_unturned(
    bench: DevicesUnderTest,
) -> None:
    up = high(bench)
    assert bench.arm.rotates
    begun_s = bench.now_s()
    there = Pose(up.x_mm + 5.0, up.y_mm, up.z_mm, 0.10, -0.05, 0.2)
    motion = bench.arm.move_to(there, 20.0, 0.2)
    bench.succeed(motion)
    assert bench.now_s() - begun_s >= float(np.linalg.norm(vector(there))) / 0.2
    bench.rest(0.1)
    pose = bench.arm.pose(0.1)
    assert vector(pose) == pytest.approx(vector(there), abs=1e-4)
    assert place(pose) == pytest.approx(place(there), abs=0.05)
    with pytest.raises(RefusedError, match="level it first"):
        bench.arm.press(PRESS)
    level = bench.arm.move_to(up, 20.0, 0.2)
    bench.succeed(level)
    bench.rest(0.1)
    assert vector(bench.arm.pose(0.1)) == (0.0, 0.0, 0.0)


@EVERY
def test_a_turning_jog_keeps_its_pivot_and_ends_by_itself(bench: DevicesUnderTest) -> None:
    up = high(bench)
    first = bench.arm.jog(STILL, 0.14, (0.0, 0.1, 0.0))
    bench.rest(0.1)
    assert bench.arm.jog(STILL, 0.14, (0.0, 0.1, 0.0)) is first
    bench.rest(0.5)
    assert first.done
    first.result()
    pose = bench.arm.pose(0.1)
    # 2 rad/s^2 up to 0.1 rad/s, 0.24 s of it, and as much way down as was missed going up.
    # A cycle more or less of at most 20 ms changes it by 0.002.
    assert vector(pose) == pytest.approx((0.0, 0.024, 0.0), abs=0.0025)
    assert place(pose) == pytest.approx(place(up), abs=0.02)


@EVERY
def test_a_joint_jog_turns_that_joint_alone_and_stop_ends_it(bench: DevicesUnderTest) -> None:
    high(bench)
    before = bench.arm.joints_rad(0.1)
    speeds = (0.0, 0.0, 0.0, 0.0, 0.0, 0.2)
    motion = bench.arm.jog_joints(speeds, 0.14)
    bench.rest(0.1)
    assert bench.arm.jog_joints(speeds, 0.14) is motion
    bench.rest(0.1)
    bench.arm.stop()
    bench.hear()
    assert motion.done
    bench.rest(bench.still_s)
    after = bench.arm.joints_rad(0.1)
    assert after[:5] == pytest.approx(before[:5], abs=1e-5)
    assert 0.005 < after[5] - before[5] < 0.04
    told, pose = bench.arm.place_of(after), bench.arm.pose(0.1)
    assert vector(told) == pytest.approx(vector(pose), abs=1e-5)
    assert place(told) == pytest.approx(place(pose), abs=0.02)
    bench.rest(0.3)
    assert bench.arm.joints_rad(0.1) == pytest.approx(after, abs=1e-5)


@EVERY
def test_joints_go_to_their_ends_and_never_beyond_their_range(bench: DevicesUnderTest) -> None:
    high(bench)
    before = bench.arm.joints_rad(0.1)
    target = (*before[:4], before[4] + 0.05, before[5] - 0.1)
    motion = bench.arm.move_joints(target, 0.2)
    bench.succeed(motion)
    bench.rest(0.1)
    assert bench.arm.joints_rad(0.1) == pytest.approx(target, abs=1e-4)
    beyond = (*target[:5], bench.arm.joint_limits_rad[5][1] + 0.01)
    refused = bench.arm.move_joints(beyond, 6.0)
    bench.finish(refused)
    assert bench.fail(refused).code == "JOINT-RANGE"
    low, high_rad = bench.arm.joint_limits_rad[5]
    assert low <= bench.arm.joints_rad(0.1)[5] <= high_rad


@EVERY
def test_servo_off_ends_motion_and_moves_nothing_until_it_is_on(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    here, motion = rising(bench)
    bench.rest(0.3)
    bench.arm.servo(False)
    bench.hear()
    assert motion.done
    bench.rest(0.3)
    assert bench.arm.status().robot_mode is RobotMode.SERVO_OFF
    still = bench.arm.pose(0.2)
    with pytest.raises(FaultError):
        bench.finish(bench.arm.move_to(here, 20.0))
    bench.rest(0.2)
    assert bench.arm.pose(0.2).z_mm == pytest.approx(still.z_mm, abs=0.02)
    bench.arm.servo(True)
    bench.rest(0.2)
    back = bench.arm.move_to(here, 20.0)
    bench.succeed(back)
    bench.hear()
    assert bench.arm.status().robot_mode is RobotMode.READY


@pytest.mark.promise("G3")
@EVERY
def test_a_retreat_draws_back_from_contact_once_and_stands(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    assert isinstance(bench.arm, RetreatingArm)
    samples = bench.force_torque.samples
    air_n = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)[2]
    motion = bench.arm.press(PRESS)
    bench.finish(motion)
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    bench.arm.retreat()
    bench.rest(1.0)
    after = bench.arm.pose(0.1)
    assert 1.0 < after.z_mm - before.z_mm < 2.6
    assert (after.x_mm, after.y_mm) == pytest.approx((before.x_mm, before.y_mm), abs=0.6)
    left_n = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0)[2] - air_n
    assert abs(left_n) < 1.0
    assert bench.gripper.status().holding
    assert bench.arm.status().robot_mode is RobotMode.READY
    bench.rest(0.3)
    assert bench.arm.pose(0.1).z_mm == pytest.approx(after.z_mm, abs=0.02)


@EVERY
def test_a_retreat_ends_a_move_that_runs_into_something_and_stop_ends_a_retreat(
    bench: DevicesUnderTest,
) -> None:
    bench.lifted_and_gripped()
    assert isinstance(bench.arm, RetreatingArm)
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm + 20.0, here.y_mm, here.z_mm + 5.0), 20.0)
    bench.rest(0.3)
    bench.arm.retreat()
    bench.hear()
    bench.fail(motion)
    bench.rest(0.1)
    bench.arm.stop()
    # Two millimetres take 0.2 s: it was stopped on its way.
    bench.stand_still()
