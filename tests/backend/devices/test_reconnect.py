"""A device comes back as itself or not at all."""

import threading

import pytest

from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.protocols import DeviceState, Identity
from touchdown.backend.rig.connection import reconnect


class Plugged:
    """A device whose serial number changes with each connection."""

    def __init__(self, *serials):
        self.name, self._serials, self.state = "tactile_left", list(serials), DeviceState.CLOSED
        self.identity, self.closes = None, 0

    def connect(self, timeout_s, cancel):
        self.identity = Identity("m", "m", self._serials.pop(0), "1")
        self.state = DeviceState.READY

    def close(self):
        self.closes += 1
        self.state = DeviceState.CLOSED


@pytest.mark.promise("C1")
def test_the_same_one_is_taken_and_another_one_is_refused_and_named():
    device = Plugged("A", "A", "B")
    device.connect(1.0, threading.Event())
    reconnect(device, 1.0, threading.Event())
    assert device.state is DeviceState.READY
    assert device.closes == 1
    with pytest.raises(FaultError, match="Serial number B answers instead of A"):
        reconnect(device, 1.0, threading.Event())
    assert device.state is DeviceState.CLOSED
