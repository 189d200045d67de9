"""Driver of Leptrino PFS and CFS sensors.

The rated loads, read from the sensor, are the scale.
"""

from __future__ import annotations

import threading
from typing import TypeVar

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices import force_torque
from touchdown.backend.devices.leptrino import protocol
from touchdown.backend.devices.leptrino.protocol import LeptrinoCommand, PlainFrame
from touchdown.backend.devices.protocols import Identity

RATE_HZ = 1000.0
SETTLE_S = 0.05
AnswerT = TypeVar(
    "AnswerT", protocol.SensorInfo, protocol.RatedLoads, PlainFrame, protocol.FilterSetting
)


class LeptrinoDriver(force_torque.FramedDriver[protocol.Packet]):
    """Samples are not numbered: a rejected frame counts as one lost sample."""

    baud = 460_800
    chunk = 50

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__(protocol.packets())
        self._rate_hz = settings.ft.rate_hz or RATE_HZ
        self._rated: tuple[float, ...] = ()

    def start(
        self, link: force_torque.SensorLink, cancel: threading.Event
    ) -> force_torque.SensorDescription:
        """Stop twice, read identity and rated loads, start the stream."""
        for _ in range(2):
            link.write(protocol.encode(PlainFrame(LeptrinoCommand.STOP)))
            force_torque.pause(cancel, SETTLE_S)
        link.drain()
        self._decoder.reset()
        info = self._ask(link, cancel, LeptrinoCommand.INFO, protocol.SensorInfo)
        self._rated = self._ask(link, cancel, LeptrinoCommand.RATED, protocol.RatedLoads).loads
        self._ask(link, cancel, LeptrinoCommand.START, PlainFrame)
        self.newly_bad()
        identity = Identity("Leptrino", info.model, info.serial, info.firmware)
        return force_torque.SensorDescription(identity, self._rated, 1.0 / self._rate_hz)

    def take(self, data: bytes) -> list[force_torque.WrenchReading]:
        """Return the samples."""
        samples = (p for p in self._decoder.feed(data) if isinstance(p, protocol.LeptrinoSample))
        return [self._reading(sample, self.newly_bad()) for sample in samples]

    def stop(self, link: force_torque.SensorLink) -> None:
        """End the stream."""
        link.write(protocol.encode(PlainFrame(LeptrinoCommand.STOP)))

    def _ask(
        self,
        link: force_torque.SensorLink,
        cancel: threading.Event,
        command: LeptrinoCommand,
        kind: type[AnswerT],
    ) -> AnswerT:
        def fits(packet: protocol.Packet) -> bool:
            return not isinstance(packet, PlainFrame) or packet == PlainFrame(command)

        return self.ask(link, cancel, protocol.encode(PlainFrame(command)), kind, fits)

    def _reading(self, sample: protocol.LeptrinoSample, missed: int) -> force_torque.WrenchReading:
        overload = (
            bool(sample.status & protocol.LeptrinoStatus.OVER_RATING)
            or max(map(abs, sample.counts)) >= protocol.CLIP
        )
        trouble = ""
        if sample.status & (protocol.LeptrinoStatus.SENSOR | protocol.LeptrinoStatus.CALIBRATION):
            trouble = f"The sensor reports a failure (status {sample.status})"
        return force_torque.WrenchReading(sample.wrench(self._rated), missed, overload, trouble)
