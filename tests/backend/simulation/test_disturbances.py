"""Faults on demand: the text form, and what bad texts say."""

from __future__ import annotations

import pytest

from backend.core.faults import InputError
from backend.simulation.disturbances import Disturbance, parse_disturbance, parse_script


def test_text_is_read():
    assert parse_disturbance("tactile_right:stop@2.5+1.0") == Disturbance(
        "tactile_right", "stop", 2.5, 1.0
    )
    assert parse_disturbance(" force_torque:nan@4 ").length_s == float("inf")


def test_active_from_start_to_end_only():
    script = parse_script(["tactile_left:freeze@3.0+0.5", "arm:stall@1"])
    assert not script.active("tactile_left", "freeze", 2.99)
    assert script.active("tactile_left", "freeze", 3.0)
    assert not script.active("tactile_left", "freeze", 3.5)
    assert not script.active("tactile_left", "stop", 3.2)
    assert not script.active("tactile_right", "freeze", 3.2)
    assert script.active("arm", "stall", 1e6)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "tactile_left",
        "tactile_left:freeze",
        "tactile_left:freeze@",
        "tactile_left:freeze@-1",
        "tactile_left:freeze@nan",
        "tactile_left:freeze@1+",
        "camera:freeze@1",
        "gripper:freeze@1",
        "arm:stall@1;arm:stall@2",
    ],
)
def test_bad_text_is_one_clear_error(text):
    with pytest.raises(InputError) as raised:
        parse_disturbance(text)
    assert raised.value.where == text
    assert raised.value.fix
