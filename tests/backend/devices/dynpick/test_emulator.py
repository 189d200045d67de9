"""The emulated Dynpick alone: byte-exact answers, its stream in time, and the front's log."""

import pytest

from tests.backend.devices.codecs.vectors import data
from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)


def emulated(**options):
    return EmulatedDynpick(lambda now_s: LOAD, **options)


def test_a_record_of_a_known_load_is_the_published_one():
    sensor = emulated()
    for _ in range(3):
        sensor.receive(0.0, b"R")
    assert sensor.receive(0.0, b"R") == data("dynpick-sample")


def test_answers_are_the_published_ones():
    sensor = emulated()
    assert sensor.receive(0.0, b"p") == data("dynpick-sensitivity-reply")
    assert sensor.receive(0.0, b"T") == data("dynpick-temperature-reply")
    assert sensor.receive(0.0, b"4F0F") == data("dynpick-filter-reply")
    assert emulated(tells_sensitivity=False).receive(0.0, b"p") == b""


def test_the_stream_keeps_its_rate_and_divider():
    sensor = emulated()
    assert sensor.receive(1.0, b"S") == b""
    records = protocol.records().feed(sensor.due(1.0999))
    assert len(records) == 100
    assert [record.tick for record in records[:11]] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0]
    sensor.receive(1.1, b"4F")
    assert len(protocol.records().feed(sensor.due(1.2))) == pytest.approx(25, abs=1)
    sensor.receive(1.2, b"E")
    assert sensor.due(9.0) == b""


def test_after_a_pause_old_records_are_lost_and_the_tick_tells():
    sensor = emulated()
    sensor.receive(0.0, b"S")
    first = protocol.records().feed(sensor.due(0.0))
    rest = protocol.records().feed(sensor.due(1.0))
    assert len(first) == 1
    assert 200 <= len(rest) <= 202
    assert rest[-1].tick == 1000 % 10


def test_offset_reset_zeroes():
    sensor = emulated()
    sensor.receive(0.0, b"O")
    (record,) = protocol.records().feed(sensor.receive(0.0, b"R"))
    assert record.counts == (0x2000,) * 6


def test_a_load_beyond_the_range_saturates():
    sensor = EmulatedDynpick(lambda now_s: (500.0, -500.0, 0.0, 0.0, 0.0, 0.0))
    (record,) = protocol.records().feed(sensor.receive(0.0, b"R"))
    assert record.counts[:3] == (0x3FFF, 0, 0x2000)
