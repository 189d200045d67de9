"""Emulated ATI Net F/T sensor.

Serves datagrams, the web page with the scale, and the answer on the TCP channel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from touchdown.backend import emulation
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.netft import protocol
from touchdown.backend.devices.netft.protocol import (
    TCP_REQUEST,
    UNIT_NEWTON,
    UNIT_NEWTON_METRE,
    Calibration,
    RdtCommand,
    RdtRecord,
)

PER_UNIT = 1_000_000
PERIOD_S = 0.001
SEQUENCE_TURN = 1 << 32
SATURATED = 0x0002_0000  # status bit of a saturated gauge
_LIMIT = 0x7FFF_FFFF
_STARTS = (RdtCommand.START, RdtCommand.START_AXIA, RdtCommand.START_BUFFERED)


class EmulatedNetFt:
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m. It serves the last client."""

    def __init__(self, wrench: Callable[[float], Sequence[float]]) -> None:
        self._wrench = wrench
        self.pace = emulation.SampleSchedule()
        self._left: int | None = None
        self._sequence = self._ft_sequence = 0
        self._bias: tuple[int, ...] = (0,) * 6

    def receive(self, now_s: float, data: bytes) -> list[bytes]:
        """Process one request; the records are its only answer."""
        try:
            request = protocol.decode_request(data)
        except ProtocolError:
            return []
        if request.command == RdtCommand.BIAS:
            self._bias = self._raw(now_s)
        elif request.command == RdtCommand.STOP:
            self.pace.end()
        elif request.command in _STARTS:
            self._left = request.count or None
            self._sequence = 0
            self.pace.begin(now_s, PERIOD_S)
        return []

    def due(self, now_s: float) -> list[bytes]:
        """Return the records up to now, one a datagram."""
        late, times = self.pace.due(now_s)
        self._sequence = (self._sequence + late) % SEQUENCE_TURN
        if self._left is not None:
            times = times[: self._left]
            self._left -= len(times)
            if not self._left:
                self.pace.end()
        return [protocol.encode_records((self._record(t_s),)) for t_s in times]

    def _raw(self, now_s: float) -> tuple[int, ...]:
        return tuple(round(value * PER_UNIT) for value in self._wrench(now_s))

    def _record(self, now_s: float) -> RdtRecord:
        self._sequence = (self._sequence + 1) % SEQUENCE_TURN
        self._ft_sequence = round(now_s / PERIOD_S) % SEQUENCE_TURN
        raw = [count - bias for count, bias in zip(self._raw(now_s), self._bias, strict=True)]
        status = SATURATED if max(map(abs, raw)) > _LIMIT else 0
        counts = tuple(min(max(count, -_LIMIT), _LIMIT) for count in raw)
        return RdtRecord(self._sequence, self._ft_sequence, status, counts)


class _Answering(emulation.EmulatedDevice):
    """A device that answers whole requests and sends nothing by itself."""

    def __init__(self) -> None:
        self._heard = b""

    def closed(self, now_s: float) -> None:
        """Discard an incomplete request."""
        self._heard = b""


class EmulatedCalibration(_Answering):
    """TCP channel of an Ethernet Axia: a request of 20 bytes, answered with the scale."""

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Answer a complete request."""
        self._heard += data
        if len(self._heard) < len(TCP_REQUEST):
            return b""
        whole, self._heard = self._heard[: len(TCP_REQUEST)], b""
        if whole != TCP_REQUEST:
            return b""
        scale = Calibration(UNIT_NEWTON, UNIT_NEWTON_METRE, PER_UNIT, PER_UNIT, (1,) * 6)
        return protocol.encode_calibration(scale)


class EmulatedPage(_Answering):
    """Web page of a Net F/T box: one request, one answer."""

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Answer a complete request."""
        self._heard += data
        if b"\r\n\r\n" not in self._heard:
            return b""
        found = self._heard.startswith(b"GET /netftapi2.xml ")
        self._heard = b""
        body = (
            '<?xml version="1.0"?><netft>'
            f"<cfgcpf>{PER_UNIT}</cfgcpf><cfgcpt>{PER_UNIT}</cfgcpt>"
            f"<scfgfu>N</scfgfu><scfgtu>N-m</scfgtu></netft>"
            if found
            else ""
        ).encode()
        status = b"200 OK" if found else b"404 Not Found"
        head = b"HTTP/1.1 %b\r\nContent-Type: text/xml\r\nContent-Length: %d\r\n\r\n"
        return head % (status, len(body)) + body


def emulate_netft(
    choice: emulation.EmulationChoice, faults: emulation.Faults
) -> emulation.Emulation:
    """Serve the datagrams on the port, the TCP channel on the port below, the page above."""
    port = choice.network_port()
    sensor = EmulatedNetFt(emulation.apply_faults(choice.wrench, faults))
    sensor.pace.faults = faults
    front = emulation.UdpServer(sensor, choice.host, port, faults=faults)
    channel = emulation.TcpServer(EmulatedCalibration(), choice.host, port - 1 if port else 0)
    page = emulation.TcpServer(EmulatedPage(), choice.host, port + 1 if port else 0)
    tables: emulation.BenchTables = {
        "ft": {"driver": "netft", "address": front.url},
        "netft": {"tcp_port": channel.address[1], "http_port": page.address[1]},
    }
    return emulation.Emulation((front, channel, page), tables)
