# ruff: noqa: N802
"""The sensor built into a Universal Robots wrist, over a module that has what ur_rtde offers."""

import inspect
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.devices.ur import rtde
from touchdown.backend.devices.ur.rtde import SAMPLE, UrWrenchDriver

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
PERIOD_S = 0.002
SETTINGS = HardwareSettings.model_validate(
    {
        "ft": {"driver": "ur", "rotation": ((0, -1, 0), (1, 0, 0), (0, 0, 1)), "sign": -1},
        "ur": {"host": "robot", "rate_hz": 500.0},
    }
)


class Robot:
    """What ``rtde_receive.RTDEReceiveInterface`` tells; every sample trembles a little."""

    def __init__(self, host, rate_hz):
        assert (host, rate_hz) == ("robot", 500.0)
        self.begun_s = None
        self.halted_s = None
        self.connected, self.lacks = True, False

    def getTimestamp(self):
        now_s = time.monotonic() if self.halted_s is None else self.halted_s
        self.begun_s = now_s if self.begun_s is None else self.begun_s
        return PERIOD_S * int((now_s - self.begun_s) / PERIOD_S)

    def getFtRawWrench(self):
        if self.lacks:
            raise RuntimeError("unable to get state data for specified key: ft_raw_wrench")
        return [v + 1e-6 * (self.getTimestamp() % 1.0) for v in LOAD]

    def isConnected(self):
        return self.connected

    def disconnect(self):
        self.connected = False


@pytest.fixture
def robots(monkeypatch):
    made = []

    def receive(host, rate_hz):
        made.append(Robot(host, rate_hz))
        return made[-1]

    module = SimpleNamespace(RTDEReceiveInterface=receive)
    monkeypatch.setitem(rtde.importlib.sys.modules, "rtde_receive", module)
    return made


@pytest.fixture
def driver():
    made = make_force_torque(SETTINGS, time.monotonic)
    yield made
    made.close()


def test_it_is_read_like_any_wrist_sensor(robots, driver):
    driver.connect(5.0, threading.Event())
    until(lambda: driver.samples.count >= 40)
    samples = driver.samples.since(0)
    # Turned into tool axes, and the other way round: force by the sensor.
    wanted = [-2.0, -1.0, 10.5, -0.2, -0.1, -0.05]
    assert np.abs(samples.values - wanted).max() < 1e-5
    assert (np.diff(samples.t_s) > 0).all()
    # What a busy computer misses is counted: nothing of the robot's time is left out.
    robot = robots[0]
    robot.halted_s = time.monotonic()
    told = round(robot.getTimestamp() / PERIOD_S)
    until(lambda: driver.health.received + driver.health.lost == told)
    assert driver.identity.model == "built-in F/T"
    assert driver.rated.tolist() == [50.0, 50.0, 50.0, 10.0, 10.0, 10.0]


@pytest.mark.parametrize("how", ["mute", "gone", "old"])
def test_a_robot_that_tells_nothing_is_a_fault(robots, driver, how):
    driver.connect(5.0, threading.Event())
    robot = robots[0]
    if how == "old":
        robot.lacks = True
    else:
        robot.halted_s = time.monotonic()
        robot.connected = how == "mute"
    until(lambda: driver.state is DeviceState.FAULT)
    assert driver.fault.code == "FT-LINK"
    words = {"mute": "silent", "gone": "closed the connection", "old": "tells no wrench"}
    assert words[how] in driver.fault.what


def test_without_the_package_it_says_so(driver, monkeypatch):
    monkeypatch.setitem(rtde.importlib.sys.modules, "rtde_receive", None)
    with pytest.raises(FaultError, match="'ur_rtde' is not installed"):
        driver.connect(1.0, threading.Event())


def test_a_gap_in_the_time_of_the_robot_is_counted_and_the_end_of_its_range_told():
    language = UrWrenchDriver(SETTINGS, "rtde://robot")
    told = [SAMPLE.pack(t_s, *LOAD) for t_s in (5.0, 5.002, 5.010, 5.012)]
    assert [reading.missed for data in told for reading in language.take(data)] == [0, 0, 3, 0]
    (reading,) = language.take(SAMPLE.pack(5.014, 0.0, 0.0, -50.0, 0.0, 0.0, 0.0))
    assert reading.overload
    assert language.take(SAMPLE.pack(5.016, float("nan"), *LOAD[1:])) == []
    assert language.refusals.in_a_row == 1


@pytest.mark.optional
def test_the_package_has_what_the_sensor_asks():
    theirs = pytest.importorskip("rtde_receive").RTDEReceiveInterface
    for name, method in inspect.getmembers(rtde.WrenchSource, inspect.isfunction):
        if not name.startswith("_"):
            assert list(inspect.signature(method).parameters) == ["self"]
            assert callable(getattr(theirs, name))
