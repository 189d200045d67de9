"""The rig as a process of its own, with emulated devices: what it loads, and every way to die.

Order and outcome are asserted, never times: a busy machine takes as long as it takes. The figures
are in tests/bench/arm.py.
"""

import os
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.backend.devices.waiting import until
from tests.backend.rig.served import Backend, Served
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.protocols import DeviceState


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
