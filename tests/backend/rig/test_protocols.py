"""The log of an emulated arm that figures of starved rigs are judged by sees a burst as one."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.backend.devices.waiting import until
from tests.backend.rig.hosted import Hosted
from tests.backend.rig.served import Backend, Served
from tests.bench.children.logged_arm import ahead_of
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core import FaultError, InputError, Pose, RawStreams
from touchdown.backend.devices import DeviceState, Interlock
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.emulation import TcpServer, add_noise, hanging_gripper
from touchdown.backend.rig import BenchDevices, process
from touchdown.backend.rig.host import DeviceWorkers


@pytest.mark.promise("P4")
def test_what_was_missed_and_is_made_up_is_a_burst_and_one_late_command_is_none():
    grid_s = 1e3 + CYCLE_S * np.arange(100.0)
    assert ahead_of(np.array([])) == 0.0
    assert ahead_of(grid_s) == pytest.approx(0.0, abs=1e-6)
    late_s = grid_s.copy()
    late_s[50] += 0.99 * CYCLE_S
    assert 0.9 < ahead_of(late_s) <= 1.0
    skipped_s = np.delete(late_s, range(30, 50))
    assert ahead_of(skipped_s) == ahead_of(late_s)
    made_up_s = grid_s.copy()
    made_up_s[30:50] = grid_s[50] - 1e-4
    assert ahead_of(made_up_s) > 15.0


@pytest.fixture(scope="module")
def served():
    made = Served()
    yield made
    made.close()


@pytest.fixture
def backend(served):
    made = Backend(served.settings)
    yield made
    made.close()


def loaded(number):
    """What of the libraries that a rig must not have the system has mapped for a process."""
    maps = Path(f"/proc/{number}/maps")
    if not maps.exists():
        pytest.skip("only Linux tells what a process has loaded")
    mapped = maps.read_text()
    assert "numpy" in mapped
    return [name for name in ("PySide6", "torch", "cv2", "mujoco") if name in mapped]


def test_stop_reaches_the_controller_and_after_reset_the_arm_moves_on(served, backend):
    motion = backend.moving()
    before = len(served.arm.stops)
    backend.interlock.stop()
    backend.arm.stop()
    until(lambda: len(served.arm.stops) > before and motion.done)
    with pytest.raises(FaultError) as caught:
        motion.result()
    assert caught.value.fault.code == "STOPPED"
    assert backend.arm.state is DeviceState.READY
    backend.interlock.reset()
    assert not backend.moving().done
    # A window, networks of neurons and pictures have no business beside a loop of 3.5 ms.
    assert loaded(backend.link.hello["pid"]) == []


@pytest.mark.promise("P8")
def test_a_rig_that_is_killed_is_told_at_once_and_starts_only_with_a_new_connection(backend):
    motion = backend.moving()
    first = backend.link.hello["pid"]
    os.kill(first, signal.SIGKILL)
    until(lambda: motion.done)
    with pytest.raises(FaultError) as caught:
        motion.result()
    assert caught.value.fault.code == "CONTROL-LOST"
    until(lambda: backend.interlock.latched)
    assert [fault.code for fault in backend.interlock.faults] == ["CONTROL-LOST"]
    devices = (backend.arm, backend.gripper, backend.wrist)
    assert {device.state for device in devices} == {DeviceState.FAULT}
    # What it had recorded is still there.
    assert any("arm.move_to" in text for _, text in backend.link.memory.notes())
    backend.interlock.reset()
    with pytest.raises(FaultError, match="has ended"):
        backend.arm.move_to(Pose(0.0, 0.0, 100.0), 10.0)
    backend.disconnect()
    assert not psutil.pid_exists(first)
    assert not backend.moving().done
    assert backend.link.hello["pid"] != first


@pytest.mark.promise("P8")
def test_a_rig_that_stands_still_is_lost_too(backend):
    motion = backend.moving()
    number = backend.link.hello["pid"]
    os.kill(number, signal.SIGSTOP)
    until(lambda: motion.done)
    os.kill(number, signal.SIGCONT)
    assert backend.link.lost.code == "CONTROL-LOST"
    backend.disconnect()
    assert not psutil.pid_exists(number)


@pytest.mark.promise("R12", "P9")
def test_a_backend_that_is_killed_leaves_a_stopped_arm_and_no_process(served):
    command = [sys.executable, "-m", "tests.backend.rig.served", served.settings.model_dump_json()]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as child:
        number = int(child.stdout.readline())
        before = len(served.arm.stops)
        child.kill()
    until(lambda: len(served.arm.stops) > before)
    until(lambda: not psutil.pid_exists(number))


def addresses(number):
    """Where sockets of a process listen or, where nothing is connected, could be sent to."""
    found = psutil.Process(number).net_connections("inet")
    open_ones = [c for c in found if c.status == psutil.CONN_LISTEN or not c.raddr]
    return {(c.laddr.ip if c.laddr else "") for c in open_ones}


@pytest.mark.promise("D10")
def test_nobody_can_come_in_but_to_emulated_devices_and_those_only_from_here(backend):
    backend.connect()
    # The rig calls its devices; whoever would call it finds nothing.
    assert addresses(backend.link.hello["pid"]) == set()
    assert addresses(os.getpid()) == {"127.0.0.1"}


def test_what_the_rig_refuses_at_its_start_is_said_in_words(served):
    bad = served.settings.model_copy(
        update={"ft": served.settings.ft.model_copy(update={"address": ""})}
    )
    refused = Backend(HardwareSettings.model_construct(**dict(bad)))
    try:
        with pytest.raises(InputError, match=r"ft\.address"):
            refused.connect()
        assert (refused.arm.state, refused.interlock.latched) == (DeviceState.CLOSED, False)
    finally:
        refused.close()


def wired(**tables):
    raw, settings = RawStreams.new(), HardwareSettings.model_validate(tables)
    return BenchDevices(settings, time.monotonic, raw, Interlock()), raw.samples


def test_sensors_come_first_and_the_arm_that_moves_on_them_last():
    devices, _ = wired(ft={"driver": "dynpick", "address": "nowhere"})
    names = ["force_torque", "tactile_left", "tactile_right", "gripper", "arm"]
    assert list(devices.devices) == names
    assert {device.name for device in devices.devices.values()} == set(names)


def test_the_first_that_is_away_is_named_and_those_before_it_stay():
    front = TcpServer(EmulatedDynpick(add_noise(hanging_gripper)))
    front.start()
    tables = {
        "ft": {"driver": "dynpick", "address": front.url},
        "gelsight": {"left": {"serial": "2D8Y-69GR"}, "by_id": "none", "names": "none"},
    }
    devices, samples = wired(**tables)
    with pytest.raises(FaultError, match="2D8Y-69GR"):
        devices.connect(threading.Event(), limit_s=1.0)
    assert devices.arm.state is DeviceState.CLOSED
    assert devices.force_torque.state is DeviceState.READY
    assert samples.count > 0
    devices.close()
    assert {device.state for device in devices.devices.values()} == {DeviceState.CLOSED}
    front.close()


def test_the_log_gets_the_first_bytes_that_the_rig_could_not_read(caplog):
    caplog.set_level("INFO", "touchdown.rig")
    front = TcpServer(EmulatedDynpick(add_noise(hanging_gripper)))
    front.damage = lambda out: b"PC LOAD LETTER" if out else b""
    front.start()
    devices, _ = wired(ft={"driver": "dynpick", "address": front.url})
    with pytest.raises(FaultError, match="cannot be read"):
        devices.connect(threading.Event(), limit_s=1.0)
    devices.close()
    front.close()
    assert b"PC LOAD".hex(" ") in caplog.text


def test_a_bench_file_without_a_sensor_is_bad_input():
    with pytest.raises(InputError, match=r"ft\.address"):
        wired(ft={"driver": "dynpick"})


@pytest.fixture
def rig():
    made = Hosted()
    yield made
    made.close()


def test_an_order_waits_for_none_of_another_device_and_after_leaving_none_begins():
    hold, begun, done = threading.Event(), threading.Event(), []

    def carry_out(order):
        if order["id"] == 1:
            begun.set()
            assert hold.wait(30.0)
        done.append(order["id"])

    workers = DeviceWorkers(("arm", "gripper"), carry_out)
    assert workers.give("arm", {"id": 1})
    assert workers.give("arm", {"id": 2})
    assert workers.give("gripper", {"id": 3})
    assert not workers.give("head", {"id": 4})
    assert begun.wait(30.0)
    workers.leave()
    assert not workers.idle("arm", 0.0)
    hold.set()
    assert workers.idle("arm", 30.0)
    assert workers.idle("gripper", 30.0)
    assert 1 in done
    assert 2 not in done


def test_the_rig_closes_no_device_that_is_just_being_connected(rig, monkeypatch):
    begun, free = threading.Event(), threading.Event()

    def connect(timeout_s, cancel):
        rig.wrist.state = DeviceState.CONNECTING
        begun.set()
        assert free.wait(30.0)

    monkeypatch.setattr(process, "FAREWELL_S", 0.05)
    monkeypatch.setattr(rig.wrist, "connect", connect)
    order = {"kind": "order", "id": 1, "order": "force_torque.connect", "args": {"timeout_s": 1.0}}
    rig.host.take({**order, "lease_until_s": rig.lease_s()})
    assert begun.wait(30.0)
    process._end(rig.host)
    assert rig.gripper.state is DeviceState.CLOSED
    assert rig.wrist.state is DeviceState.CONNECTING
    free.set()
    assert rig.host.workers.idle("force_torque", 30.0)
    process._end(rig.host)
    assert rig.wrist.state is DeviceState.CLOSED
