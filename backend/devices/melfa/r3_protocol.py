"""R3, the command channel protocol of a MELFA controller: ASCII requests, each with one reply.

Only the commands of ``ALLOWED`` can be encoded or decoded: none that reboots, moves the origin,
releases brakes, deletes programs or writes parameters. Angles are degrees on the wire, rad in the
messages. Source: BFP-A4288-V; MELFA-BASIC detailed specifications (position constants).
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from enum import IntFlag

from touchdown.backend.devices.framing import LineStream, ProtocolError

LONGEST_REQUEST, LONGEST_REPLY = 255, 4096

_PROGRAM = r"[A-Za-z0-9_]{1,12}"
_VARIABLE_NAME = r"[A-Za-z][A-Za-z0-9_]{0,15}"
_WRITE = _VARIABLE_NAME + r"=[-+0-9.,()Ee]{1,160}"
_MOTION = r"(?i:MOV|MVS|SPD|JOVRD|OVRD) [A-Za-z0-9_+\-.,() ]{1,160}"

_PLAIN = (
    "CLOSE", "OVRD", "STOP", "CSTOP", "STOPON", "STOPOFF", "SLOTINIT", "RSTPRG", "RSTALRM", "STATE",
    "DSTATE", "ERROR", "HNDSTS", "TOOLRD", "MOVSP", "ALIGN", "ATENA", "STPSIG", "CALIB",
)  # fmt: skip

# Permitted commands with the pattern of their argument.
ALLOWED: dict[str, str] = {
    **dict.fromkeys(_PLAIN, ""),
    "OPEN=": r"[A-Za-z0-9]{1,32}",
    "CNTL": "ON|OFF",
    "SRV": "ON|OFF",
    "OVRD=": r"[1-9][0-9]?|100",
    "PRGLOAD=": _PROGRAM,
    "RUN": rf"(?:{_PROGRAM})?(?:;[01])?",
    "ERRORMES": r"[0-9]{1,5}",
    "PPOS": "F",
    "JPOS": "F",
    "EXEC": _MOTION,
    "EXEC2=": _MOTION,
    "JOG": r"0[0-5];00;[0-9A-F]{2};[0-9A-F]{2};0[0-2](?:;0[0-2])?",
    "HNDON": "[1-8]",
    "HNDOFF": "[1-8]",
    "OUT=": r"[0-9]{1,5};[0-9A-F]{4}",
    "OUT": r"[0-9]{1,5}",
    "IN": r"[0-9]{1,5}",
    "VAL=": _WRITE,
    "VAL": rf"<;[A-Z]|{_VARIABLE_NAME}",
    "HOT": rf"{_PROGRAM};{_WRITE}",
    "TOOLSET=": r"[0-9]|1[0-6]",
    "PAR": r"[A-Z0-9]{1,12}",
    "OPSTSRD": r"[0-9]{1,2}",
}

_FILE = rf"{_PROGRAM}(?:\.[A-Za-z0-9]{{1,3}})?"
# Requests of other clients in addition: an emulator answers them, no driver sends them.
FOREIGN: dict[str, str] = {
    "OVRD=": r"[0-9]{1,3}(?:\.[0-9]{1,4})?",
    "PRGLOAD=": _FILE,
    "RUN": rf"(?:{_FILE})?(?:;[01])?",
    "HOT": rf"{_FILE};{_WRITE}",
    "PNR": r"[A-Z0-9]{1,12}",
    "EXEC": r"[ -~]{1,160}",
    "EXEC2=": r"[ -~]{1,160}",
}


def _compiled(table: dict[str, str]) -> list[tuple[str, re.Pattern[str]]]:
    return [(name, re.compile(table[name])) for name in sorted(table, key=len, reverse=True)]


_PATTERNS, _FOREIGN_PATTERNS = _compiled(ALLOWED), _compiled({**ALLOWED, **FOREIGN})
_ADDRESS = re.compile(r"([0-3]?);([0-9]|[12][0-9]|3[0-3]|);")
_HEAD = re.compile(r"[Qq](?:[Oo][Kk]|[Ee][Rr])")
_FORBIDDEN_BYTES = re.compile(rb"[\x00-\x08\x0a\x0c-\x1f\x7f]")


@dataclass(frozen=True, slots=True)
class R3Request:
    """One command; ``robot`` and ``slot`` are 1 unless given, 0 means all, None sends neither."""

    command: str
    argument: str = ""
    robot: int | None = 1
    slot: int | None = 1

    @property
    def arguments(self) -> tuple[str, ...]:
        """The parts of the argument."""
        return tuple(re.split("[;\v]", self.argument))


@dataclass(frozen=True, slots=True)
class R3Reply:
    """One reply: ``head`` is QoK, or Qok while an error is active, or QeR with the error number."""

    head: str
    answer: str = ""

    @property
    def ok(self) -> bool:
        """True if the command was accepted."""
        return self.head[1] in "oO"

    @property
    def alarm(self) -> bool:
        """True if an error is active; inferred from printed samples."""
        return self.ok and self.head[2] == "k"

    @property
    def error(self) -> int:
        """Error number of a refusal, 0 if accepted."""
        found = None if self.ok else re.match(r"[0-9]{1,5}", self.answer)
        return int(found[0]) if found else 0


def encode_request(request: R3Request) -> bytes:
    """Return the text without its end; raises ``ProtocolError`` for commands outside
    ``ALLOWED``.
    """
    if (request.robot is None) != (request.slot is None):
        raise ProtocolError("address", "r3 request")
    address = "" if request.robot is None else f"{request.robot};{request.slot};"
    try:
        content = f"{address}{request.command}{request.argument}".encode("ascii")
    except UnicodeEncodeError as error:
        raise ProtocolError("text", "r3 request", error.start) from error
    if decode_request(content) != request:
        raise ProtocolError("command", "r3 request", len(address))
    return content


def decode_request(content: bytes, *, foreign: bool = False) -> R3Request:
    """Return the request of one text without its end; raises ``ProtocolError``. ``foreign``: accept
    the requests of ``FOREIGN`` as well.
    """
    if len(content) > LONGEST_REQUEST:
        raise ProtocolError("length", "r3 request", LONGEST_REQUEST)
    text = _text(content, "ascii", "r3 request")
    found = _ADDRESS.match(text)
    rest = text[found.end() :] if found else text
    robot, slot = (int(part) if part else 1 for part in found.groups()) if found else (None, None)
    for command, argument in _FOREIGN_PATTERNS if foreign else _PATTERNS:
        if rest.startswith(command) and argument.fullmatch(rest, len(command)):
            return R3Request(command, rest[len(command) :], robot, slot)
    raise ProtocolError("command", "r3 request", len(text) - len(rest))


def encode_reply(reply: R3Reply) -> bytes:
    """Return the text without its end."""
    try:
        content = (reply.head + reply.answer).encode("latin-1")
    except UnicodeEncodeError as error:
        raise ProtocolError("text", "r3 reply", error.start) from error
    if decode_reply(content) != reply:
        raise ProtocolError("head", "r3 reply")
    return content


def decode_reply(content: bytes) -> R3Reply:
    """Return the reply of one text without its end; raises ``ProtocolError``."""
    if len(content) > LONGEST_REPLY:
        raise ProtocolError("length", "r3 reply", LONGEST_REPLY)
    text = _text(content, "latin-1", "r3 reply")
    if _HEAD.match(text) is None:
        raise ProtocolError("head", "r3 reply")
    return R3Reply(text[:3], text[3:])


def requests() -> LineStream[R3Request]:
    """Return the decoder of a controller: CR, LF, both, or ``flush`` after a short gap."""
    return LineStream(decode_request, LONGEST_REQUEST)


def replies() -> LineStream[R3Reply]:
    """Return the decoder of a driver."""
    return LineStream(decode_reply, LONGEST_REPLY)


def _text(content: bytes, encoding: str, where: str) -> str:
    bad = _FORBIDDEN_BYTES.search(content)
    if bad:
        raise ProtocolError("text", where, bad.start())
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise ProtocolError("text", where, error.start) from error


_ANGLES = re.compile(r"[ABC]|J[1-8]")
_NAME = re.compile(r"[XYZABC]|J[1-8]|L[12]")
_NUMBER = re.compile(r"[-+]?[0-9]{1,9}(?:\.[0-9]{1,9})?")
_NO_FLAGS = "****,****"


@dataclass(frozen=True, slots=True)
class AxisReading:
    """Answer to PPOSF or JPOSF: named axes in mm and rad.

    ``flags`` are None for joints. ``override`` in %. Limit bits 1 X or J1 to 32 C or J6.
    """

    names: tuple[str, ...]
    values: tuple[float, ...]
    flags: tuple[int, int] | None
    override: int
    speed_mm_s: float
    plus_limit: int = 0
    minus_limit: int = 0

    def answer(self) -> str:
        """Return the text of the answer."""
        pairs = zip(self.names, self.values, strict=True)
        printed = ((n, math.degrees(v) if _ANGLES.fullmatch(n) else v) for n, v in pairs)
        axes = "".join(f"{n};{value:.2f};" for n, value in printed)
        flags = _NO_FLAGS if self.flags is None else f"{self.flags[0]},{self.flags[1]}"
        limits = f"{self.plus_limit:02X}{self.minus_limit:02X}0000"
        return f"{axes};{flags};{self.override};{self.speed_mm_s:.2f};{limits}"


def read_axes(answer: str) -> AxisReading:
    """Return the reading; raises ``ProtocolError``."""
    axes, mark, rest = answer.partition(";;")
    parts, tail = axes.split(";"), rest.split(";")
    if not mark or len(parts) % 2 or len(tail) != 4:
        raise ProtocolError("fields", "r3 position")
    names = tuple(parts[::2])
    if not all(map(_NAME.fullmatch, names)) or len(set(names)) != len(names):
        raise ProtocolError("name", "r3 position")
    pairs = zip(names, map(number, parts[1::2]), strict=True)
    values = tuple(math.radians(v) if _ANGLES.fullmatch(n) else v for n, v in pairs)
    limits = re.fullmatch(r"([0-9A-F]{2})([0-9A-F]{2})[0-9A-F]{4}", tail[3])
    if limits is None:
        raise ProtocolError("limits", "r3 position")
    plus, minus = int(limits[1], 16), int(limits[2], 16)
    first, _, second = tail[0].partition(",")
    flags = None if tail[0] == _NO_FLAGS else (whole(first), whole(second))
    return AxisReading(names, values, flags, whole(tail[1]), number(tail[2]), plus, minus)


def number(text: str) -> float:
    """Return a decimal number without exponent; raises ``ProtocolError``."""
    if _NUMBER.fullmatch(text) is None:
        raise ProtocolError("number", "r3 answer")
    return float(text)


def whole(text: str) -> int:
    """Return a whole number, not negative; raises ``ProtocolError``."""
    if re.fullmatch(r"[0-9]{1,10}", text) is None:
        raise ProtocolError("number", "r3 answer")
    return int(text)


EMERGENCY_ERRORS = frozenset({50, 51, 61, 70, 71})
OUT_OF_RANGE_ERRORS = frozenset({2601, 2602, 2603, 2800, 2801, 2802, 2810})
NOT_READY_ERRORS = frozenset({2000, 5120, 5600, 5610, 5620, 5630, 5640, 6020})
REJECTED_ERRORS = frozenset({4140, 4340, 4350})  # any other number is a fault of the device


class RunFlags(IntFlag):
    """Bits of the run status."""

    REPEAT = 0x01
    CYCLE_STOP = 0x02
    MACHINE_LOCK = 0x04
    TEACH = 0x08
    TEACH_RUNNING = 0x10
    SERVO_ON = 0x20
    RUNNING = 0x40
    OPERATION_ENABLED = 0x80


class StopFlags(IntFlag):
    """Bits of the stop status."""

    EMERGENCY = 0x01
    STOP = 0x02
    WAIT = 0x04
    STOP_SIGNAL = 0x08
    PROGRAM_SELECT_ENABLED = 0x10
    PSEUDO_INPUT = 0x40


@dataclass(frozen=True, slots=True)
class ControllerState:
    """Answer to STATE; ``error`` 0 is none."""

    program: str
    line: int
    override: int
    edit_status: int
    run: RunFlags
    stop: StopFlags
    error: int
    step: int
    mechanism: int
    task_program: str
    task_mode: str
    task_condition: str
    task_priority: int
    mechanism_in_use: int

    def answer(self) -> str:
        """Return the text of the answer, with the empty fields of the printed sample."""
        status = f"{self.run:02X}{self.stop:02X}{self.error}"
        front = f"{self.program};{self.line};{self.override};{self.edit_status};{status}"
        tail = f"{self.task_program};{self.task_mode};{self.task_condition};{self.task_priority}"
        return f"{front};{self.step};{self.mechanism};;;;;;;;{tail};{self.mechanism_in_use}"


def read_opened(answer: str) -> tuple[str, str]:
    """Return robot type and version from the answer to OPEN; raises ``ProtocolError``."""
    parts = _parts(answer, 16, "r3 open")
    return parts[6], parts[10]


def read_state(answer: str) -> ControllerState:
    """Return the answer to STATE; the number of empty fields in its middle may vary."""
    parts = _parts(answer, 12, "r3 state")
    line, override, edit_status, step, mechanism = (whole(parts[i]) for i in (1, 2, 3, 5, 6))
    program, mode, condition, priority, in_use = parts[-5:]
    return ControllerState(
        parts[0], line, override, edit_status, *_status(parts[4]), step, mechanism, program, mode,
        condition, whole(priority), whole(in_use),
    )  # fmt: skip


def read_error(answer: str) -> tuple[int, int]:
    """Return number and level (1 high, 2 low, 3 caution) of the active error; (0, 0) if none."""
    if not answer:
        return 0, 0
    error, mark, level = answer.partition(";")
    if not mark:
        raise ProtocolError("fields", "r3 answer", len(answer))
    return whole(error), whole(level)


def read_parameter(answer: str) -> tuple[str, str, int]:
    """Return name, value and count of a parameter."""
    name, *value, count = _parts(answer, 3, "r3 parameter")
    return name, ";".join(value), whole(count)


def _parts(answer: str, least: int, where: str) -> list[str]:
    parts = answer.split(";")
    if len(parts) < least:
        raise ProtocolError("fields", where, len(answer))
    return parts


def _status(text: str) -> tuple[RunFlags, StopFlags, int]:
    if len(text) < 5:
        raise ProtocolError("fields", "r3 status", len(text))
    return RunFlags(_hexadecimal(text[:2])), StopFlags(_hexadecimal(text[2:4])), whole(text[4:])


def _hexadecimal(text: str) -> int:
    if re.fullmatch(r"[0-9A-F]{1,8}", text) is None:
        raise ProtocolError("number", "r3 answer")
    return int(text, 16)
