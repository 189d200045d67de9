"""Who answers where another device was expected, by the bytes of each emulated device."""

from types import SimpleNamespace

import pytest

from touchdown.backend.devices import identification
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.identification import identify_device, load_signatures
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.wsg.emulator import EmulatedGcl, EmulatedWsg

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
DEVICES = {
    "binary": EmulatedWsg,
    "gcl": lambda: EmulatedGcl(EmulatedWsg()),
    "leptrino": lambda: EmulatedLeptrino(lambda now_s: LOAD),
    "ft300": lambda: EmulatedFt300(lambda now_s: LOAD),
    "dynpick": lambda: EmulatedDynpick(lambda now_s: LOAD),
}


class Wire:
    """A device at the other end; its time passes by reading, and so does that of the listener."""

    def __init__(self, device, monkeypatch):
        self.device, self.now_s, self.out = device, 0.0, b""
        monkeypatch.setattr(identification, "time", SimpleNamespace(monotonic=lambda: self.now_s))

    def send(self, data):
        self.out += self.device.receive(self.now_s, data)

    def receive(self, limit_s):
        self.now_s += limit_s
        out, self.out = self.out + self.device.due(self.now_s), b""
        return out


@pytest.mark.promise("S5")
@pytest.mark.parametrize("name", DEVICES)
def test_each_device_is_known_unless_it_is_the_expected_one(name, monkeypatch):
    (kind,) = [one for one in load_signatures() if one.name == name]
    for expected, words in (("another", kind.description), (name, "")):
        wire = Wire(DEVICES[name](), monkeypatch)
        assert identify_device(wire.send, wire.receive, expected) == words


@pytest.mark.promise("S5")
def test_noise_silence_and_a_lost_wire_are_nobody(monkeypatch):
    class Noise:
        receive = staticmethod(lambda now_s, data: data)
        due = staticmethod(lambda now_s: bytes(range(256)))

    wire = Wire(Noise(), monkeypatch)
    assert identify_device(wire.send, wire.receive, "leptrino") == ""

    def lost(_):
        raise ConnectionResetError

    assert identify_device(lost, lost, "leptrino") == ""


@pytest.mark.promise("S5")
def test_asking_zeroes_no_sensor_and_configures_none():
    asked = b"".join(kind.request for kind in load_signatures())
    assert dynpick.DynpickCommand.OFFSET_RESET.value not in asked
    assert protocol.encode(protocol.BotaRequest("C")) not in asked
