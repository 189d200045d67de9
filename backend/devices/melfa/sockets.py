"""Sockets of a MELFA controller: one thread for commands, one for the stream.

The stream runs at absolute deadlines; a missed cycle is skipped, never made up. A lock file named
after the address excludes a second program on this computer; the controller's operation right
excludes other computers.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import wait
from pathlib import Path

from touchdown.backend.config import MelfaSettings
from touchdown.backend.core import Fault, FaultError, lock_file, set_realtime_priority
from touchdown.backend.devices.identification import identify_device
from touchdown.backend.devices.melfa.command_channel import (
    CycleFunction,
    CycleTimes,
    PendingRequest,
    R3Client,
)
from touchdown.backend.devices.melfa.faults import link_fault
from touchdown.backend.devices.melfa.r3_protocol import R3Request, encode_request
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S, PACKET_BYTES
from touchdown.backend.devices.melfa.stream import END
from touchdown.backend.devices.protocols import NOTHING_MOVED, arm_fault

PREFIX, SUFFIX = "touchdown-arm-", ".lock"
# Retries: the deletion of old files locks each of them for an instant.
TRIES, AGAIN_S = 5, 0.02


class ControllerLock:
    """Lock of a controller until ``close``; raises ``FaultError`` if another program has it."""

    def __init__(self, host: str, port: int) -> None:
        name = re.sub(r"[^A-Za-z0-9.-]", "_", host)
        folder = Path(tempfile.gettempdir())
        self._path = folder / f"{PREFIX}{name}-{port}{SUFFIX}"
        found = folder.glob(f"{PREFIX}*{SUFFIX}") if os.name == "posix" else ()
        for path in found:
            if path != self._path:
                with contextlib.suppress(OSError):
                    _delete_file(_lock(path), path)
        try:
            self._descriptor = _lock(self._path, TRIES)
        except OSError as error:
            what = f"Another program on this computer drives the controller at {host}:{port}."
            step = "Close the arm there first."
            raise FaultError(arm_fault("ARM-TAKEN", what, step, NOTHING_MOVED)) from error

    def close(self) -> None:
        """Release the lock."""
        _delete_file(self._descriptor, self._path)


def _lock(path: Path, tries: int = 1) -> int:
    """Lock ``path``, but not a file that was deleted while waiting for the lock."""
    while True:
        try:
            descriptor = lock_file(path)
        except BlockingIOError:
            tries -= 1
            if tries == 0:
                raise
            threading.Event().wait(AGAIN_S)
            continue
        if os.name != "posix":
            return descriptor
        with contextlib.suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        os.close(descriptor)


def _delete_file(descriptor: int, path: Path) -> None:
    if os.name == "posix":
        # Delete before unlocking: a waiting program finds it deleted and creates a new one.
        path.unlink(missing_ok=True)
    os.close(descriptor)


CONNECT_S = 3.0
FINISH_S = 30.0  # longer than any request waits: each ends by itself, at the latest with its wire
IDLE_S = 0.005  # longest sleep of the command channel between two polls
RECEIVE_BUFFER = (
    16 * PACKET_BYTES
)  # space for the datagrams of a cycle, including repeated and late ones
MOST_DATAGRAMS = 64  # read per cycle: a flood must not delay the stream
STOP_LINE = encode_request(R3Request("STOP")) + b"\r"
OPEN_LINE = encode_request(R3Request("OPEN=", "TOUCHDOWNSTOP")) + b"\r"


class SocketLinks:
    """Links over sockets; ``now_s`` is the bench clock, synchronous with ``time.monotonic``."""

    def __init__(self, settings: MelfaSettings, now_s: Callable[[], float]) -> None:
        self._settings, self._now_s = settings, now_s
        self.times = CycleTimes()
        self._anew = threading.Event()
        self._stop = threading.Event()
        self._threads: list[threading.Thread] = []
        self._client = R3Client(1e-3 * settings.r3.reply_gap_ms)
        self._client.end(link_fault("The connection is closed."))
        self._claim: ControllerLock | None = None
        self._commands: socket.socket | None = None
        self._lane: socket.socket | None = None
        self._stream: socket.socket | None = None

    @property
    def bad_replies(self) -> int:
        """Number of invalid replies of the command channel."""
        return self._client.bad_replies

    # -- open and close ---------------------------------------------------------------------------

    def open(self, cycle: CycleFunction, lost: Callable[[Fault], None]) -> None:
        """Connect both channels and start their threads; raises ``FaultError``."""
        self.close()
        host, r3 = self._settings.host, self._settings.r3
        self._claim = ControllerLock(host, r3.port)
        try:
            self._commands = _connected(host, r3.port)
            self._lane = _connected(host, r3.stop_port)
            self._lane.sendall(OPEN_LINE)
            self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            self._stream.connect((host, self._settings.mxt.port))
            self._stream.setblocking(False)
        except OSError as error:
            self.close()
            raise FaultError(link_fault(f"The controller cannot be reached: {error}.")) from error
        self._stop.clear()
        self.times = CycleTimes()
        self._client = R3Client(1e-3 * self._settings.r3.reply_gap_ms, self._identify)
        self._start("melfa commands", self._own_commands, self._commands, self._lane, lost)
        self._start("melfa stream", self._own_stream, self._stream, cycle, lost)

    def _identify(self) -> str:
        """Return the description of another device on the command channel, "" if unknown."""
        wire = self._commands
        if wire is None or self._stop.is_set():
            return ""

        def receive(limit_s: float) -> bytes:
            return wire.recv(4096) if select.select([wire], [], [], limit_s)[0] else b""

        return identify_device(wire.sendall, receive, "melfa")

    def close(self) -> None:
        """End both threads and close the sockets."""
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        for wire in (self._commands, self._lane, self._stream):
            if wire is not None:
                wire.close()
        self._commands = self._lane = self._stream = None
        if self._claim is not None:
            self._claim.close()
            self._claim = None

    def _start(self, name: str, target: Callable[..., None], *args: object) -> None:
        thread = threading.Thread(target=target, args=args, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    # -- commands ---------------------------------------------------------------------------------

    def ask(self, request: R3Request, timeout_s: float) -> PendingRequest:
        """Queue a request."""
        return self._client.ask(request, timeout_s)

    def finish(self, ticket: PendingRequest) -> None:
        """Wait until the request is done; it fails by itself after its time limit."""
        wait([ticket], FINISH_S)

    def restart_timing(self) -> None:
        """Restart the count of ``times`` from the next cycle on."""
        self.times = CycleTimes(realtime=self.times.realtime)
        self._anew.set()

    def pause(self, seconds: float) -> None:
        """Sleep; ends early when the wires close."""
        self._stop.wait(seconds)

    def pace(self, running: bool) -> None:
        """Set True while a controller program runs."""
        self._client.paced = running

    def stop_now(self, packet: bytes) -> None:
        """Send STOP on its own connection and ``packet`` on the stream, from the caller's
        thread.
        """
        lane, stream = self._lane, self._stream
        if stream is not None:
            with contextlib.suppress(OSError):
                stream.send(packet)
        try:
            if lane is not None:
                lane.send(STOP_LINE)
        except OSError:
            # The connection is gone or full: send STOP first on the other channel.
            self._client.ask(R3Request("STOP"))

    def _own_commands(
        self, wire: socket.socket, lane: socket.socket, lost: Callable[[Fault], None]
    ) -> None:
        try:
            while not self._stop.is_set():
                readable, _, _ = select.select([wire, lane], [], [], IDLE_S)
                if lane in readable and not lane.recv(4096):
                    raise ConnectionError("the STOP lane was closed")
                data = b""
                if wire in readable:
                    data = wire.recv(4096)
                    if not data:
                        raise ConnectionError("the controller closed the connection")
                out = self._client.step(self._now_s(), data)
                if out:
                    wire.sendall(out)
        except FaultError as error:
            lost(error.fault)
        except OSError as error:
            fault = link_fault(f"The command channel is lost: {error}.")
            self._client.end(fault)
            lost(fault)
        finally:
            self._client.end(link_fault("The connection was closed."))

    # -- stream -----------------------------------------------------------------------------------

    def _own_stream(
        self, wire: socket.socket, cycle: CycleFunction, lost: Callable[[Fault], None]
    ) -> None:
        try:
            self._run_cycles(wire, cycle)
        finally:
            # Also after a program error: nothing may move without this thread.
            if not self._stop.is_set():
                self.stop_now(END)
                lost(link_fault("The real-time stream has ended by an error of this program."))

    def _run_cycles(self, wire: socket.socket, cycle: CycleFunction) -> None:
        realtime = set_realtime_priority(self._settings.realtime_priority)
        deadline_s = time.monotonic() + CYCLE_S
        self.times = times = CycleTimes(realtime=realtime)
        while not self._stop.is_set():
            # One wake-up per cycle: a reply in between is not used before the next.
            self._stop.wait(deadline_s - time.monotonic())
            came = _received_datagrams(wire)
            over_s = time.monotonic() - deadline_s
            if self._anew.is_set():
                times = CycleTimes(realtime=realtime)
                self._anew.clear()
            self.times = times = times.after(over_s)
            packet = cycle(self._now_s(), tuple(came))
            if packet is not None:
                # A full buffer or a missing host is a lost packet, which the silence ladder counts.
                with contextlib.suppress(OSError):
                    wire.send(packet)
            missed = int(max(time.monotonic() - deadline_s, 0.0) / CYCLE_S)
            deadline_s += (missed + 1) * CYCLE_S


def _connected(host: str, port: int) -> socket.socket:
    wire = socket.create_connection((host, port), timeout=CONNECT_S)
    wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    wire.settimeout(CONNECT_S)
    return wire


def _received_datagrams(wire: socket.socket) -> list[bytes]:
    came: list[bytes] = []
    for _ in range(MOST_DATAGRAMS):
        try:
            came.append(wire.recv(512))
        except BlockingIOError:
            break
        except OSError:
            # ICMP refusal before the controller's program listens.
            continue
    return came
