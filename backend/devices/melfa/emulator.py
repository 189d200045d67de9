"""Emulated MELFA controller behind real sockets: two ports for commands, one for the stream.

Faults of the wire act on the stream; ``silent`` and ``unplug`` act on the command channel as well.
``estop`` is pressed during the fault; ``alarm`` and ``servo_off`` happen at its start.
"""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable
from functools import partial

from touchdown.backend import emulation
from touchdown.backend.config import HardwareSettings, MelfaSettings
from touchdown.backend.core import FloatArray
from touchdown.backend.devices.melfa.emulated_channels import (
    TYPE_FORCE,
    EmulatedCommands,
    EmulatedMonitor,
    EmulatedStream,
)
from touchdown.backend.devices.melfa.emulated_controller import STREAM, EmulatedController
from touchdown.backend.devices.melfa.realtime_protocol import MxtCommand

CALLER_LEFT_S = 0.1  # silence of the caller of the stream after which another one is followed
TICK_S = 0.004  # longest sleep between two polls; during a program, until the next cycle
ALARM = 2601  # error of the fault ``alarm``: a position over its limit
ESTOP = 50
TIMEOUT_CYCLES = 57  # MXTTOUT of the bench file: a silent stream ends after 0.2 s
IDLE_CHECK_S = 0.5  # of the bench file: shorter than on a real arm


class EmulatedMelfa:
    """One controller with its stream; ``session`` returns a command channel for each client."""

    def __init__(
        self,
        settings: MelfaSettings,
        *,
        start_rad: FloatArray | None = None,
        streaming: bool = False,
    ) -> None:
        """``streaming``: servo on and program running from the start, for a client without R3.
        ``start_rad``: initial joints (6,); by default the hand points down within reach.
        """
        self.controller = EmulatedController(settings, start_rad=start_rad, streaming=streaming)
        self.stream = EmulatedStream(self.controller)

    def session(self) -> EmulatedCommands:
        """Return the channel of a new client."""
        return EmulatedCommands(self.controller)


class MelfaServer(emulation.DeviceServer):
    """Serves ``device`` on ``host``; port 0 takes a free one, see ``settings``."""

    def __init__(
        self,
        device: EmulatedMelfa,
        host: str = "127.0.0.1",
        ports: tuple[int, int, int] = (0, 0, 0),
        faults: emulation.Faults | None = None,
    ) -> None:
        """``ports``: commands, STOP, stream."""
        super().__init__(faults or emulation.Faults("arm"))
        self._device = device
        self._sources: list[socket.socket] = []
        self._sessions: dict[socket.socket, EmulatedCommands] = {}
        self._selector: selectors.BaseSelector  # of the present connections
        self._host, self._ports = host, ports
        self._listen()
        self.stops: list[float] = []  # times of STOP on the server's clock
        self._on: set[str] = set()
        self._caller: tuple[str, int] | None = None
        self._caller_s, self._commands = 0.0, False
        controller = device.controller
        self._begins: dict[str, Callable[[], None]] = {
            "alarm": partial(controller.raise_error, ALARM),
            "estop": partial(controller.raise_error, ESTOP),
            "servo_off": partial(controller.switch_servo, False),
        }

    @property
    def url(self) -> str:
        """Address of the command channel."""
        return f"tcp://{self._host}:{self._ports[0]}"

    @property
    def settings(self) -> MelfaSettings:
        """Settings of a driver for this server."""
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
                self._wait_until_plugged()

    def _serve_all(self) -> None:
        stream, *doors = self._sources
        self._sessions.clear()
        with selectors.DefaultSelector() as self._selector:
            for source in self._sources:
                self._selector.register(source, selectors.EVENT_READ)
            while not self._stop.is_set() and not self._is_unplugged():
                answers: list[bytes] = []
                for key, _ in self._selector.select(self._until_due_s()):
                    ready = key.fileobj
                    assert isinstance(ready, socket.socket)
                    if ready is stream:
                        self._take(stream, answers)
                    elif ready in doors:
                        self._admit(ready)
                    else:
                        self._answer(ready, self._sessions[ready])
                now_s = self._clock.now_s()
                self._apply_faults(now_s)
                for out in self.faults.outgoing(now_s, answers):
                    self._send_datagram(stream, out, self._caller)
                self._serve_due(now_s)
        for client, session in self._sessions.items():
            session.closed(self._clock.now_s())
            client.close()

    def _until_due_s(self) -> float:
        left_s = self._device.controller.next_cycle_s - self._clock.now_s()
        return min(max(left_s, 0.0), TICK_S)

    # -- stream -----------------------------------------------------------------------------------

    def _take(self, stream: socket.socket, answers: list[bytes]) -> None:
        """Process one datagram. Requests for positions are always answered; while one caller
        commands motion, other callers are ignored.
        """
        try:
            data, (host, port) = stream.recvfrom(emulation.CHUNK)
        except (BlockingIOError, ConnectionError):
            return
        now_s, caller = self._log_received(data), (host, port)
        if caller != self._caller:
            if self._commands and now_s - self._caller_s < CALLER_LEFT_S:
                return
            self._commands = False
        answer = self._device.stream.receive(now_s, data)
        if answer is not None:
            self._caller, self._caller_s = caller, now_s
            self._commands |= data[0] == MxtCommand.MOVE
            answers.append(answer)
        elif self._device.controller.program != STREAM:
            self._caller, self._commands = None, False

    # -- commands ---------------------------------------------------------------------------------

    def _admit(self, door: socket.socket) -> None:
        try:
            client, _ = door.accept()
        except BlockingIOError:
            return
        client.settimeout(1.0)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._selector.register(client, selectors.EVENT_READ)
        self._sessions[client] = self._device.session()
        self.clients += 1

    def _answer(self, client: socket.socket, session: EmulatedCommands) -> None:
        try:
            data = client.recv(emulation.CHUNK)
        except (ConnectionError, TimeoutError):
            data = b""
        if not data:
            session.gone = True
            return
        now_s = self._log_received(data)
        if b";STOP\r" in data:
            self.stops.append(now_s)
        self._reply(client, session, session.receive(now_s, data))

    def _serve_due(self, now_s: float) -> None:
        """Send unrequested data that are due; drop closed clients."""
        self._device.controller.advance(now_s)
        for client, session in list(self._sessions.items()):
            self._reply(client, session, session.due(now_s))
            if session.gone:
                session.closed(now_s)
                self._selector.unregister(client)
                client.close()
                del self._sessions[client]

    def _reply(self, client: socket.socket, session: EmulatedCommands, out: bytes) -> None:
        if not out or self.faults.active("silent", self._clock.now_s()):
            return
        try:
            client.sendall(out)
        except (ConnectionError, TimeoutError):
            session.gone = True
        else:
            self._log_sent(out)

    # -- faults -----------------------------------------------------------------------------------

    def _apply_faults(self, now_s: float) -> None:
        controller = self._device.controller
        controller.joints.stalled = self.faults.active("stall", now_s)
        for kind, begin in self._begins.items():
            active = self.faults.active(kind, now_s)
            if active and kind not in self._on:
                self._on.add(kind)
                begin()
            elif not active and kind in self._on:
                self._on.remove(kind)
                if kind == "estop":
                    controller.release_emergency_stop()


def emulate_melfa(
    choice: emulation.EmulationChoice, faults: emulation.Faults
) -> emulation.Emulation:
    """Serve the stream on the port, commands and STOP on the two ports above it."""
    port = choice.network_port()
    ports = (port + 1, port + 2, port) if port else (0, 0, 0)
    settings = HardwareSettings.model_validate({"melfa": {"mxt": {"mxttout": TIMEOUT_CYCLES}}})
    front = MelfaServer(EmulatedMelfa(settings.melfa), choice.host, ports, faults=faults)
    return emulation.Emulation((front,), melfa_tables(front))


def melfa_tables(front: MelfaServer) -> emulation.BenchTables:
    """Return the tables of a bench file for an emulated arm."""
    served = front.settings
    return {
        "melfa": {"host": served.host, "idle_check_s": IDLE_CHECK_S},
        "melfa.r3": {"port": served.r3.port, "stop_port": served.r3.stop_port},
        "melfa.mxt": {"port": served.mxt.port, "mxttout": served.mxt.mxttout},
    }


def emulate_monitor(
    choice: emulation.EmulationChoice, faults: emulation.Faults
) -> emulation.Emulation:
    """Serve the force that the controller reports every cycle."""
    sensor = EmulatedMonitor(emulation.apply_faults(choice.wrench, faults))
    sensor.pace.faults = faults
    front = emulation.UdpServer(sensor, choice.host, choice.network_port(), faults=faults)
    tables: emulation.BenchTables = {
        "ft": {"driver": "melfa", "address": front.url},
        "melfa.monitor": {"type_force": TYPE_FORCE},
    }
    return emulation.Emulation((front,), tables)
