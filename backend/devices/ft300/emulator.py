"""Emulated Robotiq FT300 sensor.

Answers Modbus until the stream runs; then only bytes of FFh have an effect.
"""

from __future__ import annotations

from functools import partial

from touchdown.backend.devices.ft300 import protocol
from touchdown.backend.emulation import SerialSensor, WrenchFunction, serve_serial

PERIOD_S = 0.01
PER_UNIT = (100, 100, 100, 1000, 1000, 1000)
# Of a hand that points down and stands, thousandths of g.
ACCELERATION = (0, 0, -1000)
SERIAL, FIRMWARE, YEAR = b"F-12345\x00", b"FTS-3\x00", 2021
BAD_REGISTER = 2
_READ = 3
_LIMIT = 0x7FFF


class EmulatedFt300(SerialSensor[protocol.Ft300Request]):
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m in sensor axes."""

    def __init__(self, wrench: WrenchFunction) -> None:
        super().__init__(wrench, protocol.requests())

    def _answer(self, now_s: float, request: protocol.Ft300Request) -> bytes:
        if isinstance(request, protocol.StreamStop):
            self.pace.end()
            return b""
        if self.pace.running:
            return b""
        if isinstance(request, protocol.ReadRegisters):
            return protocol.encode(self._registers(now_s, request))
        wanted = request.value if isinstance(request, protocol.WriteRegister) else request.values[0]
        if request.register == protocol.STREAM_REGISTER and wanted == protocol.STREAM_ON:
            self.pace.begin(now_s, PERIOD_S)
        if isinstance(request, protocol.WriteRegisters):
            return protocol.encode(protocol.ModbusWritten(request.register, 1))
        return protocol.encode(request)

    def _frame(self, now_s: float) -> bytes:
        return protocol.encode(self._sample(now_s))

    def _registers(
        self, now_s: float, request: protocol.ReadRegisters
    ) -> protocol.RegisterValues | protocol.ModbusRefusal:
        counts = [count & 0xFFFF for count in self._sample(now_s).counts]
        blocks = {
            protocol.WRENCH_REGISTER: counts,
            protocol.ACCELERATION_REGISTER: [count & 0xFFFF for count in ACCELERATION],
            protocol.SERIAL_REGISTER: _words(SERIAL),
            protocol.FIRMWARE_REGISTER: _words(FIRMWARE),
            protocol.YEAR_REGISTER: [YEAR],
        }
        held = {first + k: word for first, block in blocks.items() for k, word in enumerate(block)}
        asked = range(request.register, request.register + request.count)
        if not asked or not all(register in held for register in asked):
            return protocol.ModbusRefusal(_READ, BAD_REGISTER)
        return protocol.RegisterValues(tuple(held[register] for register in asked))

    def _sample(self, now_s: float) -> protocol.Ft300Sample:
        counts = self._counts(now_s, PER_UNIT)
        return protocol.Ft300Sample(tuple(min(max(count, -_LIMIT), _LIMIT) for count in counts))


def _words(content: bytes) -> list[int]:
    return [int.from_bytes(content[at : at + 2], "big") for at in range(0, len(content), 2)]


emulate_ft300 = partial(serve_serial, EmulatedFt300)
