"""Emulated WSG gripper, text protocol."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass

from touchdown.backend.config import WsgSettings
from touchdown.backend.devices.framing import LineStream, WireError
from touchdown.backend.devices.wsg import protocol, protocol_gcl
from touchdown.backend.devices.wsg.emulator import SERIAL, EmulatedWsg
from touchdown.backend.devices.wsg.protocol import Command, Number, Reply, Request, Status
from touchdown.backend.devices.wsg.protocol_gcl import (
    Answer,
    Assignment,
    Call,
    Failure,
    Line,
    Query,
    Scalar,
)

APART_S = 0.1
READINGS = {
    "POS": Command.WIDTH,
    "SPEED": Command.SPEED,
    "FORCE": Command.FORCE,
    "TEMP": Command.TEMPERATURE,
    "GRIPSTATE": Command.GRASP_STATE,
}
SELVES: dict[str, Scalar] = {"DEVTYPE": '"WSG 32-068"', "VERSION": "4.0.1", "SN": SERIAL}
KEPT = ("VERBOSE", "PWT", "CLT", "TAG")
"""What may be set; it is echoed."""
ORDERS = {
    "STOP": Request(Command.STOP),
    "FASTSTOP": Request(Command.FAST_STOP),
    "FSACK": protocol.acknowledge(),
    "BYE": Request(Command.DISCONNECT),
}
MOTIONS = ("HOME", "MOVE", "GRIP", "RELEASE")
OTHERS = ("AUTOSEND", "SYSFLAGS", "GRIPSTATS", "FDATA")
COMMANDS = frozenset({*READINGS, *SELVES, *KEPT, *ORDERS, *MOTIONS, *OTHERS})
FLAGS, LONGEST_NAME = 32, 32
STATISTICS = Request(Command.STATISTICS, (0,))
_SPEED_MM_S = 50.0
_RELEASE_MM = 10.0


@dataclass(frozen=True, slots=True)
class Unread:
    """A line that begins with ``name`` and has no form that is known."""

    name: str


@dataclass(slots=True)
class AutoSend:
    """A reading sent again and again; ``on_change`` only when it differs."""

    period_s: float
    on_change: bool
    next_s: float
    last: Line | None = None


class EmulatedGcl:
    """``gripper`` does the work; this is its mouth."""

    def __init__(self, gripper: EmulatedWsg, settings: WsgSettings | None = None) -> None:
        self.gripper, self._settings = gripper, settings or WsgSettings()
        self._lines = LineStream[Line | Unread](_read, protocol_gcl.LONGEST)
        self._replies = protocol.replies()
        self._called: dict[int, str] = {}
        self._acknowledged_s = -APART_S
        self._waiting: list[tuple[float, Line]] = []
        self._auto: dict[str, AutoSend] = {}
        self._verbose, self._kept = False, dict[str, Line]()

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Take lines; return what is answered at once."""
        out: list[Line] = []
        for asked in self._lines.feed(data):
            answer = self._answer(now_s, asked)
            out += [*self._ends(now_s), *answer]
        return b"".join(map(protocol_gcl.encode, out))

    def due(self, now_s: float) -> bytes:
        """Return the ends of motions, and the readings that are sent of themselves."""
        self._hear(now_s, self.gripper.due(now_s))
        out = self._ends(now_s)
        for name, auto in self._auto.items():
            if now_s >= auto.next_s:
                auto.next_s = max(auto.next_s + auto.period_s, now_s)
                line = self._reading(now_s, name)
                if not (auto.on_change and line == auto.last):
                    auto.last = line
                    out.append(line)
        return b"".join(map(protocol_gcl.encode, out))

    def closed(self, now_s: float) -> None:
        """Forget the client; without ``BYE`` the fast stop is latched."""
        self._lines.reset()
        self._auto.clear()
        self._waiting.clear()
        self.gripper.closed(now_s)

    def _ends(self, now_s: float) -> list[Line]:
        """Return the ends of motions that may go out by now."""
        out = [line for at_s, line in self._waiting if at_s <= now_s]
        self._waiting = [item for item in self._waiting if item[0] > now_s]
        return out

    def _answer(self, now_s: float, asked: Line | Unread) -> list[Line]:
        match asked:
            case Unread(name):
                known = name in COMMANDS
                wrong = Status.CMD_FORMAT_ERROR if known else Status.CMD_UNKNOWN
                return [self._ended(name, wrong, "ACK")]
            case Query(name):
                return self._query(now_s, name)
            case Assignment(name, value) if name in KEPT:
                self._verbose = bool(value) if name == "VERBOSE" else self._verbose
                self._kept[name] = asked
                return [asked]
            case Call("AUTOSEND", (str(name), int(period_ms), bool(third))) if name in READINGS:
                self._auto[name] = AutoSend(period_ms / 1000, third, now_s)
                return [Answer("ACK", "AUTOSEND")]
            case Call(name) if name in ORDERS:
                if name == "BYE":
                    self._auto.clear()
                status = self._ask(now_s, ORDERS[name]).status
                return [self._ended(name, status, "ACK")]
            case Call(name, arguments) if name in MOTIONS:
                return self._move(now_s, name, arguments)
            case Call(name) | Assignment(name):
                return self._answer(now_s, Unread(name.partition("[")[0]))
        return []

    def _query(self, now_s: float, name: str) -> list[Line]:
        if name in SELVES:
            return [Assignment(name, SELVES[name])]
        if name in KEPT:
            return [self._kept.get(name, Assignment(name, '""' if name == "TAG" else 0))]
        if name == "GRIPSTATS":
            counts = self._ask(now_s, STATISTICS).values
            return [Assignment(name, tuple(map(int, counts)))]
        if name.startswith("SYSFLAGS"):
            return [self._flags(name, self._ask(now_s, Request(Command.SYSTEM_STATE, (0, 0))))]
        if name in READINGS:
            return [self._reading(now_s, name)]
        if name == "FDATA[0]":
            told = self._ask(now_s, Request(Command.FORCE, (0, 0)))
            return [self._value(name, told, float)]
        return [self._ended(name.partition("[")[0], Status.CMD_UNKNOWN, "ACK")]

    def _flags(self, name: str, told: Reply) -> Line:
        """Return one flag by its number, or all of them as a list."""
        if not told.values or name not in {"SYSFLAGS", *(f"SYSFLAGS[{k}]" for k in range(FLAGS))}:
            return self._ended("SYSFLAGS", told.status or Status.CMD_FORMAT_ERROR, "ACK")
        word = int(told.values[0])
        if name == "SYSFLAGS":
            return Assignment(name, tuple(word >> bit & 1 for bit in range(FLAGS)))
        return Assignment(name, word >> int(name[9:-1]) & 1)

    def _reading(self, now_s: float, name: str) -> Line:
        command = READINGS[name]
        values = () if command is Command.TEMPERATURE else (0, 0)
        told = self._ask(now_s, Request(command, values))
        return self._value(name, told, int if name == "GRIPSTATE" else float)

    def _value(self, name: str, told: Reply, read: Callable[[Number], float]) -> Line:
        if not told.values:
            return self._ended(name.partition("[")[0], told.status, "ACK")
        return Assignment(name, read(told.values[0]))

    def _move(self, now_s: float, name: str, arguments: tuple[Scalar, ...]) -> list[Line]:
        numbers = [float(value) for value in arguments if not isinstance(value, str)]
        if len(numbers) != len(arguments) or (name == "MOVE" and not numbers):
            return [self._ended(name, Status.CMD_FORMAT_ERROR, "ACK")]
        request = self._request(now_s, name, numbers)
        self._called[request.command] = name
        # Before it is asked: the end of a motion may come with the answer.
        self._acknowledged_s = now_s
        status = self._ask(now_s, request).status
        if status == Status.CMD_PENDING:
            return [Answer("ACK", name)]
        return [self._ended(name, status, "ACK")]

    def _request(self, now_s: float, name: str, numbers: list[float]) -> Request:
        if name == "HOME":
            return protocol.home(int(numbers[0]) if numbers else 0)
        if name == "MOVE":
            return protocol.preposition(numbers[0], [*numbers, _SPEED_MM_S][1])
        if name == "GRIP":
            if numbers:
                self._ask(now_s, protocol.set_force_limit(numbers[0]))
            width_mm, speed_mm_s = [*numbers[1:], *(0.0, _SPEED_MM_S)[len(numbers[1:]) :]]
            return protocol.grasp(width_mm, speed_mm_s)
        distance_mm, speed_mm_s = [*numbers, *(_RELEASE_MM, _SPEED_MM_S)[len(numbers) :]]
        share = 1.0 if self._settings.gcl_release == "width" else 2.0
        return protocol.release(self.gripper.jaws.width_mm + share * distance_mm, speed_mm_s)

    def _ask(self, now_s: float, request: Request) -> Reply:
        """Return the gripper's own answer; ends of motions that come with it go out in time."""
        content = self.gripper.receive(now_s, protocol.encode_request(request))
        return self._hear(now_s, content, request.command) or Reply(request.command, 14)

    def _hear(self, now_s: float, content: bytes, command: int = -1) -> Reply | None:
        """Keep the ends of motions for later; return the newest reply to ``command``."""
        found: Reply | None = None
        for reply in self._replies.feed(content):
            if reply.command == command:
                found = reply
            elif name := self._called.get(reply.command):
                good = reply.status == Status.SUCCESS
                at_s = max(now_s, self._acknowledged_s + APART_S) if good else now_s
                self._waiting.append((at_s, self._ended(name, reply.status, "FIN")))
        return found

    def _ended(self, name: str, status: int, good: str) -> Line:
        if status == Status.SUCCESS:
            return Answer(good, name)
        text = Status(status).name.lower().replace("_", " ") if self._verbose else ""
        # A name as long as a line would leave no room for the rest of the answer.
        return Failure(name[:LONGEST_NAME], int(status), text)


def _read(content: bytes) -> Line | Unread:
    """Return a line; one that cannot be read still names what was wanted, or raises."""
    try:
        return protocol_gcl.decode(content)
    except WireError:
        if found := re.match(rb"[A-Z][A-Z0-9]*", content):
            return Unread(found[0].decode())
        raise
