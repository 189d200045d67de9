"""Driver of OptoForce and OnRobot HEX sensors.

The scale comes from the sensor's data sheet.
"""

from __future__ import annotations

import threading

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError
from touchdown.backend.devices.force_torque import (
    FramedDriver,
    NotAnsweredError,
    SensorDescription,
    SensorLink,
    WrenchReading,
)
from touchdown.backend.devices.optoforce import protocol
from touchdown.backend.devices.protocols import Identity

COUNT_TURN = 1 << 16
OLD = 1000  # a count this much before the newest is late; an older one is a restart
SPEED, NO_FILTER = 1, 0


class OptoforceDriver(FramedDriver[protocol.OptoforceMessage]):
    """Losses are found by the sensor's count; raises ``InputError`` without a scale."""

    baud = 1_000_000
    chunk = 44

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__(protocol.incoming())
        counts, capacity = settings.optoforce.counts, settings.optoforce.capacity
        if counts is None or capacity is None:
            what = "The scale of this sensor is not known."
            fix = "Copy both from the data sheet of the very sensor into the bench file."
            raise InputError(what, "optoforce.counts, optoforce.capacity", fix)
        self._counts, self._capacity, self._address = counts, capacity, address
        self._last: int | None = None

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """Set the full rate without filter; the acknowledgement may come between frames."""
        link.drain()
        request = protocol.encode(protocol.OptoforceConfig(SPEED, NO_FILTER))
        ack = self.ask(link, cancel, request, protocol.OptoforceAck)
        if ack.status != 0:
            raise NotAnsweredError(f"The sensor refuses its configuration ({ack.status})")
        self._last = None
        identity = Identity("OnRobot", "HEX", self._address, "")
        return SensorDescription(
            identity, self._capacity, 1.0 / protocol.SPEED_HZ[SPEED], numbered=True
        )

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples of six axes."""
        frames = (m for m in self._decoder.feed(data) if isinstance(m, protocol.OptoforceFrame))
        whole = (frame for frame in frames if len(frame.counts) == 6)
        return [self._reading(frame) for frame in whole if not self._is_old(frame)]

    def stop(self, link: SensorLink) -> None:
        """Stop the stream."""
        link.write(protocol.encode(protocol.OptoforceConfig(0, NO_FILTER)))

    def _is_old(self, frame: protocol.OptoforceFrame) -> bool:
        """Return True if the frame is overtaken or repeated."""
        return self._last is not None and (self._last - frame.count) % COUNT_TURN <= OLD

    def _reading(self, frame: protocol.OptoforceFrame) -> WrenchReading:
        missed = 0 if self._last is None else (frame.count - self._last - 1) % COUNT_TURN
        self._last = frame.count
        trouble = ""
        if frame.daq or frame.sensor:
            trouble = f"The sensor reports a failure (unit {frame.daq}, sensor {frame.sensor})"
        wrench = frame.wrench(self._counts, self._capacity)
        return WrenchReading(wrench, missed, bool(frame.overload), trouble)
