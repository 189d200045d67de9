"""MXT and monitor: what is refused, and where each monitored block lies."""

import hashlib
import struct

import pytest

from tests.backend.devices.codecs.codecs import MONITOR_KINDS
from tests.backend.devices.codecs.vectors import VECTORS, data
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa import realtime_protocol
from touchdown.backend.devices.melfa.realtime_protocol import AxisValues, BlockKind, MelfaPose

JOINTS = AxisValues(BlockKind.JOINT, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.0))


@pytest.mark.parametrize("name", [n for n, v in VECTORS.items() if "sha1" in v])
def test_encoded_packets_have_the_published_digest(name):
    ask = VECTORS[name]["direction"] == "pc-to-device"
    if ask:
        content = realtime_protocol.encode_mxt_request(
            realtime_protocol.decode_mxt_request(data(name))
        )
    else:
        content = realtime_protocol.encode_mxt_reply(realtime_protocol.decode_mxt_reply(data(name)))
    assert hashlib.sha1(content).hexdigest() == VECTORS[name]["sha1"]


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_target_that_is_no_number_is_never_sent(bad):
    target = AxisValues(BlockKind.JOINT, (bad, *JOINTS.axes[1:]))
    with pytest.raises(ProtocolError):
        realtime_protocol.encode_mxt_request(
            realtime_protocol.MxtRequest(realtime_protocol.MxtCommand.MOVE, target)
        )
    content = bytearray(data("mxt-move-joint"))
    content[8:12] = struct.pack("<f", bad)
    with pytest.raises(ProtocolError) as refusal:
        realtime_protocol.decode_mxt_request(bytes(content))
    assert (refusal.value.what, refusal.value.offset) == ("number", 8)


@pytest.mark.parametrize(("slot", "at"), [(0, 4), (1, 64), (2, 108), (3, 152)])
def test_an_unknown_monitor_type_is_refused_where_it_stands(slot, at):
    content = bytearray(data("mxt-reply-joint"))
    content[at : at + 2] = (12).to_bytes(2, "little")
    with pytest.raises(ProtocolError) as refusal:
        realtime_protocol.decode_mxt_reply(bytes(content))
    assert (refusal.value.what, refusal.value.offset) == ("type", at)


def test_an_unknown_command_is_refused():
    with pytest.raises(ProtocolError):
        realtime_protocol.decode_mxt_reply(b"\x02" + data("mxt-reply-joint")[1:])


def test_a_target_of_a_kind_that_cannot_be_sent():
    current = AxisValues(BlockKind.CURRENT, (1, 2, 3, 4, 5, 6, 7, 8))
    with pytest.raises(ProtocolError):
        realtime_protocol.encode_mxt_request(
            realtime_protocol.MxtRequest(realtime_protocol.MxtCommand.MOVE, current)
        )


def test_a_reply_whose_blocks_do_not_fit_its_types():
    with pytest.raises(ProtocolError):
        realtime_protocol.encode_mxt_reply(
            realtime_protocol.MxtReply(
                realtime_protocol.MxtCommand.MOVE, 1, (1, 0, 0, 0), (JOINTS, None, None, None), 1
            )
        )


@pytest.mark.parametrize("counter", [-1, 2**32])
def test_a_counter_wraps_in_the_caller(counter):
    with pytest.raises(ProtocolError):
        realtime_protocol.encode_mxt_request(
            realtime_protocol.MxtRequest(realtime_protocol.MxtCommand.NONE, counter=counter)
        )


def test_reserved_bytes_of_a_controller_are_not_held_against_it():
    content = bytearray(data("mxt-reply-joint"))
    content[6:8] = content[66:68] = b"\x12\x34"
    assert realtime_protocol.decode_mxt_reply(bytes(content)) == realtime_protocol.decode_mxt_reply(
        data("mxt-reply-joint")
    )


def test_an_unnamed_data_type_of_the_monitor_is_refused():
    content = data("monitor-stream-force-robmon-pose-float8")
    kinds = {number: kind for number, kind in MONITOR_KINDS.items() if number != 903}
    with pytest.raises(ProtocolError) as refusal:
        realtime_protocol.decode_monitor_reply(content, kinds)
    assert refusal.value.what == "type"


def test_a_pose_carries_its_flags_back_unchanged():
    pose = MelfaPose((1.0, 2.0, 3.0, 0.5, 0.25, -0.5, 0.0, 0.0), 6, 0x00F0_000E)
    request = realtime_protocol.MxtRequest(realtime_protocol.MxtCommand.MOVE, pose)
    assert (
        realtime_protocol.decode_mxt_request(realtime_protocol.encode_mxt_request(request)).target
        == pose
    )
