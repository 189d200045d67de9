"""The reader with a Dynpick against the emulated sensor, over TCP and over a pseudo terminal."""

import sys
import threading
import time

import numpy as np
import pytest

from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.emulation.fault_plan import add_noise
from touchdown.backend.emulation.server import PtyServer, TcpServer
from touchdown.backend.rig.connection import reconnect

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
LEAST = 1 / np.array([65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75])
"""One count of each axis."""

TREMBLE = tuple(2.0 * LEAST)
"""A living sensor never repeats itself."""


def trembling(load=LOAD):
    return add_noise(lambda now_s: load, TREMBLE)


def make(address, **dynpick):
    ft = {"driver": "dynpick", "address": address}
    settings = HardwareSettings.model_validate({"ft": ft, "dynpick": dynpick})
    return make_force_torque(settings, time.monotonic)


FRONTS = [TcpServer, *([PtyServer] if sys.platform != "win32" else [])]


@pytest.fixture(params=FRONTS, ids=["tcp", "pty"][: len(FRONTS)])
def front(request):
    made = request.param(EmulatedDynpick(trembling()))
    made.start()
    yield made
    made.close()


@pytest.fixture
def driver(front):
    made = make(front.url)
    yield made
    made.close()


def connect(driver):
    driver.connect(5.0, threading.Event())


def until(condition, limit_s=60.0):
    """Wait on an event that nobody sets: no test depends on how fast the machine is."""
    end, never = time.monotonic() + limit_s, threading.Event()
    while not condition():
        assert time.monotonic() < end
        never.wait(0.005)


def test_it_delivers_what_the_sensor_feels(driver):
    connect(driver)
    assert driver.state is DeviceState.READY
    until(lambda: driver.samples.count >= 50)
    run = driver.samples.since(0)
    assert np.all(np.diff(run.t_s) > 0)
    assert np.all(np.abs(run.values.mean(axis=0) - LOAD) <= 2 * LEAST)
    assert np.all(np.abs(run.values - LOAD) <= 12 * LEAST)
    assert driver.rated == pytest.approx(8192 * LEAST)
    assert driver.health.received >= 50


def test_start_up_and_shutdown_go_in_the_documented_order(front, driver):
    connect(driver)
    driver.close()
    until(lambda: b"".join(e.data for e in front.log if e.incoming).endswith(b"E"))
    assert b"".join(e.data for e in front.log if e.incoming) == b"Ep1FSE"


def test_it_opens_and_closes_any_number_of_times(driver):
    for _ in range(2):
        connect(driver)
        connect(driver)
        assert driver.state is DeviceState.READY
        driver.close()
        driver.close()
        assert driver.state is DeviceState.CLOSED


def test_a_lost_byte_costs_one_sample(front, driver):
    connect(driver)
    spoilt = threading.Event()

    def lose_one(out):
        if len(out) < 27 or spoilt.is_set():
            return out
        spoilt.set()
        return out[:10] + out[11:]

    front.damage = lose_one
    until(spoilt.is_set)
    before = driver.samples.count
    until(lambda: driver.samples.count >= before + 20)
    assert driver.state is DeviceState.READY
    assert driver.health.lost >= 1
    assert np.all(np.abs(driver.samples.since(0).values - LOAD) <= 12 * LEAST)
    assert driver.resynchronised == 1


def test_silence_is_a_fault_and_a_reconnect_heals_it(front, driver):
    connect(driver)
    front.damage = lambda out: b""
    until(lambda: driver.state is DeviceState.FAULT)
    assert driver.fault.code == "FT-LINK"
    count = driver.samples.count
    front.damage = bytes
    reconnect(driver, 5.0, threading.Event())
    assert driver.fault is None
    until(lambda: driver.samples.count > count)


def test_bytes_that_mean_nothing_are_a_fault(front, driver):
    connect(driver)
    front.damage = lambda out: b"?" * len(out[:-2]) + out[-2:]
    until(lambda: driver.state is DeviceState.FAULT)
    assert driver.fault.code == "FT-LINK"


def test_no_answer_at_all_fails_the_connect(front, driver):
    front.damage = lambda out: b""
    with pytest.raises(FaultError, match="sends nothing"):
        driver.connect(0.3, threading.Event())
    assert driver.state is not DeviceState.READY


def test_a_sensor_that_tells_nonsense_is_not_scaled_by_it(front, driver):
    front.damage = lambda out: out.replace(b"65.470", b"00.000")
    with pytest.raises(FaultError):
        connect(driver)
    assert driver.samples.count == 0


def test_connecting_can_be_cancelled(driver):
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(FaultError, match="cancelled"):
        driver.connect(5.0, cancel)
    assert driver.state is DeviceState.CLOSED


@pytest.mark.promise("S4")
def test_a_port_that_is_not_there_is_a_fault():
    driver = make("/dev/no-such-port")
    told = r"The port /dev/no-such-port cannot be opened: No such file or directory\."
    with pytest.raises(FaultError, match=told):
        connect(driver)


def test_an_older_sensor_is_scaled_by_the_settings():
    front = TcpServer(EmulatedDynpick(trembling(), tells_sensitivity=False))
    front.start()
    driver = make(front.url, sensitivity=(50.0,) * 6)
    connect(driver)
    driver.close()
    front.close()
    assert driver.samples.since(0).values[0, 2] == pytest.approx(-10.5 * 65.08 / 50, abs=0.5)


def test_the_end_of_the_range_is_a_fault_with_samples_going_on():
    front = TcpServer(EmulatedDynpick(lambda now_s: (500.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    front.start()
    driver = make(front.url)
    connect(driver)
    until(lambda: driver.fault is not None)
    count = driver.samples.count
    until(lambda: driver.samples.count > count)
    assert driver.fault.code == "FT-OVERLOAD"
    assert driver.state is DeviceState.FAULT
    assert np.isnan(driver.samples.since(0).values).all()
    driver.close()
    front.close()
