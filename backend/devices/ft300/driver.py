"""Driver of Robotiq FT300 sensors.

Modbus until the stream starts; 50 bytes of FFh end it.
"""

from __future__ import annotations

import threading

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import (
    FramedDriver,
    SensorDescription,
    SensorLink,
    WrenchReading,
    pause,
)
from touchdown.backend.devices.ft300 import protocol
from touchdown.backend.devices.protocols import Identity

RATED = (300.0, 300.0, 300.0, 30.0, 30.0, 30.0)
PERIOD_S = 0.01
PAUSE_S = ANSWER_S = 0.5
SERIAL_WORDS, FIRMWARE_WORDS = 4, 3


class Ft300Driver(FramedDriver[protocol.Ft300Message]):
    """Samples are not numbered: a rejected frame counts as one lost sample."""

    baud = 19_200
    chunk = protocol.FRAME_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__(protocol.incoming())
        self._address = address

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """End an old stream, read serial number and firmware, start the stream."""
        self.stop(link)
        pause(cancel, PAUSE_S)
        link.drain()
        self._decoder.reset()
        serial = self._text(link, cancel, protocol.SERIAL_REGISTER, SERIAL_WORDS)
        firmware = self._text(link, cancel, protocol.FIRMWARE_REGISTER, FIRMWARE_WORDS)
        request = protocol.encode(
            protocol.WriteRegisters(protocol.STREAM_REGISTER, (protocol.STREAM_ON,))
        )
        started = (protocol.ModbusWritten, protocol.Ft300Sample)
        self.ask(link, cancel, request, started, limit_s=ANSWER_S)
        self.newly_bad()
        return SensorDescription(Identity("Robotiq", "FT300", serial, firmware), RATED, PERIOD_S)

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples of the stream."""
        samples = (m for m in self._decoder.feed(data) if isinstance(m, protocol.Ft300Sample))
        return [WrenchReading(sample.wrench(), self.newly_bad()) for sample in samples]

    def stop(self, link: SensorLink) -> None:
        """End the stream."""
        link.write(protocol.encode(protocol.StreamStop()))

    def _text(self, link: SensorLink, cancel: threading.Event, register: int, words: int) -> str:
        request = protocol.encode(protocol.ReadRegisters(register, words))
        found = self.ask(
            link,
            cancel,
            request,
            protocol.RegisterValues,
            lambda message: len(message.values) == words,
            limit_s=ANSWER_S,
        )
        content = b"".join(value.to_bytes(2, "big") for value in found.values)
        text = content.decode("ascii", "replace").strip("\x00 ")
        return text if text.isprintable() and text else content.hex()
