"""What each language makes of losses, damage and alarms of the sensor; and the readout of all."""

import numpy as np
import pytest

from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.bota.driver import BotaDriver
from touchdown.backend.devices.force_torque.driver import WrenchReading
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.ft300.driver import Ft300Driver
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.leptrino.driver import LeptrinoDriver
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.netft.driver import NetFtDriver
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.optoforce.driver import OptoforceDriver

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
    period_us = 51 * 19.53125
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
