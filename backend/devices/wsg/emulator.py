"""Emulated Weiss WSG gripper with binary or text protocol.

A function of time and bytes. A connection that ends without an announced disconnect latches the
fast stop, as the real gripper does. The text interface serves the same gripper behind lines of GCL;
``ACK`` and ``FIN`` go out at least 100 ms apart: some clients compare a whole receive with one.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from touchdown.backend.config import WsgSettings
from touchdown.backend.devices.framing import LineStream, ProtocolError
from touchdown.backend.devices.wsg import gcl, protocol
from touchdown.backend.devices.wsg.protocol import (
    ACKNOWLEDGE_KEY,
    GraspState,
    Number,
    SystemFlag,
    WsgCommand,
    WsgRefusal,
    WsgReply,
    WsgRequest,
    WsgStatus,
)
from touchdown.backend.emulation import (
    EmulatedDevice,
    Emulation,
    EmulationChoice,
    Faults,
    TcpServer,
)

CLAMPING_TRAVEL_MM = 3.0  # travel of a grasp beyond the nominal width before it fails
# Limits; forces are the sum over both fingers.
STROKE_MM, SPEED_MM_S, ACCELERATION_MM_S2 = 66.0, (5.0, 400.0), (100.0, 5000.0)
FORCE_SUM_N = 5.0, 50.0


@dataclass(frozen=True, slots=True)
class JawMotion:
    """An active motion from ``start_mm`` at ``begun_s``; negative speed closes."""

    command: WsgCommand
    start_mm: float
    target_mm: float
    begun_s: float
    velocity_mm_s: float

    def width_mm(self, now_s: float) -> float:
        """Width at a time; the target once it is reached."""
        width = self.start_mm + self.velocity_mm_s * (now_s - self.begun_s)
        return max(width, self.target_mm) if self.velocity_mm_s < 0 else min(width, self.target_mm)


class EmulatedJaws:
    """Emulated jaws; ``part_mm`` is the width of a part between the fingers, or None."""

    def __init__(self, part_mm: float | None = None) -> None:
        self.part_mm = part_mm
        self.width_mm = STROKE_MM
        self.force_limit_n = FORCE_SUM_N[0]
        self.state = GraspState.IDLE
        self.flags = SystemFlag(0)
        self.motion: JawMotion | None = None
        self.soft_limits_mm: tuple[float, float] | None = None
        self.statistics = (0, 0, 0)  # number of grasps, of grasps without a part, of lost parts

    def count(self, *, missed: int = 0, lost: int = 0) -> None:
        """Count a completed grasp (``missed``: without a part), or a ``lost`` part."""
        total, no_part, lost_parts = self.statistics
        self.statistics = (total + 1 - lost, no_part + missed, lost_parts + lost)

    @property
    def force_n(self) -> float:
        """Sum over both fingers."""
        return self.force_limit_n if self.state is GraspState.HOLDING else 0.0

    def accepts(self, width_mm: float) -> bool:
        """Return True for a width within the stroke and the soft limits."""
        low, high = self.soft_limits_mm or (0.0, STROKE_MM)
        return max(low, 0.0) <= width_mm <= min(high, STROKE_MM)

    def begin(self, now_s: float, command: WsgCommand, target_mm: float, speed_mm_s: float) -> None:
        """Start a motion; the speed is clamped to what the gripper can do."""
        slowest, fastest = SPEED_MM_S
        speed = min(max(speed_mm_s, slowest), fastest)
        target = min(max(target_mm, 0.0), STROKE_MM)
        velocity = speed if target >= self.width_mm else -speed
        self.motion = JawMotion(command, self.width_mm, target, now_s, velocity)
        self.flags &= ~(
            SystemFlag.BLOCKED_MINUS | SystemFlag.AXIS_STOPPED | SystemFlag.TARGET_POS_REACHED
        )
        self.flags |= SystemFlag.MOVING
        self.state = {
            WsgCommand.GRASP: GraspState.GRASPING,
            WsgCommand.RELEASE: GraspState.RELEASING,
        }.get(command, GraspState.POSITIONING)

    def halt(self) -> JawMotion | None:
        """Stop; return the ended motion."""
        motion, self.motion = self.motion, None
        self.flags = (self.flags & ~SystemFlag.MOVING) | SystemFlag.AXIS_STOPPED
        self.state = GraspState.IDLE
        return motion

    def advance(self, now_s: float) -> tuple[WsgCommand, WsgStatus] | None:
        """Advance to ``now_s``; return command and result of a motion that ended."""
        if self.state is GraspState.HOLDING and self.part_mm is None:
            self.state = GraspState.PART_LOST
            self.count(lost=1)
        motion = self.motion
        if motion is None:
            return None
        width, part = motion.width_mm(now_s), self.part_mm
        if part is not None and motion.velocity_mm_s < 0 and width <= part <= motion.start_mm:
            self.width_mm = part
            return self._end(motion, blocked=True)
        self.width_mm = width
        return self._end(motion, blocked=False) if width == motion.target_mm else None

    def _end(self, motion: JawMotion, *, blocked: bool) -> tuple[WsgCommand, WsgStatus]:
        self.motion = None
        self.flags &= ~SystemFlag.MOVING
        if motion.command is WsgCommand.GRASP:
            self.state = GraspState.HOLDING if blocked else GraspState.NO_PART_FOUND
            self.count(missed=not blocked)
            return motion.command, WsgStatus.SUCCESS if blocked else WsgStatus.CMD_FAILED
        self.state = GraspState.IDLE
        if blocked:
            self.flags |= SystemFlag.BLOCKED_MINUS
            return motion.command, WsgStatus.AXIS_BLOCKED
        self.flags |= SystemFlag.TARGET_POS_REACHED
        if motion.command is WsgCommand.HOME:
            self.flags |= SystemFlag.REFERENCED
        return motion.command, WsgStatus.SUCCESS


SERIAL = 12345
TEMPERATURE_C = 31.2
_HOME_SPEED_MM_S = 50.0
_BARRED = SystemFlag.FAST_STOP | SystemFlag.POWER_FAULT
_MOTIONS = (WsgCommand.HOME, WsgCommand.PREPOSITION, WsgCommand.GRASP, WsgCommand.RELEASE)


@dataclass(slots=True)
class PeriodicUpdate:
    """A periodically sent reading; ``on_change`` only when it differs from the ``last`` one."""

    period_s: float
    on_change: bool
    next_s: float
    last: object = None

    def takes(self, now_s: float, reading: object) -> bool:
        """Return True if ``reading`` is sent now; call it when the update is due."""
        if self.on_change and reading == self.last:
            return False
        self.next_s += (math.floor((now_s - self.next_s) / self.period_s) + 1) * self.period_s
        self.last = reading
        return True


# Returns the values of a successful answer, or the status of another one.
WsgAction = Callable[[WsgRequest], tuple[Number, ...] | WsgStatus | None]


class EmulatedWsg:
    """Emulated gripper; set ``jaws.part_mm`` at any time to add or remove a part. ``faults``:
    faults of the gripper itself. ``keeps_grip``: True if a piece stays held after an announced
    disconnect.
    """

    def __init__(
        self, part_mm: float | None = None, faults: Faults | None = None, *, keeps_grip: bool = True
    ) -> None:
        self._keeps_grip = keeps_grip
        self._faults = faults or Faults("gripper")
        self.jaws = EmulatedJaws(part_mm)
        self._requests = protocol.requests()
        self._updates: dict[WsgCommand, PeriodicUpdate] = {}
        self._acceleration_mm_s2 = ACCELERATION_MM_S2[0]
        self._tag = b""
        self._leaving = False
        self._lost_mm: float | None = None
        self.barred = 0  # motion commands before a fault was acknowledged
        # This gripper has neither scripts nor fingers with sensors.
        missing = (*protocol.SCRIPTS, *protocol.FINGERS, WsgCommand.TARE)
        self._actions: dict[int, WsgAction] = {
            **dict.fromkeys(missing, lambda _: WsgStatus.NOT_AVAILABLE),
            WsgCommand.LOOP: lambda request: request.values,
            WsgCommand.SET_TAG: self._set_tag,
            WsgCommand.GET_TAG: lambda _: (self._tag,) if self._tag else (),
            WsgCommand.SET_SOFT_LIMITS: self._set_soft_limits,
            WsgCommand.GET_SOFT_LIMITS: lambda _: (
                self.jaws.soft_limits_mm or WsgStatus.NOT_AVAILABLE
            ),
            WsgCommand.CLEAR_SOFT_LIMITS: self._clear_soft_limits,
            WsgCommand.OVERDRIVE: self._overdrive,
            WsgCommand.ACKNOWLEDGE: self._acknowledge,
            WsgCommand.SET_ACCELERATION: self._set_acceleration,
            WsgCommand.SET_FORCE_LIMIT: self._set_force_limit,
            WsgCommand.STATISTICS: self._statistics,
        }

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process commands; return the immediate answers."""
        out = self.due(now_s)
        for request in self._requests.feed(data):
            replies = self._answer(now_s, request)
            out += b"".join(map(protocol.encode_reply, replies))
        return out

    def due(self, now_s: float) -> bytes:
        """Return the result of a motion that ended, and the updates that are due."""
        ended = self.jaws.advance(now_s)
        replies = [WsgReply(*ended)] if ended else []
        replies += self._apply_faults(now_s)
        for command, update in self._updates.items():
            reading = self._reading(command) if now_s >= update.next_s else None
            if reading is not None and update.takes(now_s, reading):
                replies.append(WsgReply(command, WsgStatus.SUCCESS, reading))
        return b"".join(map(protocol.encode_reply, replies))

    def closed(self, now_s: float) -> None:
        """Latch the fast stop unless the disconnect was announced."""
        self._updates.clear()
        self._requests.reset()
        if not self._leaving:
            self._fast_stop()
        elif not self._keeps_grip:
            self.jaws.state = GraspState.IDLE  # the fingers have no force
        self._leaving = False

    def _apply_faults(self, now_s: float) -> list[WsgReply]:
        """Apply active faults; return the end of an interrupted motion."""
        if self._faults.active("part_lost", now_s):
            self._lost_mm = self.jaws.part_mm or self._lost_mm
            self.jaws.part_mm = None
        elif self._lost_mm is not None and self.jaws.width_mm >= self._lost_mm:
            # End of the fault: the piece is between the open jaws again.
            self.jaws.part_mm, self._lost_mm = self._lost_mm, None
        broken: JawMotion | None = None
        if self._faults.active("power", now_s) and SystemFlag.POWER_FAULT not in self.jaws.flags:
            broken = self.jaws.halt()
            self.jaws.flags |= SystemFlag.POWER_FAULT
        if self._faults.active("fast_stop", now_s) and SystemFlag.FAST_STOP not in self.jaws.flags:
            broken = self._fast_stop() or broken
        return [WsgReply(broken.command, WsgStatus.CMD_ABORTED)] if broken else []

    def _answer(self, now_s: float, request: WsgRequest | WsgRefusal) -> list[WsgReply]:
        if isinstance(request, WsgRefusal):
            return [WsgReply(request.command, request.status)]
        if self._leaving:
            return [WsgReply(request.command, WsgStatus.ACCESS_DENIED)]
        if request.command in _MOTIONS:
            return [self._move(now_s, WsgCommand(request.command), request.values)]
        if request.command in (WsgCommand.STOP, WsgCommand.FAST_STOP, WsgCommand.DISCONNECT):
            return self._halt(request.command)
        reading = self._reading(request.command)
        if reading is not None:
            self._subscribe(now_s, request)
            return [WsgReply(request.command, WsgStatus.SUCCESS, reading)]
        action = self._actions.get(request.command)
        if action is None:
            return [WsgReply(request.command, WsgStatus.CMD_UNKNOWN)]
        told = action(request)
        if isinstance(told, WsgStatus):
            return [WsgReply(request.command, told)]
        return [WsgReply(request.command, WsgStatus.SUCCESS, told or ())]

    def _move(self, now_s: float, command: WsgCommand, values: tuple[Number, ...]) -> WsgReply:
        jaws, refusal = self.jaws, WsgStatus.CMD_PENDING
        if jaws.flags & _BARRED:
            refusal = WsgStatus.ACCESS_DENIED
            self.barred += 1
        elif jaws.motion is not None:
            refusal = WsgStatus.ALREADY_RUNNING
        elif command is not WsgCommand.HOME and SystemFlag.REFERENCED not in jaws.flags:
            refusal = WsgStatus.NOT_INITIALIZED
        if refusal is not WsgStatus.CMD_PENDING:
            return WsgReply(command, refusal)
        if command is WsgCommand.HOME:
            if values[0] not in (0, 1, 2):
                return WsgReply(command, WsgStatus.INVALID_PARAMETER)
            target_mm = 0.0 if values[0] == 2 else STROKE_MM
            jaws.begin(now_s, command, target_mm, _HOME_SPEED_MM_S)
            return WsgReply(command, refusal)
        *flags, width_mm, speed_mm_s = (float(value) for value in values)
        if flags and int(flags[0]) & 1:
            width_mm += jaws.width_mm
        if not jaws.accepts(width_mm):
            return WsgReply(command, WsgStatus.RANGE_ERROR)
        travel_mm = CLAMPING_TRAVEL_MM if command is WsgCommand.GRASP else 0.0
        jaws.begin(now_s, command, width_mm - travel_mm, speed_mm_s)
        return WsgReply(command, refusal)

    def _halt(self, command: int) -> list[WsgReply]:
        self._leaving = command == WsgCommand.DISCONNECT
        if self._leaving and self.jaws.motion is None:
            return [WsgReply(command, WsgStatus.SUCCESS)]
        ended = self._fast_stop() if command == WsgCommand.FAST_STOP else self.jaws.halt()
        aborted = [WsgReply(ended.command, WsgStatus.CMD_ABORTED)] if ended else []
        return [*aborted, WsgReply(command, WsgStatus.SUCCESS)]

    def _fast_stop(self) -> JawMotion | None:
        ended = self.jaws.halt()
        self.jaws.flags |= SystemFlag.FAST_STOP
        return ended

    def _acknowledge(self, request: WsgRequest) -> WsgStatus:
        if request.values != (ACKNOWLEDGE_KEY,):
            return WsgStatus.CMD_FORMAT_ERROR
        self.jaws.flags &= ~_BARRED
        return WsgStatus.SUCCESS

    def _set_acceleration(self, request: WsgRequest) -> None:
        low, high = ACCELERATION_MM_S2
        self._acceleration_mm_s2 = min(max(float(request.values[0]), low), high)

    def _set_force_limit(self, request: WsgRequest) -> WsgStatus:
        low, high = FORCE_SUM_N
        force_sum_n = float(request.values[0])
        if not low <= force_sum_n <= high:
            return WsgStatus.RANGE_ERROR
        self.jaws.force_limit_n = force_sum_n
        return WsgStatus.SUCCESS

    def _set_tag(self, request: WsgRequest) -> None:
        self._tag = b"".join(value for value in request.values if isinstance(value, bytes))

    def _set_soft_limits(self, request: WsgRequest) -> WsgStatus:
        low, high = (float(value) for value in request.values)
        if not 0.0 <= low < high <= STROKE_MM:
            return WsgStatus.RANGE_ERROR
        self.jaws.soft_limits_mm = low, high
        return WsgStatus.SUCCESS

    def _clear_soft_limits(self, request: WsgRequest) -> None:
        self.jaws.soft_limits_mm = None

    def _overdrive(self, request: WsgRequest) -> None:
        # The overdrive limit of this gripper is the nominal force: only the flag changes.
        on = int(request.values[0]) & 1
        self.jaws.flags &= ~SystemFlag.OVERDRIVE_MODE
        self.jaws.flags |= SystemFlag.OVERDRIVE_MODE if on else SystemFlag(0)

    def _statistics(self, request: WsgRequest) -> tuple[Number, ...]:
        told = self.jaws.statistics
        if int(request.values[0]) & 1:
            self.jaws.statistics = (0, 0, 0)
        return told

    def _subscribe(self, now_s: float, request: WsgRequest) -> None:
        if len(request.values) != 2:
            return
        flags, period_ms = (int(value) for value in request.values)
        command = WsgCommand(request.command)
        if flags & 1 and period_ms:
            period_s, reading = period_ms / 1000, self._reading(command)
            first_s = now_s + period_s
            self._updates[command] = PeriodicUpdate(period_s, bool(flags & 2), first_s, reading)
        else:
            self._updates.pop(command, None)

    def _reading(self, command: int) -> tuple[Number, ...] | None:
        """Return the answer to a reading command; None for other commands."""
        jaws, motion = self.jaws, self.jaws.motion
        readings: dict[int, tuple[Number, ...]] = {
            WsgCommand.SYSTEM_STATE: (int(jaws.flags),),
            WsgCommand.GRASP_STATE: (int(jaws.state),),
            WsgCommand.WIDTH: (jaws.width_mm,),
            WsgCommand.SPEED: (motion.velocity_mm_s if motion else 0.0,),
            WsgCommand.FORCE: (jaws.force_n,),
            WsgCommand.TEMPERATURE: (TEMPERATURE_C,),
            WsgCommand.GET_ACCELERATION: (self._acceleration_mm_s2,),
            WsgCommand.GET_FORCE_LIMIT: (jaws.force_limit_n,),
            WsgCommand.SYSTEM_INFO: (0, 2, 0x2200, SERIAL),
            WsgCommand.SYSTEM_LIMITS: (
                STROKE_MM,
                *SPEED_MM_S,
                *ACCELERATION_MM_S2,
                *FORCE_SUM_N,
                FORCE_SUM_N[1],
            ),
        }
        return readings.get(command)


APART_S = 0.1
READINGS = {
    "POS": WsgCommand.WIDTH,
    "SPEED": WsgCommand.SPEED,
    "FORCE": WsgCommand.FORCE,
    "TEMP": WsgCommand.TEMPERATURE,
    "GRIPSTATE": WsgCommand.GRASP_STATE,
}
SELVES: dict[str, gcl.Scalar] = {"DEVTYPE": '"WSG 32-068"', "VERSION": "4.0.1", "SN": SERIAL}
KEPT = ("VERBOSE", "PWT", "CLT", "TAG")  # variables that can be set; the value is echoed
ORDERS = {
    "STOP": WsgRequest(WsgCommand.STOP),
    "FASTSTOP": WsgRequest(WsgCommand.FAST_STOP),
    "FSACK": protocol.acknowledge(),
    "BYE": WsgRequest(WsgCommand.DISCONNECT),
}
# Motions with the least and the largest number of their arguments.
MOTIONS = {"HOME": (0, 1), "MOVE": (1, 2), "GRIP": (0, 3), "RELEASE": (0, 2)}
OTHERS = ("AUTOSEND", "SYSFLAGS", "GRIPSTATS", "FDATA")
COMMANDS = frozenset({*READINGS, *SELVES, *KEPT, *ORDERS, *MOTIONS, *OTHERS})
FLAGS, LONGEST_NAME = 32, 32
STATISTICS = WsgRequest(WsgCommand.STATISTICS, (0,))
_SPEED_MM_S = 50.0
_RELEASE_MM = 10.0


@dataclass(frozen=True, slots=True)
class UnknownLine:
    """A line that starts with ``name`` and has an unknown form."""

    name: str


class EmulatedGcl:
    """Text interface of the emulated ``gripper``."""

    def __init__(self, gripper: EmulatedWsg, settings: WsgSettings | None = None) -> None:
        self.gripper, self._settings = gripper, settings or WsgSettings()
        self._lines = LineStream[gcl.GclLine | UnknownLine](_read, gcl.LONGEST)
        self._replies = protocol.replies()
        self._called: dict[int, str] = {}
        self._acknowledged_s = -APART_S
        self._waiting: list[tuple[float, gcl.GclLine]] = []
        self._auto: dict[str, PeriodicUpdate] = {}
        self._verbose, self._kept = False, dict[str, gcl.GclLine]()

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process lines; return the immediate answers."""
        out: list[gcl.GclLine] = []
        for asked in self._lines.feed(data):
            answer = self._answer(now_s, asked)
            out += [*self._ends(now_s), *answer]
        return b"".join(map(gcl.encode, out))

    def due(self, now_s: float) -> bytes:
        """Return the ends of motions and the periodic readings."""
        self._hear(now_s, self.gripper.due(now_s))
        out = self._ends(now_s)
        for name, update in self._auto.items():
            if now_s >= update.next_s:
                line = self._reading(now_s, name)
                out += [line] if update.takes(now_s, line) else []
        return b"".join(map(gcl.encode, out))

    def closed(self, now_s: float) -> None:
        """Handle the end of a connection; without ``BYE`` the fast stop is latched."""
        self._lines.reset()
        self._auto.clear()
        self._waiting.clear()
        self.gripper.closed(now_s)

    def _ends(self, now_s: float) -> list[gcl.GclLine]:
        out = [line for at_s, line in self._waiting if at_s <= now_s]
        self._waiting = [item for item in self._waiting if item[0] > now_s]
        return out

    def _answer(self, now_s: float, asked: gcl.GclLine | UnknownLine) -> list[gcl.GclLine]:
        match asked:
            case UnknownLine(name):
                known = name in COMMANDS
                wrong = WsgStatus.CMD_FORMAT_ERROR if known else WsgStatus.CMD_UNKNOWN
                return [self._ended(name, wrong, "ACK")]
            case gcl.GclQuery(name):
                return self._query(now_s, name)
            case gcl.GclAssignment(name, value) if name in KEPT:
                self._verbose = bool(value) if name == "VERBOSE" else self._verbose
                self._kept[name] = asked
                return [asked]
            case gcl.GclCall("AUTOSEND", (str(name), int(period_ms), bool(third))) if (
                name in READINGS and period_ms > 0
            ):
                self._auto[name] = PeriodicUpdate(period_ms / 1000, third, now_s)
                return [gcl.GclAnswer("ACK", "AUTOSEND")]
            case gcl.GclCall(name) if name in ORDERS:
                if name == "BYE":
                    self._auto.clear()
                status = self._ask(now_s, ORDERS[name]).status
                return [self._ended(name, status, "ACK")]
            case gcl.GclCall(name, arguments) if name in MOTIONS:
                return self._move(now_s, name, arguments)
            case gcl.GclCall(name) | gcl.GclAssignment(name):
                return self._answer(now_s, UnknownLine(name.partition("[")[0]))
        return []

    def _query(self, now_s: float, name: str) -> list[gcl.GclLine]:
        if name in SELVES:
            return [gcl.GclAssignment(name, SELVES[name])]
        if name in KEPT:
            return [self._kept.get(name, gcl.GclAssignment(name, '""' if name == "TAG" else 0))]
        if name == "GRIPSTATS":
            counts = self._ask(now_s, STATISTICS).values
            return [gcl.GclAssignment(name, tuple(map(int, counts)))]
        if name.startswith("SYSFLAGS"):
            told = self._ask(now_s, WsgRequest(WsgCommand.SYSTEM_STATE, (0, 0)))
            return [self._flags(name, told)]
        if name in READINGS:
            return [self._reading(now_s, name)]
        if name == "FDATA[0]":
            told = self._ask(now_s, WsgRequest(WsgCommand.FORCE, (0, 0)))
            return [self._value(name, told, float)]
        return [self._ended(name.partition("[")[0], WsgStatus.CMD_UNKNOWN, "ACK")]

    def _flags(self, name: str, told: WsgReply) -> gcl.GclLine:
        if not told.values or name not in {"SYSFLAGS", *(f"SYSFLAGS[{k}]" for k in range(FLAGS))}:
            return self._ended("SYSFLAGS", told.status or WsgStatus.CMD_FORMAT_ERROR, "ACK")
        word = int(told.values[0])
        if name == "SYSFLAGS":
            return gcl.GclAssignment(name, tuple(word >> bit & 1 for bit in range(FLAGS)))
        return gcl.GclAssignment(name, word >> int(name[9:-1]) & 1)

    def _reading(self, now_s: float, name: str) -> gcl.GclLine:
        command = READINGS[name]
        values = () if command is WsgCommand.TEMPERATURE else (0, 0)
        told = self._ask(now_s, WsgRequest(command, values))
        return self._value(name, told, int if name == "GRIPSTATE" else float)

    def _value(self, name: str, told: WsgReply, read: Callable[[Number], float]) -> gcl.GclLine:
        if not told.values:
            return self._ended(name.partition("[")[0], told.status, "ACK")
        return gcl.GclAssignment(name, read(told.values[0]))

    def _move(
        self, now_s: float, name: str, arguments: tuple[gcl.Scalar, ...]
    ) -> list[gcl.GclLine]:
        numbers = [float(value) for value in arguments if not isinstance(value, str)]
        least, most = MOTIONS[name]
        if len(numbers) != len(arguments) or not least <= len(numbers) <= most:
            return [self._ended(name, WsgStatus.CMD_FORMAT_ERROR, "ACK")]
        widths_mm = {"GRIP": numbers[1:2], "RELEASE": numbers[:1]}.get(name, [])
        if not all(map(self.gripper.jaws.accepts, widths_mm)):
            return [self._ended(name, WsgStatus.RANGE_ERROR, "ACK")]
        if name == "GRIP" and numbers:
            told = self._ask(now_s, protocol.set_force_limit(numbers[0]))
            if told.status != WsgStatus.SUCCESS:
                return [self._ended(name, told.status, "ACK")]
        request = self._request(name, numbers)
        self._called[request.command] = name
        # Before the request: the end of a motion may come with the answer.
        self._acknowledged_s = now_s
        status = self._ask(now_s, request).status
        if status == WsgStatus.CMD_PENDING:
            return [gcl.GclAnswer("ACK", name)]
        return [self._ended(name, status, "ACK")]

    def _request(self, name: str, numbers: list[float]) -> WsgRequest:
        if name == "HOME":
            direction = numbers[0] if numbers else 0
            return protocol.home(int(direction) if direction in (0, 1, 2) else 255)
        if name == "MOVE":
            return protocol.preposition(numbers[0], [*numbers, _SPEED_MM_S][1])
        if name == "GRIP":
            width_mm, speed_mm_s = [*numbers[1:], *(0.0, _SPEED_MM_S)[len(numbers[1:]) :]]
            return protocol.grasp(width_mm, speed_mm_s)
        distance_mm, speed_mm_s = [*numbers, *(_RELEASE_MM, _SPEED_MM_S)[len(numbers) :]]
        share = 1.0 if self._settings.gcl_release == "width" else 2.0
        jaws = self.gripper.jaws
        width_mm = min(jaws.width_mm + share * distance_mm, STROKE_MM)
        return protocol.release(width_mm, speed_mm_s)

    def _ask(self, now_s: float, request: WsgRequest) -> WsgReply:
        """Return the gripper's answer; ends of motions in it are sent when due."""
        content = self.gripper.receive(now_s, protocol.encode_request(request))
        return self._hear(now_s, content, request.command) or WsgReply(request.command, 14)

    def _hear(self, now_s: float, content: bytes, command: int = -1) -> WsgReply | None:
        """Queue the ends of motions; return the newest reply to ``command``."""
        found: WsgReply | None = None
        for reply in self._replies.feed(content):
            if reply.command == command:
                found = reply
            elif name := self._called.get(reply.command):
                # A stop ends a motion at once, unless it came together with the motion.
                stopped = reply.status == WsgStatus.CMD_ABORTED and now_s > self._acknowledged_s
                at_s = now_s if stopped else max(now_s, self._acknowledged_s + APART_S)
                self._waiting.append((at_s, self._ended(name, reply.status, "FIN")))
        return found

    def _ended(self, name: str, status: int, good: str) -> gcl.GclLine:
        if status == WsgStatus.SUCCESS:
            return gcl.GclAnswer(good, name)
        text = WsgStatus(status).name.lower().replace("_", " ") if self._verbose else ""
        # A name as long as a line leaves no space for the rest of the answer.
        return gcl.GclError(name[:LONGEST_NAME], int(status), text)


def _read(content: bytes) -> gcl.GclLine | UnknownLine:
    """Return a line; an invalid one with its name if possible, else raise."""
    try:
        return gcl.decode(content)
    except ProtocolError:
        if found := re.match(rb"[A-Z][A-Z0-9]*", content):
            return UnknownLine(found[0].decode())
        raise


def emulate_wsg(choice: EmulationChoice, faults: Faults) -> Emulation:
    """Serve the gripper on a TCP port, with the binary or the text protocol."""
    gripper = EmulatedWsg(part_mm=choice.part_mm, faults=faults)
    device: EmulatedDevice = EmulatedGcl(gripper) if choice.text else gripper
    front = TcpServer(device, choice.host, choice.network_port(), faults=faults)
    table: dict[str, object] = {"host": choice.host, "port": front.address[1]}
    return Emulation((front,), {"wsg": table | ({"protocol": "gcl"} if choice.text else {})})
