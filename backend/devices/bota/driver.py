"""Driver of Bota SensONE and Rokubi sensors.

Configured by text; samples are numbered by the sensor's microsecond count.
"""

from __future__ import annotations

import threading

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.bota.protocol import BotaFrame, BotaRequest, BotaStatus
from touchdown.backend.devices.force_torque import (
    FramedDriver,
    NotAnsweredError,
    SensorDescription,
    SensorLink,
    UnansweredError,
    WrenchReading,
    listen,
    pause,
)
from touchdown.backend.devices.protocols import Identity

WAKE_S = 10.0
PAUSE_S = 0.5
ANSWER_S = 1.0
TIMESTAMP_TURN = 1 << 32
OLD_US = 1_000_000  # a timestamp this much before the newest is late; an older one is a restart


class BotaDriver(FramedDriver[protocol.BotaMessage]):
    """Losses are found by the sensor's timestamps."""

    baud = 460_800
    chunk = 2 * protocol.FRAME_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__(protocol.incoming())
        self._settings, self._address = settings.bota, address
        self._period_s = settings.bota.sinc * protocol.SINC_STEP_S
        self._last_us: int | None = None

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """Wait for the boot text or two frames; configure; run."""
        frames = 0

        def awake(data: bytes) -> bool | None:
            nonlocal frames
            for message in self._decoder.feed(data):
                frames += isinstance(message, BotaFrame)
                if isinstance(message, protocol.BotaBoot):
                    return True
            return True if frames >= 2 else None

        if listen(link, cancel, WAKE_S, awake) is None:
            raise UnansweredError
        pause(cancel, PAUSE_S)
        link.drain()
        self._decoder.reset()
        self._ask(link, cancel, BotaRequest("C"))
        self._ask(link, cancel, BotaRequest("c", (0, 1, 0, protocol.BAUD_CODES[self.baud])))
        self._ask(link, cancel, BotaRequest("f", (self._settings.sinc, 0, 0, 1)))
        self._ask(link, cancel, BotaRequest("R"))
        self._last_us = None
        identity = Identity("Bota Systems", "SensONE", self._address, "")
        return SensorDescription(identity, self._settings.rated, self._period_s, numbered=True)

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples; those marked invalid are NaN."""
        frames = (m for m in self._decoder.feed(data) if isinstance(m, BotaFrame))
        return [self._reading(frame) for frame in frames if not self._is_old(frame)]

    def stop(self, link: SensorLink) -> None:
        """Switch to configuration mode, in which the sensor is silent."""
        link.write(protocol.encode(BotaRequest("C")))

    def _ask(self, link: SensorLink, cancel: threading.Event, request: BotaRequest) -> None:
        reply = self.ask(
            link,
            cancel,
            protocol.encode(request),
            protocol.BotaReply,
            lambda message: message.command == request.command,
            limit_s=ANSWER_S,
        )
        if reply.code != 0:
            raise NotAnsweredError(f"The sensor refuses '{request.command}' ({reply.code})")

    def _is_old(self, frame: BotaFrame) -> bool:
        """Return True if the frame is overtaken or repeated."""
        if self._last_us is None:
            return False
        return (self._last_us - frame.timestamp_us) % TIMESTAMP_TURN <= OLD_US

    def _reading(self, frame: BotaFrame) -> WrenchReading:
        missed, last_us = 0, self._last_us
        self._last_us = frame.timestamp_us
        if last_us is not None:
            gap_us = (frame.timestamp_us - last_us) % TIMESTAMP_TURN
            steps = round(1e-6 * gap_us / self._period_s)
            missed = max(steps - 1, 0)
        trouble = "The sensor sends raw counts" if frame.status & BotaStatus.RAW else ""
        return WrenchReading(
            frame.wrench(), missed, bool(frame.status & BotaStatus.OVER_RANGE), trouble
        )
