"""R3: what may go out, how replies are told apart, angles, and the printed forms."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.backend.devices.codecs.vectors import data
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.melfa.r3_protocol import R3Request
from touchdown.backend.devices.melfa.realtime_protocol import MelfaPose, turns

NEVER = [
    "RSTPWR",
    "HOME",
    "DATINST",
    "AXDATINST",
    "BREAKON",
    "BREAKONF",
    "FINIT",
    "FDEL",
    "PRMINIT",
    "PRM=",
    "PAW=",
    "PAW2=",
    "PRMUNDO",
    "ERRLOGCLR",
]


@pytest.mark.parametrize("command", NEVER)
@pytest.mark.parametrize("argument", ["", "1", "ON", "MXT;1;2"])
def test_forbidden_commands_cannot_be_encoded(command, argument):
    with pytest.raises(ProtocolError):
        r3_protocol.encode_request(R3Request(command, argument))
    with pytest.raises(ProtocolError):
        r3_protocol.decode_request(f"1;1;{command}{argument}".encode())


@given(st.sampled_from(sorted(r3_protocol.ALLOWED)), st.text(max_size=40), st.sampled_from(NEVER))
def test_no_allowed_command_smuggles_a_forbidden_one(command, text, forbidden):
    for argument in (text, f"{text}\r1;1;{forbidden}", f"\n{forbidden}", f";{forbidden}{text}"):
        try:
            content = r3_protocol.encode_request(R3Request(command, argument))
        except ProtocolError:
            continue
        assert b"\r" not in content
        assert b"\n" not in content
        assert content.isascii()
        assert not any(content.decode()[4:].startswith(word) for word in NEVER)
        assert len(content) <= 255


def test_direct_execution_takes_motions_only():
    assert r3_protocol.encode_request(R3Request("EXEC", "Mvs P1", 1, 9)) == b"1;9;EXECMvs P1"
    for argument in ("Dly 1", "M1=1", "Reset Err", "MovP1", "HLT", "Mov P1;RSTPWR"):
        with pytest.raises(ProtocolError):
            r3_protocol.encode_request(R3Request("EXEC", argument, 1, 9))


@pytest.mark.parametrize("override", ["0", "101", "050", "-5", "5.5", "", "\u0661\u0660"])
def test_an_override_outside_1_to_100_is_refused(override):
    with pytest.raises(ProtocolError):
        r3_protocol.encode_request(R3Request("OVRD=", override))


def test_a_missing_address_counts_as_one():
    assert r3_protocol.decode_request(b";;STATE") == R3Request("STATE")
    assert r3_protocol.decode_request(b"0;33;STOP") == R3Request("STOP", "", 0, 33)
    assert r3_protocol.decode_request(b"STOP") == R3Request("STOP", "", None, None)
    for address in (b"4;1;", b"1;34;", b"1;"):
        with pytest.raises(ProtocolError):
            r3_protocol.decode_request(address + b"STATE")


def test_jog_of_the_vectors():
    content = r3_protocol.encode_request(r3_protocol.jog(1, minus_axes=1, plus_axes=0))
    assert content == data("r3-jog-x-minus")


@pytest.mark.parametrize("end", [b"\r", b"\n", b"\r\n"])
def test_any_line_end_is_taken(end):
    decoder = r3_protocol.replies()
    out = decoder.feed(b"QoK50" + end + b"QeR6020" + end)
    assert [(r.ok, r.error, r.answer) for r in out] == [(True, 0, "50"), (False, 6020, "6020")]
    assert decoder.bad_frames == 0


def test_without_a_line_end_silence_ends_the_reply():
    decoder = r3_protocol.replies()
    assert decoder.feed(b"QoK") == []
    assert decoder.feed(b"50") == []
    assert decoder.flush() == [r3_protocol.R3Reply("QoK", "50")]
    assert decoder.flush() == []


def test_a_line_without_end_is_given_up_and_counted():
    decoder = r3_protocol.requests()
    decoder.feed(b"1;1;ERRORMES" + b"1" * 300)
    assert decoder.pending == 0
    assert decoder.feed(b"1\r1;1;STATE\r") == [R3Request("STATE")]
    assert decoder.bad_frames == 1


def test_degrees_become_rad_once():
    reading = r3_protocol.read_axes(r3_protocol.decode_reply(data("r3-pposf-reply")).answer)
    assert reading.values[:3] == (290.62, -0.09, 11.26)
    assert reading.values[3:6] == pytest.approx((-3.140545457, -0.004537856, 3.140370924), abs=1e-8)
    assert reading.values[6] == 0.0
    joints = r3_protocol.read_axes(r3_protocol.decode_reply(data("r3-jposf-reply")).answer)
    assert joints.values == pytest.approx(
        (0, math.pi / 18, 4 * math.pi / 9, 0, math.pi / 2, -1.745329e-4)
    )


@pytest.mark.parametrize(
    "name", ["r3-pposf-reply", "r3-pposf-reply-6axis", "r3-jposf-reply", "r3-jposf-reply-limit"]
)
def test_a_reading_prints_as_it_was_read(name):
    answer = r3_protocol.decode_reply(data(name)).answer
    assert r3_protocol.read_axes(answer).answer() == answer


@pytest.mark.parametrize("name", ["r3-val-reply", "r3-val-fscurd-reply", "r3-listp-reply"])
def test_a_variable_prints_as_it_was_read(name):
    answer = r3_protocol.decode_reply(data(name)).answer
    assert r3_protocol.read_variable(answer).answer() == answer


def test_states_print_as_they_were_read():
    answer = r3_protocol.decode_reply(data("r3-state-reply")).answer
    assert r3_protocol.read_state(answer).answer() == answer
    answer = r3_protocol.decode_reply(data("r3-dstate-reply")).answer
    assert r3_protocol.read_progress(answer).answer() == answer


def test_a_pose_survives_its_printed_form():
    pose = MelfaPose((350.0, -0.5, 400.25, math.pi, 0.0, -math.pi / 2, 0.0, 0.0), 7, 0)
    numbers = (350.0, -0.5, 400.25, 180.0, 0.0, -90.0)
    printed = r3_protocol.PositionVariable("P1", numbers, (7, 0)).answer()
    assert printed == "P1=(+350.00,-0.50,+400.25,+180.00,+0.00,-90.00)(7,0)"
    back = r3_protocol.read_variable(printed).pose()
    assert back.axes == pytest.approx(pose.axes)
    assert (back.flag1, back.flag2) == (7, 0)


def test_a_force_variable_is_a_wrench_and_not_degrees():
    force = r3_protocol.read_variable("P_FsCurD=(+0.12,-0.34,+9.87,+0.01,+0.02,+0.00)(0,0)")
    assert force.wrench() == ((0.12, -0.34, 9.87), (0.01, 0.02, 0.0))


def test_turn_counts():
    assert turns(15728640) == (0, 0, 0, 0, 0, -1, 0, 0)
    assert turns(0x8000_000E) == (-2, 0, 0, 0, 0, 0, 0, -8)


@pytest.mark.parametrize(
    "answer", ["", "X;1", "X;1;X;2;;7,0;100;0.00;00000000", "X;nan;;7,0;100;0.00;00000000", ";;;;"]
)
def test_other_position_texts_are_refused(answer):
    with pytest.raises(ProtocolError):
        r3_protocol.read_axes(answer)


def test_no_active_error():
    assert r3_protocol.read_error("") == (0, 0)
