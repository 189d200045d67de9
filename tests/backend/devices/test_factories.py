"""What each language makes of losses, damage and alarms of the sensor; and the readout of all."""

import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.devices import test_force_torque_contract as contract
from tests.backend.devices import trials_camera
from tests.backend.devices.optoforce.trials_wrist import EMULATED
from tests.backend.devices.optoforce.trials_wrist import trial as trials_wrist_trial
from tests.backend.devices.wsg.trials_gripper import trial
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.devices import identification, make_force_torque, make_gripper, registry
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.bota.driver import BotaDriver
from touchdown.backend.devices.dynpick import EmulatedDynpick
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.force_torque.driver import WrenchReading
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.ft300.driver import Ft300Driver
from touchdown.backend.devices.ft300.emulator import EmulatedFt300
from touchdown.backend.devices.identification import identify_device, load_signatures
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.leptrino.driver import LeptrinoDriver
from touchdown.backend.devices.leptrino.emulator import EmulatedLeptrino
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.netft.driver import NetFtDriver
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.optoforce.driver import OptoforceDriver
from touchdown.backend.devices.wsg.driver import WsgGripper
from touchdown.backend.devices.wsg.emulator import EmulatedGcl, EmulatedWsg
from touchdown.backend.emulation.fault_plan import SampleSchedule

SETTINGS = HardwareSettings.model_validate(
    {"optoforce": {"counts": (100.0,) * 6, "capacity": (10.0,) * 6}}
)
ZERO = (0,) * 6


def missed(readings):
    return [reading.missed for reading in readings]


def record(sequence, status=0):
    return net_ft.encode_records((net_ft.RdtRecord(sequence, sequence, status, ZERO),))


def test_a_net_ft_drops_what_is_old_or_doubled_and_counts_gaps():
    language = NetFtDriver(SETTINGS, "")
    taken = [language.take(record(n)) for n in (7, 8, 8, 6, 9, 13, 12)]
    assert [missed(readings) for readings in taken] == [[0], [0], [], [], [0], [3], []]
    assert language.take(b"short") == []
    assert language.refusals.in_a_row == 1


def test_a_net_ft_goes_on_when_its_numbers_turn_over():
    language = NetFtDriver(SETTINGS, "")
    for number, lost in (((1 << 32) - 2, 0), ((1 << 32) - 1, 0), (0, 0), (2, 1)):
        assert missed(language.take(record(number))) == [lost]


def test_a_status_of_the_sensor_is_a_trouble_in_words():
    (reading,) = NetFtDriver(SETTINGS, "").take(record(1, status=0x20000))
    assert "00020000" in reading.trouble


def test_an_optoforce_counts_to_65535_and_tells_overload_and_failure():
    language = OptoforceDriver(SETTINGS, "")
    frames = [
        optoforce.OptoforceFrame(65534, 0, ZERO),
        optoforce.OptoforceFrame(1, 0, (50, *ZERO[1:])),
        optoforce.OptoforceFrame(2, 1 << 9, ZERO),
        optoforce.OptoforceFrame(3, 1 << 10, ZERO),
    ]
    readings = language.take(b"".join(map(optoforce.encode, frames)))
    assert missed(readings) == [0, 2, 0, 0]
    assert readings[1].wrench.force_n[0] == pytest.approx(5.0)
    assert [reading.overload for reading in readings] == [False, False, True, False]
    assert [bool(reading.trouble) for reading in readings] == [False, False, False, True]


def test_a_bota_counts_by_its_microseconds_and_marks_what_is_no_measurement():
    language = BotaDriver(SETTINGS, "")
    period_us = 64 * 19.53125
    begin = (1 << 32) - round(1.5 * period_us)
    frames = [
        protocol.BotaFrame(0, (0.0,) * 6, begin, 25.0),
        protocol.BotaFrame(0, (0.0,) * 6, (begin + round(3 * period_us)) % (1 << 32), 25.0),
        protocol.BotaFrame(
            protocol.BotaStatus.OVER_RANGE, (0.0,) * 6, round(2.5 * period_us), 25.0
        ),
        protocol.BotaFrame(protocol.BotaStatus.INVALID, (1.0,) * 6, round(3.5 * period_us), 25.0),
    ]
    readings = language.take(b"".join(map(protocol.encode, frames)))
    assert missed(readings) == [0, 2, 0, 0]
    assert [reading.overload for reading in readings] == [False, False, True, False]
    assert np.isnan(readings[3].wrench.force_n).all()


@pytest.mark.parametrize(
    ("language", "frame"),
    [
        (Ft300Driver(SETTINGS, ""), robotiq_ft300.encode(robotiq_ft300.Ft300Sample((1,) * 6))),
        (
            LeptrinoDriver(SETTINGS, ""),
            leptrino.encode(leptrino.LeptrinoSample(leptrino.LeptrinoCommand.START, (1,) * 6, 0)),
        ),
    ],
    ids=["ft300", "leptrino"],
)
def test_where_nothing_is_numbered_a_damaged_frame_is_one_lost(language, frame):
    if isinstance(language, LeptrinoDriver):
        language._rated = (250.0,) * 6
    spoilt = frame[:-1] + bytes((frame[-1] ^ 1,))
    readings = [reading for part in (frame, spoilt, frame) for reading in language.take(part)]
    assert len(readings) == 2
    assert sum(missed(readings)) == 1


def reading(value, **more):
    return WrenchReading(Wrench((value, 0.0, 0.0), (0.0, 0.0, 0.0)), **more)


def test_a_gap_in_the_count_is_a_gap_in_time():
    readout = WrenchStamper(ForceTorqueSettings(latency_ms=5.0), 0.01)
    stamps, _ = readout.accept(2.0, [reading(1.0), reading(2.0, missed=3), reading(3.0)])
    assert stamps == pytest.approx([1.945, 1.985, 1.995])
    assert readout.lost == 3


@pytest.mark.promise("S6")
def test_equal_samples_are_stuck_from_the_fifth_on():
    readout = WrenchStamper(ForceTorqueSettings(), 0.001)
    _, values = readout.accept(1.0, [reading(1.0)] * 7)
    assert np.isnan(values[:, 0]).tolist() == [False] * 4 + [True] * 3
    assert readout.stuck
    _, values = readout.accept(1.1, [reading(1.5)])
    assert np.isfinite(values).all()
    assert not readout.stuck


@pytest.mark.promise("S7")
@pytest.mark.parametrize("flag", [{"overload": True}, {"trouble": "it burns"}])
def test_what_the_sensor_disowns_is_no_number(flag):
    readout = WrenchStamper(ForceTorqueSettings(), 0.001)
    _, values = readout.accept(1.0, [reading(1.0), reading(2.0, **flag), reading(3.0)])
    assert np.isnan(values[:, 0]).tolist() == [False, True, False]
    assert readout.overload or readout.trouble == "it burns"


def settings(**tables):
    return HardwareSettings.model_validate(tables)


def offer(monkeypatch, name, load):
    point = SimpleNamespace(name=name, load=load)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])


def test_an_installed_language_is_made_with_settings_and_address(monkeypatch):
    made = []
    offer(monkeypatch, "mine", lambda: lambda *given: made.append(given))
    content = settings(ft={"driver": "mine", "address": "/dev/mine"})
    make_force_torque(content, time.monotonic)
    assert made == [(content, "/dev/mine")]


def test_an_installed_gripper_is_used_and_replaces_none_that_ships(monkeypatch):
    offer(monkeypatch, "claw", lambda: lambda settings, now_s: "a claw")
    assert make_gripper(settings(wsg={"driver": "claw"}), time.monotonic) == "a claw"
    offer(monkeypatch, "wsg", lambda: pytest.fail("not asked for"))
    assert isinstance(make_gripper(settings(), time.monotonic), WsgGripper)


def broken():
    raise ImportError("no module named 'my_lab'")


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"ft": {"driver": "thine", "address": "x"}}, "no driver 'thine'.*dynpick.*mine"),
        ({"ft": {"driver": "mine", "address": "x"}}, "cannot be loaded.*my_lab"),
        ({"ft": {"driver": "dynpick"}}, "no address"),
        ({"ft": {"driver": "optoforce", "address": "x"}}, "scale"),
        ({}, "real-time monitor is not known"),
    ],
)
def test_what_cannot_be_made_is_one_error(monkeypatch, tables, said):
    offer(monkeypatch, "mine", broken)
    with pytest.raises(InputError, match=said):
        make_force_torque(settings(**tables), time.monotonic)


LOAD_ALL = """
import sys
import touchdown.backend.rig.process
from touchdown.backend.devices import registry
from touchdown.backend.devices.identification import load_signatures
for make in registry.MAKES:
    if make.kind != "tactile":
        make.load_driver()
load_signatures()
heavy = ("PySide6", "torch", "cv2", "touchdown.backend.simulation", "touchdown.backend.emulation",
         "touchdown.backend.devices.cameras", "touchdown.backend.sensing", "touchdown.backend.runs")
print(*sorted(name for name in sys.modules if name.startswith(heavy)))
"""


def test_no_driver_loads_what_the_rig_process_must_not():
    done = subprocess.run([sys.executable, "-c", LOAD_ALL], capture_output=True, text=True)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


GUIDE = Path(__file__).resolve().parents[3] / "docs" / "hardware.md"
PERIOD_S = 0.005


class EmulatedSixNumbers:
    """Six numbers a line, from "start" to "stop"."""

    def __init__(self, wrench):
        self._wrench, self._pace = wrench, SampleSchedule()

    def receive(self, now_s, data):
        if b"start" in data and not self._pace.running:
            self._pace.begin(now_s, PERIOD_S)
        if b"stop" in data:
            self._pace.end()
        return b""

    def due(self, now_s):
        _, times = self._pace.due(now_s)
        return b"".join(self._line(t_s) for t_s in times)

    def closed(self, now_s):
        """Nothing."""

    def _line(self, t_s):
        values = (min(max(value, -1e5), 1e5) for value in self._wrench(t_s))
        return (",".join(f"{value:.4f}" for value in values) + "\n").encode()


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Put the class of the guide on the path, with the metadata of an installed package."""
    text = GUIDE.read_text("utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
               if "class MyLanguage" in block]  # fmt: skip
    package = tmp_path / "my_lab"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "my_sensor.py").write_text(code, "utf-8")
    (toml,) = [block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL)
               if "touchdown.force_torque" in block]  # fmt: skip
    (place,) = re.findall(r'^mine = "(.+?)"', toml, re.MULTILINE)
    info = tmp_path / "my_lab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-lab\nVersion: 1.0\n", "utf-8")
    points = f"[touchdown.force_torque]\nmine = {place}\n"
    (info / "entry_points.txt").write_text(points, "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    for name in ("my_lab", "my_lab.my_sensor"):
        sys.modules.pop(name, None)


@pytest.fixture
def wired(installed, tmp_path, monkeypatch):
    monkeypatch.setitem(contract.EMULATED, "mine", EmulatedSixNumbers)
    monkeypatch.setitem(contract.RATE_HZ, "mine", 1.0 / PERIOD_S)
    made = contract.Wired("mine", tmp_path)
    yield made
    made.close()


@pytest.mark.parametrize("clause", contract.CLAUSES, ids=lambda clause: clause.__name__[5:])
def test_the_class_of_the_guide_keeps_the_contract(clause, wired):
    clause(wired)


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


@pytest.mark.promise("S1")
@pytest.mark.parametrize("kind", sorted(EMULATED))
def test_a_wrist_sensor_ends_as_documented(kind):
    ended = trials_wrist_trial(sorted(EMULATED).index(kind), kind)
    assert ended.broken == (), ended


@pytest.mark.parametrize("seed", range(8))
def test_a_gripper_ends_as_documented(seed):
    ended = trial(seed)
    assert ended.broken == (), ended


@pytest.mark.parametrize("seed", range(10))
def test_a_camera_ends_as_documented(seed):
    ended = trials_camera.trial(seed)
    assert ended.broken == (), ended
