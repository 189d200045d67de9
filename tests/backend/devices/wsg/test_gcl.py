"""GCL: forms that clients use, and lines that are none."""

import pytest

from tests.backend.devices.codecs.vectors import data
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.wsg import gcl


def test_a_width_in_mm_is_sent_without_an_exponent():
    assert gcl.encode(gcl.GclCall("MOVE", (1e-05, 100.5))) == b"MOVE(0.00001,100.5)\n"


def test_an_error_may_carry_a_text():
    assert gcl.decode(b"ERR MOVE 29 axis blocked") == gcl.GclError("MOVE", 29, "axis blocked")


def test_text_answers_stay_as_they_stand():
    assert gcl.decode(b"VERSION=4.0.1") == gcl.GclAssignment("VERSION", "4.0.1")
    assert gcl.decode(b'TAG="left"') == gcl.GclAssignment("TAG", '"left"')


def test_acknowledge_and_end_in_one_segment_are_two_messages():
    out = gcl.lines().feed(data("gcl-move-ack") + data("gcl-move-fin"))
    assert out == [gcl.GclAnswer("ACK", "MOVE"), gcl.GclAnswer("FIN", "MOVE")]


def test_carriage_returns_are_taken():
    assert gcl.lines().feed(b"FIN GRIP\r\n") == [gcl.GclAnswer("FIN", "GRIP")]


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"move(40)",
        b"MOVE(40",
        b"MOVE(40,)x",
        b"MOVE(4 0)",
        b"ACK",
        b"ERR MOVE",
        b"\xff\xfe",
        b"POS ?",
    ],
)
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
