"""Driver of a Weiss WSG gripper over TCP.

``WsgCore`` is a state machine from replies to requests, without wire, clock or thread.
``WsgGripper`` runs it: one thread listens, commands bypass every queue.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

from touchdown.backend.config import HardwareSettings, WsgSettings
from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices import protocols
from touchdown.backend.devices.identification import identify_device
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.gcl import GclProtocol
from touchdown.backend.devices.wsg.protocol import (
    BinaryProtocol,
    GraspState,
    SystemFlag,
    WsgCommand,
    WsgReply,
    WsgRequest,
    WsgStatus,
)

NAME = "gripper"
DEVICE_FAULTS = {
    SystemFlag.TEMP_FAULT: "it is too hot",
    SystemFlag.POWER_FAULT: "its supply voltage is out of range",
    SystemFlag.CURR_FAULT: "its motor takes too much current",
    SystemFlag.FINGER_FAULT: "a finger reports a failure",
}
_STANDS = "The gripper stands still; it was not opened."
_REASONS: dict[int, tuple[str, str]] = {
    WsgStatus.NOT_INITIALIZED: ("WSG-NOT-HOMED", "The gripper does not know where its jaws are"),
    WsgStatus.ALREADY_RUNNING: ("WSG-BUSY", "The gripper is still moving"),
    WsgStatus.RANGE_ERROR: ("WSG-RANGE", "The gripper cannot go there"),
    WsgStatus.INVALID_PARAMETER: ("WSG-RANGE", "The gripper cannot do that"),
    WsgStatus.INDEX_OUT_OF_BOUNDS: ("WSG-RANGE", "The gripper cannot do that"),
    WsgStatus.AXIS_BLOCKED: ("WSG-BLOCKED", "Something blocks the jaws"),
    WsgStatus.CMD_ABORTED: ("WSG-ABORTED", "The gripper broke the motion off"),
    WsgStatus.CMD_FAILED: ("WSG-NO-PART", "The jaws met no piece"),
    WsgStatus.TIMEOUT: ("WSG-TIMEOUT", "The gripper did not end its motion in time"),
    WsgStatus.CHECKSUM_ERROR: ("WSG-FRAME", "The gripper read a damaged command twice"),
}
_STEPS = {
    "WSG-NOT-HOMED": "Take the piece out by hand, then home the gripper.",
    "WSG-NO-PART": "Put the piece between the jaws and grip again.",
    "WSG-BLOCKED": "Look between the jaws, then try again.",
}


FAST_STOP = Fault(
    "WSG-FAST-STOP",
    "The gripper is in fast stop.",
    "It accepts no motion; the grip is unchanged.",
    "Look at the piece, then acknowledge the fast stop.",
    NAME,
)


def refusal(command: int, status: int, flags: SystemFlag) -> Fault:
    """Return the fault of a command that was answered with ``status``."""
    if status == WsgStatus.ACCESS_DENIED and SystemFlag.FAST_STOP in flags:
        return FAST_STOP
    name = WsgCommand(command).name.lower().replace("_", " ")
    unknown = ("WSG-REFUSED", f"The gripper refuses '{name}' (code {status})")
    code, what = _REASONS.get(status, unknown)
    return Fault(code, f"{what}.", _STANDS, _STEPS.get(code, "Look at the gripper."), NAME)


def device_fault(flags: SystemFlag) -> Fault | None:
    """Return the fault of the system flags, None without one."""
    for flag, why in DEVICE_FAULTS.items():
        if flag in flags:
            return Fault(
                "WSG-DEVICE",
                f"The gripper reports a fault: {why}.",
                _STANDS,
                "Remove the cause, then acknowledge it.",
                NAME,
            )
    return FAST_STOP if SystemFlag.FAST_STOP in flags else None


def link_fault(what: str) -> Fault:
    """Return the fault of a missing or lost connection."""
    return Fault(
        "WSG-LINK",
        what,
        "It is not known if the piece is still held.",
        "Look at the piece; check cable and power of the gripper, then connect it again.",
        NAME,
    )


GripperProtocol = BinaryProtocol | GclProtocol
STOPPED, REPLACED = protocols.stopped_fault(NAME), protocols.replaced_fault(NAME)
NOT_CONNECTED = protocols.not_connected_fault(NAME)


class WsgMotion(protocols.CommandedMotion):
    """A motion in steps, the active one first; ``pending`` once the gripper has accepted it."""

    def __init__(
        self, steps: Sequence[WsgRequest], sent: Mapping[str, float], deadline_s: float
    ) -> None:
        super().__init__(sent)
        self.steps, self.deadline_s = list(steps), deadline_s
        self.pending = self.resent = False


SILENCE_S = 2.0  # the limit is 3 s, in docs/endings.toml
STATE_MS = 20
STOP = WsgRequest(WsgCommand.STOP)
_MOVES = (WsgCommand.HOME, WsgCommand.PREPOSITION, WsgCommand.GRASP, WsgCommand.RELEASE)


@dataclass(frozen=True, slots=True)
class WsgLimits:
    """Limits of the gripper: mm, mm/s, mm/s², N as the sum over both fingers."""

    stroke_mm: float
    speed_mm_s: tuple[float, float]
    acceleration_mm_s2: float
    force_sum_n: tuple[float, float]

    def speed(self, wanted_mm_s: float) -> float:
        """Return the nearest possible speed."""
        return min(max(wanted_mm_s, self.speed_mm_s[0]), self.speed_mm_s[1])

    def travel_s(self, travel_mm: float, speed_mm_s: float) -> float:
        """Return the longest time of a travel including its ramps, s."""
        return travel_mm / speed_mm_s + 2 * speed_mm_s / self.acceleration_mm_s2


class WsgCore:
    """State of one gripper. The owner sends the returned requests in order and feeds every
    reply.
    """

    def __init__(self, settings: WsgSettings) -> None:
        self._settings = settings
        self._fingers = 2.0 if settings.force_convention == "device" else 1.0
        # Those of the settings, until the gripper reports its own.
        speeds = (settings.speed_min, settings.speed_max)
        forces = (settings.force_min_n, settings.force_max_n)
        self.limits = WsgLimits(settings.stroke_mm, speeds, settings.acceleration_mm_s2, forces)
        self.flags = SystemFlag(0)
        self.grasp_state = GraspState.IDLE
        self.width_mm = self.force_sum_n = 0.0
        self.lost_parts = 0
        self.motion: WsgMotion | None = None
        self.fault: Fault | None = None
        self._heard_s = 0.0

    @property
    def status(self) -> protocols.GripStatus:
        """Last width, force per finger and grip."""
        holding = self.grasp_state is GraspState.HOLDING
        return protocols.GripStatus(self.width_mm, self.force_sum_n / self._fingers, holding)

    @property
    def most_force_n(self) -> float:
        """Largest grip force per finger, N."""
        return self.limits.force_sum_n[1] / self._fingers

    def subscribe(self, now_s: float) -> list[WsgRequest]:
        """Return the requests for all readings; they keep the connection alive as well."""
        self._heard_s = now_s
        return [
            protocol.update(WsgCommand.SYSTEM_STATE, STATE_MS, on_change=True),
            *self._readings(),
        ]

    def home(self, now_s: float) -> list[WsgRequest]:
        """Find the origin. Only on the operator's command: with a piece in the jaws it is wrong."""
        slowest = self.limits.speed_mm_s[0]
        return self._begin(now_s, protocol.home(), {}, self.limits.stroke_mm / slowest)

    def grip(self, now_s: float, force_n: float) -> list[WsgRequest]:
        """Close until a piece is held with ``force_n`` per finger."""
        low, high = self.limits.force_sum_n
        force_sum_n = min(max(self._fingers * force_n, low), high)
        speed = self.limits.speed(self._settings.grasp_speed_mm_s)
        requests = (
            protocol.set_force_limit(force_sum_n),
            protocol.grasp(self._settings.grasp_width_mm, speed),
        )
        sent = {"force_n": force_sum_n / self._fingers}
        within_s = self.limits.travel_s(self.limits.stroke_mm, speed)
        return self._begin(now_s, requests, sent, within_s)

    def open_to(self, now_s: float, width_mm: float, speed_mm_s: float) -> list[WsgRequest]:
        """Move to a width; releases a held piece."""
        width = min(width_mm, self.limits.stroke_mm)
        speed = self.limits.speed(speed_mm_s)
        if self.grasp_state is GraspState.HOLDING:
            request = protocol.release(width, speed)
        else:
            request = protocol.preposition(width, speed, stop_on_block=True)
        within_s = self.limits.travel_s(abs(width - self.width_mm), speed)
        return self._begin(now_s, request, {"width_mm": width, "speed_mm_s": speed}, within_s)

    def stop(self) -> list[WsgRequest]:
        """Stop a motion; keeps a completed grip."""
        moving = self.motion is not None or SystemFlag.MOVING in self.flags
        self._end(STOPPED)
        return [STOP] if moving else []

    def acknowledge(self) -> list[WsgRequest]:
        """Acknowledge a fast stop or a fault; it ends with the answer of the gripper."""
        return [
            protocol.acknowledge(),
            protocol.update(WsgCommand.SYSTEM_STATE, STATE_MS, on_change=True),
        ]

    def feed(self, now_s: float, reply: WsgReply) -> list[WsgRequest]:
        """Process one reply."""
        self._heard_s = now_s
        if reply.command == WsgCommand.ACKNOWLEDGE and reply.status == WsgStatus.SUCCESS:
            self.fault = None  # states before this answer are outdated
        if reply.status == WsgStatus.SUCCESS and reply.values:
            self._read(reply)
        motion = self.motion
        if motion is None or not motion.steps or reply.command != motion.steps[0].command:
            return []
        return self._advance(motion, reply)

    def tick(self, now_s: float) -> list[WsgRequest]:
        """Check the time: stop a motion that takes too long, report silence as a fault."""
        if now_s - self._heard_s > SILENCE_S:
            self.latch(link_fault(f"The gripper is silent for {now_s - self._heard_s:.1f} s."))
        elif self.motion is not None and now_s > self.motion.deadline_s:
            command = self.motion.steps[0].command if self.motion.steps else WsgCommand.STOP
            self._end(refusal(command, WsgStatus.TIMEOUT, self.flags))
            return [STOP]
        return []

    def _readings(self) -> list[WsgRequest]:
        period_ms = self._settings.update_ms
        return [
            protocol.update(WsgCommand.GRASP_STATE, STATE_MS, on_change=True),
            protocol.update(WsgCommand.WIDTH, period_ms),
            protocol.update(WsgCommand.FORCE, period_ms),
        ]

    def _begin(
        self,
        now_s: float,
        requests: WsgRequest | tuple[WsgRequest, ...],
        sent: Mapping[str, float],
        within_s: float,
    ) -> list[WsgRequest]:
        """Start a motion and, at its end, read what it changed."""
        if self.fault is not None:
            raise FaultError(self.fault)
        first = requests if isinstance(requests, tuple) else (requests,)
        before = [STOP] if self.motion is not None else []
        self._end(REPLACED)
        steps = [*before, *first, *self._readings()]
        deadline_s = now_s + within_s + self._settings.margin_s
        self.motion = WsgMotion(steps, sent, deadline_s)
        return steps[:1]

    def _advance(self, motion: WsgMotion, reply: WsgReply) -> list[WsgRequest]:
        request = motion.steps[0]
        if reply.status == WsgStatus.CMD_PENDING:
            motion.pending = True
            return []
        if reply.status == WsgStatus.CMD_ABORTED and not motion.pending:
            return []  # end of the previous motion
        if reply.status == WsgStatus.CHECKSUM_ERROR and not motion.resent:
            motion.resent = True
            return [request]
        if reply.status != WsgStatus.SUCCESS:
            self._end(refusal(request.command, reply.status, self.flags))
            return []
        if request.command in _MOVES and not motion.pending:
            return []  # result of a previous motion; ours starts with "pending"
        motion.steps.pop(0)
        motion.pending = False
        if not motion.steps:
            missing = "force_n" in motion.sent and self.grasp_state is not GraspState.HOLDING
            no_part = refusal(WsgCommand.GRASP, WsgStatus.CMD_FAILED, self.flags)
            self._end(no_part if missing else None)
        return motion.steps[:1]

    def _read(self, reply: WsgReply) -> None:
        value = float(reply.values[0])
        match reply.command:
            case WsgCommand.SYSTEM_STATE:
                self.flags = SystemFlag(int(value))
                fault = device_fault(self.flags)
                if fault is not None:
                    self.latch(fault)
            case WsgCommand.GRASP_STATE:
                state = GraspState(int(value)) if value in _STATES else GraspState.ERROR
                holding = self.grasp_state is GraspState.HOLDING
                self.lost_parts += holding and state is GraspState.PART_LOST
                self.grasp_state = state
            case WsgCommand.WIDTH:
                self.width_mm = value
            case WsgCommand.FORCE:
                self.force_sum_n = value

    def latch(self, fault: Fault) -> None:
        """Keep the first fault; end the motion."""
        self.fault = self.fault or fault
        self._end(fault)

    def _end(self, fault: Fault | None) -> None:
        if self.motion is not None:
            self.motion.end(fault)
            self.motion = None


_STATES = frozenset(int(state) for state in GraspState)


READ_S = 0.01
ANSWER_S = 1.0
CHUNK = 4096
STALE_S = 1.0


class WsgGripper:
    """Driver of the gripper at ``host`` and ``port``; replies are stamped by ``now_s``.
    ``language`` makes the protocol of one connection.
    """

    name = NAME

    def __init__(
        self,
        host: str,
        port: int,
        settings: WsgSettings,
        now_s: Callable[[], float],
        language: Callable[[], GripperProtocol] = BinaryProtocol,
    ) -> None:
        self._address, self._settings, self._now_s = (host, port), settings, now_s
        self._core = WsgCore(settings)
        self._lock, self._sending = threading.RLock(), threading.Lock()
        self._socket: socket.socket | None = None
        self._new_language = language
        self._language = language()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self.steps = protocols.ConnectionSteps()
        self._state = protocols.DeviceState.CLOSED
        self.identity: protocols.Identity | None = None  # None before the first connection
        self._arrivals = protocols.ArrivalCounter()
        # True if a piece was held when the connection was lost: the operator must acknowledge the
        # stop.
        self.lost_holding = False

    @property
    def state(self) -> protocols.DeviceState:
        """State of the connection; FAULT for a latched fault of the gripper."""
        faulty = self._state is protocols.DeviceState.READY and self._core.fault is not None
        return protocols.DeviceState.FAULT if faulty else self._state

    @property
    def fault(self) -> Fault | None:
        """Fault to acknowledge, or cause of a lost connection."""
        return self._core.fault

    @property
    def homed(self) -> bool:
        """True if the origin of the jaws is known."""
        return SystemFlag.REFERENCED in self._core.flags

    @property
    def health(self) -> protocols.Health:
        """Replies per second, age of the newest, counts; ``lost`` are damaged replies."""
        return self._arrivals.health(self._now_s(), self._language.bad_frames)

    def describe(self) -> Mapping[str, str | float]:
        """Return type, state of the grip, readings and losses."""
        core, status = self._core, self._core.status
        stale = self._state is protocols.DeviceState.READY and self.health.age_s > STALE_S
        return {
            "kind": self.identity.model if self.identity else "WSG",
            "condition": "stale" if stale else self.state.value,
            "grasp": core.grasp_state.name.lower().replace("_", " "),
            "homed": "yes" if self.homed else "no",
            "width_mm": status.width_mm,
            "force_n": status.force_n,
            "most_force_n": core.most_force_n,
            "lost_parts": core.lost_parts,
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Identify the gripper, acknowledge a fast stop, start the readings. If the last connection
        was lost while holding a piece, the fast stop stays until ``acknowledge``: the operator
        checks the piece first.
        """
        if self._state is protocols.DeviceState.READY:
            return
        self.close()
        self._state = protocols.DeviceState.CONNECTING
        self._core, self._language = WsgCore(self._settings), self._new_language()
        self.steps.begin()
        try:
            self._socket = socket.create_connection(self._address, timeout=timeout_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.steps.reached("reach")
            self._greet(cancel)
        except (OSError, FaultError) as error:
            self._drop()
            self._state = protocols.DeviceState.CLOSED
            if isinstance(error, FaultError):
                raise
            raise FaultError(link_fault(f"The gripper cannot be reached: {error}.")) from error
        self._begin()

    def close(self) -> None:
        """Announce the end and close; the jaws do not move, a held piece is kept."""
        if self._thread is not None:
            self.stop()
            self._stop.set()
            self._thread.join()
            self._thread = None
            if self._state is protocols.DeviceState.READY and self._socket is not None:
                self._announce_end()
        self._drop()
        self._state = protocols.DeviceState.CLOSED

    def status(self) -> protocols.GripStatus:
        """Return the last status of the gripper."""
        return self._core.status

    def home(self) -> WsgMotion:
        """Home the gripper, on the operator's command and with empty jaws only."""
        return self._command(lambda now_s: self._core.home(now_s))

    def grip(self, force_n: float) -> WsgMotion:
        """Close until a piece is held with ``force_n`` per finger."""
        self._require_ready()
        if not 0.0 < force_n < float("inf"):
            raise ValueError("the grip force must be positive and finite")
        return self._command(lambda now_s: self._core.grip(now_s, force_n))

    def open_to(self, width_mm: float, speed_mm_s: float) -> WsgMotion:
        """Open (or close) to ``width_mm``; releases a held piece."""
        self._require_ready()
        if not (0.0 <= width_mm < float("inf") and 0.0 < speed_mm_s < float("inf")):
            raise ValueError("width and speed must be finite, the speed positive")
        return self._command(lambda now_s: self._core.open_to(now_s, width_mm, speed_mm_s))

    def stop(self) -> None:
        """Stop and keep the grip; from any thread, in every state."""
        with self._lock:
            requests = self._core.stop()
        self._send(requests)

    def acknowledge(self) -> None:
        """Acknowledge a fast stop or fault, on the operator's command."""
        self._require_link()
        with self._lock:
            self.lost_holding = False
            requests = self._core.acknowledge()
        self._send(requests)

    def _command(self, begin: Callable[[float], list[WsgRequest]]) -> WsgMotion:
        self._require_ready()
        with self._lock:
            requests = begin(self._now_s())
            motion = self._core.motion
        if motion is None:
            raise RuntimeError("a command began no motion")
        self._send(requests)
        return motion

    def _require_ready(self) -> None:
        self._require_link()
        if self._core.fault is not None:
            raise FaultError(self._core.fault)

    def _require_link(self) -> None:
        if self._state is not protocols.DeviceState.READY:
            raise FaultError(self._core.fault or NOT_CONNECTED)

    def _greet(self, cancel: threading.Event) -> None:
        core = self._core
        if not self.lost_holding:
            self._exchange(protocol.acknowledge(), cancel)
        state = self._exchange(WsgRequest(WsgCommand.SYSTEM_STATE, (0, 0)), cancel)
        core.flags = SystemFlag(int(_number(state)))
        core.fault = device_fault(core.flags)
        limits = self._exchange(WsgRequest(WsgCommand.SYSTEM_LIMITS), cancel)
        acceleration = self._exchange(WsgRequest(WsgCommand.GET_ACCELERATION), cancel)
        if limits.status == WsgStatus.SUCCESS and acceleration.status == WsgStatus.SUCCESS:
            stroke, low, high, _, _, weakest, nominal, _ = map(float, limits.values)
            core.limits = WsgLimits(stroke, (low, high), _number(acceleration), (weakest, nominal))
        told = self._exchange(WsgRequest(WsgCommand.SYSTEM_INFO), cancel)
        address = f"{self._address[0]}:{self._address[1]}"
        self.identity = self._language.identity(told, address)
        self.steps.reached("identify")

    def _exchange(self, request: WsgRequest, cancel: threading.Event) -> WsgReply:
        """Send one request and wait for its answer; only before the listening thread runs."""
        if self._socket is None:
            raise FaultError(NOT_CONNECTED)
        self._socket.sendall(self._language.encode([request]))
        self._socket.settimeout(READ_S)
        end_s = time.monotonic() + ANSWER_S
        while time.monotonic() < end_s:
            if cancel.is_set():
                raise FaultError(link_fault("Connecting was cancelled."))
            for reply in self._heard(self._socket):
                if reply.command == request.command:
                    return reply
        raise FaultError(link_fault(self._other_device(self._socket)))

    def _other_device(self, line: socket.socket) -> str:
        """Return a sentence that names the device that answers instead, if any does."""
        answered = False

        def receive(limit_s: float) -> bytes:
            nonlocal answered
            line.settimeout(limit_s)
            try:
                data = line.recv(CHUNK)
            except TimeoutError:
                return b""
            answered = answered or bool(data)
            return data

        stranger = identify_device(line.sendall, receive, self._settings.protocol)
        if not stranger and not answered:
            return "The gripper is silent: its address accepts a connection, but no answer comes."
        if not stranger:
            return "The device at this address is not a WSG gripper."
        wanted = f"a WSG gripper (wsg.protocol is {self._settings.protocol})"
        return f"This is {stranger}, expected {wanted}."

    def _begin(self) -> None:
        self._stop.clear()
        now_s = self._now_s()
        self._arrivals = protocols.ArrivalCounter()
        self._arrivals.note(now_s, 0)
        with self._lock:
            requests = self._core.subscribe(now_s)
        self.steps.reached("configure")
        self._state = protocols.DeviceState.READY
        self._thread = threading.Thread(target=self._listen, name="wsg", daemon=True)
        self._thread.start()
        self._send(requests)

    def _listen(self) -> None:
        line = self._socket
        if line is None:
            return
        try:
            while not self._stop.is_set():
                for reply in self._heard(line):
                    now_s = self._now_s()
                    self.steps.reached("first sample")
                    self._arrivals.note(now_s)
                    with self._lock:
                        requests = self._core.feed(now_s, reply)
                    self._send(requests)
                with self._lock:
                    requests = self._core.tick(self._now_s())
                self._send(requests, self._language.due(self._now_s()))
                if self._core.fault is not None and self._core.fault.code == "WSG-LINK":
                    raise ConnectionError(self._core.fault.what)
        except OSError as error:
            self._lose(error)

    def _heard(self, line: socket.socket) -> list[WsgReply]:
        try:
            data = line.recv(CHUNK)
        except TimeoutError:
            return self._language.take(b"")
        if not data:
            raise ConnectionResetError("the gripper has closed the connection")
        return self._language.take(data)

    def _send(self, requests: Iterable[WsgRequest], more: bytes = b"") -> None:
        line = self._socket
        try:
            with self._sending:
                content = self._language.encode(requests) + more
                if content and line is not None:
                    line.sendall(content)
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Handle the loss of the wire: the grip is unknown from now on."""
        self._stop.set()
        with self._lock:
            self.lost_holding |= self._core.status.holding
            self._core.latch(link_fault(f"The connection to the gripper is lost: {error}."))
            self._state = protocols.DeviceState.FAULT

    def _announce_end(self) -> None:
        """Announce the end, which avoids a fast stop, unless that would open the grip. If the
        gripper opens after an announced end, the fast stop keeps the piece until the operator
        acknowledges it.
        """
        if self._core.status.holding and not self._settings.keeps_grip_after_07:
            self.lost_holding = True
            return
        try:
            self._exchange(WsgRequest(WsgCommand.DISCONNECT), threading.Event())
        except (OSError, FaultError):
            return

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _number(reply: WsgReply) -> float:
    if reply.status != WsgStatus.SUCCESS or not reply.values:
        raise FaultError(link_fault(f"The gripper refuses to be read (code {reply.status})."))
    return float(reply.values[0])


def make_wsg(settings: HardwareSettings, now_s: Callable[[], float]) -> WsgGripper:
    """Return the gripper of ``wsg.host`` with the protocol of ``wsg.protocol``."""
    wsg = settings.wsg
    make_protocol: Callable[[], GripperProtocol] = BinaryProtocol
    if wsg.protocol == "gcl":
        make_protocol = partial(GclProtocol, wsg)
    return WsgGripper(wsg.host, wsg.port, wsg, now_s, make_protocol)
