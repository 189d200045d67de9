"""Command channel of a MELFA controller: request queue, start-up sequence, state polling.

``R3Client`` is a state machine ``step(now, bytes) -> bytes`` with one request on the wire. A
request without a timely reply fails; its late reply is awaited and dropped, so that no reply is
matched to another request. Before a stream opens, the cycles of this computer are measured.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from touchdown.backend.config import MelfaSettings, is_loopback
from touchdown.backend.core import Fault, FaultError, FloatArray
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.melfa.faults import (
    UNLIMITED,
    controller_fault,
    link_fault,
    other_arm_fault,
    starved_fault,
)
from touchdown.backend.devices.melfa.kinematics import MelfaPlacement, hand_of
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.melfa.stream import FAULT_CYCLES, HOLD_CYCLES
from touchdown.backend.devices.protocols import STOPPED, ConnectionStep, Identity, arm_fault

log = logging.getLogger("touchdown.app.melfa")

FIRST_BYTES = 32  # logged of what is no reply
PACE_S = 0.1  # minimum time between two exchanges while a controller program runs
TIMEOUT_S, DOWN_S = 1.0, 3.0


class PendingRequest(Future[r3_protocol.R3Reply]):
    """A sent or queued request: wait for it, then read ``answer``."""

    def __init__(self, request: r3_protocol.R3Request, timeout_s: float) -> None:
        super().__init__()
        self.request, self.timeout_s = request, timeout_s
        self.until_s = math.inf

    def fail(self, fault: Fault) -> None:
        """End without a reply."""
        self.set_exception(FaultError(fault))

    @property
    def answer(self) -> str:
        """Text after QoK; raises ``FaultError`` if the request was refused or not answered."""
        if not self.done():
            raise FaultError(link_fault("The controller did not answer."))
        reply = self.result()
        if not reply.ok:
            raise FaultError(controller_fault(reply.error))
        return reply.answer


class R3Client:
    """Request queue; call ``ask`` from any thread, ``step`` from the owner of the wire."""

    def __init__(self, reply_gap_s: float, identify: Callable[[], str] = lambda: "") -> None:
        """``identify`` returns the description of another device on the wire, "" if unknown."""
        self._gap_s, self._identify = reply_gap_s, identify
        self._answered = False
        self._nonsense = False  # bytes since the last reply that are none
        self._unread = b""  # the first of them
        self._decoder = r3_protocol.replies()
        self._waiting: deque[PendingRequest] = deque()
        self._lock = threading.Lock()
        self._current: PendingRequest | None = None
        self._owed = 0
        self._over: Fault | None = None
        self._ready_s = -math.inf
        self._byte_s = -math.inf
        self._silent_since_s = math.inf
        self.paced = False  # True while a program runs: exchanges are spaced by ``PACE_S``

    @property
    def bad_replies(self) -> int:
        """Number of invalid replies."""
        return self._decoder.bad_frames

    def ask(self, request: r3_protocol.R3Request, timeout_s: float = TIMEOUT_S) -> PendingRequest:
        """Queue a request; STOP precedes all unsent requests."""
        ticket = PendingRequest(request, timeout_s)
        with self._lock:
            if self._over is not None:
                ticket.fail(self._over)
            elif request.command == "STOP":
                self._waiting.appendleft(ticket)
            else:
                self._waiting.append(ticket)
        return ticket

    def step(self, now_s: float, data: bytes) -> bytes:
        """Process received bytes; return the bytes to send. Raises ``FaultError`` if the link is
        down.
        """
        bad, self._unread = self._decoder.bad_frames, (self._unread + data)[:FIRST_BYTES]
        for reply in self._receive(now_s, data):
            self._take(now_s, reply)
            self._answered, self._nonsense = True, False
        self._nonsense |= self._decoder.bad_frames > bad
        if not (self._nonsense or self._decoder.pending):
            self._unread = b""
        current = self._current
        if current is not None and now_s >= current.until_s:
            self._current, self._owed = None, self._owed + 1
            name = current.request.command.rstrip("=")
            current.fail(self._missing(f"The controller did not answer to {name}."))
        if now_s - self._silent_since_s >= DOWN_S:
            fault = self._missing(f"The controller has been silent for {DOWN_S:.0f} s.")
            self.end(fault)
            raise FaultError(fault)
        return self._send(now_s)

    def end(self, fault: Fault) -> None:
        """Fail all requests, present and future: the wire is gone."""
        with self._lock:
            self._over = fault
            left = [self._current, *self._waiting]
            self._current = None
            self._waiting.clear()
        for ticket in left:
            if ticket is not None:
                ticket.fail(fault)

    def _missing(self, silent: str) -> Fault:
        """Return the fault of a missing reply: another device, unreadable, or ``silent``."""
        if not self._answered and (stranger := self._identify()):
            return link_fault(f"This is {stranger}, expected a MELFA controller.")
        if not self._nonsense:
            return link_fault(silent)
        log.info("not readable on the command channel: %s", self._unread.hex(" "))
        return link_fault("The data on the command channel are not an answer of a controller.")

    def _receive(self, now_s: float, data: bytes) -> list[r3_protocol.R3Reply]:
        if data:
            self._byte_s = now_s
            return self._decoder.feed(data)
        if self._decoder.pending and now_s - self._byte_s >= self._gap_s:
            return self._decoder.flush()
        return []

    def _take(self, now_s: float, reply: r3_protocol.R3Reply) -> None:
        self._silent_since_s = math.inf
        if self._owed:
            self._owed -= 1
        elif self._current is not None:
            ticket, self._current = self._current, None
            ticket.set_result(reply)
        self._ready_s = now_s + (PACE_S if self.paced else 0.0)

    def _send(self, now_s: float) -> bytes:
        with self._lock:
            if self._current is not None or self._owed or not self._waiting:
                return b""
            urgent = self._waiting[0].request.command == "STOP"
            if now_s < self._ready_s and not urgent:
                return b""
            ticket = self._waiting.popleft()
            self._current = ticket
        ticket.until_s = now_s + ticket.timeout_s
        self._silent_since_s = min(self._silent_since_s, now_s)
        return r3_protocol.encode_request(ticket.request) + b"\r"


# (now, received datagrams) -> packet of this cycle or None.
CycleFunction = Callable[[float, tuple[bytes, ...]], bytes | None]


@dataclass(frozen=True, slots=True)
class CycleTimes:
    """Of the wake-ups of the real-time wire: number, late by more than a cycle, latest (s).

    ``realtime``: whether its owner has real-time priority.
    """

    wakes: int = 0
    late: int = 0
    latest_s: float = 0.0
    realtime: bool = False

    def after(self, over_s: float) -> CycleTimes:
        """Return them after one more wake-up, so much after its deadline."""
        late = self.late + (over_s > CYCLE_S)
        return CycleTimes(self.wakes + 1, late, max(self.latest_s, over_s), self.realtime)


class ControllerLinks(Protocol):
    """One command channel, one STOP lane, one real-time wire.

    The owner of the real-time wire calls ``cycle`` once per control cycle; ``lost`` is called when
    the command channel is gone.
    """

    times: CycleTimes

    @property
    def bad_replies(self) -> int:
        """Number of invalid replies of the command channel."""

    def open(self, cycle: CycleFunction, lost: Callable[[Fault], None]) -> None:
        """Connect; raises ``FaultError``."""

    def ask(self, request: r3_protocol.R3Request, timeout_s: float) -> PendingRequest:
        """Queue a request."""

    def finish(self, ticket: PendingRequest) -> None:
        """Wait until the request is done."""

    def restart_timing(self) -> None:
        """Restart the count of ``times``."""

    def pause(self, seconds: float) -> None:
        """Sleep between two requests."""

    def pace(self, running: bool) -> None:
        """Set True while a controller program runs."""

    def stop_now(self, packet: bytes) -> None:
        """Send STOP on its own connection and ``packet`` on the real-time wire; does not wait."""

    def close(self) -> None:
        """Close all; may be called twice."""


@contextmanager
def _require_readable() -> Iterator[None]:
    """Raise ``FaultError`` for an answer of another form."""
    try:
        yield
    except ProtocolError as error:
        log.info("not readable in an answer: %s", error)
        fault = link_fault("An answer of the controller has an unexpected form.")
        raise FaultError(fault) from error


STATE_S = 0.1
PLACE_S = 0.04  # without a running program: otherwise 100 ms are required
PROBING_STATE_S = 0.35
STATE, PLACE = r3_protocol.R3Request("STATE"), r3_protocol.R3Request("PPOS", "F")

AskFunction = Callable[[r3_protocol.R3Request, float], PendingRequest]


class ControllerPoller:
    """Polls the controller; call ``step`` once per cycle, it never waits."""

    def __init__(self, ask: AskFunction, placing: MelfaPlacement, euler: str) -> None:
        self._ask, self._placing, self._euler = ask, placing, euler
        self._ticket: PendingRequest | None = None
        self._next_s = -math.inf
        self._state_s = -math.inf
        self.state: r3_protocol.ControllerState | None = None
        # Position of ``G`` of the last answer, (3,) mm; the reader resets it.
        self.place_mm: FloatArray | None = None
        # Fault of the controller, or of a program that ended by itself.
        self.fault: Fault | None = None

    @property
    def ended(self) -> bool:
        """True when the controller reports that no program runs."""
        return self.state is not None and r3_protocol.RunFlags.RUNNING not in self.state.run

    def step(self, now_s: float, *, streaming: bool, probing: bool = False) -> None:
        """Read the last answer and send the next request when it is due. ``probing``: the force
        program runs, requests are spaced, and most of them read the position.
        """
        if self._ticket is not None:
            if not self._ticket.done():
                return
            self._read(self._ticket, streaming=streaming)
            self._ticket = None
        if now_s < self._next_s:
            return
        due = streaming or now_s - self._state_s >= (PROBING_STATE_S if probing else STATE_S)
        if due:
            self._state_s = now_s
        self._next_s = now_s + (STATE_S if streaming else PLACE_S)
        self._ticket = self._ask(STATE if due else PLACE, TIMEOUT_S)

    def _read(self, ticket: PendingRequest, *, streaming: bool) -> None:
        try:
            with _require_readable():
                if ticket.request == PLACE:
                    self.place_mm = self._of_reading(r3_protocol.read_axes(ticket.answer))
                    return
                self.state = state = r3_protocol.read_state(ticket.answer)
        except FaultError as error:
            self.fault = error.fault
        else:
            if state.error:
                self.fault = controller_fault(state.error)
            elif streaming and r3_protocol.RunFlags.RUNNING not in state.run:
                self.fault = ENDED

    def _of_reading(self, reading: r3_protocol.AxisReading) -> FloatArray:
        axes = dict(zip(reading.names, reading.values, strict=True))
        x, y, z, a, b, c = (axes[name] for name in "XYZABC")
        return self._placing.from_flange(np.array([x, y, z]), hand_of(a, b, c, self._euler))


ENDED = arm_fault(
    "MXT-ENDED",
    "The controller's real-time program has ended by itself.",
    "Look at the controller, press Reset, then connect the arm again.",
)


# Gaps that would hold the arm, and that would end the stream.
WARN_S, REFUSE_S = HOLD_CYCLES * CYCLE_S, FAULT_CYCLES * CYCLE_S
LOOK_S = 0.1


def idle_check_notice(
    wires: ControllerLinks, settings: MelfaSettings, go_on: Callable[[], None]
) -> str:
    """Measure cycles for ``settings.idle_check_s``; return a notice for the operator, or "". Raises
    ``FaultError`` RIG-STARVED for a gap that would end the stream, unless the arm is emulated on
    this computer; ``go_on`` raises if connecting is cancelled meanwhile.
    """
    if not settings.idle_check_s:
        return ""
    wires.restart_timing()
    watched_s = 0.0
    while watched_s < settings.idle_check_s:
        go_on()
        wires.pause(LOOK_S)
        watched_s += LOOK_S
    times = wires.times
    gap_s = CYCLE_S + times.latest_s if times.wakes else watched_s
    if gap_s <= WARN_S:
        return ""
    if gap_s > REFUSE_S and not is_loopback(settings.host):
        raise FaultError(starved_fault(gap_s, settings.idle_check_s))
    return (
        f"This computer left the arm without a cycle for {1e3 * gap_s:.0f} ms while it stood: "
        "end what else keeps it busy, or allow real-time priority."
    )


POLL_S = 0.1
ANSWER_S = 1.0
RUN_S = 5.0
CLIENT = "TOUCHDOWN"  # name of this program for the controller
RESETS = (
    "Connecting once more in the same window resets this error; from elsewhere reset it at the "
    "controller."
)


class Console:
    """Command sequences of one controller; every refusal is a ``FaultError`` with its number. After
    ``stopped`` or a cancelled connection it switches on no motors and starts no program.
    """

    def __init__(
        self,
        wires: ControllerLinks,
        settings: MelfaSettings,
        stopped: threading.Event,
        cancel: threading.Event,
        alarm: int = 0,
    ) -> None:
        """``alarm`` is the error that refused the previous connection, 0 for none."""
        self._wires, self._settings = wires, settings
        # The controller's error that refuses this connection: the next connection resets it.
        self.alarm = alarm
        self._stopped, self._cancel = stopped, cancel
        # True if the controller never ends a silent stream, and the settings permit it.
        self.unlimited = False
        self.notice = ""  # notice for the operator

    def again(self, cancel: threading.Event) -> Console:
        """Return the console of the next connection, with the state of this one."""
        return Console(self._wires, self._settings, self._stopped, cancel, self.alarm)

    def ask(self, command: str, argument: str = "", timeout_s: float = ANSWER_S) -> str:
        """Send one request and return its answer."""
        ticket = self._wires.ask(r3_protocol.R3Request(command, argument), timeout_s)
        self._wires.finish(ticket)
        return ticket.answer

    def state(self) -> r3_protocol.ControllerState:
        """Return the state of the controller."""
        return r3_protocol.read_state(self.ask("STATE"))

    # -- start-up ---------------------------------------------------------------------------------

    def start_up(self, reached: Callable[[ConnectionStep], None]) -> Identity:
        """Start the real-time program on an open wire; raises ``FaultError``."""
        with _require_readable():
            identity = self._identify()
            reached("identify")
            self._reset_alarm()
            self._require_no_error()
            self._require_time_limit()
            self.notice = idle_check_notice(self._wires, self._settings, self._go_on)
            self._go_on()
            self.servo_on()
            self._go_on()
            self.run_stream()
            reached("configure")
            return identity

    def examine(self) -> Identity:
        """Return the identity of the controller; nothing is switched on."""
        with _require_readable():
            identity = self._identify()
            self._require_no_error()
            self._require_time_limit()
            self.ask("CLOSE")
            return identity

    def run_stream(self) -> None:
        """Start the controller program that opens the stream, and wait until it runs."""
        if r3_protocol.RunFlags.RUNNING in self.state().run:
            # A program of a broken connection is ended, never taken over.
            self.ask("STOP")
            self._wait_for_end()
        self._go_on()
        self.ask("SLOTINIT")
        self._run(self._settings.mxt.program, "The real-time program does not start.")

    def run_probe(self, values: Mapping[str, float]) -> None:
        """Write the variables of the force program, verify them, and run it."""
        program = self._settings.fsc.program
        if r3_protocol.RunFlags.RUNNING in self.state().run:
            self.ask("STOP")
        self._wait_for_end()
        self.ask("SLOTINIT")
        self.ask("PRGLOAD=", program)
        for name, value in values.items():
            self._go_on()
            self.ask("HOT", f"{program};{name}={value:g}")
            told = self.ask("VAL", name)
            if not re.fullmatch(rf"{name}=([-+0-9.Ee]+)", told):
                raise FaultError(link_fault(f"The controller answers '{told}' for {name}."))
            if not math.isclose(float(told.split("=")[1]), value, rel_tol=1e-3, abs_tol=1e-6):
                raise FaultError(link_fault(f"The controller did not take {name} = {value:g}."))
        self._run(program, "The force program does not start.")

    def _run(self, program: str, what: str) -> None:
        """Run a program, unless STOP came; a program that starts during STOP is stopped too."""
        self._go_on()
        self._wires.pace(running=True)
        self.ask("RUN", f"{program};1")
        try:
            self._poll(r3_protocol.RunFlags.RUNNING, RUN_S, what)
            self._go_on()
        except FaultError:
            self.ask("STOP")
            self._wires.pace(running=False)
            raise

    def _go_on(self) -> None:
        """Raise ``FaultError`` after STOP or cancellation."""
        if self._stopped.is_set():
            raise FaultError(STOPPED)
        if self._cancel.is_set():
            raise FaultError(link_fault("Connecting was cancelled."))

    def _identify(self) -> Identity:
        robot_type, version = r3_protocol.read_opened(self.ask("OPEN=", CLIENT))
        wanted = self._settings.robot_type
        if not robot_type.startswith(wanted):
            raise FaultError(other_arm_fault(robot_type, wanted))
        return Identity("Mitsubishi", robot_type, self._settings.host, version)

    def _reset_alarm(self) -> None:
        """Reset the error that refused the last connection, as announced then. The controller
        refuses while an emergency stop is pressed, and the error is reported again.
        """
        if self.alarm and r3_protocol.read_error(self.ask("ERROR"))[0] == self.alarm:
            self._go_on()
            self.ask("CNTL", "ON")
            with suppress(FaultError):
                self.ask("RSTALRM")

    def _require_no_error(self) -> None:
        found, _ = r3_protocol.read_error(self.ask("ERROR"))
        self.alarm = found
        if found:
            fault = controller_fault(found, self.ask("ERRORMES", str(found)))
            raise FaultError(replace(fault, next_step=f"{fault.next_step} {RESETS}"))

    def _require_time_limit(self) -> None:
        try:
            _, value, _ = r3_protocol.read_parameter(self.ask("PAR", "MXTTOUT"))
        except FaultError:
            value = "-1"
        self.unlimited = not value.isdecimal()
        if self.unlimited and not self._settings.mxt.allow_unlimited:
            raise FaultError(UNLIMITED)

    def servo_on(self) -> None:
        """Switch the servo motors on and wait for them; raises ``FaultError``."""
        self.ask("CNTL", "ON")
        self.ask("OVRD=", str(self._settings.override_start))
        self._go_on()
        self.ask("SRV", "ON")
        self._poll(
            r3_protocol.RunFlags.SERVO_ON,
            self._settings.servo_timeout_s,
            "The servo does not come on.",
        )

    def _poll(self, bit: r3_protocol.RunFlags, limit_s: float, what: str) -> None:
        waited_s = 0.0
        while bit not in self.state().run:
            self._go_on()
            if waited_s >= limit_s:
                raise FaultError(link_fault(what))
            self._wires.pause(POLL_S)
            waited_s += POLL_S

    # -- shutdown ---------------------------------------------------------------------------------

    def shut_down(self) -> None:
        """Switch off and return the operation right, after the end of the stream."""
        self.servo_off()
        self.ask("CNTL", "OFF")
        self.ask("CLOSE")

    def servo_off(self) -> None:
        """Stop, wait until nothing runs, switch the servo motors off, after the end of the
        stream.
        """
        self.ask("STOP")
        self._wait_for_end()
        self.ask("SRV", "OFF")

    def _wait_for_end(self) -> None:
        waited_s = 0.0
        while r3_protocol.RunFlags.RUNNING in self.state().run and waited_s < RUN_S:
            self._wires.pause(POLL_S)
            waited_s += POLL_S
        self._wires.pace(running=False)
