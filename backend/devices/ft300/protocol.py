"""Byte protocol of Robotiq FT300 and FT300-S sensors.

Modbus RTU, and a stream of 16-byte frames on the same line. Source: FT 300-S manual; Modbus
application protocol 1.1b3; public drivers ros-industrial/robotiq and rams-lab-sheffield/pyft300.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from touchdown.backend.devices import framing
from touchdown.backend.devices.identification import ProtocolSignature

SLAVE = 9
STREAM_HEADER = b"\x20\x4e"
FRAME_BYTES = 16
STOP_BYTES = 50
LARGEST_READ = 8  # registers of the longest answer used here; longer ones are noise

STREAM_REGISTER, STREAM_ON = 410, 0x0200
WRENCH_REGISTER, ACCELERATION_REGISTER = 180, 190
FIRMWARE_REGISTER, SERIAL_REGISTER, YEAR_REGISTER = 500, 510, 514

_READ, _WRITE_ONE, _WRITE_MANY = 3, 6, 16


@dataclass(frozen=True, slots=True)
class Ft300Sample:
    """One sample of the stream: hundredths of N, thousandths of N·m."""

    counts: tuple[int, ...]

    def wrench(self) -> framing.Wrench:
        """Return N and N·m."""
        return framing.wrench_of(
            [*(c / 100 for c in self.counts[:3]), *(c / 1000 for c in self.counts[3:])]
        )


@dataclass(frozen=True, slots=True)
class ReadRegisters:
    """Request for ``count`` registers."""

    register: int
    count: int


@dataclass(frozen=True, slots=True)
class RegisterValues:
    """Values of registers, unsigned."""

    values: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class WriteRegister:
    """Request to write one register; its answer is the same frame."""

    register: int
    value: int


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Request to write several registers."""

    register: int
    values: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ModbusWritten:
    """Answer to ``WriteMany``."""

    register: int
    count: int


@dataclass(frozen=True, slots=True)
class ModbusRefusal:
    """Modbus exception ``code`` as the answer to ``function``."""

    function: int
    code: int


@dataclass(frozen=True, slots=True)
class StreamStop:
    """Bytes of FFh, which end the stream."""


Ft300Request = ReadRegisters | WriteRegister | WriteRegisters | StreamStop
Ft300Message = Ft300Sample | RegisterValues | WriteRegister | ModbusWritten | ModbusRefusal


def encode(message: Ft300Request | Ft300Message) -> bytes:
    """Return the bytes of any message of this protocol."""
    if isinstance(message, StreamStop):
        return b"\xff" * STOP_BYTES
    with framing.range_errors("ft300 message"):
        body = _body(message)
    return body + struct.pack("<H", framing.crc16_modbus(body))


def _body(message: ReadRegisters | WriteRegister | WriteRegisters | Ft300Message) -> bytes:
    match message:
        case Ft300Sample(counts):
            return STREAM_HEADER + struct.pack("<6h", *counts)
        case ReadRegisters(register, count):
            return struct.pack(">BBHH", SLAVE, _READ, register, count)
        case WriteRegister(register, value):
            return struct.pack(">BBHH", SLAVE, _WRITE_ONE, register, value)
        case WriteRegisters(register, values):
            n = len(values)
            return struct.pack(f">BBHHB{n}H", SLAVE, _WRITE_MANY, register, n, 2 * n, *values)
        case RegisterValues(values):
            n = len(values)
            return struct.pack(f">BBB{n}H", SLAVE, _READ, 2 * n, *values)
        case ModbusWritten(register, count):
            return struct.pack(">BBHH", SLAVE, _WRITE_MANY, register, count)
        case ModbusRefusal(function, code):
            return struct.pack(">BBB", SLAVE, function | 0x80, code)


def incoming() -> framing.FrameStream[Ft300Message]:
    """Return the decoder of the sensor's messages: answers and stream."""
    return framing.FrameStream(_take)


def requests() -> framing.FrameStream[Ft300Request]:
    """Return the decoder of requests."""
    return framing.FrameStream(_take_request)


def _checked(frame: bytes) -> bytes:
    if framing.crc16_modbus(frame[:-2]) != int.from_bytes(frame[-2:], "little"):
        raise framing.ProtocolError("crc", "ft300 frame", len(frame) - 2)
    return frame[:-2]


def _incoming_length(data: bytes, at: int) -> int | None:
    """Return the length of the frame at ``at``; 0 if none starts there, None if unknown yet."""
    head = data[at : at + 3]
    if head[:2] == STREAM_HEADER:
        return FRAME_BYTES
    if len(head) < 2:
        return None if head[0] in (STREAM_HEADER[0], SLAVE) else 0
    if head[0] != SLAVE:
        return 0
    if head[1] in (_WRITE_ONE, _WRITE_MANY):
        return 8
    if head[1] in (_READ | 0x80, _WRITE_ONE | 0x80, _WRITE_MANY | 0x80):
        return 5
    if head[1] != _READ:
        return 0
    if len(head) < 3:
        return None
    return 5 + head[2] if head[2] in range(2, 2 * LARGEST_READ + 1, 2) else 0


def decode(frame: bytes) -> Ft300Message:
    """Return the message of one whole frame from the sensor; raises ``ProtocolError``."""
    body = _checked(frame)
    if body[:2] == STREAM_HEADER:
        return Ft300Sample(struct.unpack("<6h", body[2:]))
    if body[1] == _READ:
        return RegisterValues(struct.unpack(f">{body[2] // 2}H", body[3:]))
    if body[1] & 0x80:
        return ModbusRefusal(body[1] & 0x7F, body[2])
    register, value = struct.unpack(">HH", body[2:])
    return (
        WriteRegister(register, value) if body[1] == _WRITE_ONE else ModbusWritten(register, value)
    )


def _take(data: bytes, at: int) -> framing.FrameStep[Ft300Message] | None:
    return framing.take_frame(data, at, _incoming_length(data, at), b"\x20\x09", decode)


def _take_request(data: bytes, at: int) -> framing.FrameStep[Ft300Request] | None:
    if data[at] == 0xFF:
        return _take_stop(data, at)
    if data[at] != SLAVE:
        return framing.noise_until(data, at, b"\x09\xff")
    head = data[at : at + 7]
    if len(head) < 2:
        return None
    if head[1] in (_READ, _WRITE_ONE):
        length = 8
    elif head[1] != _WRITE_MANY:
        return framing.FrameStep(1)
    elif len(head) < 7:
        return None
    elif head[6] not in range(2, 2 * LARGEST_READ + 1, 2) or head[4:6] != bytes((0, head[6] // 2)):
        return framing.FrameStep(1, refused=True)
    else:
        length = 9 + head[6]
    return framing.take_frame(data, at, length, b"", lambda frame: _request(_checked(frame)))


def _take_stop(data: bytes, at: int) -> framing.FrameStep[Ft300Request] | None:
    window = data[at : at + STOP_BYTES]
    run = len(window) - len(window.lstrip(b"\xff"))
    if run == STOP_BYTES:
        return framing.FrameStep(STOP_BYTES, StreamStop())
    return None if run == len(window) else framing.FrameStep(run, refused=True)


def _request(body: bytes) -> Ft300Request:
    register, value = struct.unpack(">HH", body[2:6])
    if body[1] == _READ:
        return ReadRegisters(register, value)
    if body[1] == _WRITE_ONE:
        return WriteRegister(register, value)
    return WriteRegisters(register, struct.unpack(f">{value}H", body[7:]))


SIGNATURES = (
    ProtocolSignature(
        "ft300",
        "a Robotiq FT300 force/torque sensor",
        encode(ReadRegisters(FIRMWARE_REGISTER, 3)),
        incoming,
        (RegisterValues, Ft300Sample),
    ),
)
