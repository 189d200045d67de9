"""R3, the command channel of a MELFA controller: ASCII requests, each with one reply.

Only the commands of ``ALLOWED`` can be encoded or decoded: none that reboots, moves the origin,
releases brakes, deletes programs or writes parameters. Source: BFP-A4288-V.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from backend.wire.framing import WireError
from backend.wire.lines import LineStream

LONGEST_REQUEST, LONGEST_REPLY = 255, 4096
EDIT_SLOT = 9
"""TASKMAX + 1 with the factory setting."""

_PROGRAM = r"[A-Za-z0-9_]{1,12}"
_VARIABLE = r"[A-Za-z][A-Za-z0-9_]{0,15}"
_WRITE = _VARIABLE + r"=[-+0-9.,()Ee]{1,160}"
_MOTION = r"(?i:MOV|MVS|SPD|JOVRD|OVRD) [A-Za-z0-9_+\-.,() ]{1,160}"

ALLOWED: dict[str, str] = {
    "OPEN=": r"[A-Za-z0-9]{1,32}",
    "CLOSE": "",
    "CNTL": "ON|OFF",
    "SRV": "ON|OFF",
    "OVRD=": r"[1-9][0-9]?|100",
    "OVRD": "",
    "PRGLOAD=": _PROGRAM,
    "RUN": rf"(?:{_PROGRAM})?(?:;[01])?",
    "STOP": "",
    "CSTOP": "",
    "STOPON": "",
    "STOPOFF": "",
    "SLOTINIT": "",
    "RSTPRG": "",
    "RSTALRM": "",
    "STATE": "",
    "DSTATE": "",
    "ERROR": "",
    "ERRORMES": r"[0-9]{1,5}",
    "PPOS": "F",
    "JPOS": "F",
    "EXEC": _MOTION,
    "EXEC2=": _MOTION,
    "JOG": r"0[0-5];00;[0-9A-F]{2};[0-9A-F]{2};0[0-2](?:;0[0-2])?",
    "HNDON": "[1-8]",
    "HNDOFF": "[1-8]",
    "HNDSTS": "",
    "OUT=": r"[0-9]{1,5};[0-9A-F]{4}",
    "OUT": r"[0-9]{1,5}",
    "IN": r"[0-9]{1,5}",
    "VAL=": _WRITE,
    "VAL": rf"<;[A-Z]|{_VARIABLE}",
    "HOT": rf"{_PROGRAM};{_WRITE}",
    "TOOLSET=": r"[0-9]|1[0-6]",
    "TOOLRD": "",
    "MOVSP": "",
    "ALIGN": "",
    "ATENA": "",
    "STPSIG": "",
    "CALIB": "",
    "PAR": r"[A-Z0-9]{1,12}",
    "OPSTSRD": r"[0-9]{1,2}",
}
"""Every command that may go out, and what its argument may look like."""

_PATTERNS = [
    (command, re.compile(ALLOWED[command])) for command in sorted(ALLOWED, key=len, reverse=True)
]
_ADDRESS = re.compile(r"([0-3]?);([0-9]|[12][0-9]|3[0-3]|);")
_HEAD = re.compile(r"[Qq](?:[Oo][Kk]|[Ee][Rr])")
_FORBIDDEN_BYTES = re.compile(rb"[\x00-\x08\x0a\x0c-\x1f\x7f]")


@dataclass(frozen=True, slots=True)
class Request:
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
class Reply:
    """One reply: ``head`` is QoK, or Qok while an error is active, or QeR with the error number."""

    head: str
    answer: str = ""

    @property
    def ok(self) -> bool:
        """Whether the command was accepted."""
        return self.head[1] in "oO"

    @property
    def alarm(self) -> bool:
        """Whether an error is active: an inference from printed samples."""
        return self.ok and self.head[2] == "k"

    @property
    def error(self) -> int:
        """Why the command was refused; 0 if it was not."""
        found = None if self.ok else re.match(r"[0-9]{1,5}", self.answer)
        return int(found[0]) if found else 0


def jog(mode: int, minus_axes: int, plus_axes: int, inching: int = 0) -> Request:
    """Return one jog command; the controller stops by itself 140 ms after the last.

    ``mode``: 0 joint, 1 XYZ, 2 tool, 4 three-axis XYZ, 5 cylinder. Axis bits 1 X or J1 to 32 C
    or J6. ``inching``: 0 off, 1 high, 2 low.
    """
    return Request("JOG", f"{mode:02d};00;{minus_axes:02X};{plus_axes:02X};{inching:02d}")


def encode_request(request: Request) -> bytes:
    """Return the text without its end; raises ``WireError`` for all that ``ALLOWED`` lacks."""
    if (request.robot is None) != (request.slot is None):
        raise WireError("address", "r3 request")
    address = "" if request.robot is None else f"{request.robot};{request.slot};"
    try:
        content = f"{address}{request.command}{request.argument}".encode("ascii")
    except UnicodeEncodeError as error:
        raise WireError("text", "r3 request", error.start) from error
    if decode_request(content) != request:
        raise WireError("command", "r3 request", len(address))
    return content


def decode_request(content: bytes) -> Request:
    """Return the request of one text without its end; raises ``WireError``."""
    if len(content) > LONGEST_REQUEST:
        raise WireError("length", "r3 request", LONGEST_REQUEST)
    text = _text(content, "ascii", "r3 request")
    found = _ADDRESS.match(text)
    rest = text[found.end() :] if found else text
    robot, slot = (int(part) if part else 1 for part in found.groups()) if found else (None, None)
    for command, argument in _PATTERNS:
        if rest.startswith(command) and argument.fullmatch(rest, len(command)):
            return Request(command, rest[len(command) :], robot, slot)
    raise WireError("command", "r3 request", len(text) - len(rest))


def encode_reply(reply: Reply) -> bytes:
    """Return the text without its end."""
    try:
        content = (reply.head + reply.answer).encode("latin-1")
    except UnicodeEncodeError as error:
        raise WireError("text", "r3 reply", error.start) from error
    if decode_reply(content) != reply:
        raise WireError("head", "r3 reply")
    return content


def decode_reply(content: bytes) -> Reply:
    """Return the reply of one text without its end; raises ``WireError``."""
    if len(content) > LONGEST_REPLY:
        raise WireError("length", "r3 reply", LONGEST_REPLY)
    text = _text(content, "latin-1", "r3 reply")
    if _HEAD.match(text) is None:
        raise WireError("head", "r3 reply")
    return Reply(text[:3], text[3:])


def requests() -> LineStream[Request]:
    """Return the decoder of a controller: CR, LF, both, or ``flush`` after a short gap."""
    return LineStream(decode_request, LONGEST_REQUEST)


def replies() -> LineStream[Reply]:
    """Return the decoder of whoever commands one."""
    return LineStream(decode_reply, LONGEST_REPLY)


def _text(content: bytes, encoding: str, where: str) -> str:
    bad = _FORBIDDEN_BYTES.search(content)
    if bad:
        raise WireError("text", where, bad.start())
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        raise WireError("text", where, error.start) from error
