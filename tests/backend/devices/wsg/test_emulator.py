"""One contract for every gripper: the simulated one, and the WSG over a real socket.

The WSG in both of its protocols, binary and text, and behind the link of a rig.
"""

import contextlib
import socket
import threading
import time
from functools import partial

import pytest

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.waiting import until
from tests.backend.rig.ticking import TickingRig, rounds_pass
from touchdown.backend.config import HardwareSettings, SimulationSettings, WsgSettings
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.devices import ByHand, DeviceState, make_gripper
from touchdown.backend.devices.framing import crc_wsg
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.wsg import driver, protocol
from touchdown.backend.devices.wsg.driver import WsgGripper
from touchdown.backend.devices.wsg.emulator import FORCE_SUM_N, EmulatedGcl, EmulatedWsg
from touchdown.backend.devices.wsg.protocol import (
    GraspState,
    SystemFlag,
    WsgCommand,
    WsgReply,
    WsgRequest,
    WsgStatus,
    update,
)
from touchdown.backend.emulation import Faults, TcpServer
from touchdown.backend.geometry import Tower, load_pieces
from touchdown.backend.simulation.devices.bench import SimulatedBench
from touchdown.backend.simulation.ground_truth import Scene

PART_MM = 30.0


class GripperBench:
    """A gripper under test."""

    told = staticmethod(lambda: None)  # waits until an event has been reported
    senseless = ValueError

    def let_go(self, width_mm):
        return self.gripper.open_to(width_mm, 20.0)


class Simulated(GripperBench):
    """The gripper of the simulated bench; its time is wound by hand."""

    def __init__(self):
        catalogue = load_pieces()
        bottoms = Tower((catalogue.bottom("short").body(),))
        settings = SimulationSettings(preset="mixed")
        self.bench = SimulatedBench(Scene(catalogue.top("pot"), bottoms, (6.0, 3.0), 11, settings))
        self.gripper = self.bench.gripper

    def connect(self):
        self.gripper.connect(1.0, threading.Event())
        self.rest(0.05)

    def rest(self, seconds):
        self.bench.advance(round(seconds * 1e6))

    def close(self):
        self.gripper.close()


class OverTheWire(GripperBench):
    """A homed WSG driver and its emulated gripper with a piece between the jaws."""

    def __init__(self, **settings):
        faults = Faults("gripper")
        wsg = WsgSettings(**settings)
        self.emulated = EmulatedWsg(PART_MM, faults, keeps_grip=wsg.keeps_grip_after_07)
        text = wsg.protocol == "gcl"
        mouth = EmulatedGcl(self.emulated, wsg) if text else self.emulated
        self.front = TcpServer(mouth, faults=faults)
        host, port = self.front.address
        wsg = wsg.model_copy(update={"host": host, "port": port})
        self.gripper = make_gripper(HardwareSettings(wsg=wsg), time.monotonic)
        self.front.start()

    def connect(self):
        self.gripper.connect(2.0, threading.Event())
        if not self.gripper.homed:
            finish(self, self.gripper.home())
        until(lambda: self.gripper.status().width_mm > 0)

    def rest(self, seconds):
        threading.Event().wait(seconds)

    def close(self):
        self.gripper.close()
        self.front.close()


class OverTheLink(OverTheWire):
    """The same driver inside a rig."""

    told = staticmethod(rounds_pass)
    senseless = (ValueError, RefusedError)

    def __init__(self):
        super().__init__()
        self._driver = self.gripper
        self._rig = TickingRig(time.monotonic, gripper=self._driver)
        self.gripper = self._rig.gripper

    def let_go(self, width_mm):
        # Behind a rig a piece is let go only for an authorised release.
        with pytest.raises(RefusedError, match="only for an authorised release"):
            super().let_go(width_mm)
        return self.gripper.open_held(ByHand(confirmed=True), width_mm, 20.0)

    def close(self):
        super().close()
        self._rig.close()


BINARY, TEXT = OverTheWire, partial(OverTheWire, protocol="gcl")
WIRED = {"wsg": BINARY, "wsg text": TEXT, "wsg over the link": OverTheLink}
EVERY = {"simulated": Simulated, **WIRED}


def made(request):
    gripper = request.param()
    yield gripper
    gripper.close()


bench = pytest.fixture(made, name="bench", params=EVERY.values(), ids=EVERY.keys())
wired = pytest.fixture(made, name="wired", params=WIRED.values(), ids=WIRED.keys())


def finish(bench, motion):
    wait(bench, lambda: motion.done)


def wait(bench, condition):
    end_s = time.monotonic() + 30.0
    while not condition():
        assert time.monotonic() < end_s, "it does not come"
        bench.rest(0.01)


def test_it_opens_and_closes_any_number_of_times_and_refuses_while_closed(bench):
    gripper = bench.gripper
    assert gripper.name == "gripper"
    for _ in range(2):
        assert gripper.state is DeviceState.CLOSED
        for command in (lambda: gripper.grip(10.0), lambda: gripper.open_to(20.0, 10.0)):
            with pytest.raises(FaultError):
                command()
        bench.connect()
        gripper.connect(1.0, threading.Event())
        assert gripper.state is DeviceState.READY
        assert gripper.identity.serial
        assert gripper.describe()
        gripper.close()
        gripper.close()


def test_it_takes_the_piece_holds_it_with_the_force_and_lets_it_go(bench):
    bench.connect()
    wide = bench.gripper.status()
    grip = bench.gripper.grip(10.0)
    assert grip.sent == {"force_n": 10.0}
    with pytest.raises(ValueError, match="under way"):
        grip.result()
    finish(bench, grip)
    grip.result()
    # Through a rig what it tells may be a moment older than the end of the motion.
    wait(bench, lambda: abs(bench.gripper.status().force_n - 10.0) <= 1.5)
    held = bench.gripper.status()
    assert held.holding
    assert held.width_mm < wide.width_mm
    opening = bench.let_go(held.width_mm + 4.0)
    finish(bench, opening)
    opening.result()
    assert not bench.gripper.status().holding
    assert bench.gripper.status().width_mm == pytest.approx(held.width_mm + 4.0, abs=0.1)


def test_stop_is_legal_in_every_state_and_ends_a_grip(bench):
    bench.gripper.stop()
    bench.connect()
    bench.gripper.stop()
    grip = bench.gripper.grip(10.0)
    bench.rest(0.05)
    bench.gripper.stop()
    bench.told()
    assert grip.done
    with pytest.raises(FaultError):
        grip.result()
    assert not bench.gripper.status().holding
    bench.gripper.close()
    bench.gripper.stop()


def test_stop_and_close_keep_a_grip_that_stands(bench):
    bench.connect()
    finish(bench, bench.gripper.grip(10.0))
    bench.gripper.stop()
    bench.rest(0.1)
    assert bench.gripper.status().holding
    bench.gripper.close()
    bench.connect()
    bench.rest(0.1)
    assert bench.gripper.status().holding


def test_a_newer_command_ends_the_older_one(bench):
    bench.connect()
    first = bench.gripper.grip(10.0)
    bench.rest(0.02)
    second = bench.gripper.open_to(38.0, 50.0)
    bench.told()
    with pytest.raises(FaultError):
        first.result()
    finish(bench, second)
    second.result()


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_numbers_are_refused(bench, bad):
    bench.connect()
    for command in (lambda: bench.gripper.grip(bad), lambda: bench.gripper.open_to(20.0, bad)):
        with pytest.raises(bench.senseless, match=r"finite|positive"):
            command()


def connects(gripper):
    with contextlib.suppress(FaultError):
        gripper.connect(2.0, threading.Event())
        return True


@pytest.mark.promise("G2")
def test_a_link_lost_while_holding_waits_for_the_operator(wired):
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    wired.front.inject("unplug", 0.05)
    until(lambda: wired.gripper.state is DeviceState.FAULT)
    assert wired.gripper.fault.code == "WSG-LINK"
    with pytest.raises((FaultError, RefusedError)):
        wired.gripper.open_to(38.0, 50.0)
    until(lambda: not wired.front.faults.names(time.monotonic()))

    until(partial(connects, wired.gripper))
    assert wired.gripper.fault.code == "WSG-FAST-STOP"
    with pytest.raises(FaultError):
        wired.gripper.grip(10.0)
    # Nothing was asked of the jaws by coming back either.
    assert wired.emulated.barred == 0
    assert wired.emulated.jaws.motion is None
    wired.gripper.acknowledge()
    until(lambda: wired.gripper.state is DeviceState.READY)
    finish(wired, wired.gripper.grip(10.0))
    assert wired.gripper.status().holding


def test_the_limits_of_the_gripper_replace_those_of_the_settings():
    wired = OverTheWire(force_max_n=20.0)
    wired.connect()
    assert wired.gripper.describe()["most_force_n"] == pytest.approx(0.5 * FORCE_SUM_N[1])
    wired.close()


@pytest.mark.promise("G1")
def test_readings_go_on_and_a_lost_piece_is_seen(wired):
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    before = wired.gripper.health.received
    until(lambda: wired.gripper.health.received > before + 5)
    most_n = 0.5 * FORCE_SUM_N[1]
    assert wired.gripper.describe()["most_force_n"] == pytest.approx(most_n)
    wired.emulated.jaws.part_mm = None
    until(lambda: not wired.gripper.status().holding)
    until(lambda: wired.gripper.describe()["lost_parts"] == 1)
    assert wired.gripper.state is DeviceState.READY


@pytest.mark.promise("S5")
def test_another_device_is_refused_by_name():
    front = TcpServer(EmulatedLeptrino(lambda now_s: (0.0,) * 6))
    front.start()
    gripper = WsgGripper(*front.address, WsgSettings(), time.monotonic)
    words = "This is a Leptrino force/torque sensor, expected a WSG gripper"
    with pytest.raises(FaultError, match=words):
        gripper.connect(1.0, threading.Event())
    assert gripper.state is DeviceState.CLOSED
    front.close()


def test_an_address_that_never_answers_is_silent_and_no_other_device(monkeypatch):
    monkeypatch.setattr(driver, "ANSWER_S", 0.05)
    monkeypatch.setattr(driver, "identify_device", lambda _send, receive, _protocol: receive(0.01))
    with socket.create_server(("127.0.0.1", 0)) as door:
        gripper = WsgGripper(*door.getsockname(), WsgSettings(), time.monotonic)
        with pytest.raises(FaultError, match="silent"):
            gripper.connect(1.0, threading.Event())


def test_nobody_there_is_a_fault():
    gripper = WsgGripper("127.0.0.1", 1, WsgSettings(), time.monotonic)
    with pytest.raises(FaultError, match="cannot be reached"):
        gripper.connect(1.0, threading.Event())


@pytest.mark.parametrize("protocol", ["binary", "gcl"])
def test_a_gripper_that_lets_go_after_a_goodbye_is_left_without_one(protocol):
    wired = OverTheWire(protocol=protocol, stroke_mm=40.0, keeps_grip_after_07=False)
    wired.connect()
    finish(wired, wired.gripper.grip(10.0))
    wired.gripper.close()
    until(lambda: SystemFlag.FAST_STOP in wired.emulated.jaws.flags)
    wired.gripper.connect(2.0, threading.Event())
    assert wired.gripper.fault.code == "WSG-FAST-STOP"
    wired.gripper.acknowledge()
    until(lambda: wired.gripper.state is DeviceState.READY)
    wired.gripper.close()
    assert SystemFlag.FAST_STOP not in wired.emulated.jaws.flags
    wired.close()


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

    def told(self, now_s, request):
        """Return the status of the one reply to ``request``."""
        (reply,) = self.send(now_s, request)
        assert reply.command == request.command
        return reply.status

    def wait(self, now_s):
        return self.replies.feed(self.gripper.due(now_s))

    def read(self, now_s, command):
        (reply,) = self.send(now_s, WsgRequest(command, (0, 0)))
        return reply.values[0]


def test_a_motion_answers_twice_and_ends_when_it_really_ends():
    client = Client()
    assert client.told(10.0, protocol.preposition(46, 20)) == WsgStatus.CMD_PENDING
    assert client.read(10.5, WsgCommand.WIDTH) == pytest.approx(56.0)
    assert client.read(10.5, WsgCommand.SYSTEM_STATE) & SystemFlag.MOVING
    assert client.wait(10.999) == []
    assert client.wait(11.001) == [WsgReply(WsgCommand.PREPOSITION, WsgStatus.SUCCESS)]
    assert client.read(11.1, WsgCommand.WIDTH) == 46.0


def test_before_homing_only_homing_is_allowed():
    client = Client(homed=False)
    assert client.told(0.0, protocol.grasp(20, 30)) == WsgStatus.NOT_INITIALIZED
    assert client.told(0.0, protocol.preposition(20, 30)) == WsgStatus.NOT_INITIALIZED


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


def told(mouth, now_s, line):
    return mouth.receive(now_s, line + b"\n").decode().splitlines()


@pytest.mark.parametrize(
    ("request_", "line"),
    [
        (protocol.preposition(150, 50), b"MOVE(150)"),
        (protocol.preposition(-5, 50), b"MOVE(-5,50)"),
        (protocol.preposition(30, 50, relative=True), b"MOVE(96)"),
        (protocol.grasp(67, 50), b"GRIP(10,67)"),
        (protocol.release(66.5, 50), b"RELEASE(66.5)"),
        (protocol.set_force_limit(500), b"GRIP(500)"),
        (protocol.set_force_limit(4), b"GRIP(4)"),
    ],
)
def test_a_width_or_force_beyond_the_gripper_is_a_range_error_and_moves_nothing(request_, line):
    client = Client(part_mm=20.0)
    assert client.send(10.0, request_) == [WsgReply(request_.command, WsgStatus.RANGE_ERROR)]
    mouth, (name, _, _) = EmulatedGcl(client.gripper), line.partition(b"(")
    assert told(mouth, 10.1, line) == [f"ERR {name.decode()} 28"]
    assert client.gripper.jaws.motion is None
    assert client.read(12.0, WsgCommand.WIDTH) == 66.0
    assert client.gripper.jaws.force_limit_n == 5.0


def test_soft_limits_bound_the_targets_until_they_are_cleared():
    client, ask = Client(), WsgRequest(WsgCommand.GET_SOFT_LIMITS)
    assert client.told(10.0, ask) == WsgStatus.NOT_AVAILABLE
    beyond = WsgRequest(WsgCommand.SET_SOFT_LIMITS, (10, 67))
    assert client.told(10.0, beyond) == WsgStatus.RANGE_ERROR
    client.send(10.0, WsgRequest(WsgCommand.SET_SOFT_LIMITS, (10, 50)))
    assert client.send(10.0, ask)[0].values == (10.0, 50.0)
    for width_mm in (9.0, 51.0):
        assert client.told(10.0, protocol.preposition(width_mm, 50)) == 28
    client.send(10.0, WsgRequest(WsgCommand.CLEAR_SOFT_LIMITS))
    assert client.told(10.0, protocol.preposition(9, 50)) == WsgStatus.CMD_PENDING


@pytest.mark.parametrize("command", [*protocol.SCRIPTS, *protocol.FINGERS, WsgCommand.TARE])
def test_scripts_and_finger_sensors_are_answered_as_not_available(command):
    size = 200 if command in protocol.SCRIPTS else 0
    head = b"\xaa\xaa\xaa" + bytes((command,)) + size.to_bytes(2, "little") + bytes(size)
    out = Client().gripper.receive(10.0, head + crc_wsg(head).to_bytes(2, "little"))
    (reply,) = protocol.replies().feed(out)
    assert (reply.command, reply.status) == (command, WsgStatus.NOT_AVAILABLE)


def test_a_tag_and_the_overdrive_are_kept():
    client = Client()
    client.send(10.0, WsgRequest(WsgCommand.SET_TAG, (b"left",)))
    assert client.send(10.0, WsgRequest(WsgCommand.GET_TAG))[0].values == (b"left",)
    for on in (1, 0):
        client.send(10.0, WsgRequest(WsgCommand.OVERDRIVE, (on,)))
        state = client.read(10.0, WsgCommand.SYSTEM_STATE)
        assert bool(state & SystemFlag.OVERDRIVE_MODE) == bool(on)


@pytest.mark.parametrize("line", [b"MOVE(10)", b"GRIP(10,66)"])
def test_an_error_never_shares_a_segment_with_its_acknowledgement(line):
    """The jaws stand at the block already, or find no part on a short way."""
    client = Client(part_mm=66.0 if b"MOVE" in line else None)
    mouth, name = EmulatedGcl(client.gripper), line[:4].decode()
    # A server sends what is due together with the answer.
    first = mouth.receive(10.0, line + b"\n") + mouth.due(10.001)
    assert first.decode().splitlines() == [f"ACK {name}"]
    assert mouth.due(10.09) == b""
    assert mouth.due(10.2).decode().startswith(f"ERR {name} ")
    mouth.receive(20.0, b"FSACK()\n")
    mouth.gripper.jaws.part_mm = None
    assert told(mouth, 20.0, b"MOVE(10)\nSTOP()") == ["ACK MOVE", "ACK STOP"]
    assert mouth.due(20.2) == b"ERR MOVE 19\n"


@pytest.mark.parametrize(
    ("line", "code"), [(b"HOME(300)", 24), (b"GRIP(10,20,50,1)", 15), (b"RELEASE(1,2,3)", 15)]
)
def test_a_call_with_senseless_arguments_is_refused(line, code):
    assert told(EmulatedGcl(EmulatedWsg()), 0.0, line)[0].endswith(f" {code}")


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
    assert client.told(10.1, protocol.release(60, 10)) == WsgStatus.ALREADY_RUNNING
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
    assert client.told(10.1, protocol.grasp(20, 30)) == WsgStatus.ACCESS_DENIED
    assert client.told(10.2, WsgRequest(WsgCommand.ACKNOWLEDGE, (b"nak",))) == 15
    assert client.send(10.3, protocol.acknowledge()) == [WsgReply(WsgCommand.ACKNOWLEDGE, 0)]
    assert client.told(10.4, protocol.grasp(20, 30)) == WsgStatus.CMD_PENDING


def test_only_an_announced_end_leaves_no_fast_stop():
    client = Client()
    client.send(10.0, WsgRequest(WsgCommand.DISCONNECT))
    assert client.told(10.0, WsgRequest(WsgCommand.TARE)) == WsgStatus.ACCESS_DENIED
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
    assert client.send(10.0, WsgRequest(0x90)) == [WsgReply(0x90, WsgStatus.CMD_UNKNOWN)]


def test_limits_are_the_published_ones():
    client = Client()
    out = client.gripper.receive(10.0, data("wsg-system-limits"))
    assert out == data("wsg-system-limits-reply")
