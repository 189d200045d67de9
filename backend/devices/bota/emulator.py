"""Emulated Bota SensONE sensor.

Streams from power-on, is configured by text, counts microseconds.
"""

from __future__ import annotations

from functools import partial

from touchdown.backend.devices.bota import protocol
from touchdown.backend.emulation import SerialSensor, WrenchFunction, serve_serial

RATED = (500.0, 500.0, 1200.0, 15.0, 15.0, 12.0)
TEMPERATURE_C = 27.5
DEFAULT_SINC = 512
TIMESTAMP_TURN = 1 << 32


class EmulatedBota(SerialSensor[protocol.BotaRequest]):
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m."""

    def __init__(self, wrench: WrenchFunction) -> None:
        super().__init__(wrench, protocol.requests())
        self._sinc = DEFAULT_SINC
        self._booted = self._configuring = False

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process text commands; return the answers, after the boot text for a new client."""
        return self._boot(now_s) + super().receive(now_s, data)

    def due(self, now_s: float) -> bytes:
        """Return the boot text once, then the frames up to now."""
        return self._boot(now_s) + super().due(now_s)

    def closed(self, now_s: float) -> None:
        """Restart for the next client, like a sensor powered by its plug."""
        self._booted = self._configuring = False
        self._sinc = DEFAULT_SINC
        self.pace.end()
        self._requests = protocol.requests()

    def _boot(self, now_s: float) -> bytes:
        if self._booted:
            return b""
        self._booted = True
        self.pace.begin(now_s, self._period_s)
        return protocol.encode(protocol.BotaBoot())

    @property
    def _period_s(self) -> float:
        return self._sinc * protocol.SINC_STEP_S

    def _answer(self, now_s: float, request: protocol.BotaRequest) -> bytes:
        if request.command == "C":
            self._configuring = True
            self.pace.end()
        elif not self._configuring:
            return b""
        elif request.command == "f":
            self._sinc = request.arguments[0]
        elif request.command == "R":
            self._configuring = False
            self.pace.begin(now_s + self._period_s, self._period_s)
        return protocol.encode(protocol.BotaReply(request.command, 0))

    def _frame(self, now_s: float) -> bytes:
        values = tuple(self._wrench(now_s))
        over = any(abs(v) > rated for v, rated in zip(values, RATED, strict=True))
        status = int(protocol.BotaStatus.OVER_RANGE) if over else 0
        timestamp_us = round(now_s * 1e6) % TIMESTAMP_TURN
        return protocol.encode(protocol.BotaFrame(status, values, timestamp_us, TEMPERATURE_C))


emulate_bota = partial(serve_serial, EmulatedBota)
