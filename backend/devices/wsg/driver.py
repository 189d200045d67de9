"""Driver of the WSG gripper."""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from touchdown.backend.config import HardwareSettings, WsgSettings
from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices.protocols import (
    DeviceState,
    Gripper,
    GripStatus,
    Health,
    Identity,
    Steps,
)
from touchdown.backend.devices.registry import find_offered, who_answers
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.core import (
    NAME,
    Limits,
    WsgCore,
    WsgMotion,
    device_fault,
    link_fault,
    not_connected_fault,
)
from touchdown.backend.devices.wsg.dialects import BinaryLanguage, GclLanguage, GripperLanguage
from touchdown.backend.devices.wsg.protocol import Command, Reply, Request, Status, SystemFlag

READ_S = 0.01
ANSWER_S = 1.0
CHUNK = 4096
RATE_WINDOW_S = 1.0
STALE_S = 1.0


class WsgGripper:
    """``host`` and ``port`` of the gripper; replies are stamped by ``now_s``.

    ``language`` makes the protocol of one connection.
    """

    name = NAME

    def __init__(
        self,
        host: str,
        port: int,
        settings: WsgSettings,
        now_s: Callable[[], float],
        language: Callable[[], GripperLanguage] = BinaryLanguage,
    ) -> None:
        self._address, self._settings, self._now_s = (host, port), settings, now_s
        self._core = WsgCore(settings)
        self._lock, self._sending = threading.RLock(), threading.Lock()
        self._socket: socket.socket | None = None
        self._new_language = language
        self._language = language()
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self.steps = Steps()
        self._state = DeviceState.CLOSED
        self._identity: Identity | None = None
        self._received = 0
        self._arrivals: deque[float] = deque(maxlen=512)
        self.lost_holding = False
        """A piece was held when the connection was lost: its fast stop waits for the operator."""

    @property
    def state(self) -> DeviceState:
        """Where the connection is in its life; a latched fault of the gripper is FAULT."""
        faulty = self._state is DeviceState.READY and self._core.fault is not None
        return DeviceState.FAULT if faulty else self._state

    @property
    def identity(self) -> Identity | None:
        """Known once connected."""
        return self._identity

    @property
    def fault(self) -> Fault | None:
        """What the operator has to acknowledge, or why the connection was lost."""
        return self._core.fault

    @property
    def homed(self) -> bool:
        """Whether the gripper knows where its jaws are."""
        return SystemFlag.REFERENCED in self._core.flags

    @property
    def lost_parts(self) -> int:
        """How often a held piece was lost since connection."""
        return self._core.lost_parts

    @property
    def health(self) -> Health:
        """Replies per second, age of the newest, counts; ``lost`` are damaged replies."""
        now_s, arrivals = self._now_s(), list(self._arrivals)
        newest_s = arrivals[-1] if arrivals else float("-inf")
        rate_hz = sum(t > now_s - RATE_WINDOW_S for t in arrivals) / RATE_WINDOW_S
        return Health(rate_hz, now_s - newest_s, self._received, self._language.bad_frames)

    def describe(self) -> Mapping[str, str | float]:
        """Return type, state of the grip, readings and losses."""
        core, status = self._core, self._core.status
        stale = self._state is DeviceState.READY and self.health.age_s > STALE_S
        return {
            "kind": self._identity.model if self._identity else "WSG",
            "condition": "stale" if stale else self.state.value,
            "grasp": core.grasp_state.name.lower().replace("_", " "),
            "homed": "yes" if self.homed else "no",
            "width_mm": status.width_mm,
            "force_n": status.force_n,
            "lost_parts": core.lost_parts,
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Greet the gripper, acknowledge a fast stop, start the readings.

        After a connection that was lost while holding a piece the fast stop stays until
        ``acknowledge``: the operator looks at the piece first.
        """
        if self._state is DeviceState.READY:
            return
        self.close()
        self._state = DeviceState.CONNECTING
        self._core, self._language = WsgCore(self._settings), self._new_language()
        self.steps.begin()
        try:
            self._socket = socket.create_connection(self._address, timeout=timeout_s)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.steps.reached("reach")
            self._greet(cancel)
        except (OSError, FaultError) as error:
            self._drop()
            self._state = DeviceState.CLOSED
            if isinstance(error, FaultError):
                raise
            raise FaultError(link_fault(f"The gripper cannot be reached: {error}.")) from error
        self._begin()

    def close(self) -> None:
        """Say goodbye and close; the jaws stay as they are, a held piece is kept."""
        if self._thread is not None:
            self.stop()
            self._stop.set()
            self._thread.join()
            self._thread = None
            if self._state is DeviceState.READY and self._socket is not None:
                self._farewell()
        self._drop()
        self._state = DeviceState.CLOSED

    def status(self) -> GripStatus:
        """Return what the gripper told last."""
        return self._core.status

    def home(self) -> WsgMotion:
        """Let the gripper find its origin: on the operator's word, with empty jaws only."""
        return self._command(lambda now_s: self._core.home(now_s))

    def grip(self, force_n: float) -> WsgMotion:
        """Close until a piece is held with ``force_n`` per finger."""
        self._require_ready()
        if not 0.0 < force_n < float("inf"):
            raise ValueError("the grip force must be positive and finite")
        return self._command(lambda now_s: self._core.grip(now_s, force_n))

    def open_to(self, width_mm: float, speed_mm_s: float) -> WsgMotion:
        """Open (or close) to ``width_mm``; a held piece is let go."""
        self._require_ready()
        if not (0.0 <= width_mm < float("inf") and 0.0 < speed_mm_s < float("inf")):
            raise ValueError("width and speed must be finite, the speed positive")
        return self._command(lambda now_s: self._core.open_to(now_s, width_mm, speed_mm_s))

    def stop(self) -> None:
        """Stop where it is; keeps the grip. From any thread, in every state."""
        with self._lock:
            requests = self._core.stop()
        self._send(requests)

    def acknowledge(self) -> None:
        """Take a fast stop or fault as seen, on the operator's word."""
        self._require_link()
        with self._lock:
            self.lost_holding = False
            requests = self._core.acknowledge()
        self._send(requests)

    def _command(self, begin: Callable[[float], list[Request]]) -> WsgMotion:
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
        if self._state is not DeviceState.READY:
            raise FaultError(self._core.fault or not_connected_fault())

    def _greet(self, cancel: threading.Event) -> None:
        core = self._core
        if not self.lost_holding:
            self._exchange(protocol.acknowledge(), cancel)
        state = self._exchange(Request(Command.SYSTEM_STATE, (0, 0)), cancel)
        core.flags = SystemFlag(int(_number(state)))
        core.fault = device_fault(core.flags)
        limits = self._exchange(Request(Command.SYSTEM_LIMITS), cancel)
        acceleration = self._exchange(Request(Command.GET_ACCELERATION), cancel)
        if limits.status == Status.SUCCESS and acceleration.status == Status.SUCCESS:
            stroke, low, high, _, _, weakest, nominal, _ = map(float, limits.values)
            core.limits = Limits(stroke, (low, high), _number(acceleration), (weakest, nominal))
        told = self._exchange(Request(Command.SYSTEM_INFO), cancel)
        address = f"{self._address[0]}:{self._address[1]}"
        self._identity = self._language.identity(told, address)
        self.steps.reached("identify")

    def _exchange(self, request: Request, cancel: threading.Event) -> Reply:
        """Send one request and wait for its answer; only before the listening thread runs."""
        if self._socket is None:
            raise FaultError(not_connected_fault())
        self._socket.sendall(self._language.encode([request]))
        self._socket.settimeout(READ_S)
        end_s = time.monotonic() + ANSWER_S
        while time.monotonic() < end_s:
            if cancel.is_set():
                raise FaultError(link_fault("Connecting was cancelled."))
            for reply in self._heard(self._socket):
                if reply.command == request.command:
                    return reply
        raise FaultError(link_fault(self._who_answers(self._socket)))

    def _who_answers(self, line: socket.socket) -> str:
        """Return a sentence: who is there instead."""

        def receive(limit_s: float) -> bytes:
            line.settimeout(limit_s)
            try:
                return line.recv(CHUNK)
            except TimeoutError:
                return b""

        stranger = who_answers(line.sendall, receive, self._settings.protocol)
        if not stranger:
            return "What answers there is no WSG gripper."
        wanted = f"a WSG gripper (wsg.protocol is {self._settings.protocol})"
        return f"This is {stranger}, expected {wanted}."

    def _begin(self) -> None:
        self._stop.clear()
        self._received = 0
        self._arrivals.clear()
        now_s = self._now_s()
        self._arrivals.append(now_s)
        with self._lock:
            requests = self._core.subscribe(now_s)
        self.steps.reached("configure")
        self._state = DeviceState.READY
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
                    self._received += 1
                    self.steps.reached("first sample")
                    self._arrivals.append(now_s)
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

    def _heard(self, line: socket.socket) -> list[Reply]:
        try:
            data = line.recv(CHUNK)
        except TimeoutError:
            return self._language.take(b"")
        if not data:
            raise ConnectionResetError("the gripper has closed the connection")
        return self._language.take(data)

    def _send(self, requests: Iterable[Request], more: bytes = b"") -> None:
        line = self._socket
        try:
            with self._sending:
                content = self._language.encode(requests) + more
                if content and line is not None:
                    line.sendall(content)
        except OSError as error:
            self._lose(error)

    def _lose(self, error: OSError) -> None:
        """Take note that the wire is gone: whether a piece is held is not known any more."""
        self._stop.set()
        with self._lock:
            self.lost_holding |= self._core.status.holding
            self._core.lose(link_fault(f"The connection to the gripper is lost: {error}."))
            self._state = DeviceState.FAULT

    def _farewell(self) -> None:
        """Announce the end, so that it latches no fast stop; a grip that this would end is not.

        Where the gripper lets go after an announced end, the fast stop keeps the piece until the
        operator acknowledges it.
        """
        if self._core.status.holding and not self._settings.keeps_grip_after_07:
            self.lost_holding = True
            return
        try:
            self._exchange(Request(Command.DISCONNECT), threading.Event())
        except (OSError, FaultError):
            return

    def _drop(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def _number(reply: Reply) -> float:
    if reply.status != Status.SUCCESS or not reply.values:
        raise FaultError(link_fault(f"The gripper refuses to be read (code {reply.status})."))
    return float(reply.values[0])


GROUP = "touchdown.gripper"
"""Entry points: name -> callable(settings, now_s) that returns a ``Gripper``."""

GripperMaker = Callable[[HardwareSettings, Callable[[], float]], Gripper]


def make_gripper(settings: HardwareSettings, now_s: Callable[[], float]) -> Gripper:
    """Return the driver of ``wsg.driver``; raises ``InputError``."""
    shipped: dict[str, GripperMaker] = {"wsg": _wsg}
    return find_offered(GROUP, settings.wsg.driver, shipped, "wsg.driver")(settings, now_s)


def _wsg(settings: HardwareSettings, now_s: Callable[[], float]) -> WsgGripper:
    wsg = settings.wsg
    language: Callable[[], GripperLanguage] = BinaryLanguage
    if wsg.protocol == "gcl":
        language = partial(GclLanguage, wsg)
    return WsgGripper(wsg.host, wsg.port, wsg, now_s, language)
