"""The watchdogs of the rig in virtual time: each row of their table, exactly at its limit."""

import math
import random
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.backend.rig.hosted import reason
from touchdown.backend.core.faults import RefusedError, TouchdownError
from touchdown.backend.devices.interlock import ByHand, JigEvidence, Limits, ReleaseEvidence
from touchdown.backend.devices.melfa.emulated_controller import READY_RAD
from touchdown.backend.devices.melfa.realtime_protocol import decode_mxt_request
from touchdown.backend.devices.protocols import CommandedMotion, stopped_fault
from touchdown.backend.rig.safety import (
    BACKEND_SILENT_S,
    Failsafe,
    FailsafeInput,
    FailsafeOutput,
    RigMeasurement,
    refuse_opening,
)

ROUND_S = 0.004
FOREVER = math.inf


def core():
    return Failsafe(0.0, Limits())


def run(core, seconds, *, start_s=0.0, beats=None, stops=0, lease_s=FOREVER, moving=True):
    """Return the first outbox that asks for something, with its time; beats stand if given."""
    for k in range(1, round(seconds / ROUND_S) + 1):
        now_s = start_s + k * ROUND_S
        out = core.step(now_s, FailsafeInput(k if beats is None else beats, stops, lease_s, moving))
        if out != FailsafeOutput():
            return now_s, out
    return None


def test_a_backend_that_lives_is_left_alone():
    assert run(core(), 10.0) is None


def test_a_silent_backend_holds_a_motion_after_250_ms_and_latches():
    rig = core()
    at_s, out = run(rig, 1.0, beats=1)
    # The first beat is news in the first round.
    assert BACKEND_SILENT_S < at_s - ROUND_S <= BACKEND_SILENT_S + ROUND_S
    assert (out.hold, out.stop, out.leave) == (True, False, False)
    assert out.fault.code == out.why.code == "BACKEND-SILENT"
    assert reason(lambda: rig.refuse(1.0, FOREVER)) == "FAULT"
    rig.step(1.0, FailsafeInput(2, 0, FOREVER))
    assert reason(lambda: rig.refuse(1.0, FOREVER)) == "FAULT"
    rig.reset(0, rig.faults)
    rig.refuse(1.0, FOREVER)


def test_a_silent_backend_beside_a_standing_arm_is_no_fault_but_nothing_starts():
    rig = core()
    assert run(rig, 1.0, beats=1, moving=False) is None
    assert reason(lambda: rig.refuse(1.0, FOREVER)) == "BACKEND-SILENT"
    rig.step(1.1, FailsafeInput(2, 0, FOREVER))
    rig.refuse(1.1, FOREVER)


def test_a_stall_of_the_rig_itself_is_not_taken_for_silence_of_the_backend():
    rig = core()
    rig.step(0.1, FailsafeInput(10, 0, FOREVER, moving=True))
    assert rig.step(2.0, FailsafeInput(500, 0, FOREVER, moving=True)) == FailsafeOutput()


def test_a_lapsed_lease_holds_and_is_no_fault():
    rig = core()
    at_s, out = run(rig, 3.0, lease_s=0.25)
    assert 2.0 < at_s <= 2.0 + ROUND_S + 1e-9
    assert (out.hold, out.fault, out.why.code) == (True, None, "LEASE-LAPSED")
    assert reason(lambda: rig.refuse(at_s, 0.25)) == "NO-LEASE"
    rig.refuse(at_s, at_s + 0.25)


def test_stop_comes_once_and_stays_until_it_is_reset():
    rig = core()
    at_s, out = run(rig, 1.0, stops=1)
    assert (at_s, out.stop, out.leave) == (ROUND_S, True, False)
    assert run(rig, 1.0, start_s=at_s, stops=1) is None
    assert reason(lambda: rig.refuse(1.0, FOREVER)) == "STOPPED"
    rig.reset(1, 0)
    rig.refuse(1.0, FOREVER)


def test_a_reset_never_clears_what_comes_after_it():
    rig = core()
    rig.reset(5, 5)
    rig.stop(1)
    assert rig.latched
    rig.reset(0, 0)
    assert reason(lambda: rig.refuse(1.0, FOREVER)) == "STOPPED"


def test_the_word_and_the_message_of_one_stop_are_one():
    rig = core()
    assert rig.stop(1)
    rig.reset(1, 0)
    assert rig.step(0.1, FailsafeInput(1, 1, FOREVER)) == FailsafeOutput()
    assert not rig.latched


@pytest.mark.promise("P9")
def test_without_a_backend_it_stops_and_leaves():
    out = core().step(0.004, FailsafeInput(1, 0, FOREVER, moving=True, gone=True))
    assert (out.stop, out.leave) == (True, True)
    assert out.why.code == "CONTROL-LOST"


def test_nothing_moves_beside_a_wrist_that_is_not_felt():
    rig = core()
    assert reason(lambda: rig.refuse_unfelt(0.0)) == "FT-STALE"
    rig.step(1.0, FailsafeInput(1, 0, FOREVER, wrench_s=1.0))
    rig.refuse_unfelt(1.29)
    assert reason(lambda: rig.refuse_unfelt(1.31)) == "FT-STALE"


def test_a_number_that_is_none_permits_nothing():
    rig = core()
    assert reason(lambda: rig.refuse(0.1, math.nan)) == "NO-LEASE"
    out = rig.step(0.1, FailsafeInput(1, 0, math.nan, moving=True))
    assert out.hold


@given(
    st.lists(
        st.tuples(
            st.integers(0, 3), st.integers(0, 2), st.sampled_from([0.0, 0.1, FOREVER, math.nan]),
            st.booleans(), st.booleans(),
        ),
        max_size=12,
    )
)  # fmt: skip
def test_equal_inputs_give_equal_outputs_and_nothing_raises(steps):
    first, second = core(), core()
    for k, (beats, stops, lease_s, moving, gone) in enumerate(steps):
        inbox = FailsafeInput(beats, stops, lease_s, moving, gone)
        assert first.step(0.05 * k, inbox) == second.step(0.05 * k, inbox)


TOLD = ReleaseEvidence(
    verdict_stable=True, verdict_of_last_probe=True, verdict_age_s=1.0, margin_mm=1.0,
    required_margin_mm=0.0, quality_accepted=True, slip_mm=0.1, press_n=1.0, wrench_age_s=0.01,
    wrench_age_limit_s=0.015, moved_mm=0.01, width_change_mm=0.0, holding=True, approved=True,
)  # fmt: skip
MEASURED = RigMeasurement(
    press_n=1.0, wrench_age_s=0.01, moved_mm=0.01, width_change_mm=0.0, holding=True,
    devices_ready=True,
)  # fmt: skip
JIG = JigEvidence(from_jig_mm=0.1, moved_mm=0.01, force_n=0.5, holding=True)
BAD = {
    "press_n": ("RIG-NOT-UNLOADED", (0.29, 2.01, -1.0)),
    "wrench_age_s": ("RIG-WRENCH-OLD", (0.051, -0.001)),
    "moved_mm": ("RIG-ARM-MOVING", (0.051, -0.1)),
    "width_change_mm": ("RIG-WIDTH", (0.31, -0.31)),
    "holding": ("RIG-NOT-HOLDING", (False,)),
    "devices_ready": ("RIG-DEVICES", (False,)),
}
ONE_BAD = [(name, value, row) for name, (row, values) in BAD.items() for value in values] + [
    (name, value, row)
    for name, (row, _) in BAD.items()
    if name not in ("holding", "devices_ready")
    for value in (math.nan, math.inf, -math.inf)
]


def test_with_all_conditions_it_opens():
    refuse_opening(TOLD, MEASURED)
    refuse_opening(JIG, replace(MEASURED, press_n=math.nan, wrench_age_s=math.nan))


@pytest.mark.promise("G7")
@pytest.mark.parametrize(("name", "value", "row"), ONE_BAD)
def test_one_bad_measurement_refuses_by_its_own_name(name, value, row):
    assert reason(refuse_opening, TOLD, replace(MEASURED, **{name: value})) == row


def test_the_operator_may_drop_a_piece_from_an_arm_that_stands():
    unknown = RigMeasurement(math.nan, math.nan, 0.0, math.nan, holding=True, devices_ready=False)
    refuse_opening(ByHand(confirmed=True), unknown)
    assert reason(refuse_opening, ByHand(confirmed=False), unknown) == "NOT-CONFIRMED"
    assert (
        reason(refuse_opening, ByHand(confirmed=True), replace(unknown, moved_mm=1.0))
        == "RIG-ARM-MOVING"
    )


CASES = 2000
SENSELESS = (math.nan, math.inf, -math.inf, 1e308, -1e308)
STILL = (0.0, 0.0, 0.0)
ORDERS = {
    "arm.move_to": {"target": (0.0, 0.0, 100.0, *STILL), "speed_mm_s": 20.0, "turn_rad_s": 0.1},
    "arm.jog": {"velocity_mm_s": (0.0, 0.0, 5.0), "for_s": 0.1, "turn_rad_s": STILL},
    "arm.jog_joints": {"speeds_rad_s": (0.01,) * 6, "for_s": 0.1},
    "arm.move_joints": {"target_rad": tuple(READY_RAD), "speed_rad_s": 0.1},
    "arm.press": {
        "depth_mm": 1.5, "ramp_s": 1.5, "hold_s": 2.0, "approach_mm_s": 2.0, "threshold_n": 1.0,
        "max_travel_mm": 3.0, "stiffness_n_mm": (30.0, 30.0, 15.0),
    },
    "arm.unload": {"force_n": 1.0, "speed_mm_s": 2.0},
}  # fmt: skip


def spoilt(given, rng):
    """The same with one number that makes no sense."""
    name = rng.choice(sorted(given))
    bad, value = rng.choice(SENSELESS), given[name]
    if isinstance(value, tuple):
        place = rng.randrange(len(value))
        return {**given, name: (*value[:place], bad, *value[place + 1 :])}
    return {**given, name: bad}


@pytest.mark.promise("P1")
def test_no_order_with_a_senseless_number_moves_anything(rig):
    rng, before = random.Random(1), rig.arm.describe()["z_mm"]
    sent, taken = len(rig.arms.wires.packets), []
    for _ in range(CASES):
        order = rng.choice(sorted(ORDERS))
        given = spoilt(ORDERS[order], rng)
        rig.said.clear()
        try:
            rig.order(order, **given)
        except (TouchdownError, ValueError):
            continue
        taken.append((order, given))
    assert taken == []
    rig.rounds(0.1)
    targets = [decode_mxt_request(data).target for _, data in rig.arms.wires.packets[sent:]]
    assert len(targets) > 10
    assert all(np.isfinite(target.axes).all() for target in targets if target is not None)
    assert rig.arm.describe()["z_mm"] == before


@pytest.mark.promise("G7", "P1")
def test_no_right_with_a_senseless_number_or_without_a_condition_lets_go():
    rng, numbers = random.Random(2), [f.name for f in fields(TOLD) if f.type == "float"]
    felt = ["press_n", "wrench_age_s", "moved_mm", "width_change_mm"]
    conditions = [f.name for f in fields(TOLD) if f.type == "bool"]
    # What only makes the condition easier to meet, or a wider limit, is no number out of sense.
    harmless = {"margin_mm": {1e308}, "required_margin_mm": {-math.inf, -1e308, -1.0},
                "wrench_age_limit_s": {math.inf, 1e308}}  # fmt: skip
    for _ in range(CASES):
        bad, told, measured = rng.choice((*SENSELESS, -1.0)), TOLD, MEASURED
        name = rng.choice([*numbers, *felt, *conditions])
        if bad in harmless.get(name, ()):
            continue
        if name in felt and rng.random() < 0.5:
            measured = replace(MEASURED, **{name: bad})
        else:
            told = replace(TOLD, **{name: False if name in conditions else bad})
        with pytest.raises(RefusedError):
            refuse_opening(told, measured)


def test_a_rig_that_is_told_to_end_names_itself_in_every_motion(rig, monkeypatch):
    closing = CommandedMotion({"width_mm": 30.0})
    monkeypatch.setattr(rig.gripper, "grip", lambda *given: closing, raising=False)
    monkeypatch.setattr(rig.gripper, "stop", lambda: closing.end(stopped_fault("gripper")))
    motions = [rig.order("gripper.grip", force_n=10.0), rig.lift()]
    rig.host.leave()
    assert rig.rounds(0.1)
    assert [rig.fault_of(motion).code for motion in motions] == ["CONTROL-LOST"] * 2
