"""How to speak to an ATI Net F/T, an Ethernet Axia or an OnRobot compute box: UDP, one client."""

from __future__ import annotations

import http.client
import socket
import threading

from backend.config.hardware import HardwareSettings
from backend.devices.force_torque.language import (
    Greeting,
    NotAnsweredError,
    Reading,
    Refusals,
    pause,
)
from backend.devices.force_torque.links import Link, UdpLink
from backend.devices.protocols import Identity
from backend.wire import net_ft
from backend.wire.framing import WireError
from backend.wire.net_ft import TCP_REQUEST, Command, Record, Request

ONROBOT_COUNTS = (10_000.0, 100_000.0)
RATE_HZ = 1000.0
SETTLE_S = 0.05
ANSWER_S = 2.0
PAGE, PAGE_BYTES = "/netftapi2.xml", 100_000
CALIBRATION_BYTES = 24
SEQUENCE_TURN = 1 << 32


class NetFtLanguage:
    """Old and doubled datagrams are dropped by their sequence; a gap counts as lost."""

    baud = 0
    chunk = net_ft.RECORD_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._settings, self._address = settings.netft, address
        self._period_s = 1.0 / (settings.ft.rate_hz or RATE_HZ)
        self._counts: tuple[float, float] = (1.0, 1.0)
        self._last: int | None = None
        self._bad = self._bad_in_a_row = self._discarded = 0

    def start(self, link: Link, cancel: threading.Event) -> Greeting:
        """Learn the scale, stop an old stream, start."""
        self._counts = self._scale(link)
        for _ in range(2):
            link.write(net_ft.encode_request(Request(Command.STOP)))
        pause(cancel, SETTLE_S)
        link.drain()
        self._last = None
        link.write(net_ft.encode_request(Request(Command.START)))
        identity = Identity("ATI", "Net F/T", self._address, "")
        return Greeting(identity, self._settings.rated, self._period_s, numbered=True)

    def take(self, data: bytes) -> list[Reading]:
        """Return the samples of one datagram that are newer than all before."""
        if not data:
            return []
        try:
            records = net_ft.decode_records(data)
        except WireError:
            self._bad += 1
            self._bad_in_a_row += 1
            self._discarded += len(data)
            return []
        self._bad_in_a_row = 0
        return [reading for record in records if (reading := self._reading(record))]

    @property
    def refusals(self) -> Refusals:
        """Datagrams that were none."""
        return Refusals(self._bad, self._bad_in_a_row, self._discarded)

    def stop(self, link: Link) -> None:
        """Three times: a datagram may be lost."""
        for _ in range(3):
            link.write(net_ft.encode_request(Request(Command.STOP)))

    def _reading(self, record: Record) -> Reading | None:
        missed, last = 0, self._last
        if last is not None:
            step = (record.rdt_sequence - last) % SEQUENCE_TURN
            if step == 0 or step > SEQUENCE_TURN // 2:
                return None
            missed = step - 1
        self._last = record.rdt_sequence
        trouble = f"The sensor reports status {record.status:08X}h" if record.status else ""
        return Reading(record.wrench(*self._counts), missed, trouble=trouble)

    def _scale(self, link: Link) -> tuple[float, float]:
        """Return counts per N and per N·m: from the page, the TCP channel, else the settings."""
        if self._settings.onrobot:
            return ONROBOT_COUNTS
        host = link.host if isinstance(link, UdpLink) else ""
        for tell in (self._page, self._calibration):
            try:
                return tell(host)
            except (OSError, http.client.HTTPException):
                continue
        if self._settings.counts is None:
            raise NotAnsweredError("The box does not tell its scale, and netft.counts is unset")
        return self._settings.counts

    def _page(self, host: str) -> tuple[float, float]:
        connection = http.client.HTTPConnection(host, self._settings.http_port, timeout=ANSWER_S)
        try:
            connection.request("GET", PAGE)
            answer = connection.getresponse()
            content = answer.read(PAGE_BYTES)
        finally:
            connection.close()
        if answer.status != http.client.OK:
            raise OSError(f"status {answer.status}")
        return net_ft.decode_page(content)

    def _calibration(self, host: str) -> tuple[float, float]:
        with socket.create_connection((host, self._settings.tcp_port), timeout=ANSWER_S) as line:
            line.sendall(TCP_REQUEST)
            heard = b""
            while len(heard) < CALIBRATION_BYTES and (more := line.recv(CALIBRATION_BYTES)):
                heard += more
        told = net_ft.decode_calibration(heard)
        return float(told.counts_per_n), float(told.counts_per_nm)
