"""How far, how fast and whether a hand may jog from where it is: rules without a bench."""

import numpy as np
import pytest

from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.interlock import (
    Limits,
    distance_to_limit_mm,
    fastest_mm_s,
    refuse_forced,
)

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
