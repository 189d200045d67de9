"""Twenty frames in a row whose checksum is wrong end the connection of a wrist sensor."""

import threading
import time

import pytest

from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.force_torque.driver import SensorDescription
from touchdown.backend.devices.force_torque.reader import BAD_LIMIT, ForceTorqueReader
from touchdown.backend.devices.leptrino import protocol
from touchdown.backend.devices.leptrino.driver import LeptrinoDriver
from touchdown.backend.devices.leptrino.protocol import LeptrinoCommand, LeptrinoSample
from touchdown.backend.devices.protocols import DeviceState, Identity

GOOD = [
    protocol.encode(LeptrinoSample(LeptrinoCommand.START, (number, 2, 3, 4, 5, 6), 0))
    for number in range(2)
]
BAD = GOOD[0][:-1] + bytes([GOOD[0][-1] ^ 1])


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
        assert "nothing that can be read" in reader.fault.what
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
