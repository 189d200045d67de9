"""One number in two thousand orders and rights makes no sense: nothing moves, nothing is let go."""

import math
import random
from dataclasses import fields, replace

import numpy as np
import pytest

from tests.backend.rig.hosted import Hosted
from tests.backend.rig.test_release import MEASURED, TOLD
from touchdown.backend.core.faults import RefusedError, TouchdownError
from touchdown.backend.devices.melfa.emulated_controller import READY_RAD
from touchdown.backend.devices.melfa.realtime_protocol import decode_mxt_request
from touchdown.backend.rig.safety import refuse_opening

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


@pytest.fixture
def rig():
    made = Hosted()
    yield made.connected()
    made.close()


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
    harmless = {"margin_mm": {1e308}, "required_margin_mm": {-math.inf, -1e308},
                "wrench_age_limit_s": {math.inf, 1e308}}  # fmt: skip
    for _ in range(CASES):
        bad, told, measured = rng.choice(SENSELESS), TOLD, MEASURED
        name = rng.choice([*numbers, *felt, *conditions])
        if bad in harmless.get(name, ()):
            continue
        if name in felt and rng.random() < 0.5:
            measured = replace(MEASURED, **{name: bad})
        else:
            told = replace(TOLD, **{name: False if name in conditions else bad})
        with pytest.raises(RefusedError):
            refuse_opening(told, measured)
