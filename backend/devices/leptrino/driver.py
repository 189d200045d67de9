"""Driver of Leptrino PFS and CFS sensors.

The rated loads, read from the sensor, are the scale.
"""

from __future__ import annotations

import threading
from typing import TypeVar

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import (
    FrameErrors,
    SensorDescription,
    SensorLink,
    WrenchReading,
    ask,
    pause,
)
from touchdown.backend.devices.leptrino import protocol
from touchdown.backend.devices.leptrino.protocol import (
    CLIP,
    FilterSetting,
    LeptrinoCommand,
    LeptrinoSample,
    LeptrinoStatus,
    Packet,
    PlainFrame,
    RatedLoads,
    SensorInfo,
)
from touchdown.backend.devices.protocols import Identity

RATE_HZ = 1000.0
SETTLE_S = 0.05
AnswerT = TypeVar("AnswerT", SensorInfo, RatedLoads, PlainFrame, FilterSetting)


class LeptrinoDriver:
    """Samples are not numbered: a rejected frame counts as one lost sample."""

    baud = 460_800
    chunk = 50

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._rate_hz = settings.ft.rate_hz or RATE_HZ
        self._decoder = protocol.packets()
        self._rated: tuple[float, ...] = ()
        self._seen_bad = 0

    def start(self, link: SensorLink, cancel: threading.Event) -> SensorDescription:
        """Stop twice, read identity and rated loads, start the stream."""
        for _ in range(2):
            link.write(protocol.encode(PlainFrame(LeptrinoCommand.STOP)))
            pause(cancel, SETTLE_S)
        link.drain()
        self._decoder.reset()
        info = self._ask(link, cancel, LeptrinoCommand.INFO, SensorInfo)
        self._rated = self._ask(link, cancel, LeptrinoCommand.RATED, RatedLoads).loads
        self._ask(link, cancel, LeptrinoCommand.START, PlainFrame)
        self._seen_bad = self._decoder.bad_frames
        identity = Identity("Leptrino", info.model, info.serial, info.firmware)
        return SensorDescription(identity, self._rated, 1.0 / self._rate_hz)

    def take(self, data: bytes) -> list[WrenchReading]:
        """Return the samples."""
        readings = []
        for packet in self._decoder.feed(data):
            if isinstance(packet, LeptrinoSample):
                missed = self._decoder.bad_frames - self._seen_bad
                self._seen_bad = self._decoder.bad_frames
                readings.append(self._reading(packet, missed))
        return readings

    @property
    def refusals(self) -> FrameErrors:
        """Counts of invalid frames."""
        decoder = self._decoder
        return FrameErrors(decoder.bad_frames, decoder.bad_in_a_row, decoder.discarded)

    def stop(self, link: SensorLink) -> None:
        """End the stream."""
        link.write(protocol.encode(PlainFrame(LeptrinoCommand.STOP)))

    def _ask(
        self,
        link: SensorLink,
        cancel: threading.Event,
        command: LeptrinoCommand,
        kind: type[AnswerT],
    ) -> AnswerT:
        def find(data: bytes) -> AnswerT | None:
            for packet in self._decoder.feed(data):
                if isinstance(packet, kind) and _answers(packet, command):
                    return packet
            return None

        return ask(link, cancel, protocol.encode(PlainFrame(command)), find)

    def _reading(self, sample: LeptrinoSample, missed: int) -> WrenchReading:
        overload = (
            bool(sample.status & LeptrinoStatus.OVER_RATING) or max(map(abs, sample.counts)) >= CLIP
        )
        trouble = ""
        if sample.status & (LeptrinoStatus.SENSOR | LeptrinoStatus.CALIBRATION):
            trouble = f"The sensor reports a failure (status {sample.status})"
        return WrenchReading(sample.wrench(self._rated), missed, overload, trouble)


def _answers(packet: Packet, command: LeptrinoCommand) -> bool:
    return not isinstance(packet, PlainFrame) or (packet.command == command and packet.code == 0)
