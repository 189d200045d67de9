"""Driver of a DynPick sensor."""

from __future__ import annotations

import threading
from operator import sub

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.dynpick.protocol import (
    END,
    ZERO_COUNT,
    Command,
    Record,
    decode_sensitivity,
)
from touchdown.backend.devices.force_torque import Greeting, Link, Reading, Refusals, listen, pause
from touchdown.backend.devices.protocols import Identity

PERIOD_S = 0.001
SETTLE_S = 0.05
ANSWER_S = 0.3
LONGEST_ANSWER = 60


class DynpickLanguage:
    """The sensor has no checksum: one sample that leaps by more than ``max_step`` is left out.

    If the next agrees with it, the load really changed.
    """

    baud = 921_600
    chunk = 2 * protocol.RECORD_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._settings, self._address = settings.dynpick, address
        self._sensitivity: tuple[float, ...] = settings.dynpick.sensitivity
        self._decoder = protocol.records()
        self._last: Record | None = None
        self._kept: Record | None = None
        self._missed = 0

    def start(self, link: Link, cancel: threading.Event) -> Greeting:
        """Stop an old stream, ask for the sensitivities (older types do not tell), start."""
        link.write(Command.STOP.value)
        pause(cancel, SETTLE_S)
        link.drain()
        link.write(Command.SENSITIVITY.value)
        heard = bytearray()

        def whole(data: bytes) -> bytes | None:
            heard.extend(data)
            return bytes(heard) if heard.endswith(END) or len(heard) > LONGEST_ANSWER else None

        if listen(link, cancel, ANSWER_S, whole) or heard:
            self._sensitivity = decode_sensitivity(bytes(heard))
        link.write(Command.FILTER_1.value + Command.START.value)
        rated = tuple(ZERO_COUNT / per_unit for per_unit in self._sensitivity)
        # The sensor tells no number, so the port stands for it.
        return Greeting(Identity("WACOH-TECH", "Dynpick", self._address, ""), rated, PERIOD_S)

    def take(self, data: bytes) -> list[Reading]:
        """Return the plausible samples."""
        return [self._reading(r) for r in self._decoder.feed(data) if self._plausible(r)]

    @property
    def refusals(self) -> Refusals:
        """Records that were none."""
        decoder = self._decoder
        return Refusals(decoder.bad_frames, decoder.bad_in_a_row, decoder.discarded)

    def stop(self, link: Link) -> None:
        """End the stream."""
        link.write(Command.STOP.value)

    def _plausible(self, record: Record) -> bool:
        last, self._last = self._last, record
        if last is not None:
            gap = (record.tick - last.tick - self._settings.tick_step) % 10
            self._missed += gap // self._settings.tick_step
        near = self._kept is None or self._near(record, self._kept)
        if not near and (last is None or last is self._kept or not self._near(record, last)):
            self._missed += 1
            return False
        self._kept = record
        return True

    def _near(self, first: Record, second: Record) -> bool:
        leap: int = max(map(abs, map(sub, first.counts, second.counts)))
        return leap <= self._settings.max_step

    def _reading(self, record: Record) -> Reading:
        missed, self._missed = self._missed, 0
        low, high = self._settings.saturation
        overload = min(record.counts) <= low or max(record.counts) >= high
        return Reading(record.wrench(self._sensitivity), missed, overload)
