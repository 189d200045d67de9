"""Connecting in the safe order, one device at a time, and only the device that was meant."""

import pytest

from tests.backend.devices.waiting import until
from tests.backend.rig.scripted import LINES, held, scripted
from touchdown.backend.core.faults import InputError, RefusedError
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.runs.manual_control import latch_device_faults


def made(**more):
    devices, log = scripted()
    return BenchConnection(devices, **more), devices, log


def line(connection, name):
    return next(line for line in connection.lines() if line.name == name)


def states(connection):
    return {line.name: line.state for line in connection.lines()}


def test_all_are_connected_the_arm_last_and_the_bench_is_told_once():
    told = []
    connection, _, log = made(when_ready=lambda: told.append("ready"))
    assert set(states(connection).values()) == {"closed"}
    connection.begin()
    assert connection.wait(60.0)
    assert log == [f"connect {name}" for name in LINES]
    assert told == ["ready"]
    assert connection.ready
    assert {line.steps for line in connection.lines()} == {4}
    connection.close()
    assert log[-5:] == [f"close {name}" for name in reversed(LINES)]


def test_each_step_shows_while_it_goes_on():
    connection, devices, _ = made()
    devices["gripper"].hold = held()
    connection.begin()
    until(lambda: line(connection, "gripper").state == "connecting")
    assert line(connection, "arm").state == "waiting"
    assert line(connection, "tactile_left").state == "ready"
    with pytest.raises(RefusedError, match="Wait until"):
        connection.begin()
    devices["gripper"].hold.set()
    assert connection.wait(60.0)
    assert connection.ready


def test_one_that_fails_says_at_which_step_and_the_others_go_on():
    connection, devices, log = made()
    devices["tactile_left"].fails_at = "configure"
    connection.begin()
    connection.wait(60.0)
    failed = line(connection, "tactile_left")
    assert (failed.state, failed.steps) == ("failed", 2)
    assert failed.fault.next_step == "Look at it."
    assert connection.missing() == ("tactile_left",)
    devices["tactile_left"].fails_at = ""
    log.clear()
    connection.begin(("tactile_left",))
    connection.wait(60.0)
    assert log == ["connect tactile_left"], "the others are left alone"
    assert connection.ready


def test_a_driver_that_fails_in_its_own_way_is_told_and_the_others_go_on(monkeypatch):
    connection, devices, _ = made()

    def broken(limit_s, cancel):
        raise KeyError("gain")

    monkeypatch.setattr(devices["tactile_left"], "connect", broken)
    connection.begin()
    connection.wait(60.0)
    failed = line(connection, "tactile_left")
    assert failed.fault.code == "DRIVER-FAILED"
    assert "tactile_left failed: KeyError: 'gain'" in failed.fault.what
    assert connection.missing() == ("tactile_left",)


def test_the_arm_is_not_switched_on_without_the_wrist_sensor():
    connection, devices, log = made()
    devices["force_torque"].fails_at = "reach"
    connection.begin()
    connection.wait(60.0)
    assert line(connection, "arm").fault.code == "NO-WRIST"
    assert "connect arm" not in log


def test_another_device_than_the_first_time_is_closed_again():
    connection, devices, _ = made()
    connection.begin()
    connection.wait(60.0)
    devices["tactile_right"].lose()
    devices["tactile_right"].serial = "other"
    connection.begin(("tactile_right",))
    connection.wait(60.0)
    found = line(connection, "tactile_right")
    assert (found.state, found.fault.code) == ("failed", "OTHER-DEVICE")
    assert "other answers instead of tactile_right-1" in found.fault.what


@pytest.mark.promise("C6")
def test_a_number_of_the_file_is_asked_for_from_the_start():
    connection, _, _ = made(serials={"gripper": "G7", "arm": ""})
    connection.begin()
    connection.wait(60.0)
    assert line(connection, "gripper").fault.code == "OTHER-DEVICE"
    assert line(connection, "arm").state == "ready"


def test_cancel_ends_it_where_it_is():
    connection, devices, log = made()
    devices["gripper"].hold = held()
    connection.begin()
    until(lambda: line(connection, "gripper").state == "connecting")
    connection.cancel()
    assert connection.wait(60.0)
    assert states(connection) == dict(zip(LINES, ["ready"] * 3 + ["failed", "closed"], strict=True))
    assert "connect arm" not in log


def test_a_lost_device_is_told_and_its_line_says_what_to_do():
    connection, devices, _ = made()
    connection.begin()
    connection.wait(60.0)
    interlock = Interlock()
    latch_device_faults(devices.values(), interlock)
    assert not interlock.latched
    devices["force_torque"].lose()
    latch_device_faults(devices.values(), interlock)
    assert [fault.code for fault in interlock.faults] == ["LINK"]
    assert line(connection, "force_torque").fault.next_step == "Plug it in."
    connection.begin()
    connection.wait(60.0)
    assert connection.ready
    assert line(connection, "force_torque").fault is None


def test_one_device_is_disconnected_and_the_arm_goes_first_of_all():
    connection, _, log = made()
    connection.begin()
    connection.wait(60.0)
    log.clear()
    connection.disconnect(("tactile_left",))
    connection.wait(60.0)
    assert log == ["close tactile_left"]
    connection.disconnect()
    connection.wait(60.0)
    assert log[1] == "close arm"


def test_a_bench_that_cannot_be_used_says_why():
    def refuse():
        raise InputError("There is no piece 'x'.", "lab.toml", "Correct it.")

    connection, _, _ = made(when_ready=refuse)
    connection.begin()
    connection.wait(60.0)
    assert "There is no piece" in str(connection.trouble)
