"""GCL: forms that clients use, and lines that are none."""

import pytest

from tests.backend.wire.vectors import data
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.wsg import protocol_gcl


def test_a_width_in_mm_is_sent_without_an_exponent():
    assert (
        protocol_gcl.encode(protocol_gcl.Call("MOVE", (1e-05, 100.5))) == b"MOVE(0.00001,100.5)\n"
    )


def test_an_error_may_carry_a_text():
    assert protocol_gcl.decode(b"ERR MOVE 29 axis blocked") == protocol_gcl.Failure(
        "MOVE", 29, "axis blocked"
    )


def test_text_answers_stay_as_they_stand():
    assert protocol_gcl.decode(b"VERSION=4.0.1") == protocol_gcl.Assignment("VERSION", "4.0.1")
    assert protocol_gcl.decode(b'TAG="left"') == protocol_gcl.Assignment("TAG", '"left"')


def test_acknowledge_and_end_in_one_segment_are_two_messages():
    out = protocol_gcl.lines().feed(data("gcl-move-ack") + data("gcl-move-fin"))
    assert out == [protocol_gcl.Answer("ACK", "MOVE"), protocol_gcl.Answer("FIN", "MOVE")]


def test_carriage_returns_are_taken():
    assert protocol_gcl.lines().feed(b"FIN GRIP\r\n") == [protocol_gcl.Answer("FIN", "GRIP")]


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
    with pytest.raises(WireError):
        protocol_gcl.decode(line)


@pytest.mark.parametrize(
    "call",
    [
        protocol_gcl.Call("MOVE", (float("nan"),)),
        protocol_gcl.Call("MOVE", (1e300,)),
        protocol_gcl.Call("AUTOSEND", ('PO"S',)),
        protocol_gcl.Call("MOVE(1)\nHOME", ()),
        protocol_gcl.Answer("NAK", "MOVE"),
    ],
)
def test_what_would_read_back_as_something_else_is_not_sent(call):
    with pytest.raises(WireError):
        protocol_gcl.encode(call)
