"""The emulated command channel: one session per client, all of one controller.

A session is a function of time and bytes, so it serves a TCP port and a serial line alike.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np

from backend.core.flow import FloatArray
from backend.emulators.melfa_arm import angles_of, frame_of, hand_of, solve
from backend.emulators.melfa_controller import EmulatedController, RefusedCommandError
from backend.emulators.melfa_stream import FLAGS
from backend.wire import melfa_r3
from backend.wire.framing import WireError
from backend.wire.lines import LineStream
from backend.wire.melfa_r3 import LONGEST_REQUEST, Reply, Request
from backend.wire.melfa_r3_answers import Progress, State
from backend.wire.melfa_r3_positions import Reading

GAP_S = 0.05
"""A request without an end is taken as whole after this silence; the second segment of one that
was sent in two waits up to 40 ms for the first to be acknowledged."""
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
NETPORTS = tuple(range(10000, 10010))
"""Ports of a controller as it is delivered: the stream, then nine for commands."""
FORCE = "P_FsCurD"
"""What the controller's own force sensor measures."""
_ENDS = {"none": b"", "cr": b"\r", "crlf": b"\r\n"}
_PLACE = re.compile(r"(?i)(MOV|MVS) \(([^()]*)\)\([0-9]+,[0-9]+\)")
_SPEED = re.compile(r"(?i)(SPD|JOVRD|OVRD) ([0-9.]+)")


class EmulatedCommands:
    """One client of the controller."""

    def __init__(self, controller: EmulatedController) -> None:
        self._controller = controller
        self._lines: LineStream[Request | None] = LineStream(_request, LONGEST_REQUEST)
        self._end = b""
        self._byte_s = self._exchange_s = -math.inf
        self._speed_share = 0.1
        self.too_fast = 0
        """Exchanges less than 100 ms apart while a program ran."""
        self.received: deque[Request] = deque(maxlen=1000)
        self.gone = False
        self._answers = self._table()

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Take bytes; return the replies."""
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
        """Give the right back."""
        self._controller.advance(now_s)
        self._lines.reset()
        if self._controller.right is self:
            self._controller.right = None

    def _reply_all(self, now_s: float, requests: list[Request | None]) -> bytes:
        if requests:
            if self._controller.program and now_s - self._exchange_s < PACE_S - 1e-3:
                self.too_fast += 1
            self._exchange_s = now_s
        setting = self._controller.settings.r3.reply_terminator
        end = self._end if setting == "same" else _ENDS[setting]
        return b"".join(melfa_r3.encode_reply(self._reply(r)) + end for r in requests)

    def _reply(self, request: Request | None) -> Reply:
        controller = self._controller
        if request is None:
            return Reply("QeR", str(controller.settings.r3.error_unknown))
        self.received.append(request)
        try:
            answer = self._answers[request.command](request)
        except RefusedCommandError as refused:
            return Reply("Qer" if controller.error else "QeR", str(refused.number))
        except KeyError:
            return Reply("QeR", str(controller.settings.r3.error_unknown))
        return Reply("Qok" if controller.error else "QoK", answer)

    # -- answers ----------------------------------------------------------------------------------

    def _table(self) -> dict[str, Callable[[Request], str]]:
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

    def _right(self, request: Request) -> str:
        controller = self._controller
        if request.argument == "OFF":
            controller.right = None if controller.right is self else controller.right
        elif controller.right not in (None, self):
            raise RefusedCommandError(6020)
        else:
            controller.right = self
        return ""

    def _servo(self, request: Request) -> str:
        self._controller.require(self if request.argument == "ON" else None)
        self._controller.switch_servo(request.argument == "ON")
        return ""

    def _set_override(self, request: Request) -> str:
        self._controller.require(self)
        self._controller.override = int(request.argument)
        return request.argument

    def _load(self, request: Request) -> str:
        self._controller.require(self, still=True)
        if self._controller.held:
            raise RefusedCommandError(5120)
        self._controller.require_program(request.argument)
        self._controller.loaded = request.argument
        return ""

    def _run(self, request: Request) -> str:
        self._controller.require(self, still=True)
        self._controller.run_program(request.arguments[0])
        return ""

    def _stop(self, request: Request) -> str:
        self._controller.halt()
        return ""

    def _hold_stop(self, on: bool, request: Request) -> str:
        self._controller.stop_on = on
        if on:
            self._controller.halt()
        return ""

    def _reset_slots(self, request: Request) -> str:
        self._controller.require(self, still=True)
        self._controller.held = False
        return ""

    def _reset_error(self, request: Request) -> str:
        if self._controller.right is not self:
            raise RefusedCommandError(6020)
        self._controller.reset_error()
        return ""

    def _state(self, request: Request) -> str:
        controller = self._controller
        run, stop = controller.words()
        name = f"{controller.loaded}.MB6"
        state = State(
            name, 1, controller.override, 0, run, stop, controller.error, 1, 1, "", "REP",
            "START", 1, 1,
        )  # fmt: skip
        return state.answer()

    def _progress(self, request: Request) -> str:
        run, stop = self._controller.words()
        return Progress(run, stop, self._controller.error, 1, 1).answer()

    def _error(self, request: Request) -> str:
        error = self._controller.error
        return f"{error};{1 if error < 1000 else 2}" if error else ""

    def _parameter(self, request: Request) -> str:
        if request.argument == "NETPORT":
            return f"NETPORT;{','.join(map(str, NETPORTS))};{len(NETPORTS)}"
        if request.argument != "MXTTOUT":
            raise RefusedCommandError(self._controller.settings.r3.error_unknown)
        return f"MXTTOUT;{self._controller.settings.mxt.mxttout};1"

    def _write(self, request: Request) -> str:
        program, assignment = request.arguments
        name, value = assignment.split("=")
        self._controller.require_program(program)
        try:
            self._controller.variables[name] = float(value)
        except ValueError:
            raise RefusedCommandError(4340) from None
        return ""

    def _value(self, request: Request) -> str:
        if request.argument == FORCE:
            numbers = ",".join(f"{number:+.2f}" for number in self._controller.felt())
            return f"{FORCE}=({numbers})(0,0)"
        value = self._controller.variables.get(request.argument)
        if value is None:
            raise RefusedCommandError(4340)
        return f"{request.argument}={value:+g}"

    # -- places and moves -------------------------------------------------------------------------

    def _place(self, request: Request) -> str:
        frame = frame_of(self._controller.joints.feedback_rad)
        turned = angles_of(frame[:3, :3], self._controller.settings.euler)
        values = (*frame[:3, 3].tolist(), *turned)
        return Reading(tuple("XYZABC"), values, FLAGS, self._controller.override, 0.0).answer()

    def _joints(self, request: Request) -> str:
        names = tuple(f"J{k + 1}" for k in range(6))
        values = tuple(self._controller.joints.feedback_rad.tolist())
        return Reading(names, values, None, self._controller.override, 0.0).answer()

    def _jog(self, request: Request) -> str:
        self._controller.require(self, servo=True, still=True)
        mode, _, minus, plus, *_ = request.arguments
        self._controller.jog(int(mode), int(minus, 16), int(plus, 16))
        return ""

    def _execute(self, request: Request) -> str:
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


def _request(content: bytes) -> Request | None:
    """Return the request, None for what no controller knows: it is answered with an error."""
    try:
        return melfa_r3.decode_request(content)
    except WireError:
        return None
