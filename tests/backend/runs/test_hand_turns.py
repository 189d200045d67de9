"""Manual rotation on the simulated bench: far above the surface, slightly tilted, then level."""

import math
from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import Refused
from touchdown.backend.core.faults import Fault, RefusedError
from touchdown.backend.core.rotations import pose_rotation, rotation_vector, tilt_rad
from touchdown.backend.core.values import FINGERS, Pose
from touchdown.backend.devices.interlock import (
    LEASE_S,
    Limits,
    refuse_place,
    refuse_turning,
    turned_descent_mm,
)
from touchdown.backend.devices.jog import JOINTS, TURNS, JogOrder
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice

STEP_S = 0.02
FIVE, FAST = math.radians(5.0), math.radians(15.0)


@pytest.fixture
def session():
    made = simulated_session(keep=RecordingOptions(None))
    made.prepare(SceneChoice(estimates=False))
    for finger in FINGERS:
        # No picture is drawn that nobody looks at, and nobody waits for one.
        made.devices[f"tactile_{finger}"].close()
    made.interlock.limits = replace(made.interlock.limits, frame_age_s=1e6)
    for _ in range(15):
        made.advance()
    return made


@pytest.fixture
def high(session):
    """The hand far above the surface."""
    motion = session._stage.arm.move_to(Pose(0.0, 0.0, 120.0), 50.0)
    while not motion.done:
        session.advance()
    session.advance()
    return session


def pose(session):
    return session._stage.arm.pose(1.0)


def vector(session):
    at = pose(session)
    return np.array([at.rx_rad, at.ry_rad, at.rz_rad])


def order(session, axis, speed=FIVE, frame="XYZ", sequence=1, hold=1):
    return JogOrder(hold, sequence, session.clock_s(), axis, frame, speed)


def hold(session, seconds, axis, speed=FIVE, frame="XYZ", number=1):
    for count in range(round(seconds / STEP_S)):
        if count % 5 == 0:
            session.hand.jog.renew(order(session, axis, speed, frame, 1 + count // 5, number))
        session.advance()


def rest(session, seconds=0.3):
    for _ in range(round(seconds / STEP_S)):
        session.advance()


def told(session):
    facts = []
    session.events.subscribe(facts.append)
    return facts


def steps(session, axis, distance, frame="XYZ", speed=FAST):
    session.hand.jog.step(axis, frame, distance, speed)
    for _ in range(400):
        session.advance()
        if not session.hand.active:
            break
    assert not session.hand.active


def test_a_held_turn_turns_about_its_axis_and_a_release_ends_it(high):
    where = pose(high)
    for number, axis in enumerate(TURNS, 1):
        before = pose_rotation(pose(high))
        hold(high, 0.5, axis, number=number)
        high.hand.jog.end(number)
        rest(high)
        turned = rotation_vector(pose_rotation(pose(high)) @ before.T)
        at = TURNS.index(axis)
        assert 0.5 * FIVE * 0.48 < turned[at] < FIVE * 0.5
        assert np.delete(turned, at) == pytest.approx([0.0, 0.0], abs=1e-9)
        still = vector(high)
        rest(high, 0.1)
        assert np.array_equal(still, vector(high))
    now = pose(high)
    assert (now.x_mm, now.y_mm, now.z_mm) == pytest.approx(
        (where.x_mm, where.y_mm, where.z_mm), abs=1e-6
    )


def test_a_held_joint_turns_alone_and_silence_ends_it(high):
    facts, arm = told(high), high._stage.arm
    for number, axis in enumerate(JOINTS, 1):
        before = np.array(arm.joints_rad(1.0))
        hold(high, 0.2, axis, frame="JOINT", number=number)
        last_s = moved_s = high.clock_s()
        for _ in range(25):
            now = arm.joints_rad(1.0)
            high.advance()
            if np.abs(np.subtract(arm.joints_rad(1.0), now)).max() > 1e-9:
                moved_s = high.clock_s()
        assert 0.0 < moved_s - last_s <= 0.3
        turned = np.array(arm.joints_rad(1.0)) - before
        at = JOINTS.index(axis)
        assert turned[at] > 0.01
        assert np.delete(turned, at) == pytest.approx(np.zeros(5), abs=1e-7)
    assert [f.reason for f in facts if isinstance(f, Refused)] == 6 * ["JOG-LEASE"]


def test_tool_axes_turn_with_the_hand(high):
    steps(high, "rz", math.radians(5.0))
    before = pose(high)
    steps(high, "x", 5.0, frame="TOOL", speed=20.0)
    moved = (pose(high).x_mm - before.x_mm, pose(high).y_mm - before.y_mm)
    assert moved == pytest.approx((5.0 * math.cos(FIVE), 5.0 * math.sin(FIVE)), abs=1e-3)
    # About its own z a tool that points down turns the other way.
    steps(high, "rz", math.radians(5.0), frame="TOOL")
    assert vector(high) == pytest.approx(np.zeros(3), abs=1e-6)


def test_a_step_turns_exactly_so_far(high):
    arm = high._stage.arm
    for degrees in (0.5, 1.0, 5.0, -5.0):
        leant = vector(high)[1]
        steps(high, "ry", math.radians(degrees))
        assert math.degrees(vector(high)[1] - leant) == pytest.approx(degrees, abs=1e-6)
        steps(high, "ry", -math.radians(degrees))
        before = arm.joints_rad(1.0)[5]
        steps(high, "j6", math.radians(degrees), "JOINT")
        assert math.degrees(arm.joints_rad(1.0)[5] - before) == pytest.approx(degrees, abs=1e-6)
        steps(high, "j6", -math.radians(degrees), "JOINT")


def test_low_over_the_surface_nothing_turns_and_the_way_up_is_told(session):
    for number, (axis, frame) in enumerate((("rx", "XYZ"), ("j4", "JOINT")), 1):
        with pytest.raises(RefusedError, match=r"jog \+Z by 17\.\d mm first") as refused:
            session.hand.jog.renew(order(session, axis, frame=frame, hold=number))
        assert refused.value.reason == "TURN-LOW"
        assert session.hand.jog.rooms(frame)["+" + axis].why == "TURN-LOW"


def test_a_turned_hand_stays_high_until_it_is_level_and_nothing_starts_before(high):
    steps(high, "ry", math.radians(5.0))
    rooms = high.hand.jog.rooms("XYZ")
    surface = high._stage.piece.grip_height_mm
    assert rooms["-z"].left == pytest.approx(120.0 - surface - Limits().turn_clear_mm, abs=0.01)
    with pytest.raises(RefusedError, match="level it first"):
        high.start(ProbeRequest())
    with pytest.raises(RefusedError, match="level it first"):
        high.hand.grip(10.0)
    high.hand.jog.level(math.radians(15.0))
    for _ in range(200):
        high.advance()
    assert not vector(high).any()
    assert high.hand.jog.rooms("XYZ")["-z"].left > rooms["-z"].left
    high.start(ProbeRequest())
    high.engine.cancel()
    high.engine.tick()


def test_a_run_of_the_command_line_does_not_begin_with_a_turned_hand_either(high):
    """On devices an earlier run or fault may have left the hand rotated."""
    hold(high, 1.0, "rx")
    rest(high)
    high.simulated = False
    with pytest.raises(RefusedError, match="level it first"):
        high.run(ProbeRequest())


def test_a_turn_ends_where_the_hand_leans_as_far_as_it_may(high):
    facts, most = told(high), Limits().tilt_rad
    steps(high, "rx", math.radians(5.0))
    assert high.hand.jog.rooms("XYZ")["+rx"].left == pytest.approx(math.radians(10.0), abs=1e-6)
    with pytest.raises(RefusedError, match=r"\+RX \(XYZ\): 10\.0° left"):
        high.hand.jog.step("rx", "XYZ", math.radians(10.5), FIVE)
    with pytest.raises(RefusedError, match=r"LIMIT|JOG-ENDED"):
        hold(high, 3.0, "rx", math.radians(15.0))
    rest(high)
    lean = tilt_rad(pose_rotation(pose(high)))
    assert most - math.radians(0.5) < lean <= most + 1e-6
    assert not [f for f in facts if isinstance(f, Refused) and f.reason != "LIMIT"]


def test_a_joint_is_slowed_to_the_speed_of_the_hand(high):
    hold(high, 0.5, "j1", math.radians(15.0), frame="JOINT")
    state = high.hand.jog.state
    assert state.slow == "the hand at its top speed"
    poses = high._scene.sensing.raw.poses.window(high.clock_s() - 0.3, high.clock_s())
    speed = np.linalg.norm(np.diff(poses.values, axis=0), axis=1) / np.diff(poses.t_s)
    assert 0.0 < speed.max() <= Limits().jog_mm_s


def test_the_room_of_a_joint_is_where_its_jog_ends(high):
    room = high.hand.jog.rooms("JOINT")["+j5"]
    assert 0.0 < room.left <= Limits().tilt_rad + 1e-6
    before = high._stage.arm.joints_rad(1.0)[4]
    with pytest.raises(RefusedError):
        hold(high, 3.0, "j5", math.radians(15.0), frame="JOINT")
    rest(high)
    gone = high._stage.arm.joints_rad(1.0)[4] - before
    assert gone == pytest.approx(room.left, abs=math.radians(1.0))


def test_the_wrist_feels_the_weight_turn(high):
    rest(high)
    level = high._scene.sensing.raw.samples.window(
        high.clock_s() - 0.2, high.clock_s()
    ).values.mean(axis=0)
    steps(high, "ry", math.radians(10.0))
    rest(high)
    leant = high._scene.sensing.raw.samples.window(
        high.clock_s() - 0.2, high.clock_s()
    ).values.mean(axis=0)
    weight = -level[2]
    # Turned about +y, the tool's x points down by 10 degrees: gravity pulls along it.
    assert leant[0] - level[0] == pytest.approx(weight * math.sin(math.radians(10.0)), abs=0.1)
    assert leant[2] == pytest.approx(-weight * math.cos(math.radians(10.0)), abs=0.1)
    # So far it cannot pass for a contact.
    assert abs(high._scene.sensing.press_n(high.clock_s(), 0.2)) < Limits().contact_n


def test_stop_ends_a_turn_and_latches(high):
    hold(high, 0.3, "rx")
    high.stop()
    at = vector(high)
    rest(high)
    assert np.array_equal(at, vector(high))
    with pytest.raises(RefusedError):
        high.hand.jog.renew(order(high, "rx", sequence=50))


def test_after_a_fault_nothing_turns(high):
    high.interlock.raise_fault(Fault("FT-TRIP", "Force.", "Stopped.", "Look.", "force_torque"))
    high.reset()
    with pytest.raises(RefusedError, match="away from contact"):
        high.hand.jog.renew(order(high, "rz"))


def test_no_turn_is_faster_than_its_limit(high):
    scene = high._scene
    for number, speed in enumerate((math.radians(15.1), math.nan, 0.0), 1):
        with pytest.raises(RefusedError):
            high.hand.jog.renew(order(high, "rz", speed, hold=number))
        high.interlock.renew_lease(high.clock_s())
        with pytest.raises((RefusedError, ValueError)):
            scene.arm.jog((0.0, 0.0, 0.0), LEASE_S, (0.0, 0.0, speed))
        with pytest.raises((RefusedError, ValueError)):
            scene.arm.move_joints(scene.arm.joints_rad(1.0), speed)


LIMITS = Limits()


@pytest.mark.parametrize(
    ("at", "surface", "press", "reason"),
    [
        (Pose(0.0, 0.0, 60.0), 40.0, 0.0, None),
        (Pose(0.0, 0.0, 59.9), 40.0, 0.0, "TURN-LOW"),
        (Pose(0.0, 0.0, 60.0), math.nan, 0.0, "TURN-LOW"),
        (Pose(0.0, 0.0, 60.0), 40.0, 1.1, "TURN-PRESSING"),
        (Pose(0.0, 0.0, 60.0), 40.0, math.nan, "FT-UNKNOWN"),
        (Pose(0.0, 0.0, math.nan), 40.0, 0.0, "TURN-LOW"),
    ],
)
def test_where_the_hand_may_turn(at, surface, press, reason):
    if reason is None:
        refuse_turning(at, surface, press, LIMITS)
        return
    with pytest.raises(RefusedError) as refused:
        refuse_turning(at, surface, press, LIMITS)
    assert refused.value.reason == reason


@pytest.mark.parametrize(
    ("at", "reason"),
    [
        (Pose(0.0, 0.0, 60.0, 0.2, 0.0, 1.0), None),
        (Pose(0.0, 0.0, 60.0, 0.3, 0.0, 0.0), "TILT"),
        (Pose(0.0, 0.0, 50.0, 0.1, 0.0, 0.0), "TURN-LOW"),
        (Pose(0.0, 0.0, 50.0), None),
        (Pose(151.0, 0.0, 60.0), "REACH"),
        (Pose(0.0, 0.0, 401.0), "HEIGHT"),
        (Pose(0.0, math.nan, 60.0), "REACH"),
    ],
)
def test_where_the_hand_may_be(at, reason):
    if reason is None:
        refuse_place(at, 40.0, LIMITS)
        return
    with pytest.raises(RefusedError) as refused:
        refuse_place(at, 40.0, LIMITS)
    assert refused.value.reason == reason


def test_only_a_turned_hand_is_kept_high():
    assert turned_descent_mm(Pose(0.0, 0.0, 80.0), 40.0, LIMITS) == math.inf
    assert turned_descent_mm(Pose(0.0, 0.0, 80.0, 0.1), 40.0, LIMITS) == 20.0
    assert turned_descent_mm(Pose(0.0, 0.0, 50.0, 0.1), 40.0, LIMITS) == 0.0
