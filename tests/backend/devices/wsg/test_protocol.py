"""WSG binary: named commands, refusals for the gripper side, and what noise cannot do."""

import struct

import pytest

from tests.backend.devices.codecs.vectors import data
from touchdown.backend.devices.framing import ProtocolError, crc_wsg
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import (
    GraspState,
    SystemFlag,
    WsgCommand,
    WsgRequest,
    WsgStatus,
)


@pytest.mark.parametrize(
    ("name", "request_"),
    [
        ("wsg-home-default", protocol.home()),
        ("wsg-preposition-clamp", protocol.preposition(50, 100)),
        ("wsg-preposition-stop-on-block", protocol.preposition(50, 100, stop_on_block=True)),
        ("wsg-preposition-relative", protocol.preposition(-5, 20, relative=True)),
        ("wsg-grasp", protocol.grasp(20, 30)),
        ("wsg-release", protocol.release(60, 100)),
        ("wsg-ack-fast-stop", protocol.acknowledge()),
        ("wsg-set-force-limit", protocol.set_force_limit(10)),
        ("wsg-set-acceleration", WsgRequest(WsgCommand.SET_ACCELERATION, (500,))),
        ("wsg-width-50ms", protocol.update(WsgCommand.WIDTH, 50)),
        ("wsg-width-once", protocol.update(WsgCommand.WIDTH)),
        ("wsg-grasp-state-on-change", protocol.update(WsgCommand.GRASP_STATE, 20, on_change=True)),
    ],
)
def test_named_commands_are_the_published_bytes(name, request_):
    assert protocol.encode_request(request_) == data(name)


def frame(command, payload):
    body = b"\xaa\xaa\xaa" + struct.pack("<BH", command, len(payload)) + payload
    return body + crc_wsg(body).to_bytes(2, "little")


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (WsgCommand.STOP, b"\x01", WsgStatus.NO_PARAM_EXPECTED),
        (WsgCommand.GRASP, b"\x00" * 7, WsgStatus.CMD_FORMAT_ERROR),
        (WsgCommand.GRASP, b"", WsgStatus.CMD_FORMAT_ERROR),
        (WsgCommand.GRASP, struct.pack("<ff", float("nan"), 1), WsgStatus.CMD_FORMAT_ERROR),
    ],
)
def test_what_cannot_be_carried_out_names_the_answer(command, payload, status):
    out = protocol.requests().feed(frame(command, payload))
    assert out == [protocol.WsgRefusal(command, status)]


def test_a_bad_crc_is_answered_and_counted():
    spoilt = bytearray(data("wsg-grasp"))
    spoilt[8] ^= 4
    decoder = protocol.requests()
    assert decoder.feed(bytes(spoilt)) == [
        protocol.WsgRefusal(WsgCommand.GRASP, WsgStatus.CHECKSUM_ERROR)
    ]
    assert decoder.bad_frames == 1
    assert decoder.feed(data("wsg-stop")) == [protocol.WsgRequest(WsgCommand.STOP)]
    assert decoder.bad_in_a_row == 0


def test_a_false_header_in_one_segment_costs_no_request():
    noise = b"\xaa\xaa\xaa\x06\x40\x00"
    requests = [protocol.grasp(20, 30), *[protocol.WsgRequest(WsgCommand.STOP)] * 9]
    out = protocol.requests().feed(noise + b"".join(map(protocol.encode_request, requests)))
    assert [m for m in out if isinstance(m, protocol.WsgRequest)] == requests


def test_an_unknown_command_reaches_the_gripper():
    request = protocol.WsgRequest(0x90, (b"\x01\x02",))
    assert protocol.requests().feed(protocol.encode_request(request)) == [request]


def test_a_result_may_come_between_updates_in_one_segment():
    names = ["wsg-grasp-pending", "wsg-width-reply", "wsg-force-reply", "wsg-grasp-ok"]
    out = protocol.replies().feed(b"".join(map(data, names)))
    assert [reply.command for reply in out] == [0x25, 0x43, 0x45, 0x25]
    assert [reply.status for reply in out] == [WsgStatus.CMD_PENDING, 0, 0, 0]


def test_a_false_header_that_promises_much_does_not_hold_up_the_replies():
    decoder = protocol.replies()
    assert decoder.feed(b"\xaa\xaa\xaa\x06\x00\x01") == []
    assert decoder.feed(data("wsg-width-reply")) == []
    assert [r.values for r in decoder.feed(data("wsg-force-reply"))] == [(20.5,), (9.75,)]


def test_flags_and_states_read_as_words():
    (state,) = protocol.replies().feed(data("wsg-state-reply-fast-stop"))
    assert SystemFlag(state.values[0]) == SystemFlag.REFERENCED | SystemFlag.FAST_STOP
    (grasp,) = protocol.replies().feed(data("wsg-grasp-state-lost"))
    assert GraspState(grasp.values[0]) is GraspState.PART_LOST


def test_an_unknown_status_stays_a_number():
    (reply,) = protocol.replies().feed(frame(WsgCommand.GRASP, struct.pack("<H", 4711)))
    assert reply.status == 4711


def test_temperature_is_in_degrees():
    (reply,) = protocol.replies().feed(frame(WsgCommand.TEMPERATURE, struct.pack("<Hh", 0, -55)))
    assert reply.values == (-5.5,)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39])
def test_a_width_that_is_no_float_is_refused(value):
    with pytest.raises(ProtocolError):
        protocol.encode_request(protocol.grasp(value, 30))
    with pytest.raises(ProtocolError):
        protocol.encode_request(protocol.WsgRequest(WsgCommand.STOP, (1,)))
    with pytest.raises(ProtocolError):
        protocol.encode_request(protocol.WsgRequest(WsgCommand.LOOP, (bytes(257),)))
