"""Driver of ATI Net F/T, Ethernet Axia and OnRobot compute box.

UDP with one client.
"""

from __future__ import annotations

import http.client
import socket
import threading
from contextlib import closing
from urllib.parse import urlsplit

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import (
    DatagramDriver,
    NotAnsweredError,
    SensorDescription,
    SensorLink,
    WrenchReading,
    pause,
)
from touchdown.backend.devices.netft import protocol
from touchdown.backend.devices.protocols import Identity

ONROBOT_COUNTS = (10_000.0, 100_000.0)
RATE_HZ = 1000.0
SETTLE_S = 0.05
ANSWER_S = 2.0
PAGE, PAGE_BYTES = "/netftapi2.xml", 100_000
CALIBRATION_BYTES = 24


class NetFtDriver(DatagramDriver):
    """Old and repeated datagrams are dropped by their sequence number; a gap counts as lost."""

    baud = 0
    chunk = protocol.RECORD_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__()
        self._settings, self._address = settings.netft, address
        self._period_s = 1.0 / (settings.ft.rate_hz or RATE_HZ)
        self._counts: tuple[float, float] = (1.0, 1.0)

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """Read the scale, stop an old stream, start."""
        self._counts = self._scale()
        for _ in range(2):
            link.write(protocol.encode_request(protocol.RdtRequest(protocol.RdtCommand.STOP)))
        pause(cancel, SETTLE_S)
        link.drain()
        self._last = None
        link.write(protocol.encode_request(protocol.RdtRequest(protocol.RdtCommand.START)))
        identity = Identity("ATI", "Net F/T", self._address, "")
        return SensorDescription(identity, self._settings.rated, self._period_s, numbered=True)

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the new samples of one datagram."""
        records = self.decoded(data, protocol.decode_records) or ()
        return [reading for record in records if (reading := self._reading(record))]

    def stop(self, link: SensorLink) -> None:
        """Stop the stream; sent three times, because a datagram may be lost."""
        for _ in range(3):
            link.write(protocol.encode_request(protocol.RdtRequest(protocol.RdtCommand.STOP)))

    def _reading(self, record: protocol.RdtRecord) -> WrenchReading | None:
        missed = self.missed(record.rdt_sequence)
        if missed is None:
            return None
        trouble = f"The sensor reports status {record.status:08X}h" if record.status else ""
        return WrenchReading(record.wrench(*self._counts), missed, trouble=trouble)

    def _scale(self) -> tuple[float, float]:
        """Return counts per N and per N·m: from the page, the TCP channel, else the settings."""
        if self._settings.onrobot:
            return ONROBOT_COUNTS
        host = urlsplit(self._address).hostname or ""
        for tell in (self._page, self._calibration):
            try:
                return tell(host)
            except (OSError, http.client.HTTPException):
                continue
        if self._settings.counts is None:
            raise NotAnsweredError("The box does not tell its scale, and netft.counts is unset")
        return self._settings.counts

    def _page(self, host: str) -> tuple[float, float]:
        box = http.client.HTTPConnection(host, self._settings.http_port, timeout=ANSWER_S)
        with closing(box):
            box.request("GET", PAGE)
            answer = box.getresponse()
            content = answer.read(PAGE_BYTES)
        if answer.status != http.client.OK:
            raise OSError(f"status {answer.status}")
        return protocol.decode_page(content)

    def _calibration(self, host: str) -> tuple[float, float]:
        with socket.create_connection((host, self._settings.tcp_port), timeout=ANSWER_S) as line:
            line.sendall(protocol.TCP_REQUEST)
            heard = b""
            while len(heard) < CALIBRATION_BYTES and (more := line.recv(CALIBRATION_BYTES)):
                heard += more
        told = protocol.decode_calibration(heard)
        return float(told.counts_per_n), float(told.counts_per_nm)
