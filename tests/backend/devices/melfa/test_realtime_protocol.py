"""Late replies, outages and errors of the controller in every state, by stepped clock."""

import struct
import threading
from collections.abc import Callable

import numpy as np
import pytest

from tests.backend.devices.codecs.codecs import MONITOR_KINDS
from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.melfa.emulated_arm import Rig
from tests.backend.devices.melfa.test_stream import (
    FAR,
    LEAD_MM,
    SPEED_MM_S,
    connected,
    doing,
    outage,
    places,
    requests,
    steps_mm,
)
from touchdown.backend.core import FaultError, Pose, RefusedError
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa.kinematics import STEPS_RAD
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtReply,
    MxtRequest,
    decode_monitor_reply,
    decode_mxt_reply,
    decode_mxt_request,
    encode_mxt_reply,
    encode_mxt_request,
)
from touchdown.backend.devices.protocols import CommandedMotion, DeviceState, RobotMode, SafetyMode

TRAVEL_S, DOUBLED, REORDERED = 15.0, 0.10, 0.05
LATE_S = 0.5
# Length, and whether it is a fault. The fault comes with cycle 29; 28 cycles are about 100 ms.
OUTAGES_S = {0.060: False, 28 * CYCLE_S: False, 0.200: True}
MAX_JUMP_MM, FAULT_CYCLES = 0.25, 29
ALARMS, EMERGENCIES = (2000, 2601, 4140, 6020, 4242), (50, 61, 70)
STATES = ("stand", "travel", "jog", "press", "draw back", "unload", "held", "force program off")
R3_PERIOD_S = 0.1
ANSWER_CYCLES = 3  # from a question to the controller until the answer took effect


def _moves(rig: Rig, since: int) -> int:
    return [request.command for _, request in requests(rig, since)].count(MxtCommand.MOVE)


def _starts_with_the_echo(rig: Rig) -> bool:
    """Connect again; return whether only the present position is commanded."""
    here_mm, since = rig.true_mm, len(rig.wires.packets)
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    told = places(rig, since)
    return rig.arm.state is DeviceState.READY and float(np.abs(told - here_mm).max()) < 0.01


@pytest.mark.promise("R2", "R3")
def test_doubled_and_reordered_replies_cause_no_step_back() -> None:
    rig, back = connected(), 0
    link, ratio = rig.wires.link, 0.0
    link.duplicate = DOUBLED
    link.late = lambda: 2 * (link.rng.random() < REORDERED)
    goals, travels, end_s = (160.0, 60.0), 0, rig.wires.clock.now_s() + TRAVEL_S
    while rig.wires.clock.now_s() < end_s and rig.arm.state is DeviceState.READY:
        del rig.wires.packets[:]
        motion = rig.arm.move_to(Pose(0.0, 0.0, goals[travels % 2]), SPEED_MM_S)
        while not motion.done:
            rig.rest(0.5)
        way = 1.0 if travels % 2 == 0 else -1.0
        steps = np.diff(places(rig), axis=0)
        back += int((way * steps[:, 2] < -1e-4).sum())
        ratio = max(ratio, float(np.linalg.norm(steps, axis=1).max()) / LEAD_MM)
        travels += 1
    counts = rig.arm._core.replies.counts
    assert rig.arm.state is DeviceState.READY
    assert counts.repeated > 250
    assert counts.old > 125
    assert rig.arm.health.lost == counts.refused + counts.skipped
    assert back == 0
    assert ratio <= 1.05


@pytest.mark.promise("R2", "R3")
@pytest.mark.parametrize(("late_s", "lost"), [(0.09, False), (LATE_S, True)])
def test_replies_that_arrive_late_together_are_not_used(late_s: float, lost: bool) -> None:
    rig = connected()
    link = rig.wires.link
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    since, until = len(rig.wires.packets), link._cycle + round(late_s / CYCLE_S)
    # The delayed replies arrive after five that were not delayed.
    link.late = lambda: until + 5 - link._cycle if link._cycle <= until else 0
    rig.rest(late_s + 0.5)
    steps = steps_mm(rig, since - 1)
    assert (rig.arm.state is DeviceState.FAULT) is lost
    assert float(steps.max(initial=0.0)) <= 1.05 * LEAD_MM
    assert lost or rig.arm._core.replies.counts.old >= late_s / CYCLE_S - 2


@pytest.mark.promise("R2", "R3")
def test_replies_of_the_stream_before_are_not_used_by_the_next() -> None:
    rig = connected()
    link = rig.wires.link
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    link.late = lambda: 300
    rig.rest(LATE_S)
    link.late = lambda: 0
    rig.arm.close()
    rig.device.controller.reset_error()
    assert len(link._waiting) >= FAULT_CYCLES - 1
    assert _starts_with_the_echo(rig)


@pytest.mark.promise("R5", "P4")
@pytest.mark.parametrize("state", ["travel", "press"])
@pytest.mark.parametrize("silent", ["replies", "this computer"])
@pytest.mark.parametrize(("seconds", "lost"), OUTAGES_S.items())
def test_an_outage_is_held_or_a_fault(seconds: float, lost: bool, silent: str, state: str) -> None:
    rig = connected()
    doing(rig, state)
    rig.wires.advance(3500)
    since, here_mm = len(rig.wires.packets), rig.true_mm[2]
    if silent == "replies":
        outage(rig, seconds)
    else:
        rig.wires.stalled = True
        rig.rest(seconds)
        rig.wires.stalled = False
    rig.rest(0.3)
    steps = steps_mm(rig, since - 1)
    assert float(steps.max(initial=0.0)) <= MAX_JUMP_MM
    assert (rig.arm.state is DeviceState.FAULT) is lost
    assert lost or rig.arm._core.holds == 1
    if state == "travel" and not lost:
        # It goes on by itself, from zero speed.
        assert not rig.arm._core.program.motion.done
        assert rig.true_mm[2] > here_mm + 2.0


@pytest.mark.promise("R12")
@pytest.mark.parametrize("phase", range(4))
@pytest.mark.parametrize("state", ["travel", "jog", "press"])
def test_the_controller_stops_when_the_computer_dies(state: str, phase: int) -> None:
    rig = connected()
    doing(rig, state)
    rig.rest(0.01 * phase)
    limit = rig.settings.mxt.mxttout
    rig.wires.stalled = True
    rig.wires.advance(3500)
    cycles, here_mm = 0, rig.true_mm
    while rig.device.controller.error == 0 and cycles < 2 * limit:
        rig.wires.advance(3500)
        cycles += 1
    rig.rest(0.1)
    assert limit - 2 <= cycles <= limit
    assert float(np.abs(rig.true_mm - here_mm).max()) < 1.0
    assert rig.device.controller.error == rig.settings.mxt.error_timeout
    assert not rig.device.controller.servo


def _bring(rig: Rig, state: str) -> None:
    """Bring the arm into one of ``STATES``."""
    if state in ("stand", "travel", "jog", "press"):
        doing(rig, state)
    elif state == "held":
        rig.arm.move_to(FAR, SPEED_MM_S)
        rig.rest(0.5)
        rig.wires.link.cut = True
        rig.rest(0.05)
        rig.wires.link.cut = False
    elif state == "force program off":
        rig.arm.move_to(FAR, SPEED_MM_S)
        rig.rest(0.2)
        rig.arm.halt()
        rig.rest(0.2)
    else:
        doing(rig, "press")
        if state == "draw back":
            rig.arm.retreat()
        else:
            rig.rest(1.0)
            rig.arm.unload(1.0, 2.0)
        rig.rest(0.05)


EVENTS: dict[str, Callable[[Rig], None]] = {
    **{
        str(number): lambda rig, number=number: rig.device.controller.raise_error(number)
        for number in (*ALARMS, *EMERGENCIES)
    },
    "servo off": lambda rig: rig.device.controller.switch_servo(False),
    "program ended": lambda rig: rig.device.controller.finish_program(),
}


@pytest.mark.promise("R8", "R9")
@pytest.mark.parametrize("state", STATES)
def test_an_error_ends_all_commands_until_reset(state: str) -> None:
    broken, slowest_s = [], 0.0
    # Every number while the arm stands; one alarm and one emergency in the other states.
    few = {name for name in EVENTS if not name.isdigit()} | {str(ALARMS[0]), str(EMERGENCIES[0])}
    for name, happen in EVENTS.items():
        if state != STATES[0] and name not in few:
            continue
        rig = connected()
        _bring(rig, state)
        took_s, found = _ended(rig, happen, name)
        slowest_s = max(slowest_s, took_s)
        broken += [f"{name}: {what}" for what in found]
    assert broken == []
    assert slowest_s <= R3_PERIOD_S + ANSWER_CYCLES * CYCLE_S + 1e-6


def _ended(rig: Rig, happen: Callable[[Rig], None], name: str) -> tuple[float, list[str]]:
    happen(rig)
    begun_s = rig.wires.clock.now_s()
    followed = rig.device.stream.commands

    def known() -> bool:
        fault = rig.arm.fault
        return fault is not None and (name in fault.what or not name.isdigit())

    while not known() and rig.wires.clock.now_s() - begun_s < 0.5:
        rig.wires.advance(3500)
    took_s, since = rig.wires.clock.now_s() - begun_s, len(rig.wires.packets)
    rig.rest(0.2)
    fault = rig.arm.fault
    emergency = int(name) in EMERGENCIES if name.isdigit() else False
    status, stopped = rig.arm.status(), fault is not None and fault.code == "HW-STOP"
    safety, off = SafetyMode.HW_STOP if emergency else SafetyMode.FAULT, RobotMode.SERVO_OFF
    rows = {
        "not told": known() and rig.arm.state is DeviceState.FAULT,
        "not as an emergency": stopped is emergency and status.safety_mode is safety,
        "the servo is told on": name == "program ended" or status.robot_mode is off,
        "a command afterwards": _moves(rig, since) == 0,
        "a command was obeyed": rig.device.stream.commands == followed,
    }
    rig.arm.close()
    rig.rest(0.5)
    rows["connected by itself"] = rig.arm.state is DeviceState.CLOSED
    if name.isdigit():
        try:
            rig.arm.connect(1.0, threading.Event())
            rows["taken with its error"] = False
        except FaultError as error:
            rows["taken with its error"] = name in error.fault.what
    rows["a command before the reset"] = rig.device.stream.commands == followed
    rig.device.controller.emergency = False
    rig.device.controller.reset_error()
    rows["not the echo first"] = _starts_with_the_echo(rig)
    return took_s, [what for what, well in rows.items() if not well]


@pytest.mark.promise("R8")
@pytest.mark.parametrize("state", STATES)
def test_without_the_operation_right_no_stream_starts(state: str) -> None:
    rig = connected()
    _bring(rig, state)
    rig.device.controller.right = "teaching box"
    rig.rest(0.4)
    rig.arm.close()
    commands = rig.device.stream.commands
    with pytest.raises((FaultError, RefusedError), match=r"\w"):
        rig.arm.connect(1.0, threading.Event())
    assert rig.device.stream.commands == commands
    rig.device.controller.right = None
    assert _starts_with_the_echo(rig)


class Leaping:
    """A faulty motion: asks ``leaps`` times for ``step_mm`` (3,) at once, then stands."""

    fragile = False
    turn = None
    speed_mm_s = 20.0

    def __init__(self, step_mm, leaps):
        self.motion = CommandedMotion({})
        self._step_mm, self._left = step_mm, leaps

    def next_mm(self, felt):
        if self._left == 0:
            self.motion.end()
            return felt.command_mm
        self._left -= 1
        return np.asarray(felt.command_mm + self._step_mm)

    def cut(self, command_mm):
        pass

    def still(self):
        pass


@pytest.mark.promise("R7")
@pytest.mark.parametrize(("leaps", "told"), [(10, None), (11, "STEPS-TOO-LARGE")])
@pytest.mark.parametrize(
    "step_mm", [(0.0, 0.0, 5.0), (0.9, -0.4, 0.2), (-30.0, 20.0, -10.0), (100.0, 300.0, -150.0)]
)
def test_more_than_ten_cut_steps_in_a_row_are_a_fault(step_mm, leaps, told):
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    program = Leaping(np.array(step_mm), leaps)
    rig.arm._core.run(program)
    rig.rest(0.1)
    assert rig.device.controller.error == 0
    joints = [t.axes[:6] for _, p in rig.wires.packets if (t := decode_mxt_request(p).target)]
    assert (np.abs(np.diff(joints, axis=0)) / STEPS_RAD).max() <= 0.5
    assert (rig.arm.fault and rig.arm.fault.code) == told
    assert rig.arm.state is (DeviceState.FAULT if told else DeviceState.READY)
    if told:
        with pytest.raises(FaultError, match="too large"):
            program.motion.result()
        assert decode_mxt_request(rig.wires.packets[-1][1]).command is MxtCommand.END


JOINTS = AxisValues(BlockKind.JOINT, (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.0, 0.0))


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_target_that_is_no_number_is_never_sent(bad):
    target = AxisValues(BlockKind.JOINT, (bad, *JOINTS.axes[1:]))
    with pytest.raises(ProtocolError):
        encode_mxt_request(MxtRequest(MxtCommand.MOVE, target))
    content = bytearray(data("mxt-move-joint"))
    content[8:12] = struct.pack("<f", bad)
    with pytest.raises(ProtocolError, match=r"^number .*byte 8\]"):
        decode_mxt_request(bytes(content))


@pytest.mark.parametrize(("slot", "at"), [(0, 4), (1, 64), (2, 108), (3, 152)])
def test_an_unknown_monitor_type_is_refused_where_it_stands(slot, at):
    content = bytearray(data("mxt-reply-joint"))
    content[at : at + 2] = (12).to_bytes(2, "little")
    with pytest.raises(ProtocolError, match=rf"^type .*byte {at}\]"):
        decode_mxt_reply(bytes(content))


CURRENT = AxisValues(BlockKind.CURRENT, (1, 2, 3, 4, 5, 6, 7, 8))


@pytest.mark.parametrize(
    ("encode", "packet"),
    [
        (encode_mxt_request, MxtRequest(MxtCommand.MOVE, CURRENT)),
        (encode_mxt_request, MxtRequest(MxtCommand.NONE, counter=-1)),
        (encode_mxt_request, MxtRequest(MxtCommand.NONE, counter=2**32)),
        (encode_mxt_reply, MxtReply(MxtCommand.MOVE, 1, (1, 0, 0, 0), (JOINTS, *[None] * 3), 1)),
        (decode_mxt_reply, b"\x02" + data("mxt-reply-joint")[1:]),  # unknown command
    ],
)
def test_what_no_packet_can_carry_is_refused(encode, packet):
    with pytest.raises(ProtocolError):
        encode(packet)


def test_reserved_bytes_of_a_controller_are_not_held_against_it():
    content = bytearray(data("mxt-reply-joint"))
    content[6:8] = content[66:68] = b"\x12\x34"
    assert decode_mxt_reply(bytes(content)) == decode_mxt_reply(data("mxt-reply-joint"))


def test_an_unnamed_data_type_of_the_monitor_is_refused():
    content = data("monitor-stream-force-pose-float8")
    kinds = {number: kind for number, kind in MONITOR_KINDS.items() if number != 903}
    with pytest.raises(ProtocolError, match=r"^type "):
        decode_monitor_reply(content, kinds)
