"""Emulated MELFA controller: servers and commands."""

from __future__ import annotations

import contextlib
import math
import re
import selectors
import socket
from collections import deque
from collections.abc import Callable
from functools import partial

import numpy as np

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import Clock, FloatArray
from touchdown.backend.devices.framing import LineStream, WireError
from touchdown.backend.devices.melfa import protocol_r3
from touchdown.backend.devices.melfa.emulator_arm import angles_of, frame_of, hand_of, solve
from touchdown.backend.devices.melfa.emulator_controller import (
    EmulatedController,
    RefusedCommandError,
)
from touchdown.backend.devices.melfa.emulator_stream import FLAGS, EmulatedStream
from touchdown.backend.devices.melfa.protocol_r3 import (
    LONGEST_REQUEST,
    Progress,
    Reading,
    Reply,
    Request,
    State,
)
from touchdown.backend.emulation import CHUNK, UNPLUGGED_S, Faults, Front

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
        return b"".join(protocol_r3.encode_reply(self._reply(r)) + end for r in requests)

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
        return protocol_r3.decode_request(content)
    except WireError:
        return None


TICK_S = 0.004
"""Longest sleep between two looks; while cycles are counted, until the next one."""
ALARM = 2601
"""Error of the fault ``alarm``: a position over its limit."""
ESTOP = 50
TIMEOUT_CYCLES = 57
"""MXTTOUT of a rehearsal: a silent stream ends after 0.2 s, as it should on a real controller."""


class EmulatedMelfa:
    """One controller with its stream; ``session`` gives a command channel for each client."""

    def __init__(
        self,
        settings: MelfaSettings,
        *,
        start_rad: FloatArray | None = None,
        streaming: bool = False,
    ) -> None:
        """``streaming``: servo on and the program running from the start, for a client without R3.

        ``start_rad``: (6,) joints to begin with; else the hand points down somewhere in reach.
        """
        self.controller = EmulatedController(settings, start_rad=start_rad, streaming=streaming)
        self.stream = EmulatedStream(self.controller)

    def session(self) -> EmulatedCommands:
        """Return the channel of a new client."""
        return EmulatedCommands(self.controller)


class MelfaFront(Front):
    """Serves ``device`` on ``host``; ports 0 take free ones. ``settings`` has them afterwards."""

    def __init__(
        self,
        device: EmulatedMelfa,
        host: str = "127.0.0.1",
        ports: tuple[int, int, int] = (0, 0, 0),
        clock: Clock | None = None,
        faults: Faults | None = None,
    ) -> None:
        """``ports``: commands, STOP, stream."""
        super().__init__(clock, faults or Faults("arm"))
        self._device = device
        self._sources: list[socket.socket] = []
        self._host, self._ports = host, ports
        self._listen()
        self.stops: list[float] = []
        """When STOP came, on the clock of the front."""
        self._on: set[str] = set()
        controller = device.controller
        self._begins: dict[str, Callable[[], None]] = {
            "alarm": partial(controller.raise_error, ALARM),
            "estop": partial(controller.press_emergency_stop, ESTOP),
            "servo_off": partial(controller.switch_servo, False),
        }

    @property
    def url(self) -> str:
        """Address of the command channel."""
        return f"tcp://{self._host}:{self._ports[0]}"

    @property
    def settings(self) -> MelfaSettings:
        """Settings with which a driver reaches it."""
        commands, stop, stream = self._ports
        given = self._device.controller.settings
        r3 = given.r3.model_copy(update={"port": commands, "stop_port": stop})
        mxt = given.mxt.model_copy(update={"port": stream})
        return given.model_copy(update={"host": self._host, "r3": r3, "mxt": mxt})

    def close(self) -> None:
        """Stop serving and free the ports."""
        super().close()
        self._leave()

    def _listen(self) -> None:
        stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sources = [stream]
        try:
            stream.bind((self._host, self._ports[2]))
            for port in self._ports[:2]:
                self._sources.append(socket.create_server((self._host, port), backlog=4))
        except OSError:
            self._leave()
            raise
        for source in self._sources:
            source.setblocking(False)
        stream, *doors = self._sources
        first, second = (door.getsockname()[1] for door in doors)
        self._ports = (first, second, stream.getsockname()[1])

    def _leave(self) -> None:
        for source in self._sources:
            source.close()
        self._sources = []

    def _run(self) -> None:
        while not self._stop.is_set():
            if not self._sources:
                self._listen()
            self._serve_all()
            if self._is_unplugged():
                self._leave()
            while self._is_unplugged() and not self._stop.wait(UNPLUGGED_S):
                pass

    def _serve_all(self) -> None:
        stream, *doors = self._sources
        sessions: dict[socket.socket, EmulatedCommands] = {}
        caller: tuple[str, int] | None = None
        with selectors.DefaultSelector() as selector:
            for source in self._sources:
                selector.register(source, selectors.EVENT_READ)
            while not self._stop.is_set() and not self._is_unplugged():
                answers: list[bytes] = []
                for key, _ in selector.select(self._until_due_s()):
                    ready = key.fileobj
                    assert isinstance(ready, socket.socket)
                    if ready is stream:
                        caller = self._take(stream, answers) or caller
                    elif ready in doors:
                        self._admit(ready, selector, sessions)
                    else:
                        self._answer(ready, sessions[ready])
                now_s = self._clock.now_s()
                self._trouble(now_s)
                for out in self.faults.outgoing(now_s, answers):
                    self._send(stream, out, caller)
                self._tend(now_s, selector, sessions)
        for client, session in sessions.items():
            session.closed(self._clock.now_s())
            client.close()

    def _until_due_s(self) -> float:
        left_s = self._device.controller.next_cycle_s - self._clock.now_s()
        return min(max(left_s, 0.0), TICK_S)

    # -- stream -----------------------------------------------------------------------------------

    def _take(self, stream: socket.socket, answers: list[bytes]) -> tuple[str, int] | None:
        try:
            data, caller = stream.recvfrom(CHUNK)
        except (BlockingIOError, ConnectionError):
            return None
        answer = self._device.stream.receive(self._took(data), data)
        if answer is not None:
            answers.append(answer)
        return caller[0], caller[1]

    def _send(self, stream: socket.socket, out: bytes, caller: tuple[str, int] | None) -> None:
        out = self.damage(out)
        if caller is None or not out:
            return
        with contextlib.suppress(ConnectionError, BlockingIOError):
            stream.sendto(out, caller)
            self._gave(out)

    # -- commands ---------------------------------------------------------------------------------

    def _admit(
        self,
        door: socket.socket,
        selector: selectors.BaseSelector,
        sessions: dict[socket.socket, EmulatedCommands],
    ) -> None:
        try:
            client, _ = door.accept()
        except BlockingIOError:
            return
        client.settimeout(1.0)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        selector.register(client, selectors.EVENT_READ)
        sessions[client] = self._device.session()
        self.clients += 1

    def _answer(self, client: socket.socket, session: EmulatedCommands) -> None:
        try:
            data = client.recv(CHUNK)
        except (ConnectionError, TimeoutError):
            data = b""
        if not data:
            session.gone = True
            return
        now_s = self._took(data)
        if b";STOP\r" in data:
            self.stops.append(now_s)
        self._reply(client, session, session.receive(now_s, data))

    def _tend(
        self,
        now_s: float,
        selector: selectors.BaseSelector,
        sessions: dict[socket.socket, EmulatedCommands],
    ) -> None:
        """Send what is due without a question; forget who has gone."""
        self._device.controller.advance(now_s)
        for client, session in list(sessions.items()):
            self._reply(client, session, session.due(now_s))
            if session.gone:
                session.closed(now_s)
                selector.unregister(client)
                client.close()
                del sessions[client]

    def _reply(self, client: socket.socket, session: EmulatedCommands, out: bytes) -> None:
        if not out or self.faults.active("silent", self._clock.now_s()):
            return
        try:
            client.sendall(out)
        except (ConnectionError, TimeoutError):
            session.gone = True
        else:
            self._gave(out)

    # -- trouble ----------------------------------------------------------------------------------

    def _trouble(self, now_s: float) -> None:
        """Let the faults of the controller itself begin and end."""
        controller = self._device.controller
        for kind, begin in self._begins.items():
            active = self.faults.active(kind, now_s)
            if active and kind not in self._on:
                self._on.add(kind)
                begin()
            elif not active and kind in self._on:
                self._on.remove(kind)
                if kind == "estop":
                    controller.release_emergency_stop()
