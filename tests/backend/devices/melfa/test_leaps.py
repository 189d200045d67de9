"""Steps that are too large never reach the controller, and many of them in a row are a fault."""

import threading

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.leaps import Leaping
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.melfa.realtime_protocol import MxtCommand, decode_mxt_request
from touchdown.backend.devices.protocols import DeviceState


@pytest.mark.promise("R7")
@pytest.mark.parametrize(("leaps", "told"), [(10, None), (11, "STEPS-TOO-LARGE")])
def test_more_than_ten_cut_steps_in_a_row_are_a_fault(leaps, told):
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    program = Leaping(np.array([0.0, 0.0, 5.0]), leaps)
    rig.arm._core.run(program)
    rig.rest(0.1)
    assert rig.device.controller.error == 0
    assert (rig.arm.fault and rig.arm.fault.code) == told
    assert rig.arm.state is (DeviceState.FAULT if told else DeviceState.READY)
    if told:
        with pytest.raises(FaultError, match="too large"):
            program.motion.result()
        assert decode_mxt_request(rig.wires.packets[-1][1]).command is MxtCommand.END
