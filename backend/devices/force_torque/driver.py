"""Interface of a wrist-sensor driver, and its links.

A driver owns no thread and no port: ``ForceTorqueReader`` does. The address of a link is the path
of a serial port, ``socket://host:port`` (TCP), or ``udp://host:port``. Links raise ``OSError``.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, NamedTuple, Protocol, TypeVar
from urllib.parse import urlsplit

import serial

from touchdown.backend.core import TouchdownError
from touchdown.backend.devices.framing import FrameStream, Message, ProtocolError, Wrench
from touchdown.backend.devices.protocols import Identity

CHUNK = 4096
WRITE_S = 1.0
FIRST_BYTES = 32  # kept for the log


class SensorLink(Protocol):
    """One open wire, used by one thread."""

    def read(self, limit_s: float) -> bytes:
        """Return the received bytes, for UDP one datagram; empty after ``limit_s``."""

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""

    def drain(self) -> None:
        """Discard received bytes."""

    def close(self) -> None:
        """Close the wire."""


class SerialLink:
    """A serial port with 8 data bits, no parity, opened exclusively."""

    def __init__(self, path: str, baud: int, chunk: int) -> None:
        self._port = serial.Serial(path, baud, timeout=0.0, write_timeout=WRITE_S, exclusive=True)
        self._chunk = chunk
        # Read without pyserial where possible: at 1 kHz that halves the processor load.
        self._file: int | None = self._port.fileno() if os.name == "posix" else None
        # Request low latency of the adapter; the system may not support it.
        with contextlib.suppress(OSError, ValueError, NotImplementedError, AttributeError):
            self._port.set_low_latency_mode(True)

    def read(self, limit_s: float) -> bytes:
        """Return the received bytes, once they are a few frames or the time is over."""
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


class SocketLink:
    """A socket that is read with a time limit."""

    _socket: socket.socket

    def read(self, limit_s: float) -> bytes:
        """Return the received bytes, of UDP one datagram."""
        self._socket.settimeout(limit_s)
        try:
            return self._socket.recv(CHUNK)
        except (TimeoutError, BlockingIOError):
            return b""

    def drain(self) -> None:
        """Discard received bytes."""
        while self.read(1e-3):
            pass

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpLink(SocketLink):
    """A sensor behind a serial-to-network box, or an emulated one."""

    def __init__(self, host: str, port: int, limit_s: float) -> None:
        self._socket = socket.create_connection((host, port), timeout=limit_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, limit_s: float) -> bytes:
        """Return the received bytes; raises ``ConnectionError`` when the other side has closed."""
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


class UdpLink(SocketLink):
    """Datagrams to and from one address."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
        except OSError:
            self._socket.close()
            raise

    def write(self, data: bytes) -> None:
        """Send one datagram."""
        self._socket.send(data)


class RecordedLink:
    """A link that keeps the first bytes received."""

    def __init__(self, link: SensorLink) -> None:
        self._link, self.first = link, b""
        self.write, self.drain, self.close = link.write, link.drain, link.close

    def read(self, limit_s: float) -> bytes:
        """Return the received bytes."""
        data = self._link.read(limit_s)
        self.first += data[: FIRST_BYTES - len(self.first)]
        return data


def open_link(address: str, *, baud: int, chunk: int, limit_s: float = 2.0) -> SensorLink:
    """Open the link to ``address``; ``chunk`` bytes are a few frames of a serial sensor."""
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


AnswerT = TypeVar("AnswerT")
AXES = 6  # Fx Fy Fz Tx Ty Tz


class NotAnsweredError(TouchdownError):
    """The sensor does not answer as expected; the text is for the operator."""


class UnansweredError(NotAnsweredError):
    """The sensor sent no answer; the reader tells silence from bytes that cannot be read."""

    def __init__(self) -> None:
        super().__init__("The sensor does not answer")


@dataclass(frozen=True, slots=True)
class WrenchReading:
    """One sample in the axes of the sensor, N and N·m; NaN if the sensor marks it invalid.

    ``missed``: number of samples lost before this one. ``overload``: True at the end of the range.
    ``trouble``: text of a failure that the sensor reports.
    """

    wrench: Wrench
    missed: int = 0
    overload: bool = False
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class SensorDescription:
    """Description of a started sensor: identity, rated loads (6,) N and N·m, and sample period.
    ``numbered`` is True if ``WrenchReading.missed`` shows every loss.
    """

    identity: Identity
    rated: tuple[float, ...]
    period_s: float
    numbered: bool = False

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for unusable values."""
        if len(self.rated) != AXES or not self.period_s > 0:
            raise ValueError(f"{AXES} rated loads and a period are needed, not {self}")


class FrameErrors(NamedTuple):
    """Rejected frames in total and since the last valid one; bytes outside of frames."""

    frames: int
    in_a_row: int
    discarded: int


class WrenchDriver(Protocol):
    """One make of sensor, for one connection."""

    @property
    def baud(self) -> int:
        """Baud rate of a serial line."""

    @property
    def chunk(self) -> int:
        """Bytes of about two frames, which are read together."""

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """Bring the sensor from any state to streaming.

        ``cancel`` ends it. Raises ``NotAnsweredError`` or ``ProtocolError``.
        """

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples completed by ``data``, oldest first."""

    @property
    def refusals(self) -> FrameErrors:
        """Counts of rejected data."""

    def stop(self, link: SensorLink) -> None:
        """Stop the stream."""


def pause(cancel: threading.Event, seconds: float) -> None:
    """Sleep; raises ``NotAnsweredError`` when cancelled."""
    if cancel.wait(seconds):
        raise NotAnsweredError("Connecting was cancelled")


def listen(
    link: SensorLink,
    cancel: threading.Event,
    limit_s: float,
    find: Callable[[bytes], AnswerT | None],
) -> AnswerT | None:
    """Pass received bytes to ``find`` until it returns an answer; return None after ``limit_s``."""
    end_s = time.monotonic() + limit_s
    while (left_s := end_s - time.monotonic()) > 0:
        pause(cancel, 0.0)
        found = find(link.read(min(left_s, 0.02)))
        if found is not None:
            return found
    return None


def ask(
    link: SensorLink,
    cancel: threading.Event,
    request: bytes,
    find: Callable[[bytes], AnswerT | None],
    *,
    limit_s: float = 0.2,
    tries: int = 3,
) -> AnswerT:
    """Send ``request`` up to ``tries`` times until ``find`` returns an answer."""
    for _ in range(tries):
        link.write(request)
        answer = listen(link, cancel, limit_s, find)
        if answer is not None:
            return answer
    raise UnansweredError


class FramedDriver(Generic[Message]):
    """Base of the drivers whose bytes a ``FrameStream`` decodes."""

    def __init__(self, decoder: FrameStream[Message]) -> None:
        self._decoder = decoder
        self._seen_bad = 0

    @property
    def refusals(self) -> FrameErrors:
        """Counts of invalid frames."""
        decoder = self._decoder
        return FrameErrors(decoder.bad_frames, decoder.bad_in_a_row, decoder.discarded)

    def newly_bad(self) -> int:
        """Return the number of frames rejected since the last call."""
        before, self._seen_bad = self._seen_bad, self._decoder.bad_frames
        return self._seen_bad - before

    def ask(
        self,
        link: SensorLink,
        cancel: threading.Event,
        request: bytes,
        kind: type[AnswerT] | tuple[type[AnswerT], ...],
        fits: Callable[[AnswerT], bool] = lambda message: True,
        *,
        limit_s: float = 0.2,
    ) -> AnswerT:
        """Send ``request``; return the first message of type ``kind`` that ``fits``."""

        def find(data: bytes) -> AnswerT | None:
            answers = (m for m in self._decoder.feed(data) if isinstance(m, kind))
            return next(filter(fits, answers), None)

        return ask(link, cancel, request, find, limit_s=limit_s)


NUMBER_TURN = 1 << 32


class DatagramDriver:
    """Base of the drivers with one message a datagram."""

    def __init__(self) -> None:
        self._bad = self._bad_in_a_row = self._discarded = 0
        self._last: int | None = None  # number of the last sample

    @property
    def refusals(self) -> FrameErrors:
        """Counts of invalid datagrams."""
        return FrameErrors(self._bad, self._bad_in_a_row, self._discarded)

    def decoded(self, data: bytes, decode: Callable[[bytes], AnswerT]) -> AnswerT | None:
        """Return the message of a datagram, None for none or an invalid one."""
        if not data:
            return None
        try:
            message = decode(data)
        except ProtocolError:
            self._bad += 1
            self._bad_in_a_row += 1
            self._discarded += len(data)
            return None
        self._bad_in_a_row = 0
        return message

    def missed(self, number: int) -> int | None:
        """Return how many samples were lost before ``number``; None if it is old or repeated."""
        step = 1 if self._last is None else (number - self._last) % NUMBER_TURN
        if step == 0 or step > NUMBER_TURN // 2:
            return None
        self._last = number
        return step - 1
