"""What the WSG driver decides, on a hand-wound clock against the emulated gripper: no wire."""

import struct

import pytest

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.wsg.stepped import PART_MM, Bench
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.framing import ProtocolError, crc_wsg
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.protocol import WsgCommand, WsgRequest, WsgStatus

both = pytest.mark.parametrize("language", ["binary", "gcl"])


def code_of(motion):
    with pytest.raises(FaultError) as raised:
        motion.result()
    return raised.value.fault.code


@pytest.mark.parametrize(("convention", "sum_n"), [("device", 20.0), ("finger", 10.0)])
def test_force_is_per_finger_and_the_wire_carries_what_the_gripper_takes(convention, sum_n):
    bench = Bench(force_convention=convention)
    status = bench.held()
    assert WsgRequest(WsgCommand.SET_FORCE_LIMIT, (sum_n,)) in bench.sent
    assert (status.width_mm, status.force_n, status.holding) == (PART_MM, 10.0, True)


def test_the_force_is_set_before_the_jaws_close_and_read_after():
    bench = Bench()
    bench.sent.clear()
    bench.held()
    assert [request.command for request in bench.sent] == [
        WsgCommand.SET_FORCE_LIMIT,
        WsgCommand.GRASP,
        WsgCommand.GRASP_STATE,
        WsgCommand.WIDTH,
        WsgCommand.FORCE,
    ]


def test_a_force_beyond_the_gripper_is_sent_as_its_limit_and_told():
    bench = Bench()
    assert bench.order(bench.core.grip, 200.0).sent == {"force_n": 25.0}


@both
@pytest.mark.parametrize(
    ("given", "code"), [({"part_mm": None}, "WSG-NO-PART"), ({"homed": False}, "WSG-NOT-HOMED")]
)
def test_a_grip_without_a_piece_or_before_homing_fails_by_name(language, given, code):
    bench = Bench(protocol=language, **given)
    assert code_of(bench.end(bench.order(bench.core.grip, 10.0))) == code
    assert not bench.core.status.holding


def test_a_held_piece_is_released_and_empty_jaws_are_positioned():
    bench = Bench()
    bench.held()
    opening = bench.end(bench.order(bench.core.open_to, 44.0, 5.0))
    opening.result()
    assert opening.sent == {"width_mm": 44.0, "speed_mm_s": 5.0}
    assert WsgCommand.RELEASE in [request.command for request in bench.sent]
    bench.end(bench.order(bench.core.open_to, 60.0, 100.0)).result()
    assert bench.sent[-4].command == WsgCommand.PREPOSITION
    assert bench.core.status.width_mm == pytest.approx(60.0)


@both
def test_stop_ends_a_motion_and_is_not_sent_to_jaws_that_hold(language):
    bench = Bench(protocol=language)
    motion = bench.order(bench.core.grip, 10.0)
    bench.advance(0.1)
    bench.send(bench.core.stop())
    assert bench.sent[-1].command == WsgCommand.STOP
    assert code_of(motion) == "STOPPED"
    bench.advance(0.3)
    bench.held()
    bench.advance(0.3)
    assert bench.core.stop() == []
    assert bench.core.status.holding


def test_a_newer_command_stops_the_older_one_first():
    bench = Bench(part_mm=None)
    first = bench.order(bench.core.open_to, 10.0, 20.0)
    bench.advance(0.2)
    bench.sent.clear()
    second = bench.order(bench.core.open_to, 50.0, 50.0)
    assert code_of(first) == "REPLACED"
    assert [request.command for request in bench.sent[:2]] == [
        WsgCommand.STOP,
        WsgCommand.PREPOSITION,
    ]
    bench.end(second).result()
    assert bench.core.status.width_mm == pytest.approx(50.0)


@both
@pytest.mark.promise("G2")
@pytest.mark.parametrize(
    ("kind", "code"), [("fast_stop", "WSG-FAST-STOP"), ("power", "WSG-DEVICE")]
)
def test_nothing_is_commanded_until_a_fault_is_acknowledged(kind, code, language):
    bench = Bench(protocol=language)
    motion = bench.order(bench.core.grip, 10.0)
    bench.faults.inject(bench.now_s, kind, 0.1)
    bench.advance(0.4)
    assert code_of(motion) in (code, "WSG-ABORTED")
    assert bench.core.fault.code == code
    bench.sent.clear()
    with pytest.raises(FaultError):
        bench.core.grip(bench.now_s, 10.0)
    assert bench.sent == []
    bench.send(bench.core.acknowledge())
    bench.advance(0.5)
    assert bench.core.fault is None
    bench.held()


@both
def test_a_motion_that_never_ends_is_stopped_at_its_deadline(language):
    bench = Bench(protocol=language, part_mm=None)
    motion = bench.order(bench.core.open_to, 10.0, 50.0)
    bench.gripper.jaws.motion = None
    bench.advance(5.0)
    assert code_of(motion) == "WSG-TIMEOUT"
    assert WsgRequest(WsgCommand.STOP) in bench.sent


@both
def test_silence_is_a_lost_link(language):
    bench = Bench(protocol=language)
    bench.held()
    bench.deaf = True
    bench.advance(1.9)
    assert bench.core.fault is None
    bench.advance(0.3)
    assert bench.core.fault.code == "WSG-LINK"


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
    assert decoder.feed(data("wsg-stop")) == [WsgRequest(WsgCommand.STOP)]
    assert decoder.bad_in_a_row == 0


def test_a_false_header_in_one_segment_costs_no_request():
    noise = b"\xaa\xaa\xaa\x06\x40\x00"
    requests = [protocol.grasp(20, 30), *[WsgRequest(WsgCommand.STOP)] * 9]
    out = protocol.requests().feed(noise + b"".join(map(protocol.encode_request, requests)))
    assert [m for m in out if isinstance(m, WsgRequest)] == requests


def test_a_false_header_that_promises_much_does_not_hold_up_the_replies():
    decoder = protocol.replies()
    assert decoder.feed(b"\xaa\xaa\xaa\x06\x00\x01") == []
    assert decoder.feed(data("wsg-width-reply")) == []
    assert [r.values for r in decoder.feed(data("wsg-force-reply"))] == [(20.5,), (9.75,)]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e39])
def test_a_width_that_is_no_float_is_refused(value):
    with pytest.raises(ProtocolError):
        protocol.encode_request(protocol.grasp(value, 30))
    with pytest.raises(ProtocolError):
        protocol.encode_request(WsgRequest(WsgCommand.STOP, (1,)))
    with pytest.raises(ProtocolError):
        protocol.encode_request(WsgRequest(WsgCommand.LOOP, (bytes(257),)))


def text(**settings):
    return Bench(protocol="gcl", **settings)


def last(bench, call):
    return [line for line in b"".join(bench.said).splitlines() if line.startswith(call)][-1]


@pytest.mark.parametrize(("convention", "line"), [("device", b"20"), ("finger", b"10")])
def test_the_force_travels_with_the_grip(convention, line):
    bench = text(force_convention=convention)
    status = bench.held()
    assert last(bench, b"GRIP(") == b"GRIP(%b.0,0.0,50.0)" % line
    assert (status.width_mm, status.force_n, status.holding) == (PART_MM, 10.0, True)


@pytest.mark.parametrize(("counts", "line"), [("width", b"4.0"), ("finger", b"2.0")])
def test_a_release_opens_by_the_distance_that_the_gripper_takes(counts, line):
    bench = text(gcl_release=counts)
    bench.held()
    bench.end(bench.order(bench.core.open_to, PART_MM + 4.0, 5.0)).result()
    assert last(bench, b"RELEASE") == b"RELEASE(%b,5.0)" % line
    assert bench.core.status.width_mm == pytest.approx(PART_MM + 4.0)


@pytest.mark.parametrize("code", [status for status in WsgStatus if status not in (0, 11, 19, 26)])
def test_every_error_code_ends_the_motion_with_a_fault(code):
    bench = text()
    motion = bench.order(bench.core.grip, 10.0)
    bench.hear(b"ERR GRIP %d\r\n" % code)
    assert code_of(motion).startswith("WSG-")


def test_lines_may_come_torn_merged_and_with_a_carriage_return():
    bench = text()
    bench.language.take(b"GRIPST")
    bench.hear(b"ATE=4\r\nPOS=12.5\nFORCE=20")
    bench.hear(b".0\n")
    assert (bench.core.status.width_mm, bench.core.status.force_n) == (12.5, 10.0)
    assert bench.core.status.holding


@pytest.mark.promise("G1")
@pytest.mark.parametrize(
    ("language", "autosend", "within_s"),
    [("binary", True, 0.03), ("gcl", True, 0.06), ("gcl", False, 0.25)],
)
def test_a_lost_piece_is_seen_by_what_is_sent_or_else_by_asking(language, autosend, within_s):
    bench = Bench(protocol=language)
    bench.held()
    if not autosend:
        bench.mouth._auto.clear()
    bench.faults.inject(bench.now_s, "part_lost")
    bench.advance(within_s)
    assert not bench.core.status.holding
    assert (bench.core.lost_parts, bench.core.fault) == (1, None)
