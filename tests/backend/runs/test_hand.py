"""Manual motion on the simulated bench on its own clock: every motion ends in time."""

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.brisk import brisk_bench
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core.events import Refused, Said
from touchdown.backend.core.faults import Fault, RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.interlock import LEASE_S
from touchdown.backend.devices.jog import TOOL_SIGNS, JogOrder, direction_of
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import ProbeRequest, SceneChoice, StackRequest

STEP_S = 0.02
MOST_S = 0.3


@pytest.fixture
def session():
    made = simulated_session(brisk_bench(), keep=RecordingOptions(None))
    made.prepare(SceneChoice(estimates=False))
    for _ in range(30):
        made.advance()
    return made


@pytest.fixture
def high(session):
    """The hand far above the slow zone near the surface."""
    stage = session._stage
    motion = stage.arm.move_to(Pose(0.0, 0.0, 100.0), 50.0)
    while not motion.done:
        session.advance()
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
    moved_s = last_s
    for _ in range(100):
        before = position(high)
        high.advance()
        if not np.array_equal(before, position(high)):
            moved_s = high.clock_s()
    assert 0.2 < moved_s - last_s <= MOST_S
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
    for _ in range(round(LEASE_S / STEP_S) + 1):
        high.advance()
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
    for _ in range(20):
        high.advance()
    with pytest.raises(RefusedError, match="JOG-ENDED"):
        high.hand.jog.renew(order(high, 9))
    high.hand.jog.renew(order(high, 1, hold=2))
    assert high.hand.active


def test_the_arm_stops_by_itself_when_nobody_ticks_the_lease(high):
    hold(high, 0.2)
    stage = high._stage
    last_s, moved_s = high.clock_s(), high.clock_s()
    for _ in range(50):
        before = position(high)
        stage.advance(20_000)
        if not np.array_equal(before, position(high)):
            moved_s = high.clock_s()
    assert 0.0 < moved_s - last_s <= MOST_S


@pytest.mark.promise("W3")
@pytest.mark.parametrize("sequence", [1, 0, -5])
def test_a_replayed_renewal_is_refused(session, sequence):
    session.hand.jog.renew(order(session, 1))
    with pytest.raises(RefusedError, match="JOG-REPLAYED"):
        session.hand.jog.renew(order(session, sequence))


@pytest.mark.promise("W3")
@pytest.mark.parametrize("late_s", [LEASE_S + 0.001, 5.0, -0.001, float("nan")])
def test_a_renewal_of_another_time_is_refused(session, late_s):
    with pytest.raises(RefusedError, match="JOG-STALE"):
        session.hand.jog.renew(order(session, sent_s=session.clock_s() - late_s))
    assert not session.hand.active


def test_a_second_hold_cannot_take_over(session):
    session.hand.jog.renew(order(session))
    with pytest.raises(RefusedError, match="JOG-BUSY"):
        session.hand.jog.renew(order(session, 1, hold=2, axis="x"))


def test_one_renewal_waits_at_most(high):
    """Ten renewals between two bench steps move as far as one."""
    before = position(high)
    for sequence in range(1, 11):
        high.hand.jog.renew(order(high, sequence))
    for _ in range(40):
        high.advance()
    assert (position(high) - before)[2] <= 20.0 * MOST_S


def test_stop_ends_a_jog_and_latches(high):
    hold(high, 0.2)
    high.stop()
    at = position(high)
    high.advance()
    assert np.array_equal(position(high), at)
    with pytest.raises(RefusedError):
        high.hand.jog.renew(order(high, 50))


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
    for _ in range(200):
        session.advance()
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
