"""How an alarm of the controller is got rid of."""

import threading

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.protocols import DeviceState


def test_an_alarm_that_refused_a_connection_is_reset_by_the_next_and_no_other():
    """R8: by an explicit order, never while the emergency stop is pressed."""
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    controller = rig.device.controller
    controller.press_emergency_stop(61)
    rig.rest(0.35)
    assert rig.arm.fault.code == "HW-STOP"
    for _ in range(2):
        with pytest.raises(FaultError, match=r"error 61.*Connecting once more.*resets"):
            rig.arm.connect(1.0, threading.Event())
        assert controller.error == 61
    controller.release_emergency_stop()
    controller.raise_error(2601)  # nobody was told of this one
    with pytest.raises(FaultError, match="error 2601"):
        rig.arm.connect(1.0, threading.Event())
    assert controller.error == 2601
    here_mm = rig.true_mm.copy()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    assert (controller.error, rig.arm.state) == (0, DeviceState.READY)
    assert np.abs(rig.true_mm - here_mm).max() < 0.01
