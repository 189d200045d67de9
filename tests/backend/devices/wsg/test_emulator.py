"""The emulated WSG: immediate and final answers of every motion, updates, stops, lost part."""

import socket

import pytest

from tests.backend.devices.codecs.vectors import data
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.emulator import EmulatedGcl, EmulatedWsg
from touchdown.backend.devices.wsg.protocol import (
    GraspState,
    SystemFlag,
    WsgCommand,
    WsgReply,
    WsgRequest,
    WsgStatus,
    update,
)
from touchdown.backend.emulation.server import TcpServer

HOMED_S = 10.0


class Client:
    """Speaks to an emulated gripper without a wire."""

    def __init__(self, part_mm=None, homed=True):
        self.gripper, self.replies = EmulatedWsg(part_mm=part_mm), protocol.replies()
        if homed:
            self.send(0.0, protocol.home())
            assert self.wait(HOMED_S) == [WsgReply(WsgCommand.HOME, WsgStatus.SUCCESS)]

    def send(self, now_s, *requests):
        content = b"".join(map(protocol.encode_request, requests))
        return self.replies.feed(self.gripper.receive(now_s, content))

    def wait(self, now_s):
        return self.replies.feed(self.gripper.due(now_s))

    def read(self, now_s, command):
        (reply,) = self.send(now_s, WsgRequest(command, (0, 0)))
        return reply.values[0]


def test_a_motion_answers_twice_and_ends_when_it_really_ends():
    client = Client()
    assert client.send(10.0, protocol.preposition(46, 20)) == [
        WsgReply(WsgCommand.PREPOSITION, WsgStatus.CMD_PENDING)
    ]
    assert client.read(10.5, WsgCommand.WIDTH) == pytest.approx(56.0)
    assert client.read(10.5, WsgCommand.SYSTEM_STATE) & SystemFlag.MOVING
    assert client.wait(10.999) == []
    assert client.wait(11.001) == [WsgReply(WsgCommand.PREPOSITION, WsgStatus.SUCCESS)]
    assert client.read(11.1, WsgCommand.WIDTH) == 46.0


def test_before_homing_only_homing_is_allowed():
    client = Client(homed=False)
    assert client.send(0.0, protocol.grasp(20, 30)) == [
        WsgReply(WsgCommand.GRASP, WsgStatus.NOT_INITIALIZED)
    ]
    assert client.send(0.0, protocol.preposition(20, 30))[0].status == WsgStatus.NOT_INITIALIZED


def test_a_part_is_held_with_the_force_limit_and_may_be_lost():
    client = Client(part_mm=20.0)
    client.send(10.0, protocol.set_force_limit(10), protocol.grasp(20.5, 46))
    assert client.wait(11.1) == [WsgReply(WsgCommand.GRASP, WsgStatus.SUCCESS)]
    assert client.read(11.2, WsgCommand.GRASP_STATE) == GraspState.HOLDING
    assert client.read(11.2, WsgCommand.FORCE) == 10.0
    assert client.read(11.2, WsgCommand.WIDTH) == 20.0
    client.send(11.3, update(WsgCommand.GRASP_STATE, 20, on_change=True))
    assert client.wait(11.5) == []
    client.gripper.jaws.part_mm = None
    assert client.wait(11.6) == [WsgReply(WsgCommand.GRASP_STATE, 0, (GraspState.PART_LOST,))]
    assert client.read(11.7, WsgCommand.FORCE) == 0.0


def test_a_lost_part_is_back_after_its_fault_once_the_jaws_are_open():
    client = Client(part_mm=20.0)
    faults = client.gripper._faults
    faults.begin(0.0)
    client.send(10.0, protocol.grasp(20.5, 46))
    assert client.wait(11.1) == [WsgReply(WsgCommand.GRASP, WsgStatus.SUCCESS)]
    faults.inject(11.2, "part_lost", 1.0)
    client.wait(11.3)
    assert client.read(11.4, WsgCommand.GRASP_STATE) == GraspState.PART_LOST
    client.send(11.5, protocol.release(60, 400))
    client.wait(12.0)
    assert client.gripper.jaws.part_mm is None
    client.wait(12.3)
    assert client.gripper.jaws.part_mm == 20.0


def test_a_text_client_that_left_is_told_nothing_more():
    mouth = EmulatedGcl(EmulatedWsg())
    mouth.receive(0.0, b'HOME()\nAUTOSEND("POS",100,false)\n')
    assert b"POS=" in mouth.due(1.0)
    assert b"ACK BYE" in mouth.receive(1.05, b"BYE()\n")
    assert mouth.due(2.0) == b""


def test_a_text_client_reads_what_the_manual_lists():
    mouth = EmulatedGcl(EmulatedWsg(part_mm=20.0))
    mouth.receive(0.0, b"HOME()\n")
    mouth.due(9.0)

    def asked(line):
        return mouth.receive(20.0, line + b"\n").decode().splitlines()

    assert asked(b"TAG?") == ['TAG=""']
    assert asked(b'TAG="a"') == ['TAG="a"']
    assert asked(b"TAG?") == ['TAG="a"']
    assert asked(b"GRIPSTATS?") == ["GRIPSTATS=[0,0,0]"]
    mouth.receive(10.0, b"GRIP(10,20.5,46)\n")
    mouth.due(15.0)
    assert asked(b"GRIPSTATS?") == ["GRIPSTATS=[1,0,0]"]
    assert asked(b"FDATA[0]?") == ["FDATA[0]=10.0"]
    (flags,) = asked(b"SYSFLAGS?")
    assert flags.count(",") == 31
    assert asked(b"SYSFLAGS[0]?") == ["SYSFLAGS[0]=1"]
    assert asked(b"SYSFLAGS[99]?")[0].startswith("ERR SYSFLAGS ")


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        (b"MOVE(20,,)", "ERR MOVE 15"),
        (b"MOVE 20", "ERR MOVE 15"),
        (b'AUTOSEND("POS")', "ERR AUTOSEND 15"),
        (b"POS=3", "ERR POS 15"),
        (b"DANCE()", "ERR DANCE 14"),
        (b"DANCE?", "ERR DANCE 14"),
        (b"DANCE=1", "ERR DANCE 14"),
        (b"DANCE now", "ERR DANCE 14"),
        (b"D" * 250 + b"()", f"ERR {'D' * 32} 14"),
        (b"D" * 256, f"ERR {'D' * 32} 14"),
    ],
)
def test_a_line_of_no_known_form_is_refused_by_its_name(line, answer):
    mouth = EmulatedGcl(EmulatedWsg())
    assert mouth.receive(0.0, line + b"\n") == answer.encode() + b"\n"
    assert mouth.receive(0.1, b"VERBOSE=1\n" + line + b"\n").startswith(
        b"VERBOSE=1\n" + answer.encode() + b" cmd "
    )
    # What names nothing has no answer, and the next line has.
    assert mouth.receive(0.2, b"\x00?!\nSN?\n") == b"SN=12345\n"


def test_grasps_are_counted_until_they_are_reset():
    client = Client(part_mm=20.0)
    ask = WsgRequest(WsgCommand.STATISTICS, (1,))
    client.send(10.0, protocol.grasp(20.5, 46))
    client.wait(11.1)
    client.gripper.jaws.part_mm = None
    client.wait(11.2)
    assert client.send(11.3, ask) == [WsgReply(WsgCommand.STATISTICS, 0, (1, 0, 1))]
    assert client.send(11.4, ask) == [WsgReply(WsgCommand.STATISTICS, 0, (0, 0, 0))]


def test_without_a_part_grasp_fails():
    client = Client()
    client.send(10.0, protocol.grasp(20, 400))
    assert client.wait(11.0) == [WsgReply(WsgCommand.GRASP, WsgStatus.CMD_FAILED)]
    assert client.read(11.0, WsgCommand.GRASP_STATE) == GraspState.NO_PART_FOUND


def test_a_second_motion_is_refused_and_stop_ends_the_first():
    client = Client()
    client.send(10.0, protocol.preposition(10, 10))
    assert client.send(10.1, protocol.release(60, 10)) == [
        WsgReply(WsgCommand.RELEASE, WsgStatus.ALREADY_RUNNING)
    ]
    assert client.send(10.2, WsgRequest(WsgCommand.STOP)) == [
        WsgReply(WsgCommand.PREPOSITION, WsgStatus.CMD_ABORTED),
        WsgReply(WsgCommand.STOP, WsgStatus.SUCCESS),
    ]
    assert client.read(20.0, WsgCommand.WIDTH) == pytest.approx(64.0)


def test_a_block_ends_a_preposition():
    client = Client(part_mm=30.0)
    client.send(10.0, protocol.preposition(10, 100))
    assert client.wait(11.0) == [WsgReply(WsgCommand.PREPOSITION, WsgStatus.AXIS_BLOCKED)]
    assert client.read(11.0, WsgCommand.SYSTEM_STATE) & SystemFlag.BLOCKED_MINUS


def test_a_fast_stop_holds_until_it_is_acknowledged():
    client = Client()
    client.send(10.0, WsgRequest(WsgCommand.FAST_STOP))
    assert client.send(10.1, protocol.grasp(20, 30))[0].status == WsgStatus.ACCESS_DENIED
    assert client.send(10.2, WsgRequest(WsgCommand.ACKNOWLEDGE, (b"nak",)))[0].status == 15
    assert client.send(10.3, protocol.acknowledge()) == [WsgReply(WsgCommand.ACKNOWLEDGE, 0)]
    assert client.send(10.4, protocol.grasp(20, 30))[0].status == WsgStatus.CMD_PENDING


def test_only_an_announced_end_leaves_no_fast_stop():
    client = Client()
    client.send(10.0, WsgRequest(WsgCommand.DISCONNECT))
    assert client.send(10.0, WsgRequest(WsgCommand.TARE))[0].status == WsgStatus.ACCESS_DENIED
    client.gripper.closed(10.0)
    assert not client.read(10.1, WsgCommand.SYSTEM_STATE) & SystemFlag.FAST_STOP
    client.gripper.closed(10.2)
    assert client.read(10.3, WsgCommand.SYSTEM_STATE) & SystemFlag.FAST_STOP


def test_updates_keep_their_period_and_come_between_answers():
    client = Client()
    client.send(10.0, update(WsgCommand.WIDTH, 50))
    out = [reply for k in range(1, 101) for reply in client.wait(10.0 + 0.01 * k)]
    assert len(out) == pytest.approx(20, abs=1)
    assert client.send(11.0, update(WsgCommand.WIDTH))[0].command == WsgCommand.WIDTH
    assert client.wait(12.0) == []


def test_bad_and_unknown_requests_are_answered():
    client = Client()
    spoilt = bytearray(data("wsg-grasp"))
    spoilt[-1] ^= 1
    out = client.replies.feed(client.gripper.receive(10.0, bytes(spoilt)))
    assert out == [WsgReply(WsgCommand.GRASP, WsgStatus.CHECKSUM_ERROR)]
    unknown = client.replies.feed(
        client.gripper.receive(10.0, protocol.encode_request(WsgRequest(0x90)))
    )
    assert unknown == [WsgReply(0x90, WsgStatus.CMD_UNKNOWN)]


def test_limits_are_the_published_ones():
    client = Client()
    out = client.gripper.receive(10.0, data("wsg-system-limits"))
    assert out == data("wsg-system-limits-reply")


def test_over_tcp_a_torn_connection_latches_the_fast_stop():
    gripper = EmulatedWsg()
    front = TcpServer(gripper)
    front.start()
    for _ in range(2):
        with socket.create_connection(front.address, timeout=60) as client:
            client.sendall(data("wsg-state-once"))
            reply = client.recv(100)
    front.close()
    assert protocol.replies().feed(reply)[0].values[0] & SystemFlag.FAST_STOP
