"""The watchdogs of the rig in virtual time: each row of their table, exactly at its limit."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.devices.interlock import Limits
from touchdown.backend.rig.safety import BACKEND_SILENT_S, Failsafe, FailsafeInput, FailsafeOutput

ROUND_S = 0.004
FOREVER = math.inf


def core():
    return Failsafe(0.0, Limits())


def reason(call):
    with pytest.raises(RefusedError) as caught:
        call()
    return caught.value.reason


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
