"""Emulated wrist sensors alone: what they answer to published bytes are the published bytes."""

import threading
import time
from itertools import pairwise

import numpy as np
import pytest

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.waiting import until
from touchdown.backend.bench.emulator_registry import emulate
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices import DeviceState, Identity, emulated_makes
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.bota.emulator import EmulatedBota
from touchdown.backend.devices.bota.protocol import BotaFrame
from touchdown.backend.devices.force_torque import reader as reader_of_wrenches
from touchdown.backend.devices.force_torque.driver import SensorDescription
from touchdown.backend.devices.force_torque.reader import BAD_LIMIT, ForceTorqueReader
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.leptrino.driver import LeptrinoDriver
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.leptrino.protocol import (
    LeptrinoCommand,
    LeptrinoSample,
    LeptrinoStatus,
)
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.netft.emulator import (
    EmulatedCalibration,
    EmulatedNetFt,
    EmulatedPage,
)
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.optoforce.emulator import PER_UNIT, EmulatedOptoforce
from touchdown.backend.emulation import EmulationChoice, Faults

FORCE_TORQUE = [n for n, make in emulated_makes().items() if make.kind == "force_torque"]
LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)


def still(now_s):
    return LOAD


def test_an_ft300_answers_modbus_until_it_streams():
    sensor = EmulatedFt300(still)
    assert sensor.receive(0.0, data("ft300-read-wrench")) == data("ft300-read-wrench-reply")
    assert sensor.receive(1.0, data("ft300-start-fc16")) == data("ft300-start-fc16-reply")
    assert sensor.due(1.0) == data("ft300-stream")
    assert len(robotiq_ft300.incoming().feed(sensor.due(1.5))) == 50
    assert sensor.receive(1.5, data("ft300-read-wrench")) == b""
    sensor.receive(1.6, b"\xff" * 50)
    assert sensor.due(2.0) == b""
    told = robotiq_ft300.decode(sensor.receive(2.0, data("ft300-read-acceleration")))
    assert told == robotiq_ft300.RegisterValues((0, 0, 0x10000 - 1000))
    assert sensor.receive(2.0, data("ft300-read-wrench")) == data("ft300-read-wrench-reply")


def leptrino_frame(*data):
    content = bytes(data)
    check = 3
    for byte in content:
        check ^= byte
    return b"\x10\x02" + content.replace(b"\x10", b"\x10\x10") + b"\x10\x03" + bytes((check,))


@pytest.mark.parametrize(
    ("frame", "result"),
    [
        (leptrino_frame(5, 0xFF, 0x2A, 0), 1),  # says five, has four
        (leptrino_frame(8, 0xFF, 0x32, 0, 1, 2, 3, 4), 1),  # more than its command takes
        (leptrino_frame(4, 0xFF, 0xA6, 0), 1),  # no filter
        (leptrino_frame(8, 0xFF, 0xA6, 0, 9, 0, 0, 0), 3),  # no such filter
        (leptrino_frame(4, 0xFF, 0x77, 0), 2),
        (leptrino_frame(8, 0xFF, 0xA6, 0, 2, 0, 0, 0), 0),
    ],
)
def test_a_leptrino_says_why_it_refuses(frame, result):
    answer = EmulatedLeptrino(still).receive(0.0, frame)
    assert answer == leptrino_frame(4, 0xFF, frame[4], result)


def test_a_bota_says_that_it_booted_before_it_answers_and_once():
    sensor = EmulatedBota(still)
    answers = sensor.receive(0.0, b"C")
    assert answers.index(b"App Init") < answers.index(b"r,0,C,0")
    assert sensor.due(0.5) == b"", "quiet while it is configured"
    sensor.closed(1.0)
    assert b"App Init" in sensor.due(1.1)
    assert b"App Init" not in sensor.due(1.2)


def test_a_leptrino_tells_its_rated_loads_and_refuses_a_damaged_frame():
    sensor = EmulatedLeptrino(still)
    assert sensor.receive(0.0, data("leptrino-limits")) == data("leptrino-limits-reply")
    assert sensor.receive(0.0, data("leptrino-bad-bcc")) == data("leptrino-nak")
    (sample,) = leptrino.packets().feed(sensor.receive(0.0, data("leptrino-read")))
    assert sample.wrench((250.0,) * 3 + (6.0,) * 3).force_n == pytest.approx(LOAD[:3], abs=0.013)
    sensor.receive(1.0, data("leptrino-start"))
    assert len(leptrino.packets().feed(sensor.due(1.1))) == 100
    sensor.receive(1.1, data("leptrino-stop"))
    assert sensor.due(2.0) == b""


def test_a_leptrino_over_its_range_says_so_and_clips():
    sensor = EmulatedLeptrino(lambda now_s: (2000.0, *LOAD[1:]))
    (sample,) = leptrino.packets().feed(sensor.receive(0.0, data("leptrino-read")))
    assert isinstance(sample, LeptrinoSample)
    assert sample.status == LeptrinoStatus.OVER_RATING
    assert sample.counts[0] == leptrino.CLIP


def test_a_bota_boots_streams_and_keeps_its_own_time():
    sensor = EmulatedBota(still)
    begun = sensor.due(0.123456)
    assert begun == b"App Init" + data("bota-frame")
    frames = protocol.incoming().feed(sensor.due(0.2))
    gaps = [b.timestamp_us - a.timestamp_us for a, b in pairwise(frames)]
    assert set(gaps) == {10_000}
    assert sensor.receive(0.2, b"C") == b"r,0,C,0"
    assert sensor.due(0.5) == b""
    assert sensor.receive(0.5, b"f,51,0,0,1") == b"r,0,f,0"
    assert sensor.receive(0.5, b"R") == b"r,0,R,0"
    frames = protocol.incoming().feed(sensor.due(0.6))
    assert len(frames) == pytest.approx(100, abs=2)
    assert all(isinstance(frame, BotaFrame) for frame in frames)


def test_an_optoforce_is_silent_until_it_is_configured_and_counts():
    counts = (100.0, -200.0, -1050.0, 10.0, -20.0, 5.0)
    sensor = EmulatedOptoforce(lambda now_s: np.divide(counts, PER_UNIT).tolist())
    assert sensor.due(0.0) == b""
    assert sensor.receive(0.0, data("optoforce-config-100hz-15hz")) == data("optoforce-config-ack")
    sensor.due(0.0)
    assert sensor.due(0.01) == data("optoforce-frame22")
    assert sensor.receive(0.02, data("optoforce-config-stop")) == data("optoforce-config-ack")
    assert sensor.due(9.0) == b""
    refused = optoforce.incoming().feed(
        sensor.receive(9.0, optoforce.encode(optoforce.OptoforceConfig(2, 0)))
    )
    assert refused[0].status != 0


def test_a_net_ft_sends_what_was_asked_for():
    sensor = EmulatedNetFt(still)
    assert sensor.receive(0.002, data("rdt-single")) == []
    assert sensor.due(0.002) == [data("rdt-record")]
    assert sensor.due(1.0) == []
    sensor.receive(1.0, data("rdt-start"))
    numbers = [net_ft.decode_records(record)[0].rdt_sequence for record in sensor.due(1.1)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) == pytest.approx(100, abs=1)
    sensor.receive(1.1, data("rdt-bias"))
    assert set(net_ft.decode_records(sensor.due(1.2)[0])[0].counts) == {0}
    sensor.receive(1.2, data("rdt-stop"))
    assert sensor.due(2.0) == []


def test_its_scale_is_told_by_page_and_channel():
    page = EmulatedPage().receive(0.0, b"GET /netftapi2.xml HTTP/1.1\r\n\r\n")
    assert net_ft.decode_page(page) == (1e6, 1e6)
    assert EmulatedPage().receive(0.0, b"GET / HTTP/1.1\r\n\r\n").startswith(b"HTTP/1.1 404")
    channel = EmulatedCalibration()
    assert channel.receive(0.0, net_ft.TCP_REQUEST[:5]) == b""
    told = net_ft.decode_calibration(channel.receive(0.0, net_ft.TCP_REQUEST[5:]))
    assert (told.counts_per_n, told.counts_per_nm) == (1_000_000, 1_000_000)


@pytest.mark.parametrize("kind", FORCE_TORQUE)
def test_every_sensor_that_is_emulated_can_slow_down(kind):
    emulation = emulate(EmulationChoice(kind))
    try:
        (faults,) = {front.faults for front in emulation.fronts if front.faults.device}
        assert emulation.fronts[0]._device.pace.faults is faults
    finally:
        emulation.close()


def test_a_slow_sensor_takes_so_many_samples_and_numbers_them_on():
    faults, sensor = Faults("force_torque"), EmulatedNetFt(still)
    faults.begin(0.0)
    sensor.pace.faults = faults
    sensor.receive(0.0, data("rdt-start"))
    faults.inject(1.0, "slow", 2.0, hz=300.0)

    def numbers(seconds, since_s):
        records = [r for k in range(10 * seconds) for r in sensor.due(since_s + 0.1 * (k + 1))]
        return [net_ft.decode_records(record)[0].rdt_sequence for record in records]

    before, slow, after = numbers(1, 0.0), numbers(2, 1.0), numbers(1, 3.0)
    assert [len(before), len(slow), len(after)] == pytest.approx([1000, 600, 1000], abs=2)
    assert all(b - a == 1 for a, b in pairwise(before + slow + after))


GOOD = [
    leptrino.encode(LeptrinoSample(LeptrinoCommand.START, (number, 2, 3, 4, 5, 6), 0))
    for number in range(2)
]
BAD = GOOD[0][:-1] + bytes([GOOD[0][-1] ^ 1])


@pytest.fixture
def judged_by_one_sample(monkeypatch):
    """Connect as soon as one sample is there: the line gives no more."""
    monkeypatch.setattr(reader_of_wrenches, "LEAST_STILL", 1)
    monkeypatch.setattr(reader_of_wrenches, "STILL_S", 0.0)


class Line:
    """Gives what was put into it, and nothing while that is empty."""

    def __init__(self):
        self.waiting = [GOOD[0]]

    def read(self, limit_s):
        threading.Event().wait(0.001)
        return self.waiting.pop(0) if self.waiting else b""

    def write(self, data):
        pass

    def drain(self):
        pass

    def close(self):
        pass


class Started(LeptrinoDriver):
    def start(self, link, cancel):
        self._rated = (100.0,) * 6
        return SensorDescription(Identity("a", "b", "c", ""), self._rated, 0.001)


@pytest.mark.promise("S3")
@pytest.mark.usefixtures("judged_by_one_sample")
@pytest.mark.parametrize(("count", "ends"), [(BAD_LIMIT - 1, False), (BAD_LIMIT, True)])
def test_twenty_refused_frames_in_a_row_are_a_lost_link(count, ends):
    line = Line()
    settings = ForceTorqueSettings(driver="leptrino", silence_s=60.0)
    reader = ForceTorqueReader(
        lambda: Started(HardwareSettings(), ""), lambda _: line, settings, time.monotonic
    )
    reader.connect(5.0, threading.Event())
    line.waiting += [BAD * count, GOOD[1], GOOD[0]]
    until(lambda: not line.waiting or reader.state is DeviceState.FAULT)
    if ends:
        until(lambda: reader.state is DeviceState.FAULT)
        assert "cannot be read" in reader.fault.what
    else:
        until(lambda: reader.health.received == 3)
        assert reader.state is DeviceState.READY
    reader.close()


class Broken(Started):
    """Meets something that its author did not think of."""

    where = ""

    def start(self, link, cancel):
        if self.where == "start":
            raise KeyError("serial")
        return super().start(link, cancel)

    def take(self, data):
        if self.where == "take" and data == GOOD[1]:
            raise IndexError("tuple index out of range")
        return super().take(data)


@pytest.mark.usefixtures("judged_by_one_sample")
@pytest.mark.parametrize(
    ("where", "said"), [("start", "KeyError: 'serial'"), ("take", "IndexError: tuple index")]
)
def test_a_driver_that_fails_is_a_fault_with_its_own_words(where, said, monkeypatch):
    raised = []
    monkeypatch.setattr(threading, "excepthook", lambda args: raised.append(args.exc_type))
    monkeypatch.setattr(Broken, "where", where)
    line = Line()
    settings = ForceTorqueSettings(driver="leptrino", silence_s=60.0)
    reader = ForceTorqueReader(
        lambda: Broken(HardwareSettings(), ""), lambda _: line, settings, time.monotonic
    )
    if where == "start":
        with pytest.raises(FaultError, match=said) as caught:
            reader.connect(5.0, threading.Event())
        fault = caught.value.fault
        assert reader.state is DeviceState.CLOSED
    else:
        reader.connect(5.0, threading.Event())
        line.waiting.append(GOOD[1])
        until(lambda: reader.state is DeviceState.FAULT)
        fault = reader.fault
    reader.close()
    assert fault.code == "FT-DRIVER"
    assert said in fault.what
    assert raised == ([IndexError] if where == "take" else [])


def test_a_greeting_has_six_rated_loads_and_a_period():
    for rated, period_s in (((1.0, 2.0), 0.001), ((1.0,) * 6, 0.0)):
        with pytest.raises(ValueError, match="6 rated loads and a period"):
            SensorDescription(Identity("a", "b", "c", ""), rated, period_s)
