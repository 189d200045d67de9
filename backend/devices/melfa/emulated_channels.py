"""Channels of an emulated MELFA controller: commands, real-time stream, monitor.

A command session is a function of time and bytes, for a TCP port or a serial line. The monitor's
data type numbers are placeholders: only the manual of the controller has them.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.devices.framing import LineStream, ProtocolError
from touchdown.backend.devices.melfa import emulated_controller, r3_protocol, realtime_protocol
from touchdown.backend.devices.melfa.kinematics import LIMITS_RAD, hand_of
from touchdown.backend.devices.melfa.r3_protocol import (
    LONGEST_REQUEST,
    AxisReading,
    ControllerState,
    R3Reply,
    R3Request,
)
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    MONITOR_KINDS,
    START,
    AxisValues,
    Block,
    BlockKind,
    DataTypes,
    MelfaPose,
    MonitorReply,
    MxtCommand,
    MxtReply,
    MxtRequest,
    decode_mxt_request,
    encode_mxt_reply,
    kind_of,
)
from touchdown.backend.emulation import SampleSchedule

TOLERANCE = 1.2  # tolerance of a commanded joint speed
PULSES_PER_RAD = 1e5
FLAGS = (7, 0)
_KINDS = {0: BlockKind.POSE, 1: BlockKind.JOINT, 2: BlockKind.PULSE}


class EmulatedStream:
    """Emulated stream; a fault sets ``jump_rad``, the error of the first replied position."""

    def __init__(self, controller: emulated_controller.EmulatedController) -> None:
        self._controller, self._settings = controller, controller.settings
        controller.on_cycle = self._cycle
        self.jump_rad: FloatArray = np.zeros(6)
        self.commands = 0  # number of executed motion commands
        # Largest commanded step of a joint relative to its top speed.
        self.largest_share = 0.0
        # Latest motion command after the end of all motion, s.
        self.late_command_s = 0.0
        self._begin()

    def _begin(self) -> None:
        self._running = False
        self._kind: BlockKind | None = None
        self._counter = self._timeouts = self._silent = 0

    def receive(self, now_s: float, data: bytes) -> bytes | None:
        """Process one datagram; return the reply or None."""
        controller = self._controller
        controller.advance(now_s)
        try:
            request = decode_mxt_request(data)
        except ProtocolError:
            return None
        if controller.program != emulated_controller.STREAM:
            if request.command is MxtCommand.MOVE and now_s > controller.stopped_s:
                late_s = now_s - controller.stopped_s
                self.late_command_s = max(self.late_command_s, late_s)
            return None
        if not self._running:
            self._begin()
            self._running = True
        self._silent = 0
        if request.command is MxtCommand.END:
            controller.finish_program()
            self._running = False
            return None
        if request.command is MxtCommand.MOVE and not self._follow(request):
            return None
        self._counter = (self._counter + 1) % (1 << 32)
        return self._reply(request)

    def _cycle(self) -> None:
        """Count a cycle without a packet; too many in a row are an error."""
        if self._controller.program != emulated_controller.STREAM:
            self._running = False
            return
        limit = self._settings.mxt.mxttout
        if not self._running or limit < 0:
            return
        self._silent += 1
        if self._silent > 1:
            self._timeouts = (self._timeouts + 1) % (1 << 16)
        if self._silent > limit:
            self._controller.raise_error(self._settings.mxt.error_timeout)

    def _follow(self, request: MxtRequest) -> bool:
        controller, mxt, kind = self._controller, self._settings.mxt, kind_of(request.target)
        # The program of another maker takes positions of the kind of its first one.
        own = controller.loaded == emulated_controller.PLAIN
        wanted = (self._kind or kind) if own else _KINDS[mxt.position_type]
        self._kind = kind
        if mxt.send_type_must_match and kind is not wanted:
            controller.raise_error(mxt.error_overspeed)
            return False
        target = self._joints(request.target)
        if target is None or (np.abs(target) > LIMITS_RAD).any():
            controller.raise_error(2602)
            return False
        if not controller.servo:
            controller.raise_error(2000)
            return False
        shares = np.abs(target - controller.joints.command_rad) / (
            emulated_controller.SPEEDS_RAD_S * CYCLE_S
        )
        share = float(shares.max())
        self.largest_share = max(self.largest_share, share)
        if share > TOLERANCE:
            controller.raise_error(mxt.error_overspeed)
            return False
        controller.joints.command_rad = target
        self.commands += 1
        return True

    def _joints(self, target: Block) -> FloatArray | None:
        near = self._controller.joints.command_rad
        if isinstance(target, AxisValues) and target.kind is BlockKind.JOINT:
            return np.array(target.axes[:6])
        if isinstance(target, AxisValues) and target.kind is BlockKind.PULSE:
            return np.array(target.axes[:6]) / PULSES_PER_RAD
        if isinstance(target, MelfaPose):
            frame = np.eye(4)
            a, b, c = target.axes[3:6]
            frame[:3, :3] = hand_of(a, b, c, self._settings.euler)
            frame[:3, 3] = target.axes[:3]
            return emulated_controller.solve(frame, near)
        return None

    def _reply(self, request: MxtRequest) -> bytes:
        blocks = tuple(map(self._block, request.monitors))
        timeouts = self._timeouts if self._settings.mxt.mxttout >= 0 else 0
        command, types = request.command, request.monitors
        reply = MxtReply(command, types[0], types, blocks, self._counter, timeouts=timeouts)
        self.jump_rad = np.zeros(6)
        return encode_mxt_reply(reply)

    def _block(self, monitor: int) -> Block:
        kind = MONITOR_KINDS[monitor]
        joints = self._controller.joints
        if kind is BlockKind.NONE:
            return None
        if kind is BlockKind.CURRENT:
            amount = joints.currents().round().astype(int).tolist()
            return AxisValues(kind, (*amount, 0, 0))
        command_rad = joints.command_rad + self.jump_rad
        sources = (command_rad, joints.filtered_rad, joints.feedback_rad)
        angles = sources[(monitor - 1) // 3]
        if kind is BlockKind.POSE:
            frame = emulated_controller.frame_of(angles)
            turned = emulated_controller.angles_of(frame[:3, :3], self._settings.euler)
            return MelfaPose((*frame[:3, 3].tolist(), *turned, 0.0, 0.0), *FLAGS)
        if kind is BlockKind.PULSE:
            pulses = (angles * PULSES_PER_RAD).round().astype(int).tolist()
            return AxisValues(kind, (*pulses, 0, 0))
        return AxisValues(kind, (*angles.tolist(), 0.0, 0.0))


# A request without an end is complete after this silence; the second segment of a split request
# waits up to 40 ms for the acknowledgement of the first.
GAP_S = 0.05
PACE_S = 0.1
TEXTS = {
    50: "External emergency stop",
    51: "Wiring of the external emergency stop",
    61: "Emergency stop of the operation panel",
    70: "Emergency stop of the teaching box",
    71: "Wiring of the teaching box",
    2000: "Servo is off",
    2601: "Start position over the limit",
    2602: "Destination position over the limit",
    2603: "Middle position over the limit",
    2802: "Illegal destination data",
    4140: "The program was not found",
    4340: "Undefined variable",
    4350: "Duplicate variable",
    5120: "The slot is not in the program selection state",
    5600: "Not possible during an error",
    5610: "Not possible during the stop signal",
    5640: "Not possible while running",
    6020: "The operation right was not acquired",
}
OPENED = (
    "3F;3F;7,0;3,5,A,1E,32,46,64;MB6;PRM;{robot};CR800-D;MELFA;20-11-19;Ver.C1;ENG;"
    "EMULATED BY TOUCHDOWN;1;1;8;"
)
# Ports of a controller with factory settings: the stream, then nine for commands.
NETPORTS = tuple(range(10000, 10010))
FORCE = "P_FsCurD"  # variable of the controller's own force sensor
_ENDS = {"none": b"", "cr": b"\r", "crlf": b"\r\n"}
_PLACE = r"\(([^()]*)\) ?(?:\([0-9]+,[0-9]+\))?"
_MOVE = re.compile(rf"(?i)(MOV|MVS) (?:{_PLACE}|([A-Z][A-Z0-9_]*))")
_SPEED = re.compile(r"(?i)(SPD|JOVRD|OVRD) ([0-9.]+|M_N\1)")
_FRAME = re.compile(rf"(?i)(BASE|TOOL) (?:{_PLACE}|P_N\1)")
_DEFINE = re.compile(r"(?i)DEF (?:POS|JNT) ([A-Z][A-Z0-9_]*)")
_ASSIGN = re.compile(rf"(?i)([A-Z][A-Z0-9_]*)={_PLACE}")
_TOOL_NUMBER = re.compile(r"(?i)M_TOOL=([0-9]+)")
NO_LIMIT = 10_000.0  # default of SPD: the joints alone limit the speed


class EmulatedCommands:
    """One client of the controller."""

    def __init__(self, controller: emulated_controller.EmulatedController) -> None:
        self._controller = controller
        self._lines: LineStream[R3Request | None] = LineStream(_request, LONGEST_REQUEST)
        self._end = b""
        self._byte_s = self._exchange_s = -math.inf
        self._speed_share, self._speed_mm_s = 0.1, NO_LIMIT
        self.too_fast = 0  # number of exchanges less than 100 ms apart during a program
        self.received: deque[R3Request] = deque(maxlen=1000)
        self.gone = False
        self._answers = self._table()

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process bytes; return the replies."""
        controller = self._controller
        controller.advance(now_s)
        self._byte_s = now_s
        if ends := re.search(rb"[\r\n]+", data):
            self._end = b"\r\n" if b"\r" in ends[0] and b"\n" in ends[0] else ends[0][:1]
        return self._reply_all(now_s, self._lines.feed(data))

    def due(self, now_s: float) -> bytes:
        """Return the reply to a request that has no end."""
        self._controller.advance(now_s)
        if self._lines.pending and now_s - self._byte_s >= GAP_S:
            self._end = b""
            return self._reply_all(now_s, self._lines.flush())
        return b""

    def closed(self, now_s: float) -> None:
        """Return the operation right."""
        self._controller.advance(now_s)
        self._lines.reset()
        if self._controller.right is self:
            self._controller.right = None

    def _reply_all(self, now_s: float, requests: list[R3Request | None]) -> bytes:
        if requests:
            if self._controller.program and now_s - self._exchange_s < PACE_S - 1e-3:
                self.too_fast += 1
            self._exchange_s = now_s
        setting = self._controller.settings.r3.reply_terminator
        end = self._end if setting == "same" else _ENDS[setting]
        return b"".join(r3_protocol.encode_reply(self._reply(r)) + end for r in requests)

    def _reply(self, request: R3Request | None) -> R3Reply:
        controller = self._controller
        if request is None:
            return R3Reply("QeR", str(controller.settings.r3.error_unknown))
        self.received.append(request)
        try:
            answer = self._answers[request.command](request)
        except emulated_controller.RefusedCommandError as refused:
            return R3Reply("Qer" if controller.error else "QeR", str(refused.number))
        except KeyError:
            return R3Reply("QeR", str(controller.settings.r3.error_unknown))
        return R3Reply("Qok" if controller.error else "QoK", answer or "")

    # -- answers ----------------------------------------------------------------------------------

    def _table(self) -> dict[str, Callable[[R3Request], str | None]]:
        """Return the action of each command: it returns the text of its answer, or nothing."""
        return {
            "OPEN=": lambda _: OPENED.format(robot=self._controller.settings.robot_type),
            "CLOSE": lambda _: None,
            "CNTL": self._right,
            "SRV": self._servo,
            "OVRD=": self._set_override,
            "OVRD": lambda _: str(self._controller.override),
            "PRGLOAD=": self._load,
            "RUN": self._run,
            "STOP": self._stop,
            "CSTOP": self._stop,
            "STOPON": partial(self._hold_stop, True),
            "STOPOFF": partial(self._hold_stop, False),
            "SLOTINIT": self._reset_slots,
            "RSTPRG": self._reset_slots,
            "RSTALRM": self._reset_error,
            "STATE": self._state,
            "DSTATE": self._progress,
            "ERROR": self._error,
            "ERRORMES": self._text,
            "PPOS": self._place,
            "JPOS": self._joints,
            "EXEC": self._execute,
            "EXEC2=": self._execute,
            "JOG": self._jog,
            "HNDSTS": lambda _: ";".join(["-1;-1;-1"] * 8),
            "STPSIG": lambda _: f"0;{int(self._controller.emergency)}",
            "ATENA": lambda _: "0",
            "CALIB": lambda _: "N3F3F",
            "TOOLRD": lambda _: str(self._controller.tool),
            "IN": lambda _: "0000",
            "PAR": self._parameter,
            "PNR": self._parameter,
            "HOT": self._write,
            "VAL": self._value,
        }

    def _right(self, request: R3Request) -> None:
        controller = self._controller
        if request.argument == "OFF":
            controller.right = None if controller.right is self else controller.right
        elif controller.right not in (None, self):
            raise emulated_controller.RefusedCommandError(6020)
        else:
            controller.right = self

    def _servo(self, request: R3Request) -> None:
        self._controller.require(self if request.argument == "ON" else None)
        self._controller.switch_servo(request.argument == "ON")

    def _set_override(self, request: R3Request) -> str:
        self._controller.require(self)
        self._controller.override = round(self._within(request.argument, 1.0, 100.0))
        return str(self._controller.override)

    def _within(self, text: str, least: float, most: float) -> float:
        """Return the number of ``text``; raises the refusal of another."""
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not least <= value <= most:
            raise emulated_controller.RefusedCommandError(
                self._controller.settings.r3.error_unknown
            )
        return value

    def _text(self, request: R3Request) -> str:
        mxt, r3 = self._controller.settings.mxt, self._controller.settings.r3
        own = {
            mxt.error_overspeed: "Joint speed over the limit during Mxt",
            mxt.error_timeout: "No packet within MXTTOUT during Mxt",
            r3.error_unknown: "Unknown command or argument",
        }
        return {**TEXTS, **own}.get(int(request.argument), "No text")

    def _load(self, request: R3Request) -> None:
        self._controller.require(self, still=True)
        if self._controller.held:
            raise emulated_controller.RefusedCommandError(5120)
        self._controller.loaded = self._controller.require_program(request.argument)

    def _run(self, request: R3Request) -> None:
        self._controller.require(self, still=True)
        self._controller.run_program(request.arguments[0])

    def _stop(self, request: R3Request) -> None:
        self._controller.halt()

    def _hold_stop(self, on: bool, request: R3Request) -> None:
        self._controller.stop_on = on
        if on:
            self._controller.halt()

    def _reset_slots(self, request: R3Request) -> None:
        self._controller.require(self, still=True)
        self._controller.held = False

    def _reset_error(self, request: R3Request) -> None:
        if self._controller.right is not self:
            raise emulated_controller.RefusedCommandError(6020)
        self._controller.reset_error()

    def _state(self, request: R3Request) -> str:
        controller = self._controller
        run, stop = controller.words()
        name = f"{controller.loaded}.MB6"
        state = ControllerState(
            name, 1, controller.override, 0, run, stop, controller.error, 1, 1, "", "REP",
            "START", 1, 1,
        )  # fmt: skip
        return state.answer()

    def _progress(self, request: R3Request) -> str:
        run, stop = self._controller.words()
        return f"{run:02X}{stop:02X}{self._controller.error};1;1"

    def _error(self, request: R3Request) -> str:
        error = self._controller.error
        return f"{error};{1 if error < 1000 else 2}" if error else ""

    def _parameter(self, request: R3Request) -> str:
        name, controller = request.argument, self._controller
        if name == "NETPORT":
            return f"NETPORT;{','.join(map(str, NETPORTS))};{len(NETPORTS)}"
        limits = np.degrees(LIMITS_RAD).round(2).tolist()
        values: dict[str, tuple[float, ...]] = {
            "MXTTOUT": (controller.settings.mxt.mxttout,),
            "MEJAR": (*(end for limit in limits for end in (-limit, limit)), 0.0, 0.0, 0.0, 0.0),
            "MEPAR": (-1e4, 1e4) * 3,
            "JSAFE": (*np.degrees(emulated_controller.READY_RAD).round(2).tolist(), 0.0, 0.0),
            "MEXTL": controller.frames["TOOL"],
            "MEXBS": controller.frames["BASE"],
        }
        if name not in values:
            raise emulated_controller.RefusedCommandError(controller.settings.r3.error_unknown)
        numbers = values[name]
        texts = (str(n) if isinstance(n, int) else f"{n:.2f}" for n in numbers)
        return f"{name};{', '.join(texts)};{len(numbers)}"

    def _write(self, request: R3Request) -> None:
        program, assignment = request.arguments
        name, value = assignment.split("=")
        self._controller.require_program(program)
        try:
            self._controller.variables[name] = float(value)
        except ValueError:
            raise emulated_controller.RefusedCommandError(4340) from None

    def _value(self, request: R3Request) -> str:
        name, controller = request.argument, self._controller
        if name == FORCE:
            return _position_text(name, controller.felt().tolist(), (0, 0))
        status = {
            "M_SVO": float(controller.servo),
            "M_RSPD": round(controller.speed_mm_s, 2),
            "M_JOVRD": 100.0 * self._speed_share,
            "M_TOOL": float(controller.tool),
        }
        x, y, z, *angles = self._shown_place()
        places = {
            **controller.positions,
            "P_FBC": (x, y, z, *map(math.degrees, angles)),
            "P_TOOL": controller.frames["TOOL"],
            "P_BASE": controller.frames["BASE"],
        }
        if name.upper() in places:
            return _position_text(name, places[name.upper()], FLAGS)
        if name.upper() in status:
            value = status[name.upper()]
            return f"{name}={value:+.{0 if value == int(value) else 6}f}"
        if name not in controller.variables:
            raise emulated_controller.RefusedCommandError(4340)
        return f"{name}={controller.variables[name]:+g}"

    # -- positions and moves ----------------------------------------------------------------------

    def _place(self, request: R3Request) -> str:
        values, controller = self._shown_place(), self._controller
        return AxisReading(tuple("XYZABC"), values, FLAGS, controller.override, 0.0).answer()

    def _shown_place(self) -> tuple[float, ...]:
        """Return position, mm, and angles, rad, of the tool in the coordinates that BASE sets."""
        base, tool = (self._frame(self._controller.frames[name]) for name in ("BASE", "TOOL"))
        frame = base @ emulated_controller.frame_of(self._controller.joints.feedback_rad) @ tool
        turned = emulated_controller.angles_of(frame[:3, :3], self._controller.settings.euler)
        return (*frame[:3, 3].tolist(), *turned)

    def _frame(self, numbers: Sequence[float]) -> FloatArray:
        """Return the (4, 4) frame of six numbers, mm and degrees."""
        frame = np.eye(4)
        a, b, c = map(math.radians, numbers[3:])
        frame[:3, :3] = hand_of(a, b, c, self._controller.settings.euler)
        frame[:3, 3] = numbers[:3]
        return frame

    def _joints(self, request: R3Request) -> str:
        names = tuple(f"J{k + 1}" for k in range(6))
        values = tuple(self._controller.joints.feedback_rad.tolist())
        return AxisReading(names, values, None, self._controller.override, 0.0).answer()

    def _jog(self, request: R3Request) -> None:
        self._controller.require(self, servo=True, still=True)
        mode, _, minus, plus, *_ = request.arguments
        self._controller.jog(int(mode), int(minus, 16), int(plus, 16))

    def _execute(self, request: R3Request) -> None:
        controller, text = self._controller, request.argument
        moves = text[:3].upper() in ("MOV", "MVS")
        controller.require(self, servo=moves, still=True)
        if found := _MOVE.fullmatch(text):
            numbers = self._numbers(found[2]) if found[3] is None else self._named(found[3])
            self._move(numbers, straight=found[1].upper() == "MVS")
        elif found := _SPEED.fullmatch(text):
            self._set_speed(found[1].upper(), found[2])
        elif found := _FRAME.fullmatch(text):
            numbers = self._numbers(found[2]) if found[2] is not None else (0.0,) * 6
            controller.frames[found[1].upper()] = numbers
        elif found := _TOOL_NUMBER.fullmatch(text):
            controller.tool = int(self._within(found[1], 1, 16))
        elif found := _DEFINE.fullmatch(text):
            if found[1].upper() in controller.positions:
                raise emulated_controller.RefusedCommandError(4350)
            controller.positions[found[1].upper()] = (0.0,) * 6
        elif found := _ASSIGN.fullmatch(text):
            self._named(found[1])
            controller.positions[found[1].upper()] = self._numbers(found[2])
        else:
            raise emulated_controller.RefusedCommandError(controller.settings.r3.error_unknown)

    def _set_speed(self, kind: str, text: str) -> None:
        if kind == "SPD":
            plain = text.upper() == "M_NSPD"
            self._speed_mm_s = NO_LIMIT if plain else self._within(text, 0.01, NO_LIMIT)
            return
        percent = 100.0 if text.upper().startswith("M_N") else self._within(text, 1.0, 100.0)
        if kind == "OVRD":
            self._controller.override = round(percent)
        else:
            self._speed_share = percent / 100.0

    def _named(self, name: str) -> tuple[float, ...]:
        numbers = self._controller.positions.get(name.upper())
        if numbers is None:
            raise emulated_controller.RefusedCommandError(4340)
        return numbers

    def _numbers(self, text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part or 0.0) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != 6 or not all(map(math.isfinite, numbers)):
            raise emulated_controller.RefusedCommandError(2802)
        return numbers

    def _move(self, numbers: tuple[float, ...], *, straight: bool) -> None:
        controller = self._controller
        frames = controller.frames
        base, tool = (np.linalg.inv(self._frame(frames[name])) for name in ("BASE", "TOOL"))
        frame = base @ self._frame(numbers) @ tool
        target = emulated_controller.solve(frame, controller.joints.command_rad)
        if target is None:
            raise emulated_controller.RefusedCommandError(2602)
        controller.move(target, self._speed_share, self._speed_mm_s if straight else None)


def _position_text(name: str, numbers: Sequence[float], flags: tuple[int, int]) -> str:
    inner = ",".join(f"{number:+.2f}" for number in numbers)
    return f"{name}=({inner})({flags[0]},{flags[1]})"


def _request(content: bytes) -> R3Request | None:
    """Return the request, None for an unknown one, which is answered with an error."""
    try:
        return r3_protocol.decode_request(content, foreign=True)
    except ProtocolError:
        return None


TYPE_FORCE = 901
COUNTER_TURN = 1 << 32


class EmulatedMonitor:
    """Emulated monitor; ``wrench(now_s)`` returns (6,) N and N·m. Unknown types are zero blocks."""

    def __init__(self, wrench: Callable[[float], Sequence[float]]) -> None:
        self._wrench = wrench
        self.pace = SampleSchedule()
        self._types: DataTypes = (0, 0, 0, 0)
        self._counter = 0

    def receive(self, now_s: float, data: bytes) -> list[bytes]:
        """Process one request."""
        try:
            request = realtime_protocol.decode_monitor_request(data)
        except ProtocolError:
            return []
        if request.command == START:
            self._types = request.types
            self.pace.begin(now_s, CYCLE_S)
        else:
            self.pace.end()
        return []

    def due(self, now_s: float) -> list[bytes]:
        """Return the packets up to now."""
        late, times = self.pace.due(now_s)
        self._counter = (self._counter + late) % COUNTER_TURN
        return [self._packet(t_s) for t_s in times]

    def _packet(self, now_s: float) -> bytes:
        self._counter = (self._counter + 1) % COUNTER_TURN
        blocks = tuple(self._block(now_s, number) for number in self._types)
        kinds = dict.fromkeys(self._types, BlockKind.NONE) | {TYPE_FORCE: BlockKind.FORCE}
        reply = MonitorReply(self._types, blocks, self._counter)
        return realtime_protocol.encode_monitor_reply(reply, kinds)

    def _block(self, now_s: float, number: int) -> Block:
        if number != TYPE_FORCE:
            return None
        return AxisValues(BlockKind.FORCE, tuple(self._wrench(now_s)))
