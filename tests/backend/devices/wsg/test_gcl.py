"""A gripper with any of its fault flags moves on nobody's word before the operator's."""

import pytest

from tests.backend.devices.wsg.stepped import Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.wsg import gcl
from touchdown.backend.devices.wsg.driver import DEVICE_FAULTS
from touchdown.backend.devices.wsg.protocol import SystemFlag, WsgCommand

FLAGS = (SystemFlag.FAST_STOP, *DEVICE_FAULTS)
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
    for order, *values in ((core.grip, 10.0), (core.open_to, 38.0, 50.0), (core.home,)):
        with pytest.raises(FaultError):
            order(bench.now_s, *values)
    bench.advance(1.0)
    assert not MOTIONS & {request.command for request in bench.sent}
    # The cause has gone; the operator has looked at the piece.
    bench.gripper.jaws.flags &= ~flag
    bench.send(core.acknowledge())
    bench.advance(0.3)
    assert core.fault is None
    assert not MOTIONS & {request.command for request in bench.sent}
    bench.held()


def test_a_width_in_mm_is_sent_without_an_exponent():
    assert gcl.encode(gcl.GclCall("MOVE", (1e-05, 100.5))) == b"MOVE(0.00001,100.5)\n"


def test_text_answers_stay_as_they_stand():
    assert gcl.decode(b"VERSION=4.0.1") == gcl.GclAssignment("VERSION", "4.0.1")
    assert gcl.decode(b'TAG="left"') == gcl.GclAssignment("TAG", '"left"')


BAD = b"|move(40)|MOVE(40|MOVE(40,)x|MOVE(4 0)|ACK|ERR MOVE|\xff\xfe|POS ?".split(b"|")


@pytest.mark.parametrize("line", BAD)
def test_other_lines_are_refused(line):
    with pytest.raises(ProtocolError):
        gcl.decode(line)


@pytest.mark.parametrize(
    "call",
    [
        gcl.GclCall("MOVE", (float("nan"),)),
        gcl.GclCall("MOVE", (1e300,)),
        gcl.GclCall("AUTOSEND", ('PO"S',)),
        gcl.GclCall("MOVE(1)\nHOME", ()),
        gcl.GclAnswer("NAK", "MOVE"),
    ],
)
def test_what_would_read_back_as_something_else_is_not_sent(call):
    with pytest.raises(ProtocolError):
        gcl.encode(call)
