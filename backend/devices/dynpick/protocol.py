"""Byte protocol of WACOH-TECH Dynpick sensors.

ASCII records of 27 bytes without a checksum. Source: vendor protocol as in the public drivers
tork-a/dynpick_driver and Amelia10007/dynpick-force-torque-sensor-rs.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from touchdown.backend.devices import framing
from touchdown.backend.devices.identification import ProtocolSignature

ZERO_COUNT, TOP_COUNT = 0x2000, 0x3FFF  # counts of no load and of the upper end; the lower end is 0
RECORD_BYTES = 27
END = b"\r\n"
_DIGITS = re.compile(rb"[0-9][0-9A-F]{24}")
_COUNTS = struct.Struct(">6H")


class DynpickCommand(Enum):
    """Commands, sent without a terminator."""

    READ = b"R"
    START = b"S"
    STOP = b"E"
    OFFSET_RESET = b"O"
    SENSITIVITY = b"p"
    TEMPERATURE = b"T"
    VERSION = b"V"
    FILTER_QUERY = b"0F"
    FILTER_1 = b"1F"
    FILTER_2 = b"2F"
    FILTER_4 = b"4F"
    FILTER_8 = b"8F"


@dataclass(frozen=True, slots=True)
class DynpickRecord:
    """One sample: ``tick`` 0 to 9, six counts of 14 bits (forces first)."""

    tick: int
    counts: tuple[int, ...]

    def wrench(self, sensitivity: Sequence[float]) -> framing.Wrench:
        """Scale by the six sensitivities, counts per N and per N·m."""
        pairs = zip(self.counts, sensitivity, strict=True)
        return framing.wrench_of([(count - ZERO_COUNT) / per_unit for count, per_unit in pairs])


def encode_record(record: DynpickRecord) -> bytes:
    """Return the 27 bytes."""
    if not 0 <= record.tick <= 9 or len(record.counts) != 6:
        raise framing.ProtocolError("range", "dynpick record")
    if not (min(record.counts) >= 0 and max(record.counts) <= TOP_COUNT):
        raise framing.ProtocolError("range", "dynpick record", 1)
    return b"%d%04X%04X%04X%04X%04X%04X\r\n" % (record.tick, *record.counts)


def decode_record(data: bytes) -> DynpickRecord:
    """Return the record of exactly 27 bytes; raises ``ProtocolError``."""
    if len(data) != RECORD_BYTES or data[-2:] != END:
        raise framing.ProtocolError("length", "dynpick record", min(len(data), RECORD_BYTES))
    if _DIGITS.match(data) is None:
        bad = re.search(rb"[^0-9A-F]", data[:-2])
        raise framing.ProtocolError("digit", "dynpick record", bad.start() if bad else 0)
    counts = _COUNTS.unpack(bytes.fromhex(data[1:25].decode("ascii")))
    if max(counts) > TOP_COUNT:
        raise framing.ProtocolError("range", "dynpick record", 1)
    return DynpickRecord(data[0] - ord("0"), counts)


def _take(data: bytes, at: int) -> framing.FrameStep[DynpickRecord] | None:
    end = data.find(END, at)
    if end < 0:
        surplus = len(data) - at - RECORD_BYTES
        return framing.FrameStep(surplus, refused=True) if surplus > RECORD_BYTES else None
    length = end + 2 - at
    try:
        return framing.FrameStep(length, decode_record(data[at : end + 2]))
    except framing.ProtocolError:
        return framing.FrameStep(length, refused=True)


def records() -> framing.FrameStream[DynpickRecord]:
    """Return the decoder of a stream of records; invalid lines are counted."""
    return framing.FrameStream(_take, framing.never_skip)


def command_stream() -> framing.FrameStream[DynpickCommand]:
    """Return the decoder of commands."""
    return framing.FrameStream(_take_command, framing.never_skip)


def _take_command(data: bytes, at: int) -> framing.FrameStep[DynpickCommand] | None:
    for command in DynpickCommand:
        if data.startswith(command.value, at):
            return framing.FrameStep(len(command.value), command)
    digit = data[at : at + 1] in (b"0", b"1", b"2", b"4", b"8")
    return None if digit and at + 1 == len(data) else framing.FrameStep(1, refused=True)


def encode_sensitivity(sensitivity: Sequence[float]) -> bytes:
    """Return the 46 bytes that answer ``p``."""
    force, torque = sensitivity[:3], sensitivity[3:]
    return ",".join([*(f"{v:.3f}" for v in force), *(f"{v:.2f}" for v in torque)]).encode() + END


def decode_sensitivity(data: bytes) -> tuple[float, ...]:
    """Return six sensitivities, counts per N and per N·m, all above zero."""
    number = rb"([0-9]{1,5}(?:\.[0-9]{1,4})?)"
    found = re.fullmatch(rb",".join([number] * 6) + rb"\r\n", data)
    if found is None:
        raise framing.ProtocolError("text", "dynpick sensitivity")
    values = tuple(float(text) for text in found.groups())
    if min(values) <= 0:
        raise framing.ProtocolError("range", "dynpick sensitivity")
    return values


def encode_temperature(temperature_c: float) -> bytes:
    """Return the answer to ``T``; sixteenths of a degree."""
    count = round(temperature_c * 16)
    if not 0 <= count <= 0xFFFF:
        raise framing.ProtocolError("range", "dynpick temperature")
    return b"%04X\r\n" % count


def encode_filter(divider: int) -> bytes:
    """Return the answer to ``0F``."""
    if divider not in (1, 2, 4, 8):
        raise framing.ProtocolError("range", "dynpick filter")
    return b"%dF\r" % divider


SIGNATURES = (
    ProtocolSignature(
        "dynpick",
        "a Dynpick force/torque sensor",
        2 * DynpickCommand.READ.value,
        records,
        (DynpickRecord,),
        2,
    ),
)
