"""How an emulated device meets its driver: a TCP port or a pseudo terminal, and a log of both ways.

One client at a time; a second one waits. The device itself is a function of time and bytes.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from backend.core.clock import Clock, MonotonicClock

TICK_S = 0.002
"""Longest sleep between two looks at the device: as finely as a stream is timed."""
CHUNK = 4096
LOG_LENGTH = 20_000


class Emulated(Protocol):
    """A device as its wire sees it."""

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Take bytes; return what is answered at once."""

    def due(self, now_s: float) -> bytes:
        """Return what the device sends of itself up to now."""

    def closed(self, now_s: float) -> None:
        """Take note that the client has gone."""


@dataclass(frozen=True, slots=True)
class Exchange:
    """Bytes that went one way: ``incoming`` is towards the device."""

    t_s: float
    incoming: bool
    data: bytes


class Front:
    """Runs one device on a thread of its own until ``close``.

    ``damage`` may be set at any time: it gets all outgoing bytes and returns what really goes out.
    """

    def __init__(self, device: Emulated, clock: Clock | None = None) -> None:
        self._device, self._clock = device, clock or MonotonicClock()
        self._stop = threading.Event()
        self.log: deque[Exchange] = deque(maxlen=LOG_LENGTH)
        self.damage: Callable[[bytes], bytes] = bytes
        self._thread = threading.Thread(target=self._run, name="emulator", daemon=True)

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()

    def close(self) -> None:
        """Stop serving; returns when the thread has ended."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        raise NotImplementedError

    def _serve(
        self, file: int, read: Callable[[], bytes], write: Callable[[bytes], object]
    ) -> None:
        """Exchange bytes with one client until it goes or the front closes."""
        with selectors.DefaultSelector() as selector:
            selector.register(file, selectors.EVENT_READ)
            while not self._stop.is_set():
                out = b""
                if selector.select(TICK_S):
                    data = read()
                    if not data:
                        return
                    now_s = self._clock.now_s()
                    self.log.append(Exchange(now_s, True, data))
                    out = self._device.receive(now_s, data)
                out = self.damage(out + self._device.due(self._clock.now_s()))
                if out:
                    write(out)
                    self.log.append(Exchange(self._clock.now_s(), False, out))


class TcpFront(Front):
    """A device behind a TCP port; ``port`` 0 takes a free one."""

    def __init__(
        self, device: Emulated, host: str = "127.0.0.1", port: int = 0, clock: Clock | None = None
    ) -> None:
        super().__init__(device, clock)
        self._listener = socket.create_server((host, port), backlog=1)
        self._listener.settimeout(0.05)
        self.address: tuple[str, int] = self._listener.getsockname()[:2]

    @property
    def url(self) -> str:
        """Address for a serial driver."""
        return f"socket://{self.address[0]}:{self.address[1]}"

    def close(self) -> None:
        """Stop serving and free the port."""
        super().close()
        self._listener.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                client, _ = self._listener.accept()
            except TimeoutError:
                continue
            with client, contextlib.suppress(ConnectionError, TimeoutError):
                client.settimeout(1.0)
                client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._serve(client.fileno(), partial(client.recv, CHUNK), client.sendall)
            self._device.closed(self._clock.now_s())


class PtyFront(Front):
    """A device behind a pseudo terminal (Linux, macOS); ``url`` is the path of its serial port."""

    def __init__(self, device: Emulated, clock: Clock | None = None) -> None:
        super().__init__(device, clock)
        import tty

        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.url = os.ttyname(self._slave)

    def close(self) -> None:
        """Stop serving and remove the port."""
        super().close()
        for file in (self._master, self._slave):
            os.close(file)

    def _run(self) -> None:
        self._serve(
            self._master,
            lambda: os.read(self._master, CHUNK),
            lambda out: os.write(self._master, out),
        )
