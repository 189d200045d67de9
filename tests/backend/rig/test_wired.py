"""The devices of a bench file: all five, in the order that is safe, and named when one is away."""

import threading
import time

import pytest

from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.emulation.fault_plan import add_noise, hanging_gripper
from touchdown.backend.emulation.server import TcpServer
from touchdown.backend.rig.remote_devices import BenchDevices


def wired(**tables):
    frames = {finger: Stream(finger, 8) for finger in FINGERS}
    samples, poses = SampleStream("force_torque", 6, 4096), SampleStream("arm", 3, 64)
    settings = HardwareSettings.model_validate(tables)
    return BenchDevices(settings, time.monotonic, frames, samples, poses, Interlock()), samples


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
    told = []
    with pytest.raises(FaultError, match="2D8Y-69GR"):
        devices.connect(threading.Event(), told.append, limit_s=1.0)
    assert told == ["force_torque", "tactile_left"]
    assert devices.force_torque.state is DeviceState.READY
    assert samples.count > 0
    devices.close()
    assert {device.state for device in devices.devices.values()} == {DeviceState.CLOSED}
    front.close()


def test_a_bench_file_without_a_sensor_is_bad_input():
    with pytest.raises(InputError, match=r"ft\.address"):
        wired(ft={"driver": "dynpick"})
