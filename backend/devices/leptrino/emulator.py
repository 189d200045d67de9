"""Emulated Leptrino sensor.

Framed commands in, samples out: a function of time and bytes.
"""

import re
from functools import partial

from touchdown.backend.devices.framing import xor8
from touchdown.backend.devices.leptrino import protocol
from touchdown.backend.devices.leptrino.protocol import LeptrinoCommand, PlainFrame
from touchdown.backend.emulation import SerialSensor, WrenchFunction, serve_serial

RATED = (250.0, 250.0, 250.0, 6.0, 6.0, 6.0)
INFO = protocol.SensorInfo("PFS080YA501A6", "00012345", "1.13")
PERIOD_S = 0.001
LENGTH, UNDEFINED, VALUE = 1, 2, 3  # result codes of refused commands
FILTERS = 4
_FRAME = re.compile(rb"\x10\x02((?:[^\x10]|\x10\x10)*)\x10\x03(.)", re.DOTALL)


class EmulatedLeptrino(SerialSensor[protocol.Packet]):
    """Emulated sensor; ``wrench(now_s)`` returns (6,) N and N·m in sensor axes."""

    def __init__(self, wrench: WrenchFunction) -> None:
        self._decoder = protocol.packets()
        super().__init__(wrench, self._decoder)
        self._bad = 0

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process commands; the answer is NAK for a wrong check, a code for a wrong length."""
        out = super().receive(now_s, data)
        if self._decoder.bad_frames > self._bad:
            self._bad = self._decoder.bad_frames
            out = protocol.encode(_refusal(data)) + out
        return out

    def _answer(self, now_s: float, packet: protocol.Packet) -> bytes:
        return protocol.encode(self._reply(now_s, packet))

    def _frame(self, now_s: float) -> bytes:
        return protocol.encode(self._sample(now_s, LeptrinoCommand.START))

    def _reply(self, now_s: float, packet: protocol.Packet) -> protocol.Packet:
        command = getattr(packet, "command", None)
        if command == LeptrinoCommand.INFO:
            return INFO
        if command == LeptrinoCommand.RATED:
            return protocol.RatedLoads(RATED)
        if command == LeptrinoCommand.READ:
            return self._sample(now_s, LeptrinoCommand.READ)
        if command == LeptrinoCommand.GET_FILTER:
            return protocol.FilterSetting(LeptrinoCommand.GET_FILTER, 0)
        if command == LeptrinoCommand.START:
            self.pace.begin(now_s + PERIOD_S, PERIOD_S)
        elif command == LeptrinoCommand.STOP:
            self.pace.end()
        elif command != LeptrinoCommand.SET_FILTER:
            return PlainFrame(command or 0, UNDEFINED)
        elif not isinstance(packet, protocol.FilterSetting):
            return PlainFrame(command, LENGTH)
        elif packet.index >= FILTERS:
            return PlainFrame(command, VALUE)
        return PlainFrame(command)

    def _sample(self, now_s: float, command: LeptrinoCommand) -> protocol.LeptrinoSample:
        pairs = zip(self._wrench(now_s), RATED, strict=True)
        raw = [round(value / load * protocol.FULL_SCALE) for value, load in pairs]
        over = (
            protocol.LeptrinoStatus.OVER_RATING if max(map(abs, raw)) > protocol.FULL_SCALE else 0
        )
        return protocol.LeptrinoSample(
            command, tuple(min(max(c, -protocol.CLIP), protocol.CLIP) for c in raw), int(over)
        )


def _refusal(data: bytes) -> protocol.Packet:
    """Return the answer to a frame with a wrong length or check."""
    found = _FRAME.search(data)
    content = b"" if found is None else found[1].replace(b"\x10\x10", b"\x10")
    whole = found is not None and len(content) >= 3 and xor8(content) ^ protocol.ETX == found[2][0]
    return PlainFrame(content[2], LENGTH) if whole else protocol.LeptrinoNak()


emulate_leptrino = partial(serve_serial, EmulatedLeptrino)
