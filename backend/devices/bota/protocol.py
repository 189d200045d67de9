"""Byte protocol of Bota Systems SensONE and Rokubi sensors.

Frames of 37 bytes, and text commands without a line end. Source: rokubimini serial driver and C
example of the maker.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from enum import IntFlag

from touchdown.backend.devices import framing
from touchdown.backend.devices.identification import ProtocolSignature

FRAME_BYTES = 37
HEADER = 0xAA
SINC_STEP_S = 19.53125e-6  # sample period per unit of the filter length ``sinc``
BAUD_CODES = {9600: 0, 57600: 1, 115200: 2, 230400: 3, 460800: 4}

_FIELDS = struct.Struct("<H6fIf")
_REPLY = re.compile(rb"r,0,([CcfR]),([0-9])")
_BOOT = b"App Init"
_REQUEST = re.compile(rb"c(?:,[0-9]){4}|f,[0-9]{1,3}(?:,[01]){3}|[CR]")
_REQUEST_LONGEST = 11


class BotaStatus(IntFlag):
    """Status word of a frame."""

    SLOW = 1
    OVER_RANGE = 2
    INVALID = 4
    RAW = 8


@dataclass(frozen=True, slots=True)
class BotaFrame:
    """One sample as sent; numbers that are not finite are NaN in an invalid frame."""

    status: int
    values: tuple[float, ...]
    timestamp_us: int
    temperature_c: float

    def wrench(self) -> framing.Wrench:
        """Return the wrench; NaN if the sensor marks it invalid or unscaled."""
        unusable = self.status & (BotaStatus.INVALID | BotaStatus.RAW)
        return framing.NO_WRENCH if unusable else framing.wrench_of(self.values)


@dataclass(frozen=True, slots=True)
class BotaReply:
    """Answer to a text command; ``code`` 0 is success."""

    command: str
    code: int


@dataclass(frozen=True, slots=True)
class BotaBoot:
    """The sensor has started."""


@dataclass(frozen=True, slots=True)
class BotaRequest:
    """C configuration mode, c communication, f filter, R run."""

    command: str
    arguments: tuple[int, ...] = ()


BotaMessage = BotaFrame | BotaReply | BotaBoot


def encode(message: BotaMessage | BotaRequest) -> bytes:
    """Return the bytes of any message of this protocol."""
    if isinstance(message, BotaFrame):
        numbers = (*message.values, message.timestamp_us, message.temperature_c)
        with framing.range_errors("bota frame", 1):
            body = _FIELDS.pack(message.status, *numbers)
        return bytes((HEADER,)) + body + struct.pack("<H", framing.crc16_x25(body))
    if isinstance(message, BotaBoot):
        return _BOOT
    if isinstance(message, BotaReply):
        text = f"r,0,{message.command},{message.code}".encode("ascii", "replace")
        return _checked(text, _REPLY)
    text = ",".join([message.command, *map(str, message.arguments)]).encode("ascii", "replace")
    return _checked(text, _REQUEST)


def decode_frame(data: bytes) -> BotaFrame:
    """Return the frame of exactly 37 bytes; raises ``ProtocolError``."""
    framing.require_length(data, FRAME_BYTES, "bota frame")
    if data[0] != HEADER:
        raise framing.ProtocolError("header", "bota frame")
    if framing.crc16_x25(data[1:-2]) != int.from_bytes(data[-2:], "little"):
        raise framing.ProtocolError("crc", "bota frame", FRAME_BYTES - 2)
    status, *values, timestamp_us, temperature_c = _FIELDS.unpack(data[1:-2])
    if not math.isfinite(temperature_c) or not all(map(math.isfinite, values)):
        if not status & BotaStatus.INVALID:
            raise framing.ProtocolError("number", "bota frame", 3)
        temperature_c, *values = (
            v if math.isfinite(v) else math.nan for v in (temperature_c, *values)
        )
    return BotaFrame(status, tuple(values), timestamp_us, temperature_c)


def incoming() -> framing.FrameStream[BotaMessage]:
    """Return the decoder of the sensor's messages: frames and texts in any order."""
    return framing.FrameStream(_take, _text_behind)


def requests() -> framing.FrameStream[BotaRequest]:
    """Return the decoder of commands."""
    return framing.FrameStream(_take_request, framing.never_skip)


def _checked(text: bytes, pattern: re.Pattern[bytes]) -> bytes:
    if pattern.fullmatch(text) is None:
        raise framing.ProtocolError("text", "bota command")
    return text


def _take(data: bytes, at: int) -> framing.FrameStep[BotaMessage] | None:
    if data[at] == HEADER:
        if len(data) - at < FRAME_BYTES:
            return None
        try:
            return framing.FrameStep(FRAME_BYTES, decode_frame(data[at : at + FRAME_BYTES]))
        except framing.ProtocolError:
            return framing.FrameStep(1, refused=True)
    if data.startswith(_BOOT, at):
        return framing.FrameStep(len(_BOOT), BotaBoot())
    if found := _REPLY.match(data, at):
        return framing.FrameStep(len(found[0]), BotaReply(found[1].decode(), int(found[2])))
    rest = data[at : at + len(_BOOT)]
    if _BOOT.startswith(rest) or re.fullmatch(rb"r(,(0(,([CcfR],?)?)?)?)?", rest):
        return None
    return framing.noise_until(data, at, b"\xaarA")


def _text_behind(take: framing.TakeFrame[BotaMessage], data: bytes, at: int) -> bool:
    """Return True if a text starts within an incomplete frame."""
    return re.compile(_REPLY.pattern + b"|" + _BOOT).search(data, at) is not None


def _take_request(data: bytes, at: int) -> framing.FrameStep[BotaRequest] | None:
    if found := _REQUEST.match(data, at):
        command, *arguments = found[0].decode().split(",")
        return framing.FrameStep(len(found[0]), BotaRequest(command, tuple(map(int, arguments))))
    if len(data) - at < _REQUEST_LONGEST and re.fullmatch(rb"[cf][0-9,]*", data[at:]):
        return None
    return framing.FrameStep(1, refused=True)


SIGNATURES = (
    ProtocolSignature(
        "bota", "a Bota force/torque sensor", b"", incoming, (BotaBoot, BotaFrame), 2
    ),
)
