"""Emulated Dynpick sensor.

Commands in, records out: a function of time and bytes.
"""

from __future__ import annotations

from functools import partial

from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.dynpick.protocol import DynpickCommand
from touchdown.backend.emulation import SerialSensor, WrenchFunction, serve_serial

RATE_HZ = 1000.0
SENSITIVITY = (65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75)
TEMPERATURE_C = 27.5
VERSION = b"Touchdown emulated Dynpick\r\n"
_DIVIDERS = {
    DynpickCommand.FILTER_1: 1,
    DynpickCommand.FILTER_2: 2,
    DynpickCommand.FILTER_4: 4,
    DynpickCommand.FILTER_8: 8,
}


class EmulatedDynpick(SerialSensor[DynpickCommand]):
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m in sensor axes. Without
    ``tells_sensitivity`` it is an older type that does not answer ``p``.
    """

    def __init__(self, wrench: WrenchFunction, *, tells_sensitivity: bool = True) -> None:
        super().__init__(wrench, protocol.command_stream())
        self._tells_sensitivity = tells_sensitivity
        self._offset: tuple[int, ...] = (0,) * 6
        self._divider, self._tick = 1, 0

    def _answer(self, now_s: float, command: DynpickCommand) -> bytes:
        match command:
            case DynpickCommand.READ:
                return self._frame(now_s)
            case DynpickCommand.SENSITIVITY if self._tells_sensitivity:
                return protocol.encode_sensitivity(SENSITIVITY)
            case DynpickCommand.TEMPERATURE:
                return protocol.encode_temperature(TEMPERATURE_C)
            case DynpickCommand.VERSION:
                return VERSION
            case DynpickCommand.FILTER_QUERY:
                return protocol.encode_filter(self._divider)
            case DynpickCommand.START:
                self.pace.begin(now_s, self._divider / RATE_HZ)
            case DynpickCommand.STOP:
                self.pace.end()
            case DynpickCommand.OFFSET_RESET:
                self._offset = self._counts(now_s, SENSITIVITY)
            case _ if command in _DIVIDERS:
                self._divider = _DIVIDERS[command]
                if self.pace.running:
                    self.pace.begin(now_s, self._divider / RATE_HZ)
        return b""

    def _skip(self, lost: int) -> None:
        self._tick = (self._tick + lost) % 10

    def _frame(self, now_s: float) -> bytes:
        pairs = zip(self._counts(now_s, SENSITIVITY), self._offset, strict=True)
        counts = tuple(
            min(max(protocol.ZERO_COUNT + c - o, 0), protocol.TOP_COUNT) for c, o in pairs
        )
        record = protocol.DynpickRecord(self._tick, counts)
        self._tick = (self._tick + 1) % 10
        return protocol.encode_record(record)


emulate_dynpick = partial(serve_serial, EmulatedDynpick)
