"""Scripted faults: the text form, and the messages for bad texts."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.faults import InputError
from touchdown.backend.core.streams import Decimator
from touchdown.backend.emulation.disturbances import Disturbance, parse_disturbance, parse_script


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


def test_a_slow_sensor_has_its_rate_and_takes_the_first_sample_of_each_period():
    script = parse_script(["force_torque:slow=300@1+2"])
    assert [script.rate_hz("force_torque", t_s) for t_s in (0.9, 1.0, 2.9, 3.0)] == [
        None,
        300.0,
        300.0,
        None,
    ]
    thinned = Decimator()
    taken = [k for k in range(1000) if thinned.takes(1.0 + 0.001 * k, 300.0)]
    assert len(taken) == 300
    assert set(np.diff(taken)) == {3, 4}
    assert sum(thinned.takes(5.0 + 0.04 * k, 40.0) for k in range(25)) == 25, "it is no faster"


def test_a_turn_comes_once_in_the_cycle_of_its_time():
    script = parse_script(["gripper:turn=3@2.005"])
    turned = [script.turn_rad(0.01 * k, 0.01 * (k + 1)) for k in range(300)]
    assert np.flatnonzero(turned).tolist() == [200]
    assert sum(turned) == pytest.approx(np.radians(3.0))


def test_a_drift_grows_as_told_and_stays():
    script = parse_script(["force_torque:drift=0.05@2+4", "force_torque:drift=0.1@4"])
    assert [script.drift_n(t_s) for t_s in (0.0, 2.0, 4.0, 5.0, 10.0)] == pytest.approx(
        [0.0, 0.0, 0.1, 0.25, 0.8]
    )


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
        "force_torque:slow@1",
        "force_torque:slow=0@1",
        "force_torque:nan=5@1",
        "arm:slow=5@1",
        "force_torque:drift@1",
        "tactile_left:drift=0.1@1",
    ],
)
def test_bad_text_is_one_clear_error(text):
    with pytest.raises(InputError) as raised:
        parse_disturbance(text)
    assert raised.value.where == text
    assert raised.value.fix
