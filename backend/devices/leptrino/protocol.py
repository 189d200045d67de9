"""Byte protocol of Leptrino PFS and CFS sensors.

Frames with doubled 10h bytes and an exclusive-or check. Source: communication format specification
1.13.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from touchdown.backend.devices import framing
from touchdown.backend.devices.identification import ProtocolSignature

DLE, STX, ETX, NAK_BYTE = 0x10, 0x02, 0x03, 0x15
LONGEST_DATA = 128
_CONTENT = re.compile(rb"(?:[^\x10]|\x10\x10)*")
FULL_SCALE, CLIP = 10_000, 32_000  # counts at the rated load, and at the end of the range


class LeptrinoCommand(IntEnum):
    """Command bytes."""

    INFO = 0x2A
    RATED = 0x2B
    READ = 0x30
    START = 0x32
    STOP = 0x33
    SET_FILTER = 0xA6
    GET_FILTER = 0xB6


class LeptrinoStatus(IntFlag):
    """Status of a sample."""

    CALIBRATION = 1
    SENSOR = 2
    OVER_RATING = 4


@dataclass(frozen=True, slots=True)
class PlainFrame:
    """A request without content, its acknowledgement, or a refusal (``code`` not 0).

    Codes: 1 length, 2 undefined command, 3 value, 4 state.
    """

    command: int
    code: int = 0


@dataclass(frozen=True, slots=True)
class SensorInfo:
    """Identity of the sensor; ``rate`` from newer firmware only."""

    model: str
    serial: str
    firmware: str
    rate: str = ""


@dataclass(frozen=True, slots=True)
class RatedLoads:
    """Rated load per axis, N and N·m."""

    loads: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class FilterSetting:
    """Filter setting: 0 off, 1 10 Hz, 2 100 Hz, 3 200 Hz."""

    command: int
    index: int


@dataclass(frozen=True, slots=True)
class LeptrinoSample:
    """One sample; ``command`` is READ for a requested one, START for a streamed one."""

    command: int
    counts: tuple[int, ...]
    status: int
    reserve: int = 0

    def wrench(self, rated: Sequence[float]) -> framing.Wrench:
        """Scale by the rated loads of the sensor."""
        pairs = zip(self.counts, rated, strict=True)
        return framing.wrench_of([count / FULL_SCALE * load for count, load in pairs])


@dataclass(frozen=True, slots=True)
class LeptrinoNak:
    """The last frame had a wrong check and must be repeated."""


Packet = PlainFrame | SensorInfo | RatedLoads | FilterSetting | LeptrinoSample | LeptrinoNak


def encode(packet: Packet) -> bytes:
    """Return the frame with byte stuffing and check."""
    if isinstance(packet, LeptrinoNak):
        return bytes((DLE, NAK_BYTE))
    with framing.range_errors("leptrino frame"):
        command, code, body = _content(packet)
        data = bytes((4 + len(body), 0xFF, command, code)) + body
    if len(data) > LONGEST_DATA:
        raise framing.ProtocolError("length", "leptrino frame", LONGEST_DATA)
    stuffed = data.replace(b"\x10", b"\x10\x10")
    return b"\x10\x02" + stuffed + b"\x10\x03" + bytes((framing.xor8(data) ^ ETX,))


def _content(
    packet: PlainFrame | SensorInfo | RatedLoads | FilterSetting | LeptrinoSample,
) -> tuple[int, int, bytes]:
    if isinstance(packet, PlainFrame):
        return packet.command, packet.code, b""
    if isinstance(packet, SensorInfo):
        parts = ((packet.model, 16), (packet.serial, 8), (packet.firmware, 4))
        text = "".join(part.ljust(width) for part, width in parts) + packet.rate
        if len(text) not in (28, 34) or not text.isascii():
            raise framing.ProtocolError("text", "leptrino info", 4)
        return LeptrinoCommand.INFO, 0, text.encode("ascii")
    if isinstance(packet, RatedLoads):
        return LeptrinoCommand.RATED, 0, struct.pack("<6f", *packet.loads)
    if isinstance(packet, FilterSetting):
        return packet.command, 0, struct.pack("<B3x", packet.index)
    body = struct.pack("<6hHBx", *packet.counts, packet.reserve, packet.status)
    return packet.command, 0, body


def packets() -> framing.FrameStream[Packet]:
    """Return a decoder of either direction."""
    return framing.FrameStream(_take, framing.never_skip)


def _take(data: bytes, at: int) -> framing.FrameStep[Packet] | None:
    if data[at] != DLE:
        return framing.noise_until(data, at, b"\x10")
    if at + 1 == len(data):
        return None
    if data[at + 1] == NAK_BYTE:
        return framing.FrameStep(2, LeptrinoNak())
    if data[at + 1] != STX:
        return framing.FrameStep(2)  # a pair of 10h is content of a lost frame, never a start
    content = _CONTENT.match(data, at + 2)
    end = at + 2 if content is None else content.end()
    if end - at > 2 * LONGEST_DATA + 2:
        return framing.FrameStep(2, refused=True)
    tail = data[end : end + 3]
    if len(tail) > 1 and tail[1] != ETX:
        return framing.FrameStep(end - at, refused=True)
    if len(tail) < 3:
        return None
    try:
        return framing.FrameStep(end + 3 - at, decode(data[at : end + 3]))
    except framing.ProtocolError:
        return framing.FrameStep(2, refused=True)


def decode(frame: bytes) -> Packet:
    """Return the message of one whole frame; raises ``ProtocolError``."""
    data, check = frame[2:-3].replace(b"\x10\x10", b"\x10"), frame[-1]
    if framing.xor8(data) ^ ETX != check:
        raise framing.ProtocolError("bcc", "leptrino frame", len(data))
    if len(data) < 4 or data[0] != len(data) or data[1] != 0xFF:
        raise framing.ProtocolError("length", "leptrino frame")
    command, code, body = data[2], data[3], data[4:]
    if not body:
        return PlainFrame(command, code)
    try:
        if code == 0:
            return _body(command, body)
    except (struct.error, UnicodeDecodeError) as error:
        raise framing.ProtocolError("body", "leptrino frame", 4) from error
    raise framing.ProtocolError("body", "leptrino frame", 4)


def _body(command: int, body: bytes) -> Packet:
    if command == LeptrinoCommand.INFO and len(body) in (28, 34):
        text = body.decode("ascii")
        model, serial, firmware = (
            part.rstrip(" ") for part in (text[:16], text[16:24], text[24:28])
        )
        return SensorInfo(model, serial, firmware, text[28:])
    if command == LeptrinoCommand.RATED:
        loads = struct.unpack("<6f", body)
        if not all(0 < load < 1e6 for load in loads):
            raise framing.ProtocolError("range", "leptrino rated load", 4)
        return RatedLoads(loads)
    if command in (LeptrinoCommand.GET_FILTER, LeptrinoCommand.SET_FILTER):
        index, *zeros = struct.unpack("<4B", body)
        if not any(zeros):
            return FilterSetting(command, index)
    if command in (LeptrinoCommand.READ, LeptrinoCommand.START):
        *counts, reserve, status, zero = struct.unpack("<6hHBB", body)
        if not zero:
            return LeptrinoSample(command, tuple(counts), status, reserve)
    raise framing.ProtocolError("body", "leptrino frame", 4)


SIGNATURES = (
    ProtocolSignature(
        "leptrino",
        "a Leptrino force/torque sensor",
        encode(PlainFrame(LeptrinoCommand.INFO)),
        packets,
        (SensorInfo, LeptrinoSample),
    ),
)
