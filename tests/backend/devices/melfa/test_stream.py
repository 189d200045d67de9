"""The stream under loss, delay, damage, stalls and stops, on a hand-wound clock."""

import math
import threading

import numpy as np
import pytest

from tests.backend.devices.melfa.emulated_arm import Rig
from touchdown.backend.core import FaultError, Pose, RefusedError
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtReply,
    decode_mxt_request,
    encode_mxt_reply,
)
from touchdown.backend.devices.melfa.stream import (
    MONITORS,
    ReplyFilter,
    SilenceLevel,
    silence_level,
)
from touchdown.backend.devices.protocols import DeviceState, PressCommand

SPEED_MM_S = 20.0
LEAD_MM = 3 * CYCLE_S * SPEED_MM_S
FAR = Pose(0.0, 0.0, 160.0)


def connected():
    made = Rig()
    made.arm.connect(1.0, threading.Event())
    made.rest(0.1)
    return made


@pytest.fixture
def rig():
    return connected()


def requests(rig, since=0):
    return [(t_s, decode_mxt_request(data)) for t_s, data in rig.wires.packets[since:]]


def places(rig, since=0):
    """Where the commands since a packet put ``G``: (n, 3) mm."""
    told = [np.array(r.target.axes[:6]) for _, r in requests(rig, since) if r.target is not None]
    return np.array([rig.placing.pivot_mm(joints) for joints in told]).reshape(-1, 3)


def steps_mm(rig, since=0):
    return np.linalg.norm(np.diff(places(rig, since), axis=0), axis=1)


def outage(rig, seconds):
    rig.wires.link.cut = True
    rig.rest(seconds)
    rig.wires.link.cut = False


# -- start ----------------------------------------------------------------------------------------


@pytest.mark.promise("R6")
def test_the_first_packet_commands_nothing_and_the_first_command_is_the_echo(rig):
    sent = [request for _, request in requests(rig)]
    assert sent[0].command is MxtCommand.NONE
    assert sent[0].target is None
    assert sent[0].monitors == MONITORS
    moves = [request for request in sent if request.command is MxtCommand.MOVE]
    start = rig.device.controller.joints.command_rad
    assert all(move.target == moves[0].target for move in moves)
    assert np.array(moves[0].target.axes[:6]) == pytest.approx(start, abs=1e-7)
    assert len(moves) > 10


@pytest.mark.promise("R6")
def test_a_position_that_jumps_at_the_start_is_taken_as_it_is_told():
    rig = Rig()
    rig.device.stream.jump_rad = np.array([2e-4, 0, 0, 0, 0, 0])
    told = rig.device.controller.joints.command_rad[0] + 2e-4
    rig.arm.connect(1.0, threading.Event())
    first = next(r for _, r in requests(rig) if r.command is MxtCommand.MOVE)
    assert first.target.axes[0] == pytest.approx(told, abs=1e-7)


def test_a_hand_that_was_left_turned_is_taken_as_it_is_and_presses_nothing():
    rig = Rig()
    rig.device.controller.joints.command_rad[4] += 0.02
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    pose = rig.arm.pose(0.1)
    assert math.hypot(pose.rx_rad, pose.ry_rad, pose.rz_rad) == pytest.approx(0.02, abs=1e-4)
    with pytest.raises(RefusedError, match="TURNED"):
        rig.arm.press(PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0)))
    level = rig.arm.move_to(Pose(pose.x_mm, pose.y_mm, pose.z_mm), SPEED_MM_S)
    rig.rest(2.0)
    level.result()
    assert rig.arm.pose(0.1).ry_rad == 0.0
    assert rig.placing.turn(rig.device.controller.joints.true_rad) == pytest.approx(
        np.eye(3), abs=1e-5
    )


def test_a_hand_that_leans_too_far_is_not_moved():
    rig = Rig()
    rig.device.controller.joints.command_rad[4] += 0.4
    with pytest.raises(FaultError, match="TILTED"):
        rig.arm.connect(1.0, threading.Event())
    assert rig.device.stream.commands == 0
    assert not rig.device.controller.servo


def test_the_command_channel_keeps_its_distance_while_the_program_runs(rig):
    rig.rest(2.0)
    session = rig.wires._session
    assert sum(request.command == "STATE" for request in session.received) > 15
    assert session.too_fast == 0


# -- loss -----------------------------------------------------------------------------------------


@pytest.mark.promise("R5")
@pytest.mark.parametrize(
    ("missed", "silent_s", "found"),
    [
        (0, CYCLE_S, SilenceLevel.GO),
        (1, 1.4 * CYCLE_S, SilenceLevel.GO),
        (2, 0.0, SilenceLevel.STAND),
        (0, 2 * CYCLE_S, SilenceLevel.STAND),
        (9, 9 * CYCLE_S, SilenceLevel.STAND),
        (10, 0.0, SilenceLevel.HOLD),
        (28, 28.9 * CYCLE_S, SilenceLevel.HOLD),
        (29, 0.0, SilenceLevel.FAULT),
        (0, 29 * CYCLE_S, SilenceLevel.FAULT),
    ],
)
def test_the_ladder(missed, silent_s, found):
    assert silence_level(missed, silent_s, CYCLE_S) is found


@pytest.mark.promise("R1")
@pytest.mark.parametrize("loss", [0.05, 0.2])
def test_lost_packets_slow_it_down_and_nothing_else(rig, loss):
    rig.wires.link.loss = loss
    since = len(rig.wires.packets)
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(3.0)
    assert rig.arm.state is DeviceState.READY
    heights = places(rig, since)[:, 2]
    assert (np.diff(heights) >= -1e-4).all()
    assert steps_mm(rig, since).max() <= 1.05 * LEAD_MM
    assert heights[-1] - heights[0] > 15.0


@pytest.mark.promise("R1")
def test_without_loss_it_reaches_the_asked_speed(rig):
    rig.arm.move_to(FAR, SPEED_MM_S)
    since = len(rig.wires.packets)
    rig.rest(1.0)
    assert steps_mm(rig, since).max() / CYCLE_S == pytest.approx(SPEED_MM_S, rel=3e-3)


@pytest.mark.promise("R4")
def test_garbage_is_counted_and_never_used(rig):
    rig.wires.link.garbage = 0.10
    motion = rig.arm.move_to(Pose(0.0, 0.0, 80.0), SPEED_MM_S)
    rig.rest(2.0)
    assert motion.done
    motion.result()
    assert rig.arm._core.replies.counts.refused > 30
    assert rig.true_mm == pytest.approx([0.0, 0.0, 80.0], abs=0.02)


@pytest.mark.promise("R5", "P4")
def test_silence_is_a_fault_at_cycle_29_exactly(rig):
    motion = rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    last_heard = len(rig.wires.packets)
    rig.wires.link.cut = True
    cycles = 0
    while rig.arm.state is DeviceState.READY:
        rig.wires.advance(3500)
        cycles += 1
    # The reply to the packet before the cut came in the first of these cycles.
    assert cycles - 1 == 29
    assert rig.arm.fault.code == "MXT-LOST"
    rig.rest(0.1)
    after = [request.command for _, request in requests(rig, last_heard)]
    assert after[-3:] == [MxtCommand.END] * 3
    assert MxtCommand.MOVE not in after[cycles - 1 :]
    assert rig.wires.stops == 1
    with pytest.raises(FaultError):
        motion.result()
    with pytest.raises(FaultError):
        rig.arm.move_to(FAR, SPEED_MM_S)


@pytest.mark.promise("P3")
def test_a_driver_that_was_stopped_for_long_makes_nothing_up(rig):
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    before = len(rig.wires.packets)
    rig.wires.stalled = True
    rig.rest(5.0)
    rig.wires.stalled = False
    rig.rest(0.3)
    assert rig.arm.state is DeviceState.FAULT
    # After 57 cycles the controller has ended it by itself: its own reason is told.
    assert rig.arm.fault.code == "CONTROLLER"
    assert {request.command for _, request in requests(rig, before)} == {MxtCommand.END}
    rig.arm.close()
    rig.device.controller.reset_error()
    here_mm, since = rig.true_mm, len(rig.wires.packets)
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    assert np.abs(places(rig, since) - here_mm).max() < 0.01


@pytest.mark.promise("R5")
def test_a_press_is_void_after_a_hold(rig):
    rig.contact = lambda pivot: np.array([0.0, 0.0, max(0.0, 8.0 * (55.0 - pivot[2]))])
    rig.rest(0.6)
    press = rig.arm.press(PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0)))
    rig.rest(3.2)
    assert press.onset_s is not None
    outage(rig, 0.06)
    assert press.done
    with pytest.raises(FaultError, match="PRESS-VOID"):
        press.result()
    rig.rest(0.5)
    assert 2.0 < 8.0 * (55.0 - rig.true_mm[2]) < 12.0


# -- stop and trouble of the controller -----------------------------------------------------------


def test_stop_ends_the_stream_and_stops_the_controller(rig):
    motion = rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    before, height = len(rig.wires.packets), rig.true_mm[2]
    rig.arm.stop()
    assert motion.done
    assert rig.device.controller.program == ""
    rig.rest(0.3)
    assert {request.command for _, request in requests(rig, before)} == {MxtCommand.END}
    assert rig.true_mm[2] - height < 0.1
    assert rig.arm.state is DeviceState.READY


def test_after_a_stop_the_next_command_begins_at_the_echo(rig):
    rig.arm.move_to(FAR, SPEED_MM_S)
    rig.rest(0.5)
    rig.arm.stop()
    rig.rest(0.3)
    before = len(rig.wires.packets)
    motion = rig.arm.move_to(Pose(0.0, 0.0, 75.0), SPEED_MM_S)
    assert requests(rig, before)[0][1].command is MxtCommand.NONE
    rig.rest(1.5)
    motion.result()
    assert steps_mm(rig, before).max() <= 1.05 * LEAD_MM
    assert rig.true_mm[2] == pytest.approx(75.0, abs=0.05)


def doing(rig, what):
    """Bring the arm into a state; in that of a press it is in contact."""
    if what == "travel":
        rig.arm.move_to(FAR, SPEED_MM_S)
    elif what == "jog":
        rig.arm.jog((0.0, 0.0, 10.0), 2.0)
    elif what == "press":
        rig.contact = lambda pivot: np.array([0.0, 0.0, max(0.0, 8.0 * (59.6 - pivot[2]))])
        rig.rest(0.6)
        rig.arm.press(PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 6.0, (30.0, 30.0, 15.0)))
        rig.rest(1.2)
        assert rig.wrench.since(0).values[-1, 2] > 1.0
    rig.rest(0.5)


@pytest.mark.promise("R7")
def test_a_place_out_of_reach_is_refused_and_nothing_too_fast_is_sent(rig):
    motion = rig.arm.move_to(Pose(0.0, 0.0, 900.0), 400.0)
    rig.rest(3.0)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code in ("REACH", "SINGULAR", "STEP")
    assert rig.device.stream.largest_share <= 0.5
    assert rig.device.controller.error == 0
    assert rig.arm.state is DeviceState.READY


# -- replies --------------------------------------------------------------------------------------


def reply(counter, *, monitors=MONITORS, joint=0.1):
    joints = AxisValues(BlockKind.JOINT, (joint,) * 6 + (0.0, 0.0))
    kinds = {2: joints, 5: joints, 8: joints, 11: AxisValues(BlockKind.CURRENT, (0,) * 8), 0: None}
    blocks = tuple(kinds[monitor] for monitor in monitors)
    return encode_mxt_reply(MxtReply(MxtCommand.MOVE, monitors[0], monitors, blocks, counter))


@pytest.mark.promise("R6")
def test_only_newer_replies_of_the_wanted_kind_count():
    replies = ReplyFilter()
    assert replies.take([reply(7)]) is not None
    assert replies.take([reply(7)]) is None
    assert replies.take([reply(6)]) is None
    assert replies.take([reply(9, joint=0.2), reply(8)]).command_rad[0] == pytest.approx(0.2)
    assert replies.take([reply(10, monitors=(2, 8, 5, 0))]) is None
    assert replies.take([reply(11, joint=11.0)]) is None
    counts = replies.counts
    assert (counts.accepted, counts.repeated, counts.old, counts.refused) == (2, 1, 2, 2)
    assert counts.skipped == 1


def test_the_counter_wraps():
    replies = ReplyFilter()
    assert replies.take([reply(2**32 - 1)]) is not None
    assert replies.take([reply(0)]) is not None
    assert replies.take([reply(2**32 - 1)]) is None


@pytest.mark.parametrize(
    ("datagram", "said"),
    [
        (None, "Check the address of this computer"),
        (b"\x12" * 196, "cannot be read"),
        (b"short", "cannot be read"),
        (reply(1, monitors=(2, 8, 5, 0)), "other data than requested"),
        (reply(1, joint=11.0), "joint angles that no arm can have"),
    ],
)
@pytest.mark.parametrize("running", [False, True])
def test_replies_that_come_and_cannot_be_used_are_told_from_silence(datagram, said, running):
    rig = Rig()
    came = () if datagram is None else (datagram,)
    if running:
        rig.arm.connect(1.0, threading.Event())
        rig.rest(0.1)
        rig.wires.link.back = lambda reply: came
        rig.rest(0.3)
        fault, silent = rig.arm.fault, "The arm sent no real-time reply for 29 cycles"
        assert fault.code == "MXT-LOST"
    else:
        rig.wires.link.back = lambda reply: came
        with pytest.raises(FaultError) as raised:
            rig.arm.connect(1.0, threading.Event())
        fault, silent = raised.value.fault, "no real-time reply comes"
        assert fault.code == "MXT-START"
    told = f"{fault.what} {fault.next_step}"
    assert (silent in told) is (datagram is None)
    assert datagram is None or said in told
    assert datagram is None or "firewall" not in told
