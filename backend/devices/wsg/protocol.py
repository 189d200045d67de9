"""Binary protocol of Weiss WSG grippers.

Frames: ``AA AA AA | id | size | payload | crc``, little-endian. Widths are mm, speeds mm/s,
accelerations mm/s²; every force is the sum over both fingers (N). The text
protocol has the same interface as ``BinaryProtocol``, with the same messages.
Source: command set reference manual, firmware 2.2.0.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, TypeAlias

from touchdown.backend.devices.framing import (
    FrameStep,
    FrameStream,
    ProtocolError,
    crc_wsg,
    noise_until,
    range_errors,
)
from touchdown.backend.devices.protocols import Identity


class WsgCommand(IntEnum):
    """Command ids."""

    LOOP = 0x06
    DISCONNECT = 0x07
    HOME = 0x20
    PREPOSITION = 0x21
    STOP = 0x22
    FAST_STOP = 0x23
    ACKNOWLEDGE = 0x24
    GRASP = 0x25
    RELEASE = 0x26
    SET_ACCELERATION = 0x30
    GET_ACCELERATION = 0x31
    SET_FORCE_LIMIT = 0x32
    GET_FORCE_LIMIT = 0x33
    SET_SOFT_LIMITS = 0x34
    GET_SOFT_LIMITS = 0x35
    CLEAR_SOFT_LIMITS = 0x36
    OVERDRIVE = 0x37
    TARE = 0x38
    SYSTEM_STATE = 0x40
    GRASP_STATE = 0x41
    STATISTICS = 0x42
    WIDTH = 0x43
    SPEED = 0x44
    FORCE = 0x45
    TEMPERATURE = 0x46
    SYSTEM_INFO = 0x50
    SET_TAG = 0x51
    GET_TAG = 0x52
    SYSTEM_LIMITS = 0x53


class WsgStatus(IntEnum):
    """Status of a reply; any other value is a fault of the device."""

    SUCCESS = 0
    NOT_AVAILABLE = 1
    NO_SENSOR = 2
    NOT_INITIALIZED = 3
    ALREADY_RUNNING = 4
    FEATURE_NOT_SUPPORTED = 5
    INCONSISTENT_DATA = 6
    TIMEOUT = 7
    READ_ERROR = 8
    WRITE_ERROR = 9
    INSUFFICIENT_RESOURCES = 10
    CHECKSUM_ERROR = 11
    NO_PARAM_EXPECTED = 12
    NOT_ENOUGH_PARAMS = 13
    CMD_UNKNOWN = 14
    CMD_FORMAT_ERROR = 15
    ACCESS_DENIED = 16
    ALREADY_OPEN = 17
    CMD_FAILED = 18
    CMD_ABORTED = 19
    INVALID_HANDLE = 20
    NOT_FOUND = 21
    NOT_OPEN = 22
    IO_ERROR = 23
    INVALID_PARAMETER = 24
    INDEX_OUT_OF_BOUNDS = 25
    CMD_PENDING = 26
    OVERRUN = 27
    RANGE_ERROR = 28
    AXIS_BLOCKED = 29
    FILE_EXISTS = 30


class SystemFlag(IntFlag):
    """Bits of the system state."""

    REFERENCED = 1 << 0
    MOVING = 1 << 1
    BLOCKED_MINUS = 1 << 2
    BLOCKED_PLUS = 1 << 3
    SOFT_LIMIT_MINUS = 1 << 4
    SOFT_LIMIT_PLUS = 1 << 5
    AXIS_STOPPED = 1 << 6
    TARGET_POS_REACHED = 1 << 7
    OVERDRIVE_MODE = 1 << 8
    FORCECNTL_MODE = 1 << 9
    FAST_STOP = 1 << 12
    TEMP_WARNING = 1 << 13
    TEMP_FAULT = 1 << 14
    POWER_FAULT = 1 << 15
    CURR_FAULT = 1 << 16
    FINGER_FAULT = 1 << 17
    CMD_FAILURE = 1 << 18
    SCRIPT_RUNNING = 1 << 19
    SCRIPT_FAILURE = 1 << 20


class GraspState(IntEnum):
    """Grasping states; ERROR only in newer firmware."""

    IDLE = 0
    GRASPING = 1
    NO_PART_FOUND = 2
    PART_LOST = 3
    HOLDING = 4
    RELEASING = 5
    POSITIONING = 6
    ERROR = 7


LONGEST_UNKNOWN = 64  # longest payload of a command outside the tables; longer ones are noise
# Commands with a payload of any length up to this.
SCRIPTS = (0xB0, 0xB1, 0xB2, 0xBA, 0xBB)  # commands of a script loaded into the gripper
FINGERS = (0x60, 0x61, 0x62, 0x63, 0x70, 0x71, 0x72, 0x73)  # commands of fingers with sensors
TEXT: dict[int, int] = {
    WsgCommand.LOOP: 256,
    WsgCommand.SET_TAG: 64,
    WsgCommand.GET_TAG: 64,
    **dict.fromkeys(SCRIPTS, 256),
}

NOTHING = "<"
# Readings that are sent once or periodically.
UPDATED = (
    WsgCommand.SYSTEM_STATE,
    WsgCommand.GRASP_STATE,
    WsgCommand.WIDTH,
    WsgCommand.SPEED,
    WsgCommand.FORCE,
)
# Layout of the payload of each request.
REQUESTS: dict[int, str] = {
    **dict.fromkeys(WsgCommand, NOTHING),
    WsgCommand.HOME: "<B",
    WsgCommand.PREPOSITION: "<Bff",
    WsgCommand.ACKNOWLEDGE: "<3s",
    WsgCommand.GRASP: "<ff",
    WsgCommand.RELEASE: "<ff",
    WsgCommand.SET_ACCELERATION: "<f",
    WsgCommand.SET_FORCE_LIMIT: "<f",
    WsgCommand.SET_SOFT_LIMITS: "<ff",
    WsgCommand.OVERDRIVE: "<B",
    WsgCommand.STATISTICS: "<B",
    **dict.fromkeys(UPDATED, "<BH"),
}

_FLOATS = (
    WsgCommand.GET_ACCELERATION, WsgCommand.GET_FORCE_LIMIT,
    WsgCommand.WIDTH, WsgCommand.SPEED, WsgCommand.FORCE,
)  # fmt: skip
# Layouts after status 0 in each reply; the manual prints 30h with a value.
REPLIES: dict[int, tuple[str, ...]] = {
    **dict.fromkeys(WsgCommand, (NOTHING,)),
    WsgCommand.SET_ACCELERATION: (NOTHING, "<f"),
    **dict.fromkeys(_FLOATS, ("<f",)),
    WsgCommand.GET_SOFT_LIMITS: ("<ff",),
    WsgCommand.SYSTEM_STATE: ("<I",),
    WsgCommand.GRASP_STATE: ("<B",),
    WsgCommand.STATISTICS: ("<IHH",),
    WsgCommand.TEMPERATURE: ("<h",),
    WsgCommand.SYSTEM_INFO: ("<BBHI",),
    WsgCommand.SYSTEM_LIMITS: ("<8f",),
}


PREAMBLE = b"\xaa\xaa\xaa"
ACKNOWLEDGE_KEY = b"ack"

_HEAD, _CRC = 6, 2
Number: TypeAlias = float | int | bytes


@dataclass(frozen=True, slots=True)
class WsgRequest:
    """A command; ``values`` as in ``REQUESTS``, or the bytes of a text or of an unknown command."""

    command: int
    values: tuple[Number, ...] = ()


@dataclass(frozen=True, slots=True)
class WsgRefusal:
    """An invalid request, and the status of its answer."""

    command: int
    status: WsgStatus


@dataclass(frozen=True, slots=True)
class WsgReply:
    """Answer, result or update; ``values`` only with status 0, temperature in degrees Celsius."""

    command: int
    status: int
    values: tuple[Number, ...] = ()


WsgIncoming = WsgRequest | WsgRefusal


def home(direction: int = 0) -> WsgRequest:
    """Move to the end stop that sets the origin: 0 as configured, 1 open, 2 closed."""
    return WsgRequest(WsgCommand.HOME, (direction,))


def preposition(
    width_mm: float, speed_mm_s: float, *, relative: bool = False, stop_on_block: bool = False
) -> WsgRequest:
    """Move the fingers; a block ends it in either mode, with pressure unless ``stop_on_block``."""
    return WsgRequest(WsgCommand.PREPOSITION, (relative | stop_on_block << 1, width_mm, speed_mm_s))


def grasp(width_mm: float, speed_mm_s: float) -> WsgRequest:
    """Close on a part of this width."""
    return WsgRequest(WsgCommand.GRASP, (width_mm, speed_mm_s))


def release(width_mm: float, speed_mm_s: float) -> WsgRequest:
    """Open to this width."""
    return WsgRequest(WsgCommand.RELEASE, (width_mm, speed_mm_s))


def acknowledge() -> WsgRequest:
    """Acknowledge a fast stop or fault."""
    return WsgRequest(WsgCommand.ACKNOWLEDGE, (ACKNOWLEDGE_KEY,))


def set_force_limit(force_sum_n: float) -> WsgRequest:
    """Set the force limit, the sum over both fingers."""
    return WsgRequest(WsgCommand.SET_FORCE_LIMIT, (force_sum_n,))


def update(command: WsgCommand, period_ms: int = 0, *, on_change: bool = False) -> WsgRequest:
    """Request a reading once (period 0) or periodically; ``on_change`` only when it differs."""
    return WsgRequest(command, ((period_ms > 0) | on_change << 1, period_ms))


def encode_request(request: WsgRequest) -> bytes:
    """Return the frame; raises ``ProtocolError`` if a value is not finite or out of range."""
    layout = REQUESTS.get(request.command)
    if layout is None or (request.command in TEXT and request.values):
        return _frame(request.command, _only_bytes(request.values, request.command))
    return _frame(request.command, _pack(layout, request.values))


def encode_reply(reply: WsgReply) -> bytes:
    """Return the frame."""
    if not 0 <= reply.status <= 0xFFFF:
        raise ProtocolError("range", "wsg status", _HEAD)
    values = reply.values
    if reply.command == WsgCommand.TEMPERATURE and values:
        values = (round(float(values[0]) * 10),)
    if reply.command in TEXT and reply.command != WsgCommand.SET_TAG and values:
        content = _only_bytes(values, reply.command)
    elif reply.status != WsgStatus.SUCCESS or not values:
        content = _pack(NOTHING, values)
    else:
        content = _pack(REPLIES.get(reply.command, (NOTHING,))[-1], values)
    return _frame(reply.command, struct.pack("<H", reply.status) + content)


def requests() -> FrameStream[WsgIncoming]:
    """Return the decoder of a gripper; an invalid request becomes a ``WsgRefusal``."""
    return FrameStream(_take_request)


def replies() -> FrameStream[WsgReply]:
    """Return the decoder of a driver."""
    return FrameStream(_take_reply)


def decode_reply(frame: bytes) -> WsgReply:
    """Return the reply of one whole frame; raises ``ProtocolError``."""
    command, payload = frame[3], _payload(frame)
    if len(payload) < 2:
        raise ProtocolError("size", "wsg reply", 4)
    status, content = int.from_bytes(payload[:2], "little"), payload[2:]
    if status != WsgStatus.SUCCESS or not content:
        layouts = REPLIES.get(command, (NOTHING,))
        needed = status == WsgStatus.SUCCESS and command not in TEXT and NOTHING not in layouts
        if content or needed:
            raise ProtocolError("size", "wsg reply", _HEAD + 2)
        return WsgReply(command, status)
    if command in (WsgCommand.LOOP, WsgCommand.GET_TAG):
        return WsgReply(command, status, (content,))
    values = _values(REPLIES.get(command, (NOTHING,))[-1], content)
    if command == WsgCommand.TEMPERATURE:
        values = (float(values[0]) / 10,)
    return WsgReply(command, status, values)


def _frame(command: int, payload: bytes) -> bytes:
    if not 0 <= command <= 0xFF:
        raise ProtocolError("command", "wsg frame", 3)
    body = PREAMBLE + struct.pack("<BH", command, len(payload)) + payload
    return body + struct.pack("<H", crc_wsg(body))


def _pack(layout: str, values: tuple[Number, ...]) -> bytes:
    if not all(isinstance(value, bytes) or math.isfinite(value) for value in values):
        raise ProtocolError("number", "wsg payload", _HEAD)
    with range_errors("wsg payload", _HEAD):
        return struct.pack(layout, *values)


def _only_bytes(values: tuple[Number, ...], command: int) -> bytes:
    content = values[0] if len(values) == 1 else b"" if not values else None
    if not isinstance(content, bytes) or len(content) > TEXT.get(command, LONGEST_UNKNOWN):
        raise ProtocolError("range", "wsg payload", _HEAD)
    return content


def _size(data: bytes, at: int) -> int | None:
    """Return the length of the frame at ``at``; 0 if none starts there, None if unknown yet."""
    head = data[at : at + _HEAD]
    if not (head.startswith(PREAMBLE) or PREAMBLE.startswith(head)):
        return 0
    if len(head) < _HEAD:
        return None
    longest = TEXT.get(head[3], LONGEST_UNKNOWN) + 2
    size = int.from_bytes(head[4:6], "little")
    return _HEAD + size + _CRC if size <= longest else 0


def _payload(frame: bytes) -> bytes:
    # Not "crc over the frame is 0": that is also true for some wrong values of its two bytes.
    if crc_wsg(frame[:-_CRC]) != int.from_bytes(frame[-_CRC:], "little"):
        raise ProtocolError("crc", "wsg frame", len(frame) - _CRC)
    return frame[_HEAD:-_CRC]


def _values(layout: str, content: bytes) -> tuple[Number, ...]:
    if struct.calcsize(layout) != len(content):
        raise ProtocolError("size", "wsg payload", _HEAD)
    values = struct.unpack(layout, content)
    if not all(isinstance(value, bytes) or math.isfinite(value) for value in values):
        raise ProtocolError("number", "wsg payload", _HEAD)
    return values


def _frame_at(data: bytes, at: int) -> bytes | FrameStep[Any] | None:
    """Return the whole frame at ``at``, the noise before the next one, or None if unfinished."""
    size = _size(data, at)
    if size == 0:
        return noise_until(data, at, PREAMBLE[:1])
    return None if size is None or at + size > len(data) else data[at : at + size]


def _take_reply(data: bytes, at: int) -> FrameStep[WsgReply] | None:
    frame = _frame_at(data, at)
    if not isinstance(frame, bytes):
        return frame
    try:
        return FrameStep(len(frame), decode_reply(frame))
    except ProtocolError:
        return FrameStep(1, refused=True)


def _take_request(data: bytes, at: int) -> FrameStep[WsgIncoming] | None:
    frame = _frame_at(data, at)
    if not isinstance(frame, bytes):
        return frame
    try:
        return FrameStep(len(frame), _request(frame[3], _payload(frame)))
    except ProtocolError:
        inner = frame.find(PREAMBLE, 1)
        length = len(frame) if inner < 0 else inner  # noise may contain a false length
        return FrameStep(length, WsgRefusal(frame[3], WsgStatus.CHECKSUM_ERROR), refused=True)


def _request(command: int, payload: bytes) -> WsgIncoming:
    layout = REQUESTS.get(command)
    if layout is None or command in (WsgCommand.LOOP, WsgCommand.SET_TAG):
        return WsgRequest(command, (payload,) if payload else ())
    if payload and layout == NOTHING:
        return WsgRefusal(command, WsgStatus.NO_PARAM_EXPECTED)
    try:
        return WsgRequest(command, _values(layout, payload))
    except ProtocolError:
        return WsgRefusal(command, WsgStatus.CMD_FORMAT_ERROR)


MAKER = "Weiss Robotics"
TYPES = {0: "WSG", 1: "WSG 50"}
DECIMALS = 100


class BinaryProtocol:
    """The binary protocol: periodic updates keep the connection alive."""

    def __init__(self) -> None:
        self._decoder = replies()

    @property
    def bad_frames(self) -> int:
        """Number of invalid frames."""
        return self._decoder.bad_frames

    def encode(self, requests: Iterable[WsgRequest]) -> bytes:
        """Return the frames."""
        return b"".join(map(encode_request, requests))

    def take(self, data: bytes) -> list[WsgReply]:
        """Return the replies."""
        return self._decoder.feed(data)

    def due(self, now_s: float) -> bytes:
        """Do nothing."""
        return b""

    def identity(self, told: WsgReply, address: str) -> Identity:
        """Return type, serial number and firmware."""
        values = [int(value) for value in told.values] or [0, 0, 0, 0]
        kind, hardware, firmware, serial = values
        model = f"{TYPES.get(kind, 'WSG')}, hardware {hardware}"
        number = str(serial) if serial else address
        return Identity(MAKER, model, number, f"{firmware / DECIMALS:.2f}")
