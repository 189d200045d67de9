"""Emulated OptoForce HEX sensor.

Silent until configured, then frames with a count.
"""

from __future__ import annotations

from functools import partial

from touchdown.backend.devices.optoforce import protocol
from touchdown.backend.emulation import SerialSensor, WrenchFunction, serve_serial

COUNTS = (10_000.0, 10_000.0, 10_000.0, 10_000.0, 10_000.0, 10_000.0)
CAPACITY = (200.0, 200.0, 200.0, 6.5, 6.5, 6.5)
PER_UNIT = tuple(count / load for count, load in zip(COUNTS, CAPACITY, strict=True))
COUNT_TURN = 1 << 16
BAD_CONFIG = 1
_LIMIT = 0x7FFF
_OVERLOAD_BITS = (9, 8, 7, 6, 5, 4)


class EmulatedOptoforce(SerialSensor[protocol.OptoforceConfig]):
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m."""

    def __init__(self, wrench: WrenchFunction) -> None:
        super().__init__(wrench, protocol.requests())
        self._count = 0
        self._zero: tuple[int, ...] = (0,) * 6

    def _answer(self, now_s: float, request: protocol.OptoforceConfig) -> bytes:
        if request.speed not in protocol.SPEED_HZ or request.filter not in protocol.FILTER_HZ:
            return protocol.encode(protocol.OptoforceAck(BAD_CONFIG))
        self._zero = (
            self._counts(now_s, PER_UNIT) if request.zero == protocol.ZERO_NOW else (0,) * 6
        )
        rate_hz = protocol.SPEED_HZ[request.speed]
        if rate_hz:
            self.pace.begin(now_s, 1.0 / rate_hz)
        else:
            self.pace.end()
        return protocol.encode(protocol.OptoforceAck(0))

    def _skip(self, lost: int) -> None:
        self._count = (self._count + lost) % COUNT_TURN

    def _frame(self, now_s: float) -> bytes:
        raw = self._counts(now_s, PER_UNIT)
        status = 0
        for bit, count, full in zip(_OVERLOAD_BITS, raw, COUNTS, strict=True):
            status |= (abs(count) > full) << bit
        zeroed = (min(max(c - z, -_LIMIT), _LIMIT) for c, z in zip(raw, self._zero, strict=True))
        frame = protocol.OptoforceFrame(self._count, status, tuple(zeroed))
        self._count = (self._count + 1) % COUNT_TURN
        return protocol.encode(frame)


# The data sheet of the sensor for the bench file.
_TABLES = {"optoforce": {"counts": list(COUNTS), "capacity": list(CAPACITY)}}
emulate_optoforce = partial(serve_serial, EmulatedOptoforce, tables=_TABLES)
