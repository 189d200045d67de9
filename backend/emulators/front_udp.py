"""A device that speaks datagrams: answers go to whoever asked last."""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections.abc import Sequence
from typing import Protocol

from backend.core.clock import Clock
from backend.emulators.faults import Faults
from backend.emulators.front import CHUNK, TICK_S, UNPLUGGED_S, Front

AT_ONCE = 64
"""Datagrams taken before the device is asked again what is due."""


class EmulatedDatagrams(Protocol):
    """A device as its network socket sees it."""

    def receive(self, now_s: float, data: bytes) -> Sequence[bytes]:
        """Take one datagram; return those that answer at once."""

    def due(self, now_s: float) -> Sequence[bytes]:
        """Return the datagrams that the device sends of itself up to now."""


class UdpFront(Front):
    """A device behind a UDP port; ``port`` 0 takes a free one."""

    def __init__(
        self,
        device: EmulatedDatagrams,
        host: str = "127.0.0.1",
        port: int = 0,
        clock: Clock | None = None,
        faults: Faults | None = None,
    ) -> None:
        super().__init__(clock, faults)
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
            while self._is_unplugged() and not self._stop.wait(UNPLUGGED_S):
                pass
            if not self._stop.is_set():
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
                    self._send(self.damage(out))

    def _take(self) -> list[bytes]:
        """Take what waits; return the answers."""
        answers: list[bytes] = []
        for _ in range(AT_ONCE):
            try:
                data, client = self._socket.recvfrom(CHUNK)
            except (BlockingIOError, ConnectionError):
                break
            if client != self._client:
                self._client = client
                self.clients += 1
            answers.extend(self._device.receive(self._took(data), data))
        return answers

    def _send(self, out: bytes) -> None:
        if self._client is None or not out:
            return
        # A client that has gone answers with an error of its system; a full buffer loses it.
        with contextlib.suppress(ConnectionError, BlockingIOError):
            self._socket.sendto(out, self._client)
            self._gave(out)
