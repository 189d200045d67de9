"""Binary and text dialect of the driver."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from typing import Protocol

from touchdown.backend.config import WsgSettings
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.devices.wsg import protocol, protocol_gcl
from touchdown.backend.devices.wsg.protocol import Command, Reply, Request, Status, SystemFlag
from touchdown.backend.devices.wsg.protocol_gcl import (
    Answer,
    Assignment,
    Call,
    Failure,
    Line,
    Query,
)

MAKER = "Weiss Robotics"
TYPES = {0: "WSG", 1: "WSG 50"}
DECIMALS = 100


class GripperLanguage(Protocol):
    """One protocol, for one connection."""

    @property
    def bad_frames(self) -> int:
        """What could not be read so far."""

    def encode(self, requests: Iterable[Request]) -> bytes:
        """Return what to send for these requests, in their order."""

    def take(self, data: bytes) -> list[Reply]:
        """Return the replies that ``data`` completes, oldest first."""

    def due(self, now_s: float) -> bytes:
        """Return what is to be sent by the clock alone."""

    def identity(self, told: Reply, address: str) -> Identity:
        """Return who answers, by the reply to SYSTEM_INFO; ``address`` stands for a number."""


class BinaryLanguage:
    """The binary protocol: updates come of themselves and keep the connection alive."""

    def __init__(self) -> None:
        self._decoder = protocol.replies()

    @property
    def bad_frames(self) -> int:
        """Frames that were none."""
        return self._decoder.bad_frames

    def encode(self, requests: Iterable[Request]) -> bytes:
        """Return the frames."""
        return b"".join(map(protocol.encode_request, requests))

    def take(self, data: bytes) -> list[Reply]:
        """Return the replies."""
        return self._decoder.feed(data)

    def due(self, now_s: float) -> bytes:
        """Nothing."""
        return b""

    def identity(self, told: Reply, address: str) -> Identity:
        """Return type, serial number and firmware."""
        values = [int(value) for value in told.values] or [0, 0, 0, 0]
        kind, hardware, firmware, serial = values
        model = f"{TYPES.get(kind, 'WSG')}, hardware {hardware}"
        number = str(serial) if serial else address
        return Identity(MAKER, model, number, f"{firmware / DECIMALS:.2f}")


QUERY_S = 0.2
"""Everything is asked for so often: it keeps the connection alive, whatever AUTOSEND does."""
FLAGS = (
    SystemFlag.REFERENCED,
    SystemFlag.FAST_STOP,
    SystemFlag.TEMP_FAULT,
    SystemFlag.POWER_FAULT,
    SystemFlag.CURR_FAULT,
    SystemFlag.FINGER_FAULT,
)
"""Those that matter, each asked for by its bit. MOVING is not asked for: told this seldom it would
be old, and a stop on its word would end a grip that stands."""
READINGS = {Command.GRASP_STATE: "GRIPSTATE", Command.WIDTH: "POS", Command.FORCE: "FORCE"}
SELVES = ("DEVTYPE", "VERSION", "SN")
"""Who it is: three texts."""
CALLS = {
    Command.STOP: "STOP",
    Command.FAST_STOP: "FASTSTOP",
    Command.ACKNOWLEDGE: "FSACK",
    Command.DISCONNECT: "BYE",
}
UNKNOWN_TO_TEXT = (Command.SYSTEM_LIMITS, Command.GET_ACCELERATION)


class GclLanguage:
    """Says requests as lines; answers itself what the text protocol does not know."""

    def __init__(self, settings: WsgSettings) -> None:
        self._settings = settings
        self._decoder = protocol_gcl.lines()
        self._own: deque[Reply] = deque()
        self._force_sum_n = settings.force_min_n
        self._width_mm = 0.0
        self._moves: dict[str, Command] = {"HOME": Command.HOME, "GRIP": Command.GRASP}
        self._bits: dict[SystemFlag, bool] = {}
        self._texts: dict[str, str] = {}
        self._sent_of_itself: set[str] = set()
        self._next_s: float | None = None
        self._greeted = False

    @property
    def bad_frames(self) -> int:
        """Lines that were none."""
        return self._decoder.bad_frames

    def encode(self, requests: Iterable[Request]) -> bytes:
        """Return the lines."""
        lines = [line for request in requests for line in self._lines(request)]
        if lines and not self._greeted:
            self._greeted = True
            lines.append(Assignment("VERBOSE", 0))
        return b"".join(map(protocol_gcl.encode, lines))

    def take(self, data: bytes) -> list[Reply]:
        """Return the replies; with no data those to requests that it answers itself."""
        replies: list[Reply] = []
        while self._own:
            replies.append(self._own.popleft())
        for line in self._decoder.feed(data):
            replies += self._understand(line)
        return replies

    def due(self, now_s: float) -> bytes:
        """Return the queries that keep the connection alive."""
        if self._next_s is not None and now_s < self._next_s:
            return b""
        self._next_s = now_s + QUERY_S
        queries = [*map(Query, READINGS.values()), *self._flag_queries()]
        return b"".join(map(protocol_gcl.encode, queries))

    def identity(self, told: Reply, address: str) -> Identity:
        """Return what it says of itself."""
        kind, version, serial = (
            value.decode() if isinstance(value, bytes) else "" for value in told.values
        )
        return Identity(MAKER, kind, serial or address, version)

    # -- requests ---------------------------------------------------------------------------------

    def _lines(self, request: Request) -> list[Line]:
        command, values = request.command, request.values
        if command == Command.SET_FORCE_LIMIT:
            self._force_sum_n = float(values[0])
            return self._answered(Reply(command, Status.SUCCESS))
        if command in UNKNOWN_TO_TEXT:
            return self._answered(Reply(command, Status.NOT_AVAILABLE))
        if command == Command.SYSTEM_STATE:
            return list(self._flag_queries())
        if command == Command.SYSTEM_INFO:
            self._texts.clear()
            return [Query(name) for name in SELVES]
        if command in READINGS:
            return self._reading(READINGS[Command(command)], int(values[1]) if values else 0)
        if command in CALLS:
            return [Call(CALLS[Command(command)])]
        return [self._motion(Command(command), tuple(float(value) for value in values))]

    def _answered(self, reply: Reply) -> list[Line]:
        self._own.append(reply)
        return []

    def _flag_queries(self) -> list[Query]:
        return [Query(f"SYSFLAGS[{flag.bit_length() - 1}]") for flag in FLAGS]

    def _reading(self, name: str, period_ms: int) -> list[Line]:
        lines: list[Line] = [Query(name)]
        if period_ms and name not in self._sent_of_itself:
            self._sent_of_itself.add(name)
            third = self._settings.gcl_autosend_third == "true"
            lines.insert(0, Call("AUTOSEND", (name, period_ms, third)))
        return lines

    def _motion(self, command: Command, values: tuple[float, ...]) -> Line:
        """Return the call that begins a motion; the one under this name is this motion from now."""
        if command is Command.HOME:
            return Call("HOME", (int(values[0]),) if values[0] else ())
        if command is Command.GRASP:
            return Call("GRIP", (self._force_sum_n, *values))
        width_mm, speed_mm_s = values[-2:]
        opens_mm = width_mm - self._width_mm
        if command is Command.RELEASE and opens_mm > 0.0:
            self._moves["RELEASE"] = command
            share = 1.0 if self._settings.gcl_release == "width" else 0.5
            return Call("RELEASE", (share * opens_mm, speed_mm_s))
        self._moves["MOVE"] = command
        return Call("MOVE", (width_mm, speed_mm_s))

    # -- answers ----------------------------------------------------------------------------------

    def _understand(self, line: Line) -> list[Reply]:
        match line:
            case Answer("ACK", name) if name in self._moves:
                return [Reply(self._moves[name], Status.CMD_PENDING)]
            case Answer("FIN", name) if name in self._moves:
                return [Reply(self._moves[name], Status.SUCCESS)]
            case Answer("ACK", name):
                return self._obeyed(name)
            case Failure(name, code):
                command = self._moves.get(name) or _called(name)
                return [Reply(command, code)] if command is not None else []
            case Assignment(name, value) if isinstance(value, str | int | float):
                return self._told(name, value)
        return []

    def _obeyed(self, name: str) -> list[Reply]:
        if name == "FSACK":
            self._bits.clear()  # what was told before belongs to the time before
        command = _called(name)
        return [] if command is None else [Reply(command, Status.SUCCESS)]

    def _told(self, name: str, value: str | float) -> list[Reply]:
        for command, reading in READINGS.items():
            if name == reading and not isinstance(value, str):
                self._width_mm = float(value) if command is Command.WIDTH else self._width_mm
                return [Reply(command, Status.SUCCESS, (value,))]
        if name in SELVES:
            self._texts[name] = str(value).strip('"')
            if len(self._texts) == len(SELVES):
                told = tuple(self._texts[key].encode() for key in SELVES)
                return [Reply(Command.SYSTEM_INFO, Status.SUCCESS, told)]
        if name.startswith("SYSFLAGS[") and not isinstance(value, str):
            return self._flag(int(name[9:-1]), bool(value))
        return []

    def _flag(self, bit: int, up: bool) -> list[Reply]:
        """Take one flag; return them all once each has been told."""
        self._bits[SystemFlag(1 << bit)] = up
        if not all(flag in self._bits for flag in FLAGS):
            return []
        flags = sum(int(flag) for flag in FLAGS if self._bits[flag])
        self._bits.clear()
        return [Reply(Command.SYSTEM_STATE, Status.SUCCESS, (flags,))]


def _called(name: str) -> Command | None:
    return next((command for command, call in CALLS.items() if call == name), None)
