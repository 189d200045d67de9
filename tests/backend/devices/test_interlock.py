"""The release conditions, the latch and the lease: one bad field must always refuse."""

from __future__ import annotations

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.faults import Fault, RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.interlock import (
    LEASE_S,
    VERDICT_ROWS,
    Interlock,
    Limits,
    ReleaseEvidence,
    distance_to_limit_mm,
    outside_box_mm,
    release_refusal,
)

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


def test_all_conditions_true_releases() -> None:
    assert release_refusal(GOOD) is None


@pytest.mark.promise("G7")
@pytest.mark.parametrize(
    ("field", "value", "name"),
    [(field, value, name) for field, (values, name) in BAD.items() for value in values],
)
def test_one_bad_field_refuses_with_its_own_name(field: str, value: object, name: str) -> None:
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
    limits = dataclasses.replace(Limits(), most_x_mm=40.0, least_y_mm=-30.0)
    here = Pose(10.0, -10.0, 50.0)
    assert distance_to_limit_mm(here, (1.0, 0.0, 0.0), limits) == pytest.approx(30.0)
    assert distance_to_limit_mm(here, (0.0, -1.0, 0.0), limits) == pytest.approx(20.0)
    diagonal = (math.sqrt(0.5), -math.sqrt(0.5), 0.0)
    assert distance_to_limit_mm(here, diagonal, limits) == pytest.approx(20.0 * math.sqrt(2.0))
    assert outside_box_mm(here, limits) == 0.0
    assert outside_box_mm(Pose(45.0, -60.0, 50.0), limits) == pytest.approx(30.0)
