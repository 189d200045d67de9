"""Text protocol of Weiss WSG grippers (GCL), translated to the messages of the binary protocol.

One command, query or answer per line. For grippers whose text interface cannot be switched off. It
has no limits, acceleration or force limit: those of the settings apply, and the force is an
argument of the grip. Source: GCL reference manual (contents), public clients.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from decimal import Decimal
from typing import TypeAlias

from touchdown.backend.config import WsgSettings
from touchdown.backend.devices.framing import LineStream, ProtocolError
from touchdown.backend.devices.identification import ProtocolSignature
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.devices.wsg.protocol import (
    MAKER,
    SystemFlag,
    WsgCommand,
    WsgReply,
    WsgRequest,
    WsgStatus,
    encode_request,
    replies,
)

LONGEST = 256
LARGEST = 1e9

_NAME = rb"[A-Z][A-Z0-9]*(?:\[[0-9]{1,3}\])?"
_CALL = re.compile(rb"([A-Z][A-Z0-9]*)\((.*)\)")
_QUERY = re.compile(rb"(" + _NAME + rb")\?")
_ASSIGNMENT = re.compile(rb"(" + _NAME + rb")=(.*)")
_ANSWER = re.compile(rb"(ACK|FIN) ([A-Z][A-Z0-9]*)")
_ERROR = re.compile(rb"ERR ([A-Z][A-Z0-9]*) ([0-9]{1,5})(?: (.*))?")
_ARGUMENT = re.compile(r'"([^"]*)"|(true|false)|([-+0-9.]+)')
_PRINTABLE = re.compile(rb"[ -~]*")

Scalar: TypeAlias = float | int | str | bool


@dataclass(frozen=True, slots=True)
class GclCall:
    """``COMMAND(arguments)``; a text argument is quoted."""

    command: str
    arguments: tuple[Scalar, ...] = ()


@dataclass(frozen=True, slots=True)
class GclQuery:
    """``NAME?``."""

    name: str


@dataclass(frozen=True, slots=True)
class GclAssignment:
    """``NAME=value``: set, echoed, or the answer to a query; text is unchanged."""

    name: str
    value: Scalar | tuple[Scalar, ...]


@dataclass(frozen=True, slots=True)
class GclAnswer:
    """``ACK`` accepted, ``FIN`` completed."""

    kind: str
    command: str


@dataclass(frozen=True, slots=True)
class GclError:
    """``ERR``: a status code of the binary protocol, and a text in verbose mode."""

    command: str
    code: int
    text: str = ""


GclLine = GclCall | GclQuery | GclAssignment | GclAnswer | GclError


def encode(line: GclLine) -> bytes:
    """Return the line with its LF; raises ``ProtocolError`` unless it reads back as the same."""
    content = _text(line).encode("ascii", "replace")
    if decode(content) != line:
        raise ProtocolError("text", "gcl line")
    return content + b"\n"


def decode(content: bytes) -> GclLine:
    """Return the message of one line without its end; raises ``ProtocolError``."""
    if len(content) > LONGEST or _PRINTABLE.fullmatch(content) is None:
        raise ProtocolError("text", "gcl line")
    if found := _ANSWER.fullmatch(content):
        return GclAnswer(found[1].decode(), found[2].decode())
    if found := _ERROR.fullmatch(content):
        return GclError(found[1].decode(), int(found[2]), (found[3] or b"").decode())
    if found := _CALL.fullmatch(content):
        return GclCall(found[1].decode(), _arguments(found[2].decode()))
    if found := _QUERY.fullmatch(content):
        return GclQuery(found[1].decode())
    if found := _ASSIGNMENT.fullmatch(content):
        return GclAssignment(found[1].decode(), _value(found[2].decode()))
    raise ProtocolError("text", "gcl line")


def lines() -> LineStream[GclLine]:
    """Return the decoder of either direction; takes LF and CR LF."""
    return LineStream(decode, LONGEST)


def _text(line: GclLine) -> str:
    match line:
        case GclAnswer(kind, command):
            return f"{kind} {command}"
        case GclError(command, code, text):
            return f"ERR {command} {code} {text}" if text else f"ERR {command} {code}"
        case GclCall(command, arguments):
            return f"{command}({_joined(arguments)})"
        case GclQuery(name):
            return f"{name}?"
        case GclAssignment(name, tuple() as values):
            return f"{name}=[{_joined(values)}]"
        case GclAssignment(name, str() | int() | float() as value):
            return f"{name}={_number_text(value)}"
    raise ProtocolError("type", "gcl line")


def _joined(values: tuple[Scalar, ...]) -> str:
    return ",".join(f'"{v}"' if isinstance(v, str) else _number_text(v) for v in values)


def _number_text(value: Scalar) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        if not math.isfinite(value) or abs(value) > LARGEST:
            raise ProtocolError("range", "gcl number")
        return f"{Decimal(repr(value)):f}"
    return str(value)


def _number(text: str) -> float | int:
    if re.fullmatch(r"[-+]?[0-9]{1,15}", text):
        return int(text)
    if re.fullmatch(r"[-+]?[0-9]{1,15}\.[0-9]*", text):
        return float(text)
    raise ProtocolError("number", "gcl number")


def _arguments(text: str) -> tuple[Scalar, ...]:
    arguments: list[Scalar] = []
    at = 0
    while text:
        found = _ARGUMENT.match(text, at)
        if found is None:
            raise ProtocolError("text", "gcl arguments", at)
        quoted, truth, number = found.groups()
        value = quoted if quoted is not None else truth == "true" if truth else _number(number)
        arguments.append(value)
        at = found.end()
        if at == len(text):
            break
        if text[at] != ",":
            raise ProtocolError("text", "gcl arguments", at)
        at += 1
    return tuple(arguments)


def _value(text: str) -> Scalar | tuple[Scalar, ...]:
    if text.startswith("[") and text.endswith("]"):
        return _arguments(text[1:-1])
    if text in ("true", "false"):
        return text == "true"
    try:
        return _number(text)
    except ProtocolError:
        return text


# Period of all queries: they keep the connection alive, independent of AUTOSEND.
QUERY_S = 0.2
# Flags that are queried, each by its bit. MOVING is left out: at this rate it would be outdated,
# and a stop because of it would end a completed grip.
FLAGS = (
    SystemFlag.REFERENCED,
    SystemFlag.FAST_STOP,
    SystemFlag.TEMP_FAULT,
    SystemFlag.POWER_FAULT,
    SystemFlag.CURR_FAULT,
    SystemFlag.FINGER_FAULT,
)
READINGS = {WsgCommand.GRASP_STATE: "GRIPSTATE", WsgCommand.WIDTH: "POS", WsgCommand.FORCE: "FORCE"}
SELVES = ("DEVTYPE", "VERSION", "SN")  # variables of the identity
CALLS = {
    WsgCommand.STOP: "STOP",
    WsgCommand.FAST_STOP: "FASTSTOP",
    WsgCommand.ACKNOWLEDGE: "FSACK",
    WsgCommand.DISCONNECT: "BYE",
}
UNKNOWN_TO_TEXT = (WsgCommand.SYSTEM_LIMITS, WsgCommand.GET_ACCELERATION)


class GclProtocol:
    """Sends requests as lines; answers by itself those that the text protocol does not have."""

    def __init__(self, settings: WsgSettings) -> None:
        self._settings = settings
        self._decoder = lines()
        self._own: list[WsgReply] = []
        self._force_sum_n = settings.force_min_n
        self._width_mm = 0.0
        self._moves: dict[str, WsgCommand] = {"HOME": WsgCommand.HOME, "GRIP": WsgCommand.GRASP}
        self._bits: dict[SystemFlag, bool] = {}
        self._texts: dict[str, str] = {}
        self._sent_of_itself: set[str] = set()
        self._next_s: float | None = None
        self._greeted = False

    @property
    def bad_frames(self) -> int:
        """Number of invalid lines."""
        return self._decoder.bad_frames

    def encode(self, requests: Iterable[WsgRequest]) -> bytes:
        """Return the lines."""
        lines = [line for request in requests for line in self._lines(request)]
        if lines and not self._greeted:
            self._greeted = True
            lines.append(GclAssignment("VERBOSE", 0))
        return b"".join(map(encode, lines))

    def take(self, data: bytes) -> list[WsgReply]:
        """Return the replies; without data those to requests that it answers by itself."""
        replies, self._own = self._own, []
        for line in self._decoder.feed(data):
            replies += self._understand(line)
        return replies

    def due(self, now_s: float) -> bytes:
        """Return the queries that keep the connection alive."""
        if self._next_s is not None and now_s < self._next_s:
            return b""
        self._next_s = now_s + QUERY_S
        queries = [*map(GclQuery, READINGS.values()), *self._flag_queries()]
        return b"".join(map(encode, queries))

    def identity(self, told: WsgReply, address: str) -> Identity:
        """Return the identity."""
        kind, version, serial = (
            value.decode() if isinstance(value, bytes) else "" for value in told.values
        )
        return Identity(MAKER, kind, serial or address, version)

    # -- requests ---------------------------------------------------------------------------------

    def _lines(self, request: WsgRequest) -> list[GclLine]:
        command, values = request.command, request.values
        if command == WsgCommand.SET_FORCE_LIMIT:
            self._force_sum_n = float(values[0])
            self._own.append(WsgReply(command, WsgStatus.SUCCESS))
            return []
        if command in UNKNOWN_TO_TEXT:
            self._own.append(WsgReply(command, WsgStatus.NOT_AVAILABLE))
            return []
        if command == WsgCommand.SYSTEM_STATE:
            return list(self._flag_queries())
        if command == WsgCommand.SYSTEM_INFO:
            self._texts.clear()
            return [GclQuery(name) for name in SELVES]
        if command in READINGS:
            name, period_ms = READINGS[WsgCommand(command)], int(values[1]) if values else 0
            if not period_ms or name in self._sent_of_itself:
                return [GclQuery(name)]
            self._sent_of_itself.add(name)
            third = self._settings.gcl_autosend_third == "true"
            return [GclCall("AUTOSEND", (name, period_ms, third)), GclQuery(name)]
        if command in CALLS:
            return [GclCall(CALLS[WsgCommand(command)])]
        return [self._motion(WsgCommand(command), tuple(float(value) for value in values))]

    def _flag_queries(self) -> list[GclQuery]:
        return [GclQuery(f"SYSFLAGS[{flag.bit_length() - 1}]") for flag in FLAGS]

    def _motion(self, command: WsgCommand, values: tuple[float, ...]) -> GclLine:
        """Return the call that starts a motion and register the motion by its name."""
        if command is WsgCommand.HOME:
            return GclCall("HOME", (int(values[0]),) if values[0] else ())
        if command is WsgCommand.GRASP:
            return GclCall("GRIP", (self._force_sum_n, *values))
        width_mm, speed_mm_s = values[-2:]
        opens_mm = width_mm - self._width_mm
        if command is WsgCommand.RELEASE and opens_mm > 0.0:
            self._moves["RELEASE"] = command
            share = 1.0 if self._settings.gcl_release == "width" else 0.5
            return GclCall("RELEASE", (share * opens_mm, speed_mm_s))
        self._moves["MOVE"] = command
        return GclCall("MOVE", (width_mm, speed_mm_s))

    # -- answers ----------------------------------------------------------------------------------

    def _understand(self, line: GclLine) -> list[WsgReply]:
        match line:
            case GclAnswer("ACK", name) if name in self._moves:
                return [WsgReply(self._moves[name], WsgStatus.CMD_PENDING)]
            case GclAnswer("FIN", name) if name in self._moves:
                return [WsgReply(self._moves[name], WsgStatus.SUCCESS)]
            case GclAnswer("ACK", name):
                if name == "FSACK":
                    self._bits.clear()  # earlier flags are outdated
                called = _called(name)
                return [] if called is None else [WsgReply(called, WsgStatus.SUCCESS)]
            case GclError(name, code):
                command = self._moves.get(name) or _called(name)
                return [WsgReply(command, code)] if command is not None else []
            case GclAssignment(name, value) if isinstance(value, str | int | float):
                return self._told(name, value)
        return []

    def _told(self, name: str, value: str | float) -> list[WsgReply]:
        for command, reading in READINGS.items():
            if name == reading and not isinstance(value, str):
                self._width_mm = float(value) if command is WsgCommand.WIDTH else self._width_mm
                return [WsgReply(command, WsgStatus.SUCCESS, (value,))]
        if name in SELVES:
            self._texts[name] = str(value).strip('"')
            if len(self._texts) == len(SELVES):
                told = tuple(self._texts[key].encode() for key in SELVES)
                return [WsgReply(WsgCommand.SYSTEM_INFO, WsgStatus.SUCCESS, told)]
        if name.startswith("SYSFLAGS[") and not isinstance(value, str):
            self._bits[SystemFlag(1 << int(name[9:-1]))] = bool(value)
            if not all(flag in self._bits for flag in FLAGS):
                return []
            flags = sum(int(flag) for flag in FLAGS if self._bits[flag])
            self._bits.clear()
            return [WsgReply(WsgCommand.SYSTEM_STATE, WsgStatus.SUCCESS, (flags,))]
        return []


def _called(name: str) -> WsgCommand | None:
    return next((command for command, call in CALLS.items() if call == name), None)


SIGNATURES = (
    ProtocolSignature(
        "binary",
        "a WSG gripper that speaks its binary protocol",
        encode_request(WsgRequest(WsgCommand.SYSTEM_STATE, (0, 0))),
        replies,
        (WsgReply,),
    ),
    ProtocolSignature(
        "gcl",
        "a WSG gripper that speaks its text protocol",
        b"\n" + encode(GclQuery("GRIPSTATE")),
        lines,
        (GclAssignment,),
    ),
)
