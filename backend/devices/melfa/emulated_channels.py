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
from touchdown.backend.devices.melfa import r3_protocol, realtime_protocol
from touchdown.backend.devices.melfa.emulated_controller import (
    SPEEDS_RAD_S,
    STREAM,
    EmulatedController,
    RefusedCommandError,
    angles_of,
    frame_of,
    solve,
)
from touchdown.backend.devices.melfa.kinematics import LIMITS_RAD, hand_of
from touchdown.backend.devices.melfa.r3_protocol import (
    LONGEST_REQUEST,
    AxisReading,
    ControllerState,
    ProgramProgress,
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

    def __init__(self, controller: EmulatedController) -> None:
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
        self._counter = self._timeouts = self._silent = 0

    def receive(self, now_s: float, data: bytes) -> bytes | None:
        """Process one datagram; return the reply or None."""
        controller = self._controller
        controller.advance(now_s)
        try:
            request = decode_mxt_request(data)
        except ProtocolError:
            return None
        if controller.program != STREAM:
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
        if self._controller.program != STREAM:
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
        controller, mxt = self._controller, self._settings.mxt
        if mxt.send_type_must_match and kind_of(request.target) is not _KINDS[mxt.position_type]:
            controller.raise_error(mxt.error_overspeed)
            return False
        target = self._joints(request.target)
        if target is None or (np.abs(target) > LIMITS_RAD).any():
            controller.raise_error(2602)
            return False
        if not controller.servo:
            controller.raise_error(2000)
            return False
        shares = np.abs(target - controller.joints.command_rad) / (SPEEDS_RAD_S * CYCLE_S)
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
            return solve(frame, near)
        return None

    def _reply(self, request: MxtRequest) -> bytes:
        first, second, third, fourth = map(self._block, request.monitors)
        blocks = (first, second, third, fourth)
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
            frame = frame_of(angles)
            turned = angles_of(frame[:3, :3], self._settings.euler)
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
    61: "Emergency stop of the operation panel",
    70: "Emergency stop of the teaching box",
    2000: "Servo is off",
    2602: "Destination position over the limit",
    4140: "The program was not found",
}
OPENED = (
    "3F;3F;7,0;3,5,A,1E,32,46,64;MB6;PRM;{robot};CR800-D;MELFA;20-11-19;Ver.C1;ENG;"
    "EMULATED BY TOUCHDOWN;1;1;8;"
)
# Ports of a controller with factory settings: the stream, then nine for commands.
NETPORTS = tuple(range(10000, 10010))
FORCE = "P_FsCurD"  # variable of the controller's own force sensor
_ENDS = {"none": b"", "cr": b"\r", "crlf": b"\r\n"}
_PLACE = re.compile(r"(?i)(MOV|MVS) \(([^()]*)\)\([0-9]+,[0-9]+\)")
_SPEED = re.compile(r"(?i)(SPD|JOVRD|OVRD) ([0-9.]+)")


class EmulatedCommands:
    """One client of the controller."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._lines: LineStream[R3Request | None] = LineStream(_request, LONGEST_REQUEST)
        self._end = b""
        self._byte_s = self._exchange_s = -math.inf
        self._speed_share = 0.1
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
        except RefusedCommandError as refused:
            return R3Reply("Qer" if controller.error else "QeR", str(refused.number))
        except KeyError:
            return R3Reply("QeR", str(controller.settings.r3.error_unknown))
        return R3Reply("Qok" if controller.error else "QoK", answer)

    # -- answers ----------------------------------------------------------------------------------

    def _table(self) -> dict[str, Callable[[R3Request], str]]:
        return {
            "OPEN=": lambda _: OPENED.format(robot=self._controller.settings.robot_type),
            "CLOSE": lambda _: "",
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
            "ERRORMES": lambda request: TEXTS.get(int(request.argument), "No text"),
            "PPOS": self._place,
            "JPOS": self._joints,
            "EXEC": self._execute,
            "EXEC2=": self._execute,
            "JOG": self._jog,
            "HNDSTS": lambda _: ";".join(["-1;-1;-1"] * 8),
            "STPSIG": lambda _: f"0;{int(self._controller.emergency)}",
            "ATENA": lambda _: "0",
            "CALIB": lambda _: "N3F3F",
            "TOOLRD": lambda _: "0",
            "PAR": self._parameter,
            "HOT": self._write,
            "VAL": self._value,
        }

    def _right(self, request: R3Request) -> str:
        controller = self._controller
        if request.argument == "OFF":
            controller.right = None if controller.right is self else controller.right
        elif controller.right not in (None, self):
            raise RefusedCommandError(6020)
        else:
            controller.right = self
        return ""

    def _servo(self, request: R3Request) -> str:
        self._controller.require(self if request.argument == "ON" else None)
        self._controller.switch_servo(request.argument == "ON")
        return ""

    def _set_override(self, request: R3Request) -> str:
        self._controller.require(self)
        self._controller.override = int(request.argument)
        return request.argument

    def _load(self, request: R3Request) -> str:
        self._controller.require(self, still=True)
        if self._controller.held:
            raise RefusedCommandError(5120)
        self._controller.require_program(request.argument)
        self._controller.loaded = request.argument
        return ""

    def _run(self, request: R3Request) -> str:
        self._controller.require(self, still=True)
        self._controller.run_program(request.arguments[0])
        return ""

    def _stop(self, request: R3Request) -> str:
        self._controller.halt()
        return ""

    def _hold_stop(self, on: bool, request: R3Request) -> str:
        self._controller.stop_on = on
        if on:
            self._controller.halt()
        return ""

    def _reset_slots(self, request: R3Request) -> str:
        self._controller.require(self, still=True)
        self._controller.held = False
        return ""

    def _reset_error(self, request: R3Request) -> str:
        if self._controller.right is not self:
            raise RefusedCommandError(6020)
        self._controller.reset_error()
        return ""

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
        return ProgramProgress(run, stop, self._controller.error, 1, 1).answer()

    def _error(self, request: R3Request) -> str:
        error = self._controller.error
        return f"{error};{1 if error < 1000 else 2}" if error else ""

    def _parameter(self, request: R3Request) -> str:
        if request.argument == "NETPORT":
            return f"NETPORT;{','.join(map(str, NETPORTS))};{len(NETPORTS)}"
        if request.argument != "MXTTOUT":
            raise RefusedCommandError(self._controller.settings.r3.error_unknown)
        return f"MXTTOUT;{self._controller.settings.mxt.mxttout};1"

    def _write(self, request: R3Request) -> str:
        program, assignment = request.arguments
        name, value = assignment.split("=")
        self._controller.require_program(program)
        try:
            self._controller.variables[name] = float(value)
        except ValueError:
            raise RefusedCommandError(4340) from None
        return ""

    def _value(self, request: R3Request) -> str:
        if request.argument == FORCE:
            numbers = ",".join(f"{number:+.2f}" for number in self._controller.felt())
            return f"{FORCE}=({numbers})(0,0)"
        value = self._controller.variables.get(request.argument)
        if value is None:
            raise RefusedCommandError(4340)
        return f"{request.argument}={value:+g}"

    # -- positions and moves ----------------------------------------------------------------------

    def _place(self, request: R3Request) -> str:
        frame = frame_of(self._controller.joints.feedback_rad)
        turned = angles_of(frame[:3, :3], self._controller.settings.euler)
        values = (*frame[:3, 3].tolist(), *turned)
        return AxisReading(tuple("XYZABC"), values, FLAGS, self._controller.override, 0.0).answer()

    def _joints(self, request: R3Request) -> str:
        names = tuple(f"J{k + 1}" for k in range(6))
        values = tuple(self._controller.joints.feedback_rad.tolist())
        return AxisReading(names, values, None, self._controller.override, 0.0).answer()

    def _jog(self, request: R3Request) -> str:
        self._controller.require(self, servo=True, still=True)
        mode, _, minus, plus, *_ = request.arguments
        self._controller.jog(int(mode), int(minus, 16), int(plus, 16))
        return ""

    def _execute(self, request: R3Request) -> str:
        controller = self._controller
        controller.require(self, servo=True, still=True)
        if found := _SPEED.fullmatch(request.argument):
            self._speed_share = min(max(float(found[2]) / 100.0, 0.01), 1.0)
            return ""
        place = _PLACE.fullmatch(request.argument)
        if place is None:
            raise RefusedCommandError(4340)
        target = self._solved([float(text) for text in place[2].split(",")])
        straight = place[1].upper() == "MVS"
        controller.move(target, straight=straight, speed_share=self._speed_share)
        return ""

    def _solved(self, numbers: list[float]) -> FloatArray:
        if len(numbers) != 6:
            raise RefusedCommandError(2802)
        controller = self._controller
        frame = np.eye(4)
        a, b, c = map(math.radians, numbers[3:])
        frame[:3, :3] = hand_of(a, b, c, controller.settings.euler)
        frame[:3, 3] = numbers[:3]
        target = solve(frame, controller.joints.command_rad)
        if target is None:
            raise RefusedCommandError(2602)
        return target


def _request(content: bytes) -> R3Request | None:
    """Return the request, None for an unknown one, which is answered with an error."""
    try:
        return r3_protocol.decode_request(content)
    except ProtocolError:
        return None


TYPE_FORCE = 901
COUNTER_TURN = 1 << 32


class EmulatedMonitor:
    """Emulated monitor; ``wrench(now_s)`` returns (6,) N and N·m. Unknown types are zero blocks."""

    def __init__(
        self, wrench: Callable[[float], Sequence[float]], *, type_force: int = TYPE_FORCE
    ) -> None:
        self._wrench, self._force = wrench, type_force
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
        first, second, third, fourth = (self._block(now_s, number) for number in self._types)
        kinds = {
            number: BlockKind.FORCE if number == self._force else BlockKind.NONE
            for number in self._types
        }
        reply = MonitorReply(self._types, (first, second, third, fourth), self._counter)
        return realtime_protocol.encode_monitor_reply(reply, kinds)

    def _block(self, now_s: float, number: int) -> Block:
        if number != self._force:
            return None
        return AxisValues(BlockKind.FORCE, tuple(self._wrench(now_s)))
