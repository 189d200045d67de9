"""A wrist sensor at the end of its range while the arm presses: the arm draws back and stands."""

import threading

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.test_press import PRESS, TOUCH_MM
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.force_torque.reader import OVERLOAD
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock


@pytest.mark.promise("S7")
def test_an_overload_in_contact_draws_the_arm_back_by_2_mm():
    rig = Rig()
    rig.contact = lambda pivot: np.array([0.0, 0.0, 8.0 * max(TOUCH_MM - pivot[2], 0.0)])
    interlock = Interlock()
    arm = GuardedArm(rig.arm, interlock, rig.wires.clock.now_s, lambda: 0.0)
    arm.connect(1.0, threading.Event())
    rig.rest(0.7)
    interlock.renew_lease(rig.wires.clock.now_s())
    motion = arm.press(PRESS)
    for _ in range(8):
        interlock.renew_lease(rig.wires.clock.now_s())
        rig.rest(0.15)
    assert rig.true_mm[2] < TOUCH_MM - 0.1
    rig.contact = lambda pivot: np.full(3, np.nan)
    # So long until the fault is heard of.
    rig.rest(0.05)
    stood_mm = rig.true_mm[2]
    interlock.raise_fault(OVERLOAD)
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    rig.rest(0.35)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.1)
    assert rig.wires.stops == 0
    rig.rest(0.2)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.1)
