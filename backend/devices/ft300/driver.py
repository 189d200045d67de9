"""Driver of Robotiq FT300 sensors.

Modbus until the stream starts; 50 bytes of FFh end it.
"""

from __future__ import annotations

import threading

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import (
    FrameErrors,
    SensorDescription,
    SensorLink,
    WrenchReading,
    ask,
    pause,
)
from touchdown.backend.devices.ft300 import protocol
from touchdown.backend.devices.ft300.protocol import (
    FIRMWARE_REGISTER,
    FRAME_BYTES,
    SERIAL_REGISTER,
    STREAM_ON,
    STREAM_REGISTER,
    Ft300Sample,
    ModbusWritten,
    ReadRegisters,
    RegisterValues,
    StreamStop,
    WriteRegisters,
)
from touchdown.backend.devices.protocols import Identity

RATED = (300.0, 300.0, 300.0, 30.0, 30.0, 30.0)
PERIOD_S = 0.01
PAUSE_S = 0.5
SERIAL_WORDS, FIRMWARE_WORDS = 4, 3


class Ft300Driver:
    """Samples are not numbered: a rejected frame counts as one lost sample."""

    baud = 19_200
    chunk = FRAME_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._address = address
        self._decoder = protocol.incoming()
        self._seen_bad = 0

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """End an old stream, read serial number and firmware, start the stream."""
        self.stop(link)
        pause(cancel, PAUSE_S)
        link.drain()
        self._decoder.reset()
        serial = self._text(link, cancel, SERIAL_REGISTER, SERIAL_WORDS)
        firmware = self._text(link, cancel, FIRMWARE_REGISTER, FIRMWARE_WORDS)
        request = protocol.encode(WriteRegisters(STREAM_REGISTER, (STREAM_ON,)))
        ask(link, cancel, request, self._started, limit_s=0.5)
        self._seen_bad = self._decoder.bad_frames
        return SensorDescription(Identity("Robotiq", "FT300", serial, firmware), RATED, PERIOD_S)

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples of the stream."""
        readings = []
        for message in self._decoder.feed(data):
            if isinstance(message, Ft300Sample):
                missed = self._decoder.bad_frames - self._seen_bad
                self._seen_bad = self._decoder.bad_frames
                overload = any(
                    abs(value) >= rated for value, rated in zip(_flat(message), RATED, strict=True)
                )
                readings.append(WrenchReading(message.wrench(), missed, overload))
        return readings

    @property
    def refusals(self) -> FrameErrors:
        """Counts of invalid frames."""
        decoder = self._decoder
        return FrameErrors(decoder.bad_frames, decoder.bad_in_a_row, decoder.discarded)

    def stop(self, link: SensorLink) -> None:
        """End the stream."""
        link.write(protocol.encode(StreamStop()))

    def _started(self, data: bytes) -> bool | None:
        messages = self._decoder.feed(data)
        return True if any(isinstance(m, ModbusWritten | Ft300Sample) for m in messages) else None

    def _text(self, link: SensorLink, cancel: threading.Event, register: int, words: int) -> str:
        def find(data: bytes) -> RegisterValues | None:
            messages = (m for m in self._decoder.feed(data) if isinstance(m, RegisterValues))
            return next((m for m in messages if len(m.values) == words), None)

        found = ask(
            link, cancel, protocol.encode(ReadRegisters(register, words)), find, limit_s=0.5
        )
        content = b"".join(value.to_bytes(2, "big") for value in found.values)
        text = content.decode("ascii", "replace").strip("\x00 ")
        return text if text.isprintable() and text else content.hex()


def _flat(sample: Ft300Sample) -> tuple[float, ...]:
    wrench = sample.wrench()
    return (*wrench.force_n, *wrench.torque_nm)
