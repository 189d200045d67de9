"""A gripper with any of its fault flags moves on nobody's word before the operator's."""

import pytest

from tests.backend.devices.wsg.stepped import Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.wsg.protocol import SystemFlag, WsgCommand

FLAGS = (
    SystemFlag.FAST_STOP,
    SystemFlag.TEMP_FAULT,
    SystemFlag.POWER_FAULT,
    SystemFlag.CURR_FAULT,
    SystemFlag.FINGER_FAULT,
)
MOTIONS = {WsgCommand.HOME, WsgCommand.PREPOSITION, WsgCommand.GRASP, WsgCommand.RELEASE}


@pytest.mark.promise("G2")
@pytest.mark.parametrize("flag", FLAGS)
def test_no_motion_is_sent_while_a_flag_is_not_acknowledged(flag):
    bench = Bench()
    bench.held()
    bench.gripper.jaws.flags |= flag
    bench.advance(0.3)
    assert bench.core.fault.code in ("WSG-FAST-STOP", "WSG-DEVICE")
    bench.sent.clear()
    core = bench.core
    orders = (
        lambda: core.grip(bench.now_s, 10.0),
        lambda: core.open_to(bench.now_s, 38.0, 50.0),
        lambda: core.home(bench.now_s),
    )
    for order in orders:
        with pytest.raises(FaultError):
            order()
    bench.advance(1.0)
    assert not MOTIONS & {request.command for request in bench.sent}
    # The cause has gone; the operator has looked at the piece.
    bench.gripper.jaws.flags &= ~flag
    bench.send(core.acknowledge())
    bench.advance(0.3)
    assert core.fault is None
    assert not MOTIONS & {request.command for request in bench.sent}
    bench.held()
