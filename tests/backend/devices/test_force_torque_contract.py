"""Contract of every wrist sensor on a wire.

The makes come from the registry: a registered make with an emulator is tested without a line here.
Each driver is connected to its emulated sensor over a real pseudo terminal or UDP socket, one of
them also through the rig process link.
"""

import math
import sys
import threading
import time
import tomllib
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.optoforce import trials_wrist
from tests.backend.devices.optoforce.trials_wrist import EMULATED as TRIALS
from tests.backend.devices.optoforce.trials_wrist import WristTrial
from tests.backend.devices.waiting import until
from tests.backend.rig.ticking import TickingRig
from touchdown.backend.bench.emulator_registry import bench_toml, emulate
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core import FaultError, InputError, SampleStream
from touchdown.backend.devices import DeviceState, identification, make_force_torque, registry
from touchdown.backend.devices.bota import driver as bota_driver
from touchdown.backend.devices.force_torque.driver import WrenchReading
from touchdown.backend.devices.force_torque.reader import (
    WrenchStamper,
    implausible_text,
    require_plausible,
)
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.devices.ft300 import driver as ft300_driver
from touchdown.backend.devices.ft300 import protocol as ft300
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.netft import protocol as protocol_of_netft
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults
from touchdown.backend.emulation.server import PtyServer, TcpServer
from touchdown.backend.emulation.serving import EmulationChoice
from touchdown.backend.rig.connection import reconnect
from touchdown.backend.simulation.devices.end_effector import SimForceTorque

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
TREMBLE = (0.03, 0.03, 0.03, 0.003, 0.003, 0.003)
EMULATED = {}  # emulated sensors of installed packages: name of the driver -> class(wrench)


def emulated_makes():
    """Return the emulator name of each wrist sensor by the name of its driver."""
    makes = registry.emulated_makes().items()
    return {make.name: name for name, make in makes if make.kind == "force_torque"}


RATE_HZ = {
    **dict.fromkeys(emulated_makes(), 1000.0),
    "bota": 800.0,
    "ft300": 100.0,
    "melfa": 1.0 / CYCLE_S,
}


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

    behind = 0  # so many samples may be in the stream that the health does not count yet

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
def wired(request, tmp_path, monkeypatch):
    for driver in (bota_driver, ft300_driver):
        monkeypatch.setattr(driver, "PAUSE_S", 0.1)  # an emulated sensor is quick
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
    # A sample may arrive between the two readings.
    until(lambda: driver.samples.count - driver.health.received in range(wired.behind + 1))
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


HANGING = (0.4, -0.3, -14.7, 0.02, 0.03, -0.01)
PAYLOAD_KG = 1.5
INTEGERS = {  # counts per N and N·m, and their type, big-endian
    "netft": ((1e6,) * 6, ">i4"),
    "leptrino": ((40.0,) * 3 + (1e4 / 6,) * 3, ">i2"),
    "ft300": ((100.0,) * 3 + (1000.0,) * 3, ">i2"),
    "optoforce": ((50.0,) * 3 + (1e4 / 6.5,) * 3, ">i2"),
    "dynpick": ((65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75), ">i2"),
}


def with_bytes_swapped(kind, values):
    """Return the values that the counts, or single floats, of a make mean with swapped bytes."""
    per_unit, counts = INTEGERS.get(kind, ((1.0,) * 6, ">f4"))
    zero = 0x2000 if kind == "dynpick" else 0
    raw = np.multiply(values, per_unit) + zero
    with np.errstate(invalid="ignore"):
        swapped = raw.astype(counts).byteswap().astype(float) - zero
    return tuple(np.nan_to_num(swapped / per_unit, nan=0.0, posinf=1e30, neginf=-1e30))


def noisy(values, seed):
    """Return ``values`` with the noise of a sensor, the same at the same time."""
    rng = np.random.default_rng(seed)
    return tuple(np.add(values, rng.normal(0.0, (0.1,) * 3 + (0.004,) * 3)))


IMPOSSIBLE = {
    "over range": lambda kind, values: (*values[:2], 1.5e4, *values[3:]),
    "over range in one moment": lambda kind, values: (*values[:4], -400.0, values[5]),
    "wrong byte order": with_bytes_swapped,
    "ten times the counts": lambda kind, values: tuple(np.multiply(values, 10.0)),
    "a tenth of the counts": lambda kind, values: tuple(np.multiply(values, 0.1)),
    "swapped axes": lambda kind, values: (*values[2::-1], *values[:2:-1]),
    "other sign": lambda kind, values: tuple(np.negative(values)),
    "frozen": lambda kind, values: HANGING,
}


class SimulatedTrial:
    """The simulated wrist sensor in place of a wired one."""

    def __init__(self, load):
        self._load, self.reader = load, SimForceTorque(SampleStream("wrist", 6, 4096), lambda: 0.5)
        self.reader.connect(1.0, threading.Event())

    def listen(self, seconds):
        t_s = np.arange(0.0, seconds, 0.001)
        self.reader.deliver(t_s, np.array([self._load(at_s) for at_s in t_s]))
        return self.reader.samples.since(0).values


def still_air(kind, load):
    """Connect a sensor that feels ``load``; raise ``FaultError`` unless it is plausible."""
    trial = SimulatedTrial(load) if kind == "simulated" else WristTrial(3, kind, load)
    sensor = trial.reader
    try:
        values = trial.listen(0.5)
    finally:
        run = sensor.samples.since(0).values
        published = run[np.isfinite(run).all(axis=1)]
        assert not np.any(np.abs(published) >= sensor.rated), "published beyond its range"
    if sensor.fault is not None:
        raise FaultError(sensor.fault)
    require_plausible(values, sensor.rated, PAYLOAD_KG)


@pytest.mark.promise("S11")
@pytest.mark.parametrize("kind", [*sorted(TRIALS), "simulated"])
@pytest.mark.parametrize("how", ["sound", *IMPOSSIBLE])
def test_what_no_wrist_sensor_can_measure_is_never_ready(kind, how, monkeypatch):
    if how == "sound":
        still_air(kind, lambda now_s: noisy(HANGING, round(now_s * 1e6)))
        return
    if how == "frozen":
        monkeypatch.setattr(trials_wrist, "TREMBLE", (0.0,) * 6)
    with pytest.raises(FaultError) as caught:
        still_air(kind, lambda now_s: IMPOSSIBLE[how](kind, noisy(HANGING, round(now_s * 1e6))))
    fault = caught.value.fault
    assert fault.code in ("FT-OVERLOAD", "FT-SENSOR", "FT-IMPLAUSIBLE")
    assert fault.device == "force_torque"
    assert fault.next_step


@pytest.mark.promise("S11")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_number_that_is_not_finite_is_a_fault_and_no_sample(value):
    readout = WrenchStamper(ForceTorqueSettings(), 0.001)
    force = Wrench((1.0, value, 2.0), (0.0, 0.0, 0.0))
    _, values = readout.accept(1.0, [WrenchReading(force)])
    assert np.isnan(values).all()
    assert "not a finite number" in readout.trouble


@pytest.mark.promise("S11")
@pytest.mark.parametrize(("missed", "refused"), [(999, False), (1001, True), (10**10, True)])
def test_a_leap_of_the_numbers_by_more_than_a_second_is_another_stream(missed, refused):
    readout = WrenchStamper(ForceTorqueSettings(), 0.001, numbered=True)
    sample = Wrench((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    _, values = readout.accept(1.0, [WrenchReading(sample, missed)])
    assert bool(readout.trouble) == bool(np.isnan(values).all()) == refused
    assert readout.lost == (0 if refused else missed)


@pytest.mark.promise("S11")
def test_a_net_ft_with_little_endian_packets_is_refused_with_its_number_leap(tmp_path):
    wired = Wired("netft", tmp_path)
    wired.front.damage = lambda out: np.frombuffer(out, ">u4").byteswap().tobytes()
    try:
        with suppress(FaultError):
            wired.connect()
        assert wired.driver.state is not DeviceState.READY
        assert wired.driver.fault.code in ("FT-OVERLOAD", "FT-SENSOR")
        assert np.isnan(wired.driver.samples.since(1).values).all()
        assert wired.driver.health.lost < 1000
    finally:
        wired.close()


RANGE = np.array([100.0, 120.0, 200.0, 5.0, 6.0, 4.0])
SWING = np.array([1.0, -1.0] * 20)  # of standard deviation 1


@pytest.mark.promise("S11")
@pytest.mark.parametrize(
    ("axis", "mean", "noise", "refused"),
    [
        (2, -14.7, 5.9, ""),
        (2, -14.7, 6.1, "Fz = -14.70 N scatters by 6.10"),
        (4, 0.3, 0.19, "Ty = 0.30 N·m scatters by 0.19"),
        (1, -59.0, 0.1, ""),
        (1, -61.0, 0.1, "Fy = -61.00 N, more than half of its range"),
        (5, 2.1, 0.01, "Tz = 2.10 N·m, more than half of its range"),
        (0, 1.0, 0.0, "they repeat one value"),
    ],
)
def test_still_air_is_judged_by_the_range_of_each_axis(axis, mean, noise, refused):
    values = np.zeros((len(SWING), 6))
    values[:, axis] = mean + noise * SWING
    assert implausible_text(values, RANGE) == refused
    values[:20] = np.nan
    assert implausible_text(values, RANGE) == "20 of 40 samples are not valid"


class Peer:
    """A device on the wire of the sensor that sends ``content`` again and again."""

    def __init__(self, content):
        self._content = content

    def receive(self, now_s, data):
        return b""

    def due(self, now_s):
        return self._content

    def closed(self, now_s):
        """Nothing."""


SERIAL = ("dynpick", "leptrino", "ft300", "bota", "optoforce")


@pytest.mark.promise("S11")
@pytest.mark.parametrize("kind", SERIAL)
@pytest.mark.parametrize(
    ("content", "what"),
    [(b"", "is silent: no byte arrived"), (b"PC LOAD LETTER\n", "cannot be read as the make")],
)
def test_silent_and_unreadable_are_told_apart_without_internal_names(
    kind, content, what, monkeypatch, caplog
):
    caplog.set_level("INFO", "touchdown.devices")
    monkeypatch.setattr(bota_driver, "WAKE_S", 0.3)
    monkeypatch.setattr(identification, "LISTEN_S", 0.02)
    monkeypatch.setattr(ft300_driver, "PAUSE_S", 0.1)
    monkeypatch.setattr(ft300_driver, "ANSWER_S", 0.1)
    front = TcpServer(Peer(content))
    tables = {
        "ft": {"driver": kind, "address": front.url},
        "optoforce": {"counts": trials_wrist.COUNTS, "capacity": trials_wrist.CAPACITY},
    }
    driver = make_force_torque(HardwareSettings.model_validate(tables), time.monotonic)
    front.start()
    with pytest.raises(FaultError) as caught:
        driver.connect(0.3, threading.Event())
    front.close()
    fault = caught.value.fault
    assert what in fault.what
    assert not set("[]") & set(fault.what + fault.next_step), "internal names"
    assert content.hex(" ")[:20] in caplog.text
    assert content.hex(" ") not in fault.what or not content


@pytest.mark.promise("S11")
def test_a_net_ft_in_pounds_is_told_by_its_units(tmp_path, monkeypatch):
    page = protocol_of_netft.decode_page
    pounds = lambda content: page(content.replace(b"<scfgfu>N<", b"<scfgfu>lbf<"))  # noqa: E731
    monkeypatch.setattr(protocol_of_netft, "decode_page", pounds)
    wired = Wired("netft", tmp_path)
    with pytest.raises(FaultError, match="set to other units than N and N·m"):
        wired.connect()
    wired.close()


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


@pytest.mark.parametrize(
    ("first", "count", "values"),
    [(190, 3, (0, 0, 64536)), (191, 2, (0, 64536)), (182, 1, (300,)), (192, 2, None), (0, 0, None)],
)
def test_the_emulated_ft300_answers_any_range_of_its_registers(first, count, values):
    sensor = EmulatedFt300(lambda now_s: np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))
    answer = sensor._registers(0.0, ft300.ReadRegisters(first, count))
    assert answer == (ft300.ModbusRefusal(3, 2) if values is None else ft300.RegisterValues(values))
