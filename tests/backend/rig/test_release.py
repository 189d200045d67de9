"""When the rig lets go of a piece: never with one condition false, missing or not finite."""

import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.devices.interlock import ByHand, JigEvidence, ReleaseEvidence
from touchdown.backend.rig.safety import RigMeasurement, refuse_opening

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


def refusal(right, measured):
    with pytest.raises(RefusedError) as caught:
        refuse_opening(right, measured)
    return caught.value.reason


def test_with_all_conditions_it_opens():
    refuse_opening(TOLD, MEASURED)
    refuse_opening(JIG, replace(MEASURED, press_n=math.nan, wrench_age_s=math.nan))


@pytest.mark.promise("G7")
@pytest.mark.parametrize(("name", "value", "row"), ONE_BAD)
def test_one_bad_measurement_refuses_by_its_own_name(name, value, row):
    assert refusal(TOLD, replace(MEASURED, **{name: value})) == row


NUMBERS = [f.name for f in fields(ReleaseEvidence) if f.type == "float"]


@pytest.mark.promise("G7")
@given(st.sampled_from(NUMBERS), st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1.0]))
def test_no_number_of_the_evidence_can_be_senseless(name, value):
    harmless = {
        ("margin_mm", 1e308),
        ("required_margin_mm", -1.0),
        ("required_margin_mm", -math.inf),
    }
    # A limit of the age that is too wide is of no use: the rig has one of its own.
    if (name, value) in harmless or (name == "wrench_age_limit_s" and value > 0):
        return
    assert refusal(replace(TOLD, **{name: value}), MEASURED)


@pytest.mark.promise("G7")
@given(st.sampled_from([f.name for f in fields(ReleaseEvidence) if f.type == "bool"]))
def test_no_condition_of_the_evidence_can_be_left_out(name):
    assert refusal(replace(TOLD, **{name: False}), MEASURED)


def test_the_operator_may_drop_a_piece_from_an_arm_that_stands():
    unknown = RigMeasurement(math.nan, math.nan, 0.0, math.nan, holding=True, devices_ready=False)
    refuse_opening(ByHand(confirmed=True), unknown)
    assert refusal(ByHand(confirmed=False), unknown) == "NOT-CONFIRMED"
    assert refusal(ByHand(confirmed=True), replace(unknown, moved_mm=1.0)) == "RIG-ARM-MOVING"
