"""What is evidence that an arm stands: never one place alone."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core import Fault, Pose, RefusedError, SampleStream
from touchdown.backend.devices.guarded_devices import GuardedGripper
from touchdown.backend.devices.interlock import (
    CLOSES,
    LEASE_S,
    VERDICT_ROWS,
    Interlock,
    JigEvidence,
    Limits,
    ReleaseEvidence,
    StagedOpening,
    distance_to_limit_mm,
    fastest_mm_s,
    jig_refusal,
    outside_box_mm,
    recent_positions_mm,
    refuse_forced,
    release_refusal,
    travelled_mm,
)
from touchdown.backend.devices.protocols import CommandedMotion, GripStatus


def told(*rows):
    poses = SampleStream("arm", 3, 4096)
    t_s, z_mm = np.array(rows, dtype=float).reshape(-1, 2).T
    poses.put(t_s, np.column_stack([np.zeros_like(z_mm), np.zeros_like(z_mm), z_mm]))
    return poses


@pytest.mark.parametrize(
    ("rows", "travel_mm"),
    [
        ([], math.nan),
        ([(9.9, 60.0)], math.nan),  # told once: it may be on its way
        ([(9.1, 60.0), (9.15, 60.0)], math.nan),  # too long ago
        ([(9.5, 60.2), (9.7, 60.0), (9.99, 60.0)], 0.0),  # ten times a second: the last two
        ([(9.7, 60.2), (9.9, 60.0)], 0.2),
        ([(9.79, 61.0), *((t, 60.0) for t in np.arange(9.81, 10.0, 0.0035))], 0.0),
        ([*((t, 60.0 + (t > 9.9)) for t in np.arange(9.7, 10.0, 0.0035))], 1.0),
        ([(9.9, math.nan), (9.95, 60.0)], math.nan),
    ],
)
def test_the_last_two_places_at_least_tell_how_far_an_arm_moved(rows, travel_mm):
    found = travelled_mm(recent_positions_mm(told(*rows), 10.0))
    assert found == pytest.approx(travel_mm, nan_ok=True)


FAULT = Fault("FT-STALE", "It is silent.", "Motion stopped.", "Look at it.", "force_torque")
GOOD = ReleaseEvidence(
    verdict_stable=True,
    verdict_of_last_probe=True,
    verdict_age_s=0.5,
    margin_mm=1.2,
    required_margin_mm=0.0,
    quality_accepted=True,
    slip_mm=0.02,
    press_n=1.0,
    wrench_age_s=0.002,
    wrench_age_limit_s=0.015,
    moved_mm=0.01,
    width_change_mm=0.0,
    holding=True,
    approved=True,
)
BAD = {
    "verdict_stable": ([False], "VERDICT-NOT-STABLE"),
    "verdict_of_last_probe": ([False], "VERDICT-NOT-LAST"),
    "verdict_age_s": ([5.01, -0.1, math.nan, math.inf], "VERDICT-OLD"),
    "margin_mm": ([-0.01, math.nan, math.inf, -math.inf], "MARGIN"),
    "required_margin_mm": ([1.3, math.nan], "MARGIN"),
    "quality_accepted": ([False], "QUALITY"),
    "slip_mm": ([0.31, math.nan, -1.0], "SLIP"),
    "press_n": ([0.29, 2.01, -5.0, math.nan], "NOT-UNLOADED"),
    "wrench_age_s": ([0.016, math.nan, -1.0], "WRENCH-OLD"),
    "moved_mm": ([0.06, math.nan], "ARM-MOVING"),
    "width_change_mm": ([0.31, -0.31, math.nan], "WIDTH"),
    "holding": ([False], "NOT-HOLDING"),
    "approved": ([False], "NOT-APPROVED"),
}


@pytest.mark.promise("G7")
@pytest.mark.parametrize(
    ("field", "value", "name"),
    [(field, value, name) for field, (values, name) in BAD.items() for value in values],
)
def test_one_bad_field_refuses_with_its_own_name(field: str, value: object, name: str) -> None:
    assert release_refusal(GOOD) is None
    refusal = release_refusal(dataclasses.replace(GOOD, **{field: value}))
    assert refusal is not None
    assert refusal[0] == name


@pytest.mark.promise("G7")
@given(data=st.data())
def test_any_mixture_with_a_bad_field_refuses(data: st.DataObject) -> None:
    fields = data.draw(st.sets(st.sampled_from(sorted(BAD)), min_size=1))
    changes = {field: data.draw(st.sampled_from(BAD[field][0])) for field in fields}
    refusal = release_refusal(dataclasses.replace(GOOD, **changes))
    assert refusal is not None
    assert refusal[0] in {BAD[field][1] for field in fields}


def test_the_untested_baseline_waives_the_verdict_and_nothing_else() -> None:
    for field, (values, name) in BAD.items():
        for value in values:
            refusal = release_refusal(dataclasses.replace(GOOD, **{field: value}), untested=True)
            assert (refusal is None) == (name in VERDICT_ROWS)


def test_motion_needs_a_live_lease() -> None:
    interlock = Interlock()
    with pytest.raises(RefusedError, match="NO-LEASE"):
        interlock.require_motion(0.0)
    interlock.renew_lease(10.0)
    interlock.require_motion(10.0 + LEASE_S)
    with pytest.raises(RefusedError, match="NO-LEASE"):
        interlock.require_motion(10.0 + LEASE_S + 0.001)
    interlock.renew_lease(11.0)
    interlock.drop_lease()
    with pytest.raises(RefusedError, match="NO-LEASE"):
        interlock.require_motion(11.0)


def test_stop_latches_until_reset_and_calls_every_stopper() -> None:
    interlock = Interlock()
    stopped: list[str] = []
    interlock.on_stop(lambda: stopped.append("arm"))
    interlock.on_stop(lambda: stopped.append("gripper"))
    interlock.renew_lease(0.0)
    interlock.stop("operator")
    assert stopped == ["arm", "gripper"]
    with pytest.raises(RefusedError, match="STOPPED"):
        interlock.require_motion(0.0)
    interlock.reset()
    with pytest.raises(RefusedError, match="NO-LEASE"):
        interlock.require_motion(0.0)
    interlock.renew_lease(0.0)
    interlock.require_motion(0.0)


def test_a_fault_latches_once_per_device_and_stops() -> None:
    interlock = Interlock()
    stops: list[int] = []
    interlock.on_stop(lambda: stops.append(1))
    fault = Fault("FT-STALE", "No sample.", "Stopped.", "Look.", "force_torque")
    interlock.raise_fault(fault)
    interlock.raise_fault(dataclasses.replace(fault, what="Again."))
    assert interlock.faults == (fault,)
    assert interlock.latched
    assert len(stops) == 2
    interlock.reset()
    assert not interlock.latched


TRIP = Fault("FT-TRIP", "Too much.", "Draws back.", "Look.", "arm")
LOST = Fault("MXT-LOST", "No reply.", "Stopped.", "Look.", "arm")


def reacting() -> tuple[Interlock, list[str]]:
    """An interlock with an arm that can draw back and a gripper that cannot."""
    interlock, did = Interlock(), list[str]()
    interlock.on_stop(lambda: did.append("stop"), lambda: did.append("retreat"))
    interlock.on_stop(lambda: did.append("jaws"))
    return interlock, did


@pytest.mark.promise("G3")
def test_too_much_force_draws_back_once_and_does_not_stop_what_draws_back() -> None:
    interlock, did = reacting()
    interlock.raise_fault(TRIP)
    # The same force is felt in the next cycles too, and by the other watch.
    interlock.raise_fault(TRIP)
    interlock.raise_fault(dataclasses.replace(TRIP, device="force_torque"))
    assert [what for what in did if what != "jaws"] == ["retreat"]
    assert interlock.latched
    interlock.reset()
    interlock.raise_fault(TRIP)
    assert did.count("retreat") == 2


@pytest.mark.parametrize("first", ["operator", "link"])
def test_the_strongest_reaction_wins(first: str) -> None:
    interlock, did = reacting()
    interlock.raise_fault(TRIP)
    did.clear()
    if first == "operator":
        interlock.stop()
    else:
        interlock.raise_fault(LOST)
    assert did == ["stop", "jaws"]
    interlock.raise_fault(dataclasses.replace(TRIP, device="force_torque"))
    assert did == ["stop", "jaws"] * 2


@pytest.mark.promise("P1")
def test_limits_must_be_finite() -> None:
    with pytest.raises(ValueError, match="speed_mm_s"):
        Interlock(Limits(speed_mm_s=math.nan))


def test_limits_change_between_motions_only() -> None:
    interlock = Interlock()
    before, lower = interlock.limits, Limits(probe_n=12.0, press_n=9.0)
    interlock.renew_lease(5.0)
    with pytest.raises(RefusedError, match="MOVING"):
        interlock.change_limits(lower, 5.0 + LEASE_S)
    assert interlock.limits is before
    interlock.change_limits(lower, 5.0 + LEASE_S + 0.001)
    assert interlock.limits is lower
    with pytest.raises(ValueError, match="probe_n"):
        interlock.change_limits(Limits(probe_n=math.inf), 9.0)


def test_the_override_keeps_its_range_and_starts_at_full_speed() -> None:
    interlock = Interlock()
    assert interlock.override == 1.0
    interlock.override_speed(0.1)
    for share in (0.09, 1.01, math.nan):
        with pytest.raises(RefusedError, match="OVERRIDE"):
            interlock.override_speed(share)
    assert interlock.override == 0.1


@pytest.mark.promise("G8")
def test_the_box_ends_room_and_targets_before_the_reach_does():
    limits = Limits(most_x_mm=40.0, least_y_mm=-30.0)
    here = Pose(10.0, -10.0, 50.0)
    assert distance_to_limit_mm(here, (1.0, 0.0, 0.0), limits) == pytest.approx(30.0)
    assert distance_to_limit_mm(here, (0.0, -1.0, 0.0), limits) == pytest.approx(20.0)
    diagonal = (math.sqrt(0.5), -math.sqrt(0.5), 0.0)
    assert distance_to_limit_mm(here, diagonal, limits) == pytest.approx(20.0 * math.sqrt(2.0))
    assert outside_box_mm(here, limits) == 0.0
    assert outside_box_mm(Pose(45.0, -60.0, 50.0), limits) == pytest.approx(30.0)


LIMITS = Limits()
AT = Pose(0.0, 0.0, 100.0)


@pytest.mark.parametrize(
    ("at", "way", "room"),
    [
        (AT, (1.0, 0.0, 0.0), 150.0),
        (Pose(90.0, 120.0, 50.0), (1.0, 0.0, 0.0), 0.0),
        (Pose(90.0, 120.0, 50.0), (-1.0, 0.0, 0.0), 180.0),
        (Pose(-100.0, 0.0, 50.0), (0.0, 1.0, 0.0), np.sqrt(150.0**2 - 100.0**2)),
        (AT, (0.0, 0.0, 1.0), 300.0),
        (AT, (0.0, 0.0, -1.0), 100.0),
        (Pose(200.0, 0.0, 50.0), (1.0, 0.0, 0.0), 0.0),
    ],
)
def test_room_to_the_edge_of_the_workspace(at, way, room):
    assert distance_to_limit_mm(at, way, LIMITS) == pytest.approx(room)


@pytest.mark.promise("W4")
@pytest.mark.parametrize(
    ("press_n", "way", "state", "reason"),
    [
        (0.5, (1.0, 0.0, 0.0), False, None),
        (1.5, (1.0, 0.0, 0.0), False, "DRAGGING"),
        (1.5, (0.0, 0.0, -1.0), False, None),
        (15.1, (0.0, 0.0, -1.0), False, "JOG-FORCE"),
        (15.1, (0.0, 0.0, 1.0), False, None),
        (-15.1, (0.0, 0.0, 1.0), False, "JOG-FORCE"),
        (2.0, (0.0, 0.0, -1.0), True, "RECOVERY"),
        (2.0, (0.0, 0.0, 1.0), True, None),
        (0.2, (0.0, 0.0, 1.0), "slow", None),
        (0.2, (1.0, 0.0, 0.0), "slow", "DEGRADED"),
        (0.2, (0.0, 0.0, -1.0), "slow", "DEGRADED"),
        (-0.2, (0.0, 0.0, -1.0), "slow", "DEGRADED"),
        (float("nan"), (0.0, 0.0, 1.0), False, "FT-UNKNOWN"),
    ],
)
def test_force_guard(press_n, way, state, reason):
    how = {"recovering": state is True, "degraded": "It is slow." if state == "slow" else ""}
    if reason is None:
        refuse_forced(press_n, way, LIMITS, **how)
        return
    with pytest.raises(RefusedError) as caught:
        refuse_forced(press_n, way, LIMITS, **how)
    assert caught.value.reason == reason
    if reason == "JOG-FORCE":
        assert "Fz" in caught.value.detail


@pytest.mark.parametrize(
    ("z", "surface", "press_n", "recovering", "speed"),
    [
        (100.0, 24.0, 0.0, False, 50.0),
        (33.9, 24.0, 0.0, False, 2.0),
        (34.0, 24.0, 0.0, False, 50.0),
        (100.0, 24.0, 1.01, False, 2.0),
        (100.0, 24.0, float("nan"), False, 2.0),
        (100.0, float("nan"), 0.0, False, 2.0),
        (100.0, 24.0, 0.0, True, 5.0),
    ],
)
def test_speed_where_contact_is_near(z, surface, press_n, recovering, speed):
    at = Pose(0.0, 0.0, z)
    assert fastest_mm_s(at, surface, press_n, LIMITS, recovering=recovering)[0] == speed


PUTTING_BACK_GOOD = JigEvidence(from_jig_mm=0.1, moved_mm=0.01, force_n=0.2, holding=True)
NAN = float("nan")


@pytest.mark.promise("G7")
@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("NOT-AT-JIG", {"from_jig_mm": 0.6}),
        ("NOT-AT-JIG", {"from_jig_mm": NAN}),
        ("ARM-MOVING", {"moved_mm": 0.06}),
        ("ARM-MOVING", {"moved_mm": NAN}),
        ("JAMMED", {"force_n": 2.1}),
        ("JAMMED", {"force_n": NAN}),
        ("NOT-HOLDING", {"holding": False}),
    ],
)
def test_each_condition_over_the_jig_refuses_alone(name, change) -> None:
    assert jig_refusal(PUTTING_BACK_GOOD) is None
    refusal = jig_refusal(replace(PUTTING_BACK_GOOD, **change))
    assert refusal is not None
    assert refusal[0] == name


class NotedGripper:
    """Notes its orders; ``fails``: it refuses them. ``meanwhile`` is called in an opening."""

    name, fails, meanwhile = "gripper", False, staticmethod(lambda: None)

    def __init__(self):
        self.orders, self.width_mm = [], 30.0

    def status(self):
        return GripStatus(self.width_mm, 10.0, not self.orders)

    def open_to(self, width_mm, speed_mm_s):
        if self.fails:
            raise RefusedError("NO", "no")
        self.meanwhile()
        self.orders.append(("open", width_mm))
        return CommandedMotion({})

    def grip(self, force_n):
        if self.fails:
            raise RefusedError("NO", "no")
        self.orders.append(("grip", force_n))
        self.motion = CommandedMotion({})
        return self.motion

    def stop(self):
        self.orders.append(("stop",))


class Staged:
    """A guarded gripper that opens in stages, at ``now_s`` with a live lease."""

    def __init__(self):
        self.noted, self.lock, self.now_s = NotedGripper(), Interlock(), 1.0
        self.gripper = GuardedGripper(self.noted, self.lock, lambda: self.now_s)

    def step(self, width_mm, evidence=None, moved_mm=0.0, force_n=8.0):
        self.lock.renew_lease(self.now_s)
        return self.gripper.open_step(evidence, width_mm, 5.0, force_n=force_n, moved_mm=moved_mm)

    def refusal(self, *given, **more):
        with pytest.raises(RefusedError) as caught:
            self.step(*given, **more)
        return caught.value.reason


def test_an_opening_in_stages_begins_with_the_conditions_of_a_release():
    jaws = Staged()
    assert jaws.refusal(30.1) == "NOT-STAGED"
    assert jaws.refusal(30.1, replace(GOOD, holding=False)) == "NOT-HOLDING"
    assert jaws.refusal(30.1, replace(GOOD, verdict_stable=False)) == "VERDICT-NOT-STABLE"
    assert jaws.refusal(30.16, GOOD) == "STAGE-STEP"
    assert jaws.refusal(30.1, GOOD, force_n=math.nan) == "STAGE-FORCE"
    assert (jaws.noted.orders, jaws.lock.staged) == ([], None)
    jaws.step(30.1, GOOD)
    assert jaws.noted.orders == [("open", 30.1)]
    assert jaws.gripper.letting_go


@pytest.mark.parametrize(
    ("width_mm", "after_s", "moved_mm", "why"),
    [
        (30.21, 1.0, 0.0, "STAGE-STEP"),
        (30.1, 1.0, 0.0, "STAGE-STEP"),
        (math.nan, 1.0, 0.0, "STAGE-STEP"),
        (30.2, 0.9, 0.0, "STAGE-EARLY"),
        (30.2, 1.0, 0.06, "ARM-MOVING"),
        (30.2, 1.0, math.nan, "ARM-MOVING"),
    ],
)
def test_a_step_is_small_and_held_and_the_arm_stands(width_mm, after_s, moved_mm, why):
    jaws = Staged()
    jaws.step(30.1, GOOD)
    jaws.now_s += after_s
    assert jaws.refusal(width_mm, moved_mm=moved_mm) == why
    jaws.now_s += 0.1
    jaws.step(30.2)
    assert jaws.noted.orders == [("open", 30.1), ("open", 30.2)]


def test_an_opening_in_stages_ends_after_a_few_millimetres():
    jaws = Staged()
    jaws.step(30.1, GOOD)
    for step in range(2, 41):
        jaws.now_s += 1.0
        jaws.step(30.0 + 0.1 * step)
    jaws.now_s += 1.0
    assert jaws.refusal(34.1) == "STAGE-WIDTH"


def test_stop_and_faults_close_loosened_jaws_and_only_these():
    jaws = Staged()
    jaws.lock.stop()
    assert jaws.noted.orders == [("stop",)]
    for end in (lambda lock: lock.stop(), lambda lock: lock.raise_fault(FAULT)):
        jaws = Staged()
        jaws.step(30.1, GOOD)
        grips = jaws.gripper.grips
        end(jaws.lock)
        assert jaws.noted.orders == [("open", 30.1), ("grip", 8.0)]
        assert (jaws.gripper.grips, jaws.gripper.letting_go) == (grips + 1, False)
        # A second stop does not interrupt the closing; after it, it stops the gripper.
        jaws.lock.stop()
        assert jaws.noted.orders[2:] == []
        jaws.noted.motion.end()
        jaws.lock.stop()
        assert jaws.noted.orders[2:] == [("stop",)]
        jaws.lock.reset()
        jaws.now_s += 1.0
        assert jaws.refusal(30.2) == "NOT-STAGED"
    jaws = Staged()
    jaws.step(30.1, GOOD)
    jaws.noted.fails = True
    jaws.lock.stop()
    assert jaws.noted.orders == [("open", 30.1), ("stop",)]


def test_a_grip_or_an_opening_at_once_ends_the_stages():
    for end in (
        lambda g: g.grip(8.0),
        lambda g: g.open_to(60.0, 5.0),
        lambda g: g.open_by_hand(60.0, 5.0, confirmed=True),
    ):
        jaws = Staged()
        jaws.step(30.1, GOOD)
        motion = end(jaws.gripper)
        assert jaws.lock.staged is None
        motion.end()
        jaws.lock.stop()
        assert jaws.noted.orders[-1] == ("stop",)


def test_a_stop_does_not_interrupt_the_grip_of_loosened_jaws():
    jaws = Staged()
    jaws.step(30.1, GOOD)
    jaws.gripper.grip(8.0)
    jaws.lock.stop()
    assert jaws.noted.orders[1:] == [("grip", 8.0)]


def test_a_stop_that_comes_during_the_order_of_a_step_closes_the_jaws():
    jaws = Staged()
    jaws.noted.meanwhile = jaws.lock.stop
    jaws.step(30.1, GOOD)
    assert jaws.noted.orders[-1] == ("grip", 8.0)
    assert (jaws.lock.staged, jaws.gripper.letting_go) == (None, False)


def test_a_gripper_that_refuses_to_grip_or_open_leaves_the_stages_in_progress():
    for order in ("grip", "open_to"):
        jaws = Staged()
        jaws.step(30.1, GOOD)
        jaws.noted.fails = True
        with pytest.raises(RefusedError):
            getattr(jaws.gripper, order)(*(8.0, 5.0)[: 1 + (order == "open_to")])
        assert jaws.lock.staged is not None


def test_the_arm_stops_instead_of_retreating_while_the_jaws_are_loose():
    done, lock = [], Interlock()
    lock.on_stop(lambda: done.append("stop"), lambda: done.append("retreat"))
    lock.staged = StagedOpening(30.0, 8.0)
    lock.raise_fault(replace(FAULT, code="FT-TRIP"))
    assert done == ["stop"]
    assert lock.faults[0].consequence == CLOSES
