"""A support that stands too high: the way down through the air ends in a retreat, on its own.

A press begins 3 mm above where contact is expected. What comes earlier than that is met by a move,
which feels nothing by itself: the watch over the wrist draws the arm back.
"""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.streams import Stream
from touchdown.backend.core.values import FINGERS, Pose
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.supervision import Supervision

START_MM, BOARD_MM, WANTED_MM = 75.0, 68.0, 62.0
"""The board stands 6 mm above where the arm was sent to be still in air."""
GEL_N_MM = 8.0
ROUND_US = 10_500


@pytest.mark.promise("G4")
@pytest.mark.parametrize("speed_mm_s", [5.0, 20.0])
def test_contact_that_comes_too_early_ends_the_way_down_in_a_retreat(speed_mm_s: float) -> None:
    rig = Rig((0.0, 0.0, START_MM))
    rig.contact = lambda pivot: np.array([0.0, 0.0, GEL_N_MM * max(BOARD_MM - pivot[2], 0.0)])
    interlock = Interlock()
    now_s = rig.wires.clock.now_s
    arm = GuardedArm(rig.arm, interlock, now_s, lambda: 0.0)
    watch = Supervision(interlock, rig.wrench, {finger: Stream(finger, 4) for finger in FINGERS})
    arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    # No cameras here: within the grace after a scene began nobody asks for their pictures.
    watch.begin(now_s() + 100.0)
    interlock.renew_lease(now_s())
    motion = arm.move_to(Pose(0.0, 0.0, WANTED_MM), speed_mm_s)
    lowest_mm = START_MM
    while not motion.done:
        rig.wires.advance(ROUND_US)
        watch.check(now_s())
        lowest_mm = min(lowest_mm, float(rig.true_mm[2]))
        assert now_s() < 30.0
    with pytest.raises(FaultError):
        motion.result()
    assert [fault.code for fault in interlock.faults] == ["FT-TRIP"]
    assert lowest_mm > WANTED_MM
    peak_n = float(rig.wrench.since(0).values[:, 2].max())
    # 40 N trip; what is gone meanwhile stays below what would trip at once.
    assert 40.0 < peak_n < 60.0
    rig.rest(1.0)
    assert rig.true_mm[2] == pytest.approx(lowest_mm + 2.0, abs=0.4)
    assert rig.wrench.latest(now_s(), 0.01)[1][2] < peak_n - 10.0
    before = rig.true_mm[2]
    rig.rest(0.5)
    assert rig.true_mm[2] == pytest.approx(before, abs=0.01)


@pytest.mark.parametrize(("press_n", "why"), [(math.nan, "FT-UNKNOWN"), (3.0, "DRAGGING")])
def test_nothing_moves_sideways_without_a_number_of_the_wrist(press_n: float, why: str) -> None:
    rig = Rig((0.0, 0.0, START_MM))
    interlock = Interlock()
    arm = GuardedArm(rig.arm, interlock, rig.wires.clock.now_s, lambda: press_n)
    arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    interlock.renew_lease(rig.wires.clock.now_s())
    before_mm = rig.true_mm.copy()
    with pytest.raises(RefusedError) as refused:
        arm.move_to(Pose(3.0, 0.0, START_MM), 20.0)
    assert refused.value.reason == why
    rig.rest(0.2)
    assert rig.true_mm == pytest.approx(before_mm, abs=0.01)
