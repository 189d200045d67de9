"""Driver and emulated controller over real sockets: order of start-up, motion, stop, faults."""

import contextlib
import socket
import threading
import time

import numpy as np
import pytest

from tests.backend.devices.melfa.emulated_arm import settings
from tests.backend.devices.waiting import until
from touchdown.backend.bench.emulator_registry import emulate
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core import FaultError, ManualClock, Pose, SampleStream
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.melfa import READY_RAD, EmulatedMelfa, MelfaServer
from touchdown.backend.devices.melfa.driver import MelfaArm, MelfaPrograms
from touchdown.backend.devices.melfa.realtime_protocol import (
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtRequest,
    decode_mxt_reply,
    encode_mxt_request,
)
from touchdown.backend.devices.melfa.sockets import SocketLinks
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.emulation import EmulationChoice, TcpServer

START = np.array([0.0, 0.0, 60.0])


def front_of(**more):
    wanted = settings(servo_delay_s=0.05, **more)
    start = MelfaPrograms(wanted).placing.joints(START, READY_RAD)
    return MelfaServer(EmulatedMelfa(wanted, start_rad=start))


def arm_of(front):
    return arm_for(front.settings)


def arm_for(wanted):
    wires, wrench = SocketLinks(wanted, time.monotonic), SampleStream("force_torque", 6, 1000)
    return MelfaArm(wires, wrench, wanted, time.monotonic)


@pytest.fixture
def front():
    # A machine that is busy with other tests may stall for a while: that is not tested here.
    made = front_of(mxt={"mxttout": 2000})
    made.start()
    yield made
    made.close()


@pytest.fixture
def arm(front):
    made = arm_of(front)
    yield made
    made.close()


def connect(arm):
    arm.connect(5.0, threading.Event())


def patiently(arm, act=lambda: None):
    """Connect and ``act``; again where this machine stalled longer than a stream may be silent."""
    for _ in range(10):
        try:
            connect(arm)
            return act()
        except FaultError as error:
            if error.fault.code != "MXT-LOST":
                raise
            arm.close()
    raise AssertionError("this machine stalls all the time")


def rise(arm, to_mm, until_mm):
    """Move up; return the motion once the arm is measured over ``until_mm``."""
    motion = arm.move_to(Pose(0.0, 0.0, to_mm), 20.0)
    until(lambda: motion.done or height(arm) > until_mm)
    if motion.done:
        motion.result()
    return motion


def height(arm):
    measured = arm.poses.since(0).values
    return float(measured[-1, 2]) if len(measured) else float("nan")


def said(front):
    return b"".join(e.data for e in front.log if e.incoming and len(e.data) != 196)


def in_order(text, *parts):
    places = [text.find(part) for part in parts]
    return -1 not in places and places == sorted(places)


def test_it_starts_moves_and_shuts_down_in_the_documented_order(front, arm):
    patiently(arm, lambda: rise(arm, 62.0, 100.0))
    assert arm.state is DeviceState.READY
    assert arm.identity.model == "RV-5AS-D"
    until(lambda: abs(height(arm) - 62.0) < 0.1)
    arm.close()
    assert arm.state is DeviceState.CLOSED
    assert in_order(
        said(front),
        *(b"OPEN=TOUCHDOWN\r", b"ERROR", b"PARMXTTOUT", b"CNTLON", b"OVRD=10", b"SRVON"),
        *(b"SLOTINIT", b"RUNTDMXT;1", b"1;1;STOP", b"SRVOFF", b"CNTLOFF", b"CLOSE"),
    )
    packets = [e.data[0] for e in front.log if e.incoming and len(e.data) == 196]
    assert packets[0] == 0
    assert packets[-1] == 255
    assert not front._device.controller.servo


def test_the_rehearsal_controller_is_driven_by_the_bench_table_that_it_prints():
    served = emulate(EmulationChoice("melfa"))
    served.start()
    table = {key.removeprefix("melfa").lstrip("."): dict(row) for key, row in served.bench.items()}
    told = {**table.pop(""), **table, "servo_timeout_s": 10.0, "realtime_priority": 0}
    wanted = HardwareSettings.model_validate({"melfa": told}).melfa
    arm = arm_for(wanted)
    try:
        patiently(arm)
        assert arm.state is DeviceState.READY
    finally:
        arm.close()
        served.close()


def test_a_pulled_plug_is_a_fault_and_comes_back_by_hand(front, arm):
    patiently(arm)
    front.inject("unplug", for_s=0.3)
    until(lambda: arm.state is DeviceState.FAULT)
    with pytest.raises(FaultError):
        arm.move_to(Pose(0.0, 0.0, 61.0), 20.0)
    until(lambda: not front._is_unplugged())
    arm.close()

    def again():
        with contextlib.suppress(FaultError):
            connect(arm)
            return True

    until(again)
    assert arm.state is DeviceState.READY


@pytest.mark.parametrize(
    ("more", "trouble", "code"),
    [
        ({"mxt": {"mxttout": -1}}, lambda c: None, "MXTTOUT"),
        ({}, lambda c: c.raise_error(61), "HW-STOP"),
        ({}, lambda c: c.missing_programs.add("TDMXT"), "REJECTED"),
        ({}, lambda c: setattr(c, "right", object()), "NOT-READY"),
    ],
    ids=["no time limit", "emergency stop", "no program", "right taken"],
)
def test_a_controller_that_is_not_ready_is_refused_by_name(more, trouble, code):
    front = front_of(**more)
    trouble(front._device.controller)
    front.start()
    arm = arm_of(front)
    try:
        with pytest.raises(FaultError) as raised:
            connect(arm)
    finally:
        arm.close()
        front.close()
    assert raised.value.fault.code == code
    assert arm.state is DeviceState.CLOSED
    assert front._device.stream.commands == 0


def test_another_arm_at_the_address_is_refused(front):
    arm = arm_for(front.settings.model_copy(update={"robot_type": "RV-8CRL"}))
    with pytest.raises(FaultError, match="OTHER-ARM"):
        connect(arm)


@pytest.mark.promise("R11")
def test_a_second_program_is_refused_until_the_first_lets_go(front, arm):
    patiently(arm)
    second = arm_of(front)
    with pytest.raises(FaultError, match="ARM-TAKEN"):
        connect(second)
    arm.close()
    patiently(second)
    second.close()


@pytest.mark.promise("R10")
def test_stop_goes_out_while_the_command_channel_is_silent(front, arm):
    motion = patiently(arm, lambda: rise(arm, 160.0, 61.0))
    front.inject("silent", for_s=1.5)
    arm.stop()
    assert motion.done
    until(lambda: front.stops)
    until(lambda: front._device.controller.program == "")
    until(lambda: arm.state is DeviceState.FAULT)
    assert arm.fault.code == "ARM-LINK"


def test_nobody_at_the_address_is_one_fault():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    wanted = settings(host="127.0.0.1", r3={"port": port})
    arm = arm_for(wanted)
    with pytest.raises(FaultError, match="ARM-LINK"):
        connect(arm)
    arm.stop()
    arm.close()


def test_the_stream_follows_the_caller_that_commands_until_it_leaves():
    clock, device = ManualClock(), EmulatedMelfa(settings(), streaming=True)
    front = MelfaServer(device)
    front._clock = clock
    front.start()
    first, second = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))

    def asked(wire, command, joints=None):
        target = joints and AxisValues(BlockKind.JOINT, (*joints, 0.0, 0.0))
        wire.send(encode_mxt_request(MxtRequest(command, target, (2, 0, 0, 0))))

    def exchange(wire, *asking):
        asked(wire, *asking)
        return decode_mxt_reply(wire.recv(300)).blocks[0].axes[:6]

    try:
        for wire in (first, second):
            wire.settimeout(60.0)
            wire.connect((front.settings.host, front.settings.mxt.port))
        here = exchange(first, MxtCommand.NONE)
        # Positions are told to whoever asks, as long as nobody commands motion.
        assert exchange(second, MxtCommand.NONE) == here
        exchange(first, MxtCommand.MOVE, here)
        asked(second, MxtCommand.NONE)
        asked(second, MxtCommand.MOVE, (1.0,) * 6)
        assert exchange(first, MxtCommand.MOVE, here) == here
        second.setblocking(False)
        with pytest.raises(BlockingIOError):
            second.recv(300)
        assert (device.controller.error, device.stream.commands) == (0, 2)
        second.settimeout(60.0)
        clock.advance(101_000)
        assert exchange(second, MxtCommand.NONE) == here
    finally:
        front.close()
        first.close()
        second.close()


@pytest.mark.promise("S5")
def test_another_device_on_the_command_port_is_named():
    others = [TcpServer(EmulatedLeptrino(lambda now_s: (0.0,) * 6)) for _ in range(2)]
    for other in others:
        other.start()
    (host, port), (_, stop_port) = (other.address for other in others)
    arm = arm_for(settings(host=host, r3={"port": port, "stop_port": stop_port}))
    words = "This is a Leptrino force/torque sensor, expected a MELFA controller"
    try:
        with pytest.raises(FaultError, match=words):
            connect(arm)
    finally:
        arm.close()
        for other in others:
            other.close()


@pytest.mark.promise("R14")
def test_stop_while_connecting_ends_the_start_up():
    front = front_of(servo_timeout_s=30.0)
    front._device.controller.settings = front.settings.model_copy(update={"servo_delay_s": 30.0})
    front.start()
    arm, raised = arm_of(front), []

    def try_it():
        try:
            connect(arm)
        except FaultError as error:
            raised.append(error.fault.code)

    thread = threading.Thread(target=try_it)
    thread.start()
    try:
        until(lambda: b"SRVON" in said(front))
        arm.stop()
        thread.join(60.0)
        assert not thread.is_alive()
    finally:
        arm.close()
        front.close()
    assert raised == ["STOPPED"]
    assert front.stops
