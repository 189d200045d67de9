"""Trials without ground truth: set up, started beside the stable region, judged by the operator."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_bench, brisk_method, brisk_settings
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.cli.connection import parse_outcome
from touchdown.backend.config import Limits
from touchdown.backend.config.method import StackSettings, TowerSettings
from touchdown.backend.core.events import (
    Event,
    FaultRaised,
    HandOverAwaited,
    OutcomeAwaited,
    PhaseEntered,
    Refused,
    RunFinished,
    RunStarted,
    Said,
    SetUpAwaited,
    TrialFinished,
)
from touchdown.backend.core.faults import Fault, InputError, RefusedError
from touchdown.backend.core.rotations import pose_rotation, rotation_vector, tilt_rad
from touchdown.backend.core.values import FINGERS, Outcome, Pose
from touchdown.backend.devices import LEASE_S, JogOrder
from touchdown.backend.devices.interlock import refuse_place, refuse_turning, turned_descent_mm
from touchdown.backend.devices.jog import JOINTS, TOOL_SIGNS, TURNS, direction_of
from touchdown.backend.geometry import Tower, judge_tower, load_pieces
from touchdown.backend.runs import ProbeRequest, RecordingOptions, SceneChoice, StackRequest
from touchdown.backend.runs.outcome import TrialResult, outcome_from_signals, with_toppled_support
from touchdown.backend.runs.stack import certificate_status, grasped_piece, stack_run

POT = load_pieces().piece("pot")
HEAVY = replace(POT, mass_g=200.0)


class Attended:
    """Simulated bench that hides its truth, with an operator who answers."""

    def __init__(self, tmp_path, seen=(Outcome.PLACED, ""), faults=()):
        keep = RecordingOptions(tmp_path, episodes=False)
        bench = brisk_bench("quiet", faults=faults)
        self.session = simulated_session(bench, keep=keep, method=brisk_method())
        make = self.session._make_stage
        self.stages = []

        def blind(choice, raw):
            self.stages.append(make(choice, raw))
            return replace(self.stages[-1], scoring=None)

        self.session._make_stage = blind
        self.seen, self.ready, self.facts, self.asks = seen, True, list[Event](), []
        self.session.events.subscribe(self._answer)

    def _answer(self, fact: Event) -> None:
        self.facts.append(fact)
        if isinstance(fact, SetUpAwaited | HandOverAwaited):
            self.asks.append((self.session.status().asks, self.session.hand.holding))
            if self.ready is not None:
                self.session.answer(self.ready)
        elif isinstance(fact, OutcomeAwaited):
            self.asks.append((self.session.status().asks, self.session.hand.holding))
            self.session.prompt.see(*self.seen)

    def run(self, **asked):
        self.session.run(StackRequest(piece="pot", bottoms=("short",), seed=10, **asked))
        self.session.close()
        return self.of(TrialFinished)

    def of(self, kind):
        return [fact for fact in self.facts if isinstance(fact, kind)]


@pytest.mark.slow
def test_a_trial_is_set_up_started_where_it_would_fall_and_judged_by_the_operator(tmp_path):
    attended = Attended(tmp_path, (Outcome.KNOCKED_OVER, "I bumped into it."))
    (finished,) = attended.run(origin_mm=(1.0, -2.0))
    (asked,) = attended.of(SetUpAwaited)
    assert attended.asks == [
        ("set the scene", False), ("a hand at the jaws", False), ("say the outcome", False)
    ]  # fmt: skip
    # The static judge, asked here once more: the piece would fall from where it starts.
    at = Tower((load_pieces().piece("short").body(),)).with_top(POT.body(asked.start_mm))
    assert judge_tower(at).margin_mm < 0
    pressed = next(f for f in attended.facts if isinstance(f, PhaseEntered) and f.phase == "press")
    poses = attended.session.raw.poses.window(0.0, pressed.t_s).values
    assert poses[-1, :2] == pytest.approx(np.add(asked.start_mm, (1.0, -2.0)), abs=0.2)
    assert finished.outcome is Outcome.KNOCKED_OVER
    assert finished.reason == "The operator saw the bottom disturbed. I bumped into it."
    assert (finished.margin_mm, finished.excess_probes) == (None, None)
    # What the signals said agrees with the truth that the bench keeps to itself.
    (proposal,) = attended.of(OutcomeAwaited)
    assert (proposal.proposed is Outcome.PLACED) == attended.stages[-1].scoring.verdict().stands


def test_without_a_set_scene_nothing_moves(tmp_path):
    attended = Attended(tmp_path)
    attended.ready = False
    (finished,) = attended.run(trials=3)
    assert finished.outcome is Outcome.ABORTED
    assert attended.of(PhaseEntered) == []
    assert attended.of(RunFinished)[-1].ending == "cancelled"


@pytest.mark.promise("S10")
@pytest.mark.parametrize(
    ("fault", "code", "asked"),
    [
        ("force_torque:nan@1.5", "FT-STALE", True),
        ("tactile_left:stop@1.5", "CAMERA-STALE", True),
        ("force_torque:nan@3.5", "FT-STALE", False),
        ("force_torque:stop@3.5", "FT-STALE", False),
    ],
)
def test_a_device_lost_while_the_scene_is_set_up_ends_the_run_before_a_probe(
    tmp_path, fault, code, asked
):
    """While the operator is prompted, or while the piece is carried to its start."""
    attended = Attended(tmp_path, faults=(fault,))
    attended.ready = None if asked else True
    (finished,) = attended.run(trials=3)
    assert finished.outcome is Outcome.ABORTED
    (raised,) = attended.of(FaultRaised)
    assert raised.fault.code == code
    assert attended.of(RunFinished)[-1].ending == "failed"
    phases = [fact.phase for fact in attended.of(PhaseEntered)]
    assert not {"approach", "press", "release"} & set(phases)
    # Nothing moved for the hand that was at the bench; what was taken over stays held.
    assert phases == [] if asked else "grip" in phases
    assert attended.session.devices["gripper"].status().holding is not asked


def test_starts_follow_from_the_seed_and_differ(tmp_path):
    drawn = []
    for seed in (7, 8, 7):
        attended = Attended(tmp_path / str(len(drawn)))
        attended.ready = False
        attended.session.run(StackRequest(piece="pot", bottoms=("short",), seed=seed))
        attended.session.close()
        drawn.append(attended.of(SetUpAwaited)[0].start_mm)
    assert drawn[0] == drawn[2] != drawn[1]


@pytest.mark.parametrize(
    ("piece", "side_n", "left_n", "holding", "outcome"),
    [
        (HEAVY, 0.3, 1.9, False, Outcome.PLACED),
        (HEAVY, 3.0, 1.9, False, Outcome.FELL),
        (HEAVY, 0.3, 0.2, False, Outcome.ABORTED),
        (HEAVY, 0.3, 1.9, True, Outcome.ABORTED),
        (POT, 0.3, -0.1, False, Outcome.PLACED),
        (HEAVY, float("nan"), 1.9, False, Outcome.FELL),
    ],
)
def test_wrist_and_gripper_propose(piece, side_n, left_n, holding, outcome):
    found, why = outcome_from_signals(piece, side_n=side_n, left_n=left_n, holding=holding)
    assert found is outcome
    assert why.endswith(".")


ASKED = OutcomeAwaited(0.0, Outcome.PLACED, "Nothing pushed.")
STUCK = OutcomeAwaited(0.0, Outcome.ABORTED, "It hangs.")


@pytest.mark.parametrize(
    ("line", "asked", "said"),
    [
        ("\n", ASKED, (Outcome.PLACED, "")),
        ("\n", STUCK, (Outcome.ABORTED, "It hangs.")),
        ("F it leaned\n", ASKED, (Outcome.FELL, "it leaned")),
        ("d\n", ASKED, (Outcome.KNOCKED_OVER, "")),
        ("v wrong piece\n", ASKED, (Outcome.ABORTED, "wrong piece")),
        ("v\n", ASKED, None),
        ("yes\n", ASKED, None),
    ],
)
def test_a_line_says_what_was_seen(line, asked, said):
    assert parse_outcome(line, asked) == said


STEP_S = 0.02
MOST_S = 0.3


def prepared(bench=None):
    made = simulated_session(bench)
    made.prepare(SceneChoice(estimates=False))
    return made


def raise_hand(session, z_mm):
    motion = session._stage.arm.move_to(Pose(0.0, 0.0, z_mm), 50.0)
    while not motion.done:
        session.advance()


@pytest.fixture
def session():
    settings = brisk_settings().model_copy(update={"cycle_us": 10_000})  # as fine as braking needs
    made = prepared(SimulatedBenchChoice(given=settings))
    turn(made, 0.6)
    return made


@pytest.fixture
def high(session):
    """The hand far above the slow zone near the surface."""
    raise_hand(session, 100.0)
    return session


def position(session):
    return session._stage.arm._world.drive.command_mm


def order(session, sequence=1, hold=1, axis="z", speed=20.0, frame="XYZ", sent_s=None):
    sent_s = session.clock_s() if sent_s is None else sent_s
    return JogOrder(hold, sequence, sent_s, axis, frame, speed)


def hold(session, seconds, first=1, **what):
    """Renew every 100 ms for a while, as a held button does; return the last renewal time."""
    sent_s = session.clock_s()
    for count in range(round(seconds / STEP_S)):
        if count % 5 == 0:
            sent_s = session.clock_s()
            session.hand.jog.renew(order(session, first + count // 5, sent_s=sent_s, **what))
        session.advance()
    return sent_s


def last_motion_s(session, advance, times):
    """Return when the arm moved last while ``advance`` was called so many times."""
    moved_s = session.clock_s()
    for _ in range(times):
        before = position(session)
        advance()
        if not np.array_equal(before, position(session)):
            moved_s = session.clock_s()
    return moved_s


def told(session):
    facts = []
    session.events.subscribe(facts.append)
    return facts


def test_the_override_slows_a_held_jog_and_says_so(high):
    high.interlock.override_speed(0.5)
    before = position(high)
    hold(high, 0.5)
    state = high.hand.jog.state
    assert (state.speed, state.slow) == (10.0, "override 50 %")
    assert np.linalg.norm(position(high) - before) == pytest.approx(0.5 * 20.0 * 0.48, rel=0.1)


def test_a_held_jog_moves_at_its_speed_and_a_release_ends_it_at_once(high):
    before = position(high)
    hold(high, 0.5)
    moved = position(high) - before
    # 500 mm/s^2 in cycles of 10 ms: 5, 10, 15, 20 mm/s. The first three lack 0.3 mm.
    assert moved == pytest.approx([0, 0, 10.0 - 0.3], abs=1e-6)
    high.hand.jog.end(1)
    at = position(high)
    high.advance()
    assert np.array_equal(position(high), at)
    assert not high.hand.active


@pytest.mark.promise("W3")
def test_a_frozen_window_stops_the_arm_within_the_lease(high):
    facts = told(high)
    last_s = hold(high, 0.4)
    assert 0.2 < last_motion_s(high, high.advance, 100) - last_s <= MOST_S
    (refused,) = [f for f in facts if isinstance(f, Refused)]
    assert refused.reason == "JOG-LEASE"
    assert "The window hung" in refused.text
    assert not high.hand.active


@pytest.mark.promise("R13")
@pytest.mark.parametrize("speed", [5.0, 50.0])
def test_no_order_of_a_jog_outlasts_its_lease(high, monkeypatch, speed):
    """Including braking at 500 mm/s2: a hanging bench could not end the motion."""
    ends_s, arm = [], high._stage.arm
    jog = arm.jog

    def noted(velocity_mm_s, for_s, *turning):
        ends_s.append(high.clock_s() + for_s)
        return jog(velocity_mm_s, for_s, *turning)

    monkeypatch.setattr(arm, "jog", noted)
    sent_s = hold(high, 0.3, speed=speed)
    turn(high, LEASE_S + STEP_S)
    assert sent_s + 0.05 < max(ends_s) <= sent_s + LEASE_S - speed / 500.0


def test_a_bench_that_falls_behind_stops_by_the_wall_clock(high, monkeypatch):
    """At a tenth of real time, 250 ms of bench time are 2.5 s for the operator."""
    wall = [0.0]
    monkeypatch.setattr(
        high.hand.jog, "_around", replace(high.hand.jog._around, wall_s=lambda: wall[0])
    )
    facts = told(high)
    high.hand.jog.renew(order(high))
    moved = 0.0
    for _ in range(10):
        before = position(high)
        high.advance()
        wall[0] += 10 * STEP_S
        if not np.array_equal(before, position(high)):
            moved = wall[0]
    assert 0.0 < moved <= LEASE_S + 10 * STEP_S
    (refused,) = [f for f in facts if isinstance(f, Refused)]
    assert "came late as well, by 200 ms: this computer is overloaded" in refused.text


@pytest.mark.promise("H12")
def test_after_expiry_only_a_new_press_moves(high):
    hold(high, 0.1)
    turn(high, 0.4)
    with pytest.raises(RefusedError, match="JOG-ENDED"):
        high.hand.jog.renew(order(high, 9))
    high.hand.jog.renew(order(high, 1, hold=2))
    assert high.hand.active


def test_the_arm_stops_by_itself_when_nobody_ticks_the_lease(high):
    hold(high, 0.2)
    last_s = high.clock_s()
    moved_s = last_motion_s(high, lambda: high._stage.advance(20_000), 50)
    assert 0.0 < moved_s - last_s <= MOST_S


@pytest.mark.promise("W3")
@pytest.mark.parametrize(
    ("second", "refusal"),
    [
        ({"sequence": 1}, "JOG-REPLAYED"),
        ({"sequence": 0}, "JOG-REPLAYED"),
        ({"sequence": -5}, "JOG-REPLAYED"),
        ({"hold": 2, "axis": "x"}, "JOG-BUSY"),
    ],
)
def test_a_replayed_renewal_and_a_second_hold_are_refused(session, second, refusal):
    session.hand.jog.renew(order(session))
    with pytest.raises(RefusedError, match=refusal):
        session.hand.jog.renew(order(session, **second))


@pytest.mark.promise("W3")
@pytest.mark.parametrize("late_s", [LEASE_S + 0.001, 5.0, -0.001, float("nan")])
def test_a_renewal_of_another_time_is_refused(session, late_s):
    with pytest.raises(RefusedError, match="JOG-STALE"):
        session.hand.jog.renew(order(session, sent_s=session.clock_s() - late_s))
    assert not session.hand.active


def test_one_renewal_waits_at_most(high):
    """Ten renewals between two bench steps move as far as one."""
    before = position(high)
    for sequence in range(1, 11):
        high.hand.jog.renew(order(high, sequence))
    turn(high, 0.8)
    assert (position(high) - before)[2] <= 20.0 * MOST_S


def test_a_piece_that_presses_is_lifted_before_anything_starts(session):
    session.start(ProbeRequest())
    for _ in range(2000):
        session.engine.tick()
        session.advance()
        if session.hand.pressing_n > 2.0:
            break
    session.stop()
    session.engine.tick()
    session.reset()
    session.advance()
    for request in (ProbeRequest(), StackRequest("pot", ("short",))):
        with pytest.raises(RefusedError, match="lift before you start") as refused:
            session.start(request)
        assert refused.value.reason == "IN-CONTACT"
    hold(session, 2.0, axis="z")
    session.hand.jog.end(1)
    assert session.hand.pressing_n == 0.0
    session.start(ProbeRequest())
    session.engine.cancel()
    session.engine.tick()


@pytest.mark.promise("W4")
def test_near_the_surface_it_is_slow_and_says_so(session):
    """The hand starts 3 mm above the height of contact."""
    before = position(session)
    hold(session, 0.3)
    assert session.hand.jog.state.speed == 2.0
    assert "surface" in session.hand.jog.state.slow
    assert 0.5 < (position(session) - before)[2] <= 0.601


def test_an_order_for_references_is_answered_once(session):
    """A briefly hidden marker causes a retry, not a refusal."""
    facts = told(session)
    session.hand.take_references()
    turn(session, 2.5)
    assert len([f for f in facts if isinstance(f, (Said, Refused))]) == 1


@pytest.mark.promise("W4")
@pytest.mark.parametrize("distance", [0.1, 1.0, -5.0])
def test_a_step_goes_exactly_so_far(session, distance):
    session.hand.jog.step("x", "XYZ", 0.0 + distance, 20.0)
    before = position(session)
    turn(session, 4.0)
    assert position(session) - before == pytest.approx([distance, 0, 0], abs=1e-9)
    assert not session.hand.active


def test_a_step_keeps_the_permission_to_move_as_long_as_it_lasts(session):
    session.hand.jog.step("x", "XYZ", 5.0, 5.0)
    begun_s = session.clock_s()
    while session.hand.active:
        assert session.interlock.has_lease(session.clock_s())
        session.advance()
    assert session.clock_s() - begun_s > 0.9
    turn(session, 0.3)
    assert not session.interlock.has_lease(session.clock_s())


def test_a_step_under_way_refuses_the_next(session):
    session.hand.jog.step("x", "XYZ", 5.0, 20.0)
    session.advance()
    with pytest.raises(RefusedError, match="JOG-BUSY"):
        session.hand.jog.step("x", "XYZ", 5.0, 20.0)


def test_a_step_beyond_a_soft_limit_names_axis_and_way_left(session):
    left = 400.0 - session._stage.arm.pose(1.0).z_mm
    with pytest.raises(RefusedError) as caught:
        session.hand.jog.step("z", "XYZ", left + 1.0, 20.0)
    assert caught.value.reason == "LIMIT"
    assert f"+Z (XYZ): {left:.1f} mm left" in caught.value.detail


def test_the_tools_z_points_down(high):
    before = position(high)
    hold(high, 0.2, frame="TOOL", speed=-10.0)
    assert (position(high) - before)[2] > 1.0
    assert direction_of("y", "TOOL", 3.0) == (0.0, TOOL_SIGNS[1], 0.0)


def test_grip_then_open_needs_a_confirmation(session):
    facts = told(session)
    session.hand.grip(10.0)
    with pytest.raises(RefusedError, match="MOVING"):
        session.hand.open(confirmed=True)
    turn(session, 1.5)
    assert session.devices["gripper"].status().holding
    with pytest.raises(RefusedError, match="HOLDING"):
        session.hand.open(confirmed=False)
    assert session.devices["gripper"].status().holding
    session.hand.open(confirmed=True)
    turn(session, 3.0)
    assert not session.devices["gripper"].status().holding
    assert any("by the operator" in f.text for f in facts if isinstance(f, Said))


def test_zero_and_reference_by_hand(session):
    facts = told(session)
    session.hand.grip(10.0)
    turn(session, 1.5)
    session.hand.zero_wrench()
    session.hand.take_references()
    turn(session, 2.5)
    said = [f.text for f in facts if isinstance(f, Said)]
    assert said == ["Force and moment are zeroed.", "New tactile references are taken."]
    turn(session, 0.3)
    window = session.wrench.window(session.clock_s() - 0.2, session.clock_s())
    assert abs(float(window.values[:, 2].mean())) < 0.1


def test_a_run_refuses_the_hand_and_the_hand_a_run(session):
    session.hand.jog.renew(order(session))
    with pytest.raises(RefusedError, match="BY-HAND"):
        session.start(ProbeRequest())
    session.hand.jog.end(1)
    session.start(ProbeRequest())
    for call in (
        lambda: session.hand.jog.renew(order(session, 1, hold=2)),
        lambda: session.hand.grip(10.0),
        session.hand.zero_wrench,
    ):
        with pytest.raises(RefusedError, match="BUSY"):
            call()


def test_after_a_fault_in_contact_only_slowly_away(session):
    session.interlock.raise_fault(Fault("FT-TRIP", "Force.", "Stopped.", "Look.", "force_torque"))
    session.reset()
    assert session.interlock.recovering
    turn(session, 0.1)
    assert not session.interlock.recovering, "in air there is nothing to recover from"


def turn(session, seconds):
    for _ in range(round(seconds / STEP_S)):
        session.advance()


# -- limits ----------------------------------------------------------------------------------------


FIVE, FAST = math.radians(5.0), math.radians(15.0)


@pytest.fixture
def bare():
    made = prepared()
    for finger in FINGERS:
        # No picture is drawn that nobody looks at, and nobody waits for one.
        made.devices[f"tactile_{finger}"].close()
    made.interlock.limits = made.interlock.limits.model_copy(update={"frame_age_s": 1e6})
    turn(made, 0.3)
    return made


@pytest.fixture
def raised(bare):
    """The hand far above the surface."""
    raise_hand(bare, 120.0)
    bare.advance()
    return bare


def pose(bare):
    return bare._stage.arm.pose(1.0)


def vector(bare):
    at = pose(bare)
    return np.array([at.rx_rad, at.ry_rad, at.rz_rad])


def hold_turn(bare, seconds, axis, speed=FIVE, frame="XYZ", number=1):
    hold(bare, seconds, axis=axis, speed=speed, frame=frame, hold=number)


def steps(bare, axis, distance, frame="XYZ", speed=FAST):
    bare.hand.jog.step(axis, frame, distance, speed)
    for _ in range(400):
        bare.advance()
        if not bare.hand.active:
            break
    assert not bare.hand.active


def test_a_held_turn_turns_about_its_axis_and_a_release_ends_it(raised):
    where = pose(raised)
    for number, axis in enumerate(TURNS, 1):
        before = pose_rotation(pose(raised))
        hold_turn(raised, 0.5, axis, number=number)
        raised.hand.jog.end(number)
        turn(raised, 0.3)
        turned = rotation_vector(pose_rotation(pose(raised)) @ before.T)
        at = TURNS.index(axis)
        assert 0.5 * FIVE * 0.48 < turned[at] < FIVE * 0.5
        assert np.delete(turned, at) == pytest.approx([0.0, 0.0], abs=1e-9)
        still = vector(raised)
        turn(raised, 0.1)
        assert np.array_equal(still, vector(raised))
    now = pose(raised)
    assert (now.x_mm, now.y_mm, now.z_mm) == pytest.approx(
        (where.x_mm, where.y_mm, where.z_mm), abs=1e-6
    )


def test_a_held_joint_turns_alone_and_silence_ends_it(raised):
    facts, arm = told(raised), raised._stage.arm
    for number, axis in enumerate(JOINTS, 1):
        before = np.array(arm.joints_rad(1.0))
        hold_turn(raised, 0.2, axis, frame="JOINT", number=number)
        last_s = moved_s = raised.clock_s()
        for _ in range(25):
            now = arm.joints_rad(1.0)
            raised.advance()
            if np.abs(np.subtract(arm.joints_rad(1.0), now)).max() > 1e-9:
                moved_s = raised.clock_s()
        assert 0.0 < moved_s - last_s <= 0.3
        turned = np.array(arm.joints_rad(1.0)) - before
        at = JOINTS.index(axis)
        assert turned[at] > 0.01
        assert np.delete(turned, at) == pytest.approx(np.zeros(5), abs=1e-7)
    assert [f.reason for f in facts if isinstance(f, Refused)] == 6 * ["JOG-LEASE"]


def test_tool_axes_turn_with_the_hand(raised):
    steps(raised, "rz", math.radians(5.0))
    before = pose(raised)
    steps(raised, "x", 5.0, frame="TOOL", speed=20.0)
    moved = (pose(raised).x_mm - before.x_mm, pose(raised).y_mm - before.y_mm)
    assert moved == pytest.approx((5.0 * math.cos(FIVE), 5.0 * math.sin(FIVE)), abs=1e-3)
    # About its own z a tool that points down turns the other way.
    steps(raised, "rz", math.radians(5.0), frame="TOOL")
    assert vector(raised) == pytest.approx(np.zeros(3), abs=1e-6)


def test_a_step_turns_exactly_so_far(raised):
    arm = raised._stage.arm
    for degrees in (0.5, 1.0, 5.0, -5.0):
        leant = vector(raised)[1]
        steps(raised, "ry", math.radians(degrees))
        assert math.degrees(vector(raised)[1] - leant) == pytest.approx(degrees, abs=1e-6)
        steps(raised, "ry", -math.radians(degrees))
        before = arm.joints_rad(1.0)[5]
        steps(raised, "j6", math.radians(degrees), "JOINT")
        assert math.degrees(arm.joints_rad(1.0)[5] - before) == pytest.approx(degrees, abs=1e-6)
        steps(raised, "j6", -math.radians(degrees), "JOINT")


def test_low_over_the_surface_nothing_turns_and_the_way_up_is_told(bare):
    for number, (axis, frame) in enumerate((("rx", "XYZ"), ("j4", "JOINT")), 1):
        with pytest.raises(RefusedError, match=r"jog \+Z by 17\.\d mm first") as refused:
            bare.hand.jog.renew(order(bare, axis=axis, speed=FIVE, frame=frame, hold=number))
        assert refused.value.reason == "TURN-LOW"
        assert bare.hand.jog.rooms(frame)["+" + axis].why == "TURN-LOW"


def test_a_turned_hand_stays_high_until_it_is_level_and_nothing_starts_before(raised):
    steps(raised, "ry", math.radians(5.0))
    rooms = raised.hand.jog.rooms("XYZ")
    surface = raised._stage.piece.grip_height_mm
    assert rooms["-z"].left == pytest.approx(120.0 - surface - Limits().turn_clear_mm, abs=0.01)
    with pytest.raises(RefusedError, match="level it first"):
        raised.start(ProbeRequest())
    with pytest.raises(RefusedError, match="level it first"):
        raised.hand.grip(10.0)
    raised.hand.jog.level(math.radians(15.0))
    turn(raised, 4.0)
    assert not vector(raised).any()
    assert raised.hand.jog.rooms("XYZ")["-z"].left > rooms["-z"].left
    raised.start(ProbeRequest())
    raised.engine.cancel()
    raised.engine.tick()


def test_a_run_of_the_command_line_does_not_begin_with_a_turned_hand_either(raised):
    """On devices an earlier run or fault may have left the hand rotated."""
    hold_turn(raised, 1.0, "rx")
    turn(raised, 0.3)
    raised.simulated = False
    with pytest.raises(RefusedError, match="level it first"):
        raised.run(ProbeRequest())


def test_a_turn_ends_where_the_hand_leans_as_far_as_it_may(raised):
    facts, most = told(raised), Limits().tilt_rad
    steps(raised, "rx", math.radians(5.0))
    assert raised.hand.jog.rooms("XYZ")["+rx"].left == pytest.approx(math.radians(10.0), abs=1e-6)
    with pytest.raises(RefusedError, match=r"\+RX \(XYZ\): 10\.0° left"):
        raised.hand.jog.step("rx", "XYZ", math.radians(10.5), FIVE)
    with pytest.raises(RefusedError, match=r"LIMIT|JOG-ENDED"):
        hold_turn(raised, 3.0, "rx", math.radians(15.0))
    turn(raised, 0.3)
    lean = tilt_rad(pose_rotation(pose(raised)))
    assert most - math.radians(0.5) < lean <= most + 1e-6
    assert not [f for f in facts if isinstance(f, Refused) and f.reason != "LIMIT"]


def test_a_joint_is_slowed_to_the_speed_of_the_hand(raised):
    hold_turn(raised, 0.5, "j1", math.radians(15.0), frame="JOINT")
    state = raised.hand.jog.state
    assert state.slow == "the hand at its top speed"
    poses = raised._scene.sensing.raw.poses.window(raised.clock_s() - 0.3, raised.clock_s())
    speed = np.linalg.norm(np.diff(poses.values, axis=0), axis=1) / np.diff(poses.t_s)
    assert 0.0 < speed.max() <= Limits().jog_mm_s


def test_the_room_of_a_joint_is_where_its_jog_ends(raised):
    room = raised.hand.jog.rooms("JOINT")["+j5"]
    assert 0.0 < room.left <= Limits().tilt_rad + 1e-6
    before = raised._stage.arm.joints_rad(1.0)[4]
    with pytest.raises(RefusedError):
        hold_turn(raised, 3.0, "j5", math.radians(15.0), frame="JOINT")
    turn(raised, 0.3)
    gone = raised._stage.arm.joints_rad(1.0)[4] - before
    assert gone == pytest.approx(room.left, abs=math.radians(1.0))


def test_the_wrist_feels_the_weight_turn(raised):
    def felt():
        turn(raised, 0.3)
        samples, now_s = raised._scene.sensing.raw.samples, raised.clock_s()
        return samples.window(now_s - 0.2, now_s).values.mean(axis=0)

    level = felt()
    steps(raised, "ry", math.radians(10.0))
    leant = felt()
    weight = -level[2]
    # Turned about +y, the tool's x points down by 10 degrees: gravity pulls along it.
    assert leant[0] - level[0] == pytest.approx(weight * math.sin(math.radians(10.0)), abs=0.1)
    assert leant[2] == pytest.approx(-weight * math.cos(math.radians(10.0)), abs=0.1)
    # So far it cannot pass for a contact.
    assert abs(raised._scene.sensing.press_n(raised.clock_s(), 0.2)) < Limits().contact_n


@pytest.mark.parametrize(("axis", "speed"), [("z", 20.0), ("rx", FIVE)])
def test_stop_ends_a_jog_at_once_and_latches(raised, axis, speed):
    hold(raised, 0.3, axis=axis, speed=speed)
    raised.stop()
    ordered, at = position(raised), pose(raised)
    turn(raised, 0.3)
    assert np.array_equal(position(raised), ordered)
    assert pose(raised) == at
    with pytest.raises(RefusedError):
        raised.hand.jog.renew(order(raised, 50, axis=axis, speed=speed))


def test_after_a_fault_nothing_turns(raised):
    raised.interlock.raise_fault(Fault("FT-TRIP", "Force.", "Stopped.", "Look.", "force_torque"))
    raised.reset()
    with pytest.raises(RefusedError, match="away from contact"):
        raised.hand.jog.renew(order(raised, axis="rz", speed=FIVE))


def test_no_turn_is_faster_than_its_limit(raised):
    scene = raised._scene
    for number, speed in enumerate((math.radians(15.1), math.nan, 0.0), 1):
        with pytest.raises(RefusedError):
            raised.hand.jog.renew(order(raised, axis="rz", speed=speed, hold=number))
        raised.interlock.renew_lease(raised.clock_s())
        with pytest.raises((RefusedError, ValueError)):
            scene.arm.jog((0.0, 0.0, 0.0), LEASE_S, (0.0, 0.0, speed))
        with pytest.raises((RefusedError, ValueError)):
            scene.arm.move_joints(scene.arm.joints_rad(1.0), speed)


LIMITS = Limits()


def refusal(check, *values):
    """Return the reason for which ``check`` refuses the values, None if it accepts them."""
    try:
        check(*values)
    except RefusedError as refused:
        return refused.reason
    return None


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
    assert refusal(refuse_turning, at, surface, press, LIMITS) == reason


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
    assert refusal(refuse_place, at, 40.0, LIMITS) == reason


def test_only_a_turned_hand_is_kept_high():
    assert turned_descent_mm(Pose(0.0, 0.0, 80.0), 40.0, LIMITS) == math.inf
    assert turned_descent_mm(Pose(0.0, 0.0, 80.0, 0.1), 40.0, LIMITS) == 20.0
    assert turned_descent_mm(Pose(0.0, 0.0, 50.0, 0.1), 40.0, LIMITS) == 0.0


def test_the_centre_of_mass_comes_from_the_piece():
    with simulated_session(SimulatedBenchChoice()) as session:
        scene = session._set_scene(SceneChoice(piece="mug", bottoms=("short",), estimates=False))
        held = grasped_piece(session._for_run(scene, StackSettings()))
        assert (held.com_xy_mm, held.grip_height_mm) == ((1.7, -0.9), 32.0)


def test_the_height_of_the_sensor_and_the_tower_come_from_bench_and_entry():
    with simulated_session(SimulatedBenchChoice()) as session:
        tower = session._set_scene(SceneChoice(bottoms=("short", "long"), estimates=False))
        entry = TowerSettings(offset_mm=((2.0, -1.0),), sigma_mm=0.5)
        held = grasped_piece(session._for_run(tower, StackSettings(tower=entry)))
        assert held.lever_mm() == held.grip_height_mm + 120.0
        # What was entered, not where the simulated bench has it.
        assert (held.below.offset_mm, held.below.sigma_mm) == (((2.0, -1.0),), 0.5)
        assert [body.name for body in held.below.bodies] == ["short", "long"]
        wrong = TowerSettings(offset_mm=((1.0, 0.0), (1.0, 0.0)))
        with pytest.raises(InputError, match="were entered"):
            session._for_run(tower, StackSettings(tower=wrong))
        single = session._set_scene(SceneChoice(bottoms=("short",), estimates=False))
        assert grasped_piece(session._for_run(single, StackSettings())).below is None


@pytest.mark.parametrize(
    ("knocked", "outcome"), [(True, Outcome.KNOCKED_OVER), (False, Outcome.GAVE_UP)]
)
def test_a_trial_that_knocked_its_support_over_has_no_other_outcome(knocked, outcome) -> None:
    verdict = SimpleNamespace(knocked_over=knocked)
    bench = SimpleNamespace(scoring=SimpleNamespace(verdict=lambda: verdict))
    found = with_toppled_support(bench, TrialResult(Outcome.GAVE_UP, "Enough.", 3))
    assert (found.outcome, found.probes) == (outcome, 3)
    assert found.reason.endswith("Enough.")


def test_run_on_a_bench_says_if_a_certificate_covers_it() -> None:
    session = simulated_session(
        SimulatedBenchChoice(preset="bench-v1"), keep=RecordingOptions(None)
    )
    with session:
        plan = stack_run(session, StackRequest(strategy="fused"))
        started, said = next(plan), next(plan)
        assert isinstance(started, RunStarted)
        kept = json.loads(started.settings)["release"]
        assert (kept["bench"], kept["bench_sha256"]) == ("bench-v1", session.identity.sha256)
        assert kept["certificate"] == "no certificate for this bench"
        assert said == Said(0.0, "No certificate for this bench: none was made for this network.")
        paper = stack_run(session, StackRequest())
        first = next(paper)
        assert isinstance(first, RunStarted)
        assert "release" not in json.loads(first.settings)
        status = certificate_status(
            session.identity, StackSettings(strategy="fused"), StackRequest()
        )
        assert status.scope == "Only learned fusion can have one."
    scripted = SimulatedBenchChoice(preset="bench-v1", disturbances=("tactile_left:stop@3.0",))
    with simulated_session(scripted, keep=RecordingOptions(None)) as disturbed:
        assert disturbed.identity.sha256 == ""
