"""STOP that comes between two requests of the command channel, by a hand-wound clock."""

import threading

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.stop_meets import interrupted, still
from tests.backend.devices.melfa.trials import PRESS
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.values import Pose


def connected(**more):
    rig = Rig(**more)
    rig.noise_n = 0.05
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.3)
    return rig


@pytest.mark.promise("R14")
@pytest.mark.parametrize("request_", ["VAL MDKZ", "RUN TDPROBE;1"])
def test_a_force_program_that_is_being_prepared_does_not_begin(request_):
    rig = connected(stiffness_mode="controller")
    assert interrupted(rig, lambda: rig.arm.press(PRESS), request_) == "STOPPED"
    assert rig.device.controller.program == ""
    assert still(rig)


@pytest.mark.promise("R14")
def test_a_stream_that_is_being_opened_again_carries_no_motion():
    rig = connected()
    rig.arm.stop()
    rig.rest(0.3)
    up = Pose(0.0, 0.0, 120.0)
    assert interrupted(rig, lambda: rig.arm.move_to(up, 20.0), "RUN TDMXT;1") == "STOPPED"
    assert rig.device.controller.program == ""
    assert still(rig)


@pytest.mark.promise("R14")
def test_motors_that_are_being_switched_on_stay_off():
    rig = connected()
    rig.arm.servo(False)
    assert interrupted(rig, lambda: rig.arm.servo(True), "CNTL ON") == "STOPPED"
    assert not rig.device.controller.servo
    with pytest.raises(FaultError, match="off"):
        rig.arm.move_to(Pose(0.0, 0.0, 120.0), 20.0)


def test_a_program_whose_stream_has_just_ended_does_not_wait_for_the_next():
    rig = connected()
    rig.arm._core.stop()
    motion = rig.arm._orders.travel(
        rig.arm._core, (np.array([0.0, 0.0, 120.0]), np.eye(3)), (20.0, 0.1)
    )
    assert motion.done
    assert rig.arm._core.program is None
