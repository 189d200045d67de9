"""Contract of every wrist sensor on a wire.

The makes come from the registry: a registered make with an emulator is tested without a line here.
Each driver is connected to its emulated sensor over a real pseudo terminal or UDP socket, one of
them also through the rig process link.
"""

import sys
import threading
import time
import tomllib
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.waiting import until
from tests.backend.rig.ticking import TickingRig
from touchdown.backend.bench.emulator_registry import bench_toml, emulate
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.devices import registry
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults
from touchdown.backend.emulation.server import PtyServer, TcpServer
from touchdown.backend.emulation.serving import EmulationChoice
from touchdown.backend.rig.connection import reconnect

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
TREMBLE = (0.03, 0.03, 0.03, 0.003, 0.003, 0.003)
EMULATED = {}  # emulated sensors of installed packages: name of the driver -> class(wrench)


def emulated_makes():
    """Return the emulator name of each wrist sensor by the name of its driver."""
    makes = registry.emulated_makes().items()
    return {make.name: name for name, make in makes if make.kind == "force_torque"}


RATE_HZ = {**dict.fromkeys(emulated_makes(), 1000.0), "ft300": 100.0, "melfa": 1.0 / CYCLE_S}


def emulation_of(kind, folder, wrench):
    """Return the emulated sensor, on a pseudo terminal with a fixed name if it has one."""
    choice = EmulationChoice(emulated_makes()[kind], wrench=wrench)
    if sys.platform != "win32":
        with suppress(InputError):
            return emulate(replace(choice, tty=folder / "sensor"))
    return emulate(choice)


class Wired:
    """A driver and its emulated sensor."""

    def __init__(self, kind, folder):
        self.kind = kind
        load = add_noise(lambda now_s: LOAD, TREMBLE)
        if kind in EMULATED:
            self.faults = Faults("force_torque")
            sensor = EMULATED[kind](apply_faults(load, self.faults))
            serial = sys.platform != "win32"
            self.front = (
                PtyServer(sensor, faults=self.faults, link=folder / "sensor")
                if serial
                else TcpServer(sensor, faults=self.faults)
            )
            self._served = [self.front]
            tables = {"ft": {"driver": kind, "address": self.front.url}}
        else:
            emulation = emulation_of(kind, folder, load)
            self._served, self.front = list(emulation.fronts), emulation.fronts[0]
            self.faults = self.front.faults
            tables = tomllib.loads(bench_toml(emulation.bench))
        self.driver = make_force_torque(HardwareSettings.model_validate(tables), time.monotonic)
        for front in self._served:
            front.start()

    behind = 0
    """So many samples may be in the stream that the health does not count yet."""

    @property
    def condition(self):
        # What the rig tells of a device comes a moment after the device itself.
        return self.driver.describe().get("condition", "")

    def connect(self):
        self.driver.connect(5.0, threading.Event())

    def newest(self, count):
        """Values of the next ``count`` samples."""
        begin = self.driver.samples.count
        until(lambda: self.driver.samples.count >= begin + count)
        return self.driver.samples.since(begin).values

    def close(self):
        self.driver.close()
        for front in self._served:
            front.close()


class OverTheLink(Wired):
    """The same driver inside a rig."""

    behind = 2000

    def __init__(self, kind, folder):
        super().__init__(kind, folder)
        self._rig = TickingRig(time.monotonic, force_torque=self.driver)
        self.driver = self._rig.force_torque

    def close(self):
        super().close()
        self._rig.close()


@pytest.fixture(params=[*sorted(emulated_makes()), "leptrino over the link"])
def wired(request, tmp_path):
    kind, _, link = request.param.partition(" ")
    made = (OverTheLink if link else Wired)(kind, tmp_path)
    yield made
    made.close()


def test_every_make_has_an_emulated_sensor():
    # The link of ``ur`` is a package: test_ur_sensor.py holds it to a module like it.
    makes = {make.name for make in registry.MAKES if make.kind == "force_torque"}
    assert set(emulated_makes()) == makes - {"ur"}


def test_it_delivers_what_the_sensor_feels_in_order_at_its_rate(wired):
    driver = wired.driver
    assert driver.state is DeviceState.CLOSED
    assert driver.identity is None
    wired.connect()
    assert driver.state is DeviceState.READY
    assert driver.identity.maker
    assert driver.identity.serial
    assert np.all(driver.rated > 0)
    values = wired.newest(40)
    assert np.abs(values.mean(axis=0) - LOAD).max() < 0.1
    assert np.all(np.abs(values[:, 3:].mean(axis=0) - LOAD[3:]) < 0.01)
    run = driver.samples.since(0)
    assert np.all(np.diff(run.t_s) > 0)
    period_s = 1.0 / (RATE_HZ.get(wired.kind) or driver.describe()["usual_hz"])
    span_s = run.t_s[-1] - run.t_s[10]
    assert span_s / (len(run.t_s) - 11) == pytest.approx(period_s, rel=0.3)
    assert driver.samples.count - driver.health.received in range(wired.behind + 1)
    assert wired.condition in ("good", "slow")
    assert all(isinstance(value, str | float | int) for value in driver.describe().values())


@pytest.mark.promise("S1")
def test_garbage_is_refused_counted_and_overcome(wired):
    wired.connect()
    wired.front.inject("garbage", 0.2, share=0.2)
    wired.front.inject("flip", 0.2, share=0.1)
    until(lambda: not wired.faults.names(time.monotonic()))
    if wired.driver.state is DeviceState.FAULT:
        reconnect(wired.driver, 5.0, threading.Event())
    values = wired.newest(20)
    assert np.abs(values.mean(axis=0) - LOAD).max() < 0.2


@pytest.mark.promise("S6")
def test_a_frozen_sensor_gives_no_measurement(wired):
    wired.connect()
    wired.newest(5)
    wired.front.inject("freeze")
    until(lambda: wired.condition == "stuck")
    assert np.isnan(wired.newest(3)).all()
    wired.faults.clear()
    until(lambda: np.isfinite(wired.newest(2)).all())
    assert wired.driver.state is DeviceState.READY


@pytest.mark.promise("S7")
def test_the_end_of_the_range_is_a_fault_and_no_number(wired):
    wired.connect()
    begin = wired.driver.samples.count
    wired.front.inject("saturate")
    until(lambda: wired.driver.fault is not None)
    assert wired.driver.fault.code in ("FT-OVERLOAD", "FT-SENSOR")
    assert wired.driver.state is DeviceState.FAULT
    # Over the link the word of the fault may come before the last samples.
    until(lambda: not np.isfinite(wired.driver.samples.since(begin).values).all())
    values = wired.driver.samples.since(begin).values
    finite = values[np.isfinite(values).all(axis=1)]
    assert not len(finite) or np.abs(finite - LOAD).max() < 1.0
    assert np.isnan(wired.newest(5)).all(), "samples go on"


@pytest.mark.promise("S4")
def test_unplugged_it_is_a_fault_and_plugged_in_again_it_heals(wired):
    wired.connect()
    first = wired.driver.identity
    wired.front.inject("unplug")
    until(lambda: wired.driver.state is DeviceState.FAULT)
    assert wired.driver.fault.code == "FT-LINK"
    wired.faults.clear()

    def back():
        try:
            reconnect(wired.driver, 2.0, threading.Event())
        except FaultError:
            return False
        return True

    until(back)
    assert wired.driver.identity == first
    assert np.abs(wired.newest(20).mean(axis=0) - LOAD).max() < 0.2


def test_connecting_can_be_cancelled_and_closing_twice_is_allowed(wired):
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(FaultError, match="cancelled"):
        wired.driver.connect(5.0, cancel)
    wired.driver.close()
    wired.driver.close()
    assert wired.driver.state is DeviceState.CLOSED


CLAUSES = [
    test_it_delivers_what_the_sensor_feels_in_order_at_its_rate,
    test_garbage_is_refused_counted_and_overcome,
    test_a_frozen_sensor_gives_no_measurement,
    test_the_end_of_the_range_is_a_fault_and_no_number,
    test_unplugged_it_is_a_fault_and_plugged_in_again_it_heals,
    test_connecting_can_be_cancelled_and_closing_twice_is_allowed,
]


@pytest.mark.promise("S5")
def test_a_gripper_in_place_of_a_wrist_sensor_is_refused():
    front = TcpServer(EmulatedWsg())
    settings = {"ft": {"driver": "leptrino", "address": front.url}}
    driver = make_force_torque(HardwareSettings.model_validate(settings), time.monotonic)
    front.start()
    words = "This is a WSG gripper that speaks its binary protocol, expected a force/torque sensor"
    with pytest.raises(FaultError, match=words):
        driver.connect(2.0, threading.Event())
    assert driver.state is DeviceState.CLOSED
    front.close()
