"""Command channel: alarms, idle check, kinematics, permitted commands, answers, stops."""

import itertools
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.melfa.emulated_arm import CYCLE_US, Rig
from tests.backend.devices.melfa.test_compliance import PRESS, TOUCH_MM
from tests.backend.devices.melfa.trials import PRESS as TRIALS_PRESS
from tests.backend.devices.melfa.trials import trial
from touchdown.backend.config.hardware import MelfaSettings
from touchdown.backend.core import FaultError, Pose, RefusedError
from touchdown.backend.devices import DeviceState, GuardedArm, Interlock
from touchdown.backend.devices.force_torque.reader import OVERLOAD
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa import READY_RAD, emulated_controller, r3_protocol
from touchdown.backend.devices.melfa.kinematics import (
    LIMITS_RAD,
    STEPS_RAD,
    MelfaPlacement,
    check_joints,
    check_step,
    flange,
    hand_of,
    joints_for,
)
from touchdown.backend.devices.melfa.r3_protocol import R3Request


def test_an_alarm_that_refused_a_connection_is_reset_by_the_next_and_no_other():
    """R8: by an explicit order, never while the emergency stop is pressed."""
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    controller = rig.device.controller
    controller.raise_error(61)
    rig.rest(0.35)
    assert rig.arm.fault.code == "HW-STOP"
    for _ in range(2):
        with pytest.raises(FaultError, match=r"error 61.*Connecting once more.*resets"):
            rig.arm.connect(1.0, threading.Event())
        assert controller.error == 61
    controller.release_emergency_stop()
    controller.raise_error(2601)  # nobody was told of this one
    with pytest.raises(FaultError, match="error 2601"):
        rig.arm.connect(1.0, threading.Event())
    assert controller.error == 2601
    here_mm = rig.true_mm.copy()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    assert (controller.error, rig.arm.state) == (0, DeviceState.READY)
    assert np.abs(rig.true_mm - here_mm).max() < 0.01


LAB, HERE = "192.168.0.20", "127.0.0.1"


def checked(host: str, cycles: int) -> Rig:
    """Return a bench whose driver gets no processor for so many cycles, amid the check."""
    rig = Rig(host=host, idle_check_s=0.5)
    go_on, begun_us = rig.wires.also, []
    watch = rig.wires.restart_timing

    def restart_timing() -> None:
        begun_us.append(rig.wires.clock.now_us)
        watch()

    def stall(step_us: int) -> None:
        go_on(step_us)
        if begun_us:
            into = (rig.wires.clock.now_us - begun_us[0]) // CYCLE_US - 50
            rig.wires.stalled = 0 <= into < cycles

    rig.wires.restart_timing, rig.wires.also = restart_timing, stall
    return rig


@pytest.mark.promise("P4")
@pytest.mark.parametrize(("cycles", "told"), [(0, False), (8, False), (12, True), (27, True)])
def test_a_starved_rig_is_warned_of_from_35_ms_on(cycles, told):
    rig = checked(LAB, cycles)
    rig.arm.connect(1.0, threading.Event())
    notice = rig.arm.describe().get("notice", "")
    assert rig.arm.state is DeviceState.READY
    assert bool(notice) is told
    assert not told or f"for {3.5 * (cycles + 1):.0f} ms" in notice


@pytest.mark.promise("P4")
def test_on_hardware_a_gap_over_101_ms_is_refused_before_the_servo_goes_on():
    rig = checked(LAB, 40)
    with pytest.raises(FaultError, match="for 144 ms") as refused:
        rig.arm.connect(1.0, threading.Event())
    assert refused.value.fault.code == "RIG-STARVED"
    assert not rig.device.controller.servo
    assert not [data for _, data in rig.wires.packets if data[:2] == b"\x01\x00"]


def test_an_emulated_arm_is_connected_with_a_warning():
    rig = checked(HERE, 40)
    rig.arm.connect(1.0, threading.Event())
    assert "144 ms" in rig.arm.describe()["notice"]


def test_cancelling_ends_the_check():
    rig = Rig(host=LAB, idle_check_s=60.0)
    cancel, go_on = threading.Event(), rig.wires.also

    def also(step_us: int) -> None:
        go_on(step_us)
        if rig.wires.clock.now_s() > 1.0:
            cancel.set()

    rig.wires.also = also
    with pytest.raises(FaultError, match="cancelled"):
        rig.arm.connect(1.0, cancel)
    assert rig.wires.clock.now_s() < 2.0


PLACING = MelfaPlacement((450.0, 20.0, -30.0), 0.3, math.pi, 180.0)


def any_joints(count, share=1.0):
    rng = np.random.default_rng(7)
    return rng.uniform(-1.0, 1.0, (count, 6)) * LIMITS_RAD * share


def test_the_flange_is_where_the_chain_of_frames_puts_it():
    for joints in any_joints(200):
        frame = emulated_controller.frame_of(joints)
        position, hand = flange(joints)
        assert position == pytest.approx(frame[:3, 3], abs=1e-9)
        assert hand == pytest.approx(frame[:3, :3], abs=1e-12)
        assert PLACING.pivot_mm(joints) == pytest.approx(
            PLACING.from_flange(position, hand), abs=1e-9
        )


def test_straight_up_it_is_as_long_as_its_links():
    position, hand = flange(np.zeros(6))
    assert position == pytest.approx([0.0, 0.0, 254.0 + 410.0 + 500.0 + 125.0])
    assert hand == pytest.approx(np.eye(3))


def test_joints_for_a_place_reach_it():
    rng = np.random.default_rng(3)
    for _ in range(60):
        pivot = rng.uniform([-120.0, -120.0, 0.0], [120.0, 120.0, 250.0])
        joints = PLACING.joints(pivot, READY_RAD)
        check_joints(joints)
        assert PLACING.pivot_mm(joints) == pytest.approx(pivot, abs=1e-8)
        assert PLACING.turn(joints) == pytest.approx(np.eye(3), abs=1e-7)
        solved = emulated_controller.solve(emulated_controller.frame_of(joints), joints + 0.05)
        assert solved == pytest.approx(joints, abs=1e-7)


def test_the_turn_nearest_the_present_one_is_taken():
    joints = PLACING.joints(np.array([10.0, 5.0, 100.0]), READY_RAD)
    near = joints + np.array([0.0, 0.0, 0.0, 2 * math.pi, 0.0, -2 * math.pi])
    assert PLACING.joints(np.array([10.0, 5.0, 100.0]), near) == pytest.approx(near)


@pytest.mark.promise("G8")
@pytest.mark.parametrize(
    ("at", "reason"),
    [((1500.0, 0.0, 300.0), "REACH"), ((0.0, 0.0, 500.0), "SINGULAR"), ((math.nan,) * 3, "REACH")],
)
def test_what_cannot_be_reached_is_refused_by_name(at, reason):
    with pytest.raises(RefusedError, match=reason):
        joints_for(np.array(at), np.diag([1.0, -1.0, -1.0]), READY_RAD)


@pytest.mark.parametrize(
    ("joint", "value", "reason"),
    [
        (1, LIMITS_RAD[1] - 0.01, "JOINT-RANGE"),
        (5, math.nan, "JOINT-RANGE"),
        (4, 0.05, "SINGULAR"),
        (2, 0.05, "SINGULAR"),
    ],
)
def test_the_guard_names_what_it_refuses(joint, value, reason):
    joints = READY_RAD.copy()
    check_joints(joints)
    joints[joint] = value
    with pytest.raises(RefusedError, match=reason):
        check_joints(joints)


@pytest.mark.promise("R7")
def test_a_step_over_the_share_of_the_top_speed_is_refused():
    check_step(READY_RAD, READY_RAD + 0.499 * STEPS_RAD, 0.5)
    for factor in (0.501, math.nan):
        with pytest.raises(RefusedError, match="top speed"):
            check_step(READY_RAD, READY_RAD + factor * STEPS_RAD, 0.5)


@pytest.mark.parametrize("euler", ["Rz(C) Ry(B) Rx(A)", "Rx(A) Ry(B) Rz(C)"])
def test_angles_of_the_controller_mean_the_same_on_both_sides(euler):
    rng = np.random.default_rng(1)
    for angles in rng.uniform(-1.4, 1.4, (50, 3)):
        hand = hand_of(*angles, euler)
        axes = "xyz" if euler.startswith("Rz") else "XYZ"  # fixed axes, moving axes
        assert hand == pytest.approx(Rotation.from_euler(axes, angles).as_matrix())
        assert emulated_controller.angles_of(hand, euler) == pytest.approx(tuple(angles))


@pytest.mark.promise("S7")
def test_an_overload_in_contact_draws_the_arm_back_by_2_mm():
    rig = Rig()
    rig.contact = lambda pivot: np.array([0.0, 0.0, 8.0 * max(TOUCH_MM - pivot[2], 0.0)])
    interlock = Interlock()
    arm = GuardedArm(rig.arm, interlock, rig.wires.clock.now_s, lambda: 0.0)
    arm.connect(1.0, threading.Event())
    rig.rest(0.7)
    interlock.renew_lease(rig.wires.clock.now_s())
    motion = arm.press(PRESS)
    for _ in range(8):
        interlock.renew_lease(rig.wires.clock.now_s())
        rig.rest(0.15)
    assert rig.true_mm[2] < TOUCH_MM - 0.1
    rig.contact = lambda pivot: np.full(3, np.nan)
    # So long until the fault is heard of.
    rig.rest(0.05)
    stood_mm = rig.true_mm[2]
    interlock.raise_fault(OVERLOAD)
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    rig.rest(0.35)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.1)
    assert rig.wires.stops == 0
    rig.rest(0.2)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.1)


FOLDER = Path(__file__).resolve().parents[4] / "resources" / "melfa"


def test_the_program_opens_the_stream_that_the_driver_expects():
    wanted = MelfaSettings().mxt
    lines = (FOLDER / f"{wanted.program}.prg").read_text("ascii").splitlines()
    orders = [line for line in lines if line and not line.startswith("'")]
    assert orders[0] == "Servo On"
    assert re.fullmatch(r'Open "ENET:[0-9.]+" As #1', orders[1])
    assert orders[2] == f"Mxt 1,{wanted.position_type},10"
    assert orders[-1] == "End"


NEVER = (
    "RSTPWR", "HOME", "DATINST", "AXDATINST", "BREAKON", "BREAKONF", "FINIT", "FDEL", "PRMINIT",
    "PRM=", "PAW=", "PAW2=", "PRMUNDO", "ERRLOGCLR",
)  # fmt: skip


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
    ("read", "name"),
    [
        *((r3_protocol.read_axes, f"pposf-reply{end}") for end in ("", "-6axis")),
        *((r3_protocol.read_axes, f"jposf-reply{end}") for end in ("", "-limit")),
        (r3_protocol.read_state, "state-reply"),
    ],
)
def test_an_answer_prints_as_it_was_read(read, name):
    answer = r3_protocol.decode_reply(data(f"r3-{name}")).answer
    assert read(answer).answer() == answer


@pytest.mark.parametrize(
    "answer", ["", "X;1", "X;1;X;2;;7,0;100;0.00;00000000", "X;nan;;7,0;100;0.00;00000000", ";;;;"]
)
def test_other_position_texts_are_refused(answer):
    with pytest.raises(ProtocolError):
        r3_protocol.read_axes(answer)


@pytest.mark.parametrize(("press_n", "why"), [(math.nan, "FT-UNKNOWN"), (3.0, "DRAGGING")])
def test_nothing_moves_sideways_without_a_number_of_the_wrist(press_n: float, why: str) -> None:
    rig = Rig((0.0, 0.0, 75.0))
    interlock = Interlock()
    arm = GuardedArm(rig.arm, interlock, rig.wires.clock.now_s, lambda: press_n)
    arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    interlock.renew_lease(rig.wires.clock.now_s())
    before_mm = rig.true_mm.copy()
    with pytest.raises(RefusedError, match=why):
        arm.move_to(Pose(3.0, 0.0, 75.0), 20.0)
    rig.rest(0.2)
    assert rig.true_mm == pytest.approx(before_mm, abs=0.01)


def connected(**more):
    rig = Rig(**more)
    rig.noise_n = 0.05
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.3)
    return rig


def interrupted(rig, order, wanted):
    """Give an order and press STOP as ``wanted`` was answered; the code of its fault, "" if none.

    ``wanted``: a request by its text, or by its number; None if the order asks no such request.
    """
    wires = rig.wires
    ask, finish = wires.ask, wires.finish
    tickets = []
    pressed = False

    def asked(request, timeout_s):
        ticket = ask(request, timeout_s)
        tickets.append((ticket, f"{request.command} {request.argument}".strip()))
        return ticket

    def finished(ticket):
        nonlocal pressed
        finish(ticket)
        number = next(k for k, (one, _) in enumerate(tickets) if one is ticket)
        if not pressed and wanted in (number, tickets[number][1]):
            pressed = True
            rig.arm.stop()

    wires.ask, wires.finish = asked, finished
    code = ""
    try:
        order()
    except FaultError as error:
        code = error.fault.code
    finally:
        wires.ask, wires.finish = ask, finish
    return code if pressed else None


def still(rig, for_s=0.2):
    """True if the arm stands, after it has had time to brake."""
    rig.rest(0.2)
    before = rig.true_mm
    rig.rest(for_s)
    return bool(np.abs(rig.true_mm - before).max() < 0.01)


@pytest.mark.promise("R14")
@pytest.mark.parametrize("request_", ["VAL MDKZ", "RUN TDPROBE;1"])
def test_a_force_program_that_is_being_prepared_does_not_begin(request_):
    rig = connected(stiffness_mode="controller")
    assert interrupted(rig, lambda: rig.arm.press(TRIALS_PRESS), request_) == "STOPPED"
    assert rig.device.controller.program == ""
    assert still(rig)


@pytest.mark.promise("R14")
def test_a_stream_that_is_being_opened_again_carries_no_motion():
    rig = connected()
    rig.arm.stop()
    rig.rest(0.3)
    up = Pose(0.0, 0.0, 120.0)
    assert interrupted(rig, lambda: rig.arm.move_to(up, 20.0), "RUN TDMXT;1") == "STOPPED"
    assert rig.device.controller.program == ""
    assert still(rig)


@pytest.mark.promise("R14")
def test_motors_that_are_being_switched_on_stay_off():
    rig = connected()
    rig.arm.servo(False)
    assert interrupted(rig, lambda: rig.arm.servo(True), "CNTL ON") == "STOPPED"
    assert not rig.device.controller.servo
    with pytest.raises(FaultError, match="off"):
        rig.arm.move_to(Pose(0.0, 0.0, 120.0), 20.0)


def _servo_is_off(rig):
    rig.arm.servo(False)


def _stopped(rig):
    rig.arm.stop()
    rig.rest(0.3)


# by name: what comes before, the order, its stiffness mode, and the requests that it takes at least
ORDERS = {
    "press of the controller": (bool, lambda arm: arm.press(TRIALS_PRESS), "controller", 30),
    "move after a stop": (_stopped, lambda arm: arm.move_to(Pose(0, 0, 120), 20), "software", 4),
    "servo on": (_servo_is_off, lambda arm: arm.servo(True), "software", 7),
    "servo off": (bool, lambda arm: arm.servo(False), "software", 3),
    "closing": (bool, lambda arm: arm.close(), "software", 5),
}


@pytest.mark.promise("R14")
@pytest.mark.parametrize("name", ORDERS)
def test_nothing_moves_after_a_stop_between_any_two_requests(name):
    prepare, order, mode, least = ORDERS[name]
    for count in itertools.count():
        rig = connected(stiffness_mode=mode)
        prepare(rig)
        if interrupted(rig, lambda rig=rig: order(rig.arm), count) is None:
            break
        assert still(rig), count
        assert rig.arm.state is DeviceState.CLOSED or rig.arm._core.program is None, count
        assert rig.device.controller.program != "probe", count
    assert count >= least


def test_a_program_whose_stream_has_just_ended_does_not_wait_for_the_next():
    rig = connected()
    rig.arm._core.stop()
    motion = rig.arm._orders.travel(
        rig.arm._core, (np.array([0.0, 0.0, 120.0]), np.eye(3)), (20.0, 0.1)
    )
    assert motion.done
    assert rig.arm._core.program is None


@pytest.mark.promise("R5", "R7")
@pytest.mark.parametrize("seed", range(3))
def test_whatever_goes_wrong_ends_as_documented(seed):
    ended = trial(seed)
    assert ended.broken == (), ended
