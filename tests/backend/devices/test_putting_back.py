"""The jaws open on a held piece only over the jig, at rest, and free of force."""

from __future__ import annotations

from dataclasses import replace

import pytest

from touchdown.backend.devices.interlock import JigEvidence, jig_refusal

GOOD = JigEvidence(from_jig_mm=0.1, moved_mm=0.01, force_n=0.2, holding=True)
NAN = float("nan")


def test_at_rest_over_the_jig_the_piece_may_go() -> None:
    assert jig_refusal(GOOD) is None


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
def test_each_condition_refuses_alone(name, change) -> None:
    refusal = jig_refusal(replace(GOOD, **change))
    assert refusal is not None
    assert refusal[0] == name
