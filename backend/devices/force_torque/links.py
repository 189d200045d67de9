"""Serial and UDP links of wrist sensors."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from typing import Protocol
from urllib.parse import urlsplit

import serial

CHUNK = 4096
WRITE_S = 1.0


class Link(Protocol):
    """One open wire; only its owner reads and writes."""

    def read(self, limit_s: float) -> bytes:
        """Return what has come, for UDP one datagram; nothing after ``limit_s``."""

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""

    def drain(self) -> None:
        """Throw away what has come so far."""

    def close(self) -> None:
        """Let go of the wire."""


class SerialLink:
    """A serial port of 8 data bits, no parity, opened for this program alone."""

    def __init__(self, path: str, baud: int, chunk: int) -> None:
        self._port = serial.Serial(path, baud, timeout=0.0, write_timeout=WRITE_S, exclusive=True)
        self._chunk = chunk
        # Read past pyserial where the system allows: at 1 kHz that costs half as much.
        self._file: int | None = self._port.fileno() if os.name == "posix" else None
        # The adapter shall hand over what it has at once; the system may refuse, or not know how.
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self._port.set_low_latency_mode(True)

    def read(self, limit_s: float) -> bytes:
        """Return all that waits, once it is a few frames or the time is over."""
        if self._file is None:
            if self._port.timeout != limit_s:
                self._port.timeout = limit_s
            return bytes(self._port.read(self._chunk))
        data, end_s = b"", time.monotonic() + limit_s
        while len(data) < self._chunk:
            left_s = end_s - time.monotonic()
            if not select.select([self._file], [], [], max(left_s, 0.0))[0]:
                break
            more = os.read(self._file, CHUNK)
            if not more:
                raise ConnectionResetError("the port says that there is something, and has nothing")
            data += more
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        self._port.write(data)

    def drain(self) -> None:
        """Empty the buffer of the adapter."""
        self._port.reset_input_buffer()

    def close(self) -> None:
        """Close the port."""
        self._port.close()


class TcpLink:
    """A sensor behind a serial-to-network box, or an emulated one."""

    def __init__(self, host: str, port: int, limit_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=limit_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, limit_s: float) -> bytes:
        """Return what has come; ``ConnectionError`` once the other side has closed."""
        self._socket.settimeout(limit_s)
        try:
            data = self._socket.recv(CHUNK)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("the other side has closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        self._socket.settimeout(WRITE_S)
        self._socket.sendall(data)

    def drain(self) -> None:
        """Throw away what has come."""
        while self.read(1e-3):
            pass

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class UdpLink:
    """Datagrams to and from one address."""

    def __init__(self, host: str, port: int) -> None:
        self.host = host
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError:
            self._socket.close()
            raise

    def read(self, limit_s: float) -> bytes:
        """Return one datagram."""
        self._socket.settimeout(limit_s)
        try:
            return self._socket.recv(CHUNK)
        except (TimeoutError, BlockingIOError):
            return b""

    def write(self, data: bytes) -> None:
        """Send one datagram."""
        self._socket.send(data)

    def drain(self) -> None:
        """Throw away the datagrams that wait."""
        while self.read(1e-3):
            pass

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def open_link(address: str, *, baud: int, chunk: int, limit_s: float = 2.0) -> Link:
    """Open what ``address`` names; ``chunk`` bytes are a few frames of a serial sensor."""
    parts = urlsplit(address)
    if parts.scheme in ("socket", "udp"):
        try:
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise OSError(f"{address} is no address: {error}") from error
        if not host or not port:
            raise OSError(f"{address} lacks host or port")
        return TcpLink(host, port, limit_s) if parts.scheme == "socket" else UdpLink(host, port)
    return SerialLink(address, baud, chunk)
