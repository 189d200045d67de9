"""Servers of emulated devices: TCP port, pseudo terminal, datagrams.

One client at a time; a second one waits. Datagram answers go to the last sender. The device itself
is a function of time and bytes. Both directions are logged.
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from touchdown.backend.core import MonotonicClock, set_realtime_priority
from touchdown.backend.emulation.fault_plan import Faults

TICK_S = 0.002  # longest sleep between two polls of the device; limits the timing of a stream
UNPLUGGED_S = 0.01
CHUNK = 4096
LOG_LENGTH = 20_000


class EmulatedDevice(Protocol):
    """A device on a stream of bytes."""

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process received bytes; return the immediate answer."""

    def due(self, now_s: float) -> bytes:
        """Return the bytes that the device sends by itself up to now; none by default."""
        return b""

    def closed(self, now_s: float) -> None:
        """Handle the end of a client's connection; does nothing by default."""
        return


@dataclass(frozen=True, slots=True)
class Exchange:
    """Logged bytes; ``incoming`` is towards the device."""

    t_s: float
    incoming: bool
    data: bytes


class DeviceServer(ABC):
    """Server of one device on its own thread.

    ``faults`` act on the wire. ``damage`` may be set at any time: it receives all outgoing bytes
    and returns the bytes to send.
    """

    def __init__(self, faults: Faults | None = None) -> None:
        self._clock = MonotonicClock()
        self.faults = faults or Faults("")
        self._stop = threading.Event()
        self.log: deque[Exchange] = deque(maxlen=LOG_LENGTH)
        self.received = self.sent = self.clients = 0
        self.damage: Callable[[bytes], bytes] = bytes
        # Real-time priority of the thread, if permitted; 0 leaves it unchanged.
        self.priority = 0
        self._thread = threading.Thread(target=self._begin, name="emulator", daemon=True)

    @property
    @abstractmethod
    def url(self) -> str:
        """Address for a driver."""

    def start(self) -> None:
        """Start to serve; starts the time of the fault plan."""
        self.faults.begin(self._clock.now_s())
        self._thread.start()

    def close(self) -> None:
        """Stop serving and wait for the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def inject(self, kind: str, for_s: float | None = None, **more: float) -> None:
        """Start a fault now."""
        self.faults.inject(self._clock.now_s(), kind, for_s, **more)

    def _begin(self) -> None:
        set_realtime_priority(self.priority)
        self._run()

    @abstractmethod
    def _run(self) -> None:
        """Serve until ``_stop`` is set."""

    def _is_unplugged(self) -> bool:
        return self.faults.active("unplug", self._clock.now_s())

    def _wait_until_plugged(self) -> bool:
        """Wait for the end of the fault ``unplug``; return False if the server closes."""
        while self._is_unplugged() and not self._stop.wait(UNPLUGGED_S):
            pass
        return not self._stop.is_set()

    def _log_received(self, data: bytes) -> float:
        now_s = self._clock.now_s()
        self.received += len(data)
        self.log.append(Exchange(now_s, True, data))
        return now_s

    def _log_sent(self, data: bytes) -> None:
        self.sent += len(data)
        self.log.append(Exchange(self._clock.now_s(), False, data))

    def _send_datagram(
        self, wire: socket.socket, out: bytes, client: tuple[str, int] | None
    ) -> None:
        out = self.damage(out)
        if client is None or not out:
            return
        # A closed client causes an error here; a full buffer loses the datagram.
        with contextlib.suppress(ConnectionError, BlockingIOError):
            wire.sendto(out, client)
            self._log_sent(out)


class StreamServer(DeviceServer):
    """Server of a byte stream; polls its device every ``tick_s``."""

    tick_s = TICK_S

    def __init__(self, device: EmulatedDevice, faults: Faults | None = None) -> None:
        super().__init__(faults)
        self._device = device

    def _serve(
        self, file: int, read: Callable[[], bytes], write: Callable[[bytes], object]
    ) -> None:
        """Exchange bytes with one client until it disconnects or the server closes."""
        with selectors.DefaultSelector() as selector:
            selector.register(file, selectors.EVENT_READ)
            while not self._stop.is_set() and not self._is_unplugged():
                answer = b""
                if selector.select(self.tick_s):
                    data = read()
                    if not data:
                        return
                    answer = self._device.receive(self._log_received(data), data)
                now_s = self._clock.now_s()
                messages = self.faults.outgoing(now_s, (answer, self._device.due(now_s)))
                if out := self.damage(b"".join(messages)):
                    write(out)
                    self._log_sent(out)


class TcpServer(StreamServer):
    """A device behind a TCP port; ``port`` 0 takes a free one."""

    def __init__(
        self,
        device: EmulatedDevice,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(device, faults)
        self._listener = self._listen((host, port))
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    @property
    def url(self) -> str:
        """Address for a serial driver."""
        return f"socket://{self.address[0]}:{self.address[1]}"

    def close(self) -> None:
        """Stop serving and free the port."""
        super().close()
        self._listener.close()

    def _listen(self, address: tuple[str, int]) -> socket.socket:
        listener = socket.create_server(address, backlog=1)
        listener.settimeout(0.05)
        return listener

    def _run(self) -> None:
        while not self._stop.is_set():
            if self._is_unplugged():
                self._listener.close()
                if self._wait_until_plugged():
                    self._listener = self._listen(self.address)
                continue
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            self.clients += 1
            with client, contextlib.suppress(ConnectionError, TimeoutError):
                client.settimeout(1.0)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._serve(client.fileno(), partial(client.recv, CHUNK), client.sendall)
            self._device.closed(self._clock.now_s())


class PtyServer(StreamServer):
    """A device behind a pseudo terminal (Linux, macOS); ``url`` is the path of its serial port.

    ``link`` always points to the current terminal, which changes after a replug.
    """

    def __init__(
        self, device: EmulatedDevice, faults: Faults | None = None, link: Path | None = None
    ) -> None:
        super().__init__(device, faults)
        self._link = link
        self.plugs = 0  # number of times it was plugged in
        self._plug()

    @property
    def url(self) -> str:
        """Path of the serial port."""
        return str(self._link or self._path)

    def close(self) -> None:
        """Stop serving and remove the port."""
        super().close()
        self._unplug()

    def _plug(self) -> None:
        import tty

        self._master, slave = os.openpty()
        self._files: tuple[int, ...] = (self._master, slave)
        tty.setraw(slave)
        self._path = os.ttyname(slave)
        if self._link is not None:
            self._name(self._link)
        self.plugs += 1

    def _name(self, link: Path) -> None:
        """Point ``link`` to the terminal; a missing folder is an error at the start only."""
        fresh = link.with_name(f"{link.name}.new")
        if link.exists() and not link.is_symlink():
            raise FileExistsError(errno.EEXIST, "it is a file, not a link", str(link))
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self._path)
            fresh.replace(link)
        except FileNotFoundError:
            if not self._thread.is_alive():
                raise

    def _unplug(self) -> None:
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        for file in self._files:
            os.close(file)
        self._files = ()

    def _run(self) -> None:
        while not self._stop.is_set():
            os.set_blocking(self._master, False)
            self._serve(self._master, partial(os.read, self._master, CHUNK), self._write)
            if not self._is_unplugged():
                continue
            self._device.closed(self._clock.now_s())
            self._unplug()
            self._wait_until_plugged()
            self._plug()

    def _write(self, out: bytes) -> None:
        # Without a reader, bytes that do not fit are lost, as in an adapter's buffer.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, out)


AT_ONCE = 64  # datagrams processed between two polls of the device


class EmulatedDatagrams(Protocol):
    """A device on a network socket."""

    def receive(self, now_s: float, data: bytes) -> Sequence[bytes]:
        """Process one datagram; return the immediate answers."""

    def due(self, now_s: float) -> Sequence[bytes]:
        """Return the datagrams that the device sends by itself up to now."""


class UdpServer(DeviceServer):
    """A device behind a UDP port; ``port`` 0 takes a free one."""

    def __init__(
        self,
        device: EmulatedDatagrams,
        host: str = "127.0.0.1",
        port: int = 0,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(faults)
        self._device = device
        self._socket = self._bind((host, port))
        self.address: tuple[str, int] = self._socket.getsockname()[:2]
        self._client: tuple[str, int] | None = None

    @property
    def url(self) -> str:
        """Address for a driver."""
        return f"udp://{self.address[0]}:{self.address[1]}"

    def close(self) -> None:
        """Stop serving and free the port."""
        super().close()
        self._socket.close()

    def _bind(self, address: tuple[str, int]) -> socket.socket:
        bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            bound.bind(address)
        except OSError:
            bound.close()
            raise
        bound.setblocking(False)
        return bound

    def _run(self) -> None:
        while not self._stop.is_set():
            if not self._is_unplugged():
                self._exchange()
                continue
            self._socket.close()
            if self._wait_until_plugged():
                self._socket = self._bind(self.address)

    def _exchange(self) -> None:
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            while not self._stop.is_set() and not self._is_unplugged():
                answers: list[bytes] = []
                if selector.select(TICK_S):
                    answers = self._take()
                now_s = self._clock.now_s()
                for out in self.faults.outgoing(now_s, [*answers, *self._device.due(now_s)]):
                    self._send_datagram(self._socket, out, self._client)

    def _take(self) -> list[bytes]:
        """Process waiting datagrams; return the answers."""
        answers: list[bytes] = []
        for _ in range(AT_ONCE):
            try:
                data, client = self._socket.recvfrom(CHUNK)
            except (BlockingIOError, ConnectionError):
                break
            if client != self._client:
                self._client = client
                self.clients += 1
            answers.extend(self._device.receive(self._log_received(data), data))
        return answers
