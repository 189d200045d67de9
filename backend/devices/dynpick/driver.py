"""Driver of WACOH-TECH Dynpick sensors.

Detects losses, single outliers and values at the ends of the range.
"""

from __future__ import annotations

import threading
from operator import sub

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices import force_torque
from touchdown.backend.devices.dynpick import protocol
from touchdown.backend.devices.dynpick.protocol import DynpickCommand, DynpickRecord
from touchdown.backend.devices.protocols import Identity

PERIOD_S = 0.001
SETTLE_S = 0.05
ANSWER_S = 0.3
LONGEST_ANSWER = 60


class DynpickDriver(force_torque.FramedDriver[DynpickRecord]):
    """The protocol has no checksum: a single sample that differs by more than ``max_step`` is
    dropped. If the next one agrees with it, the load has changed.
    """

    baud = 921_600
    chunk = 2 * protocol.RECORD_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__(protocol.records())
        self._settings, self._address = settings.dynpick, address
        self._sensitivity: tuple[float, ...] = settings.dynpick.sensitivity
        self._last: DynpickRecord | None = None
        self._kept: DynpickRecord | None = None
        self._missed = 0

    def start(
        self, link: force_torque.SensorLink, cancel: threading.Event
    ) -> force_torque.SensorDescription:
        """Stop an old stream, read the sensitivities (older types do not answer), start."""
        link.write(DynpickCommand.STOP.value)
        force_torque.pause(cancel, SETTLE_S)
        link.drain()
        link.write(DynpickCommand.SENSITIVITY.value)
        heard = bytearray()

        def answered(data: bytes) -> bool | None:
            heard.extend(data)
            whole = heard.endswith(protocol.END) or len(heard) > LONGEST_ANSWER
            return True if whole else None

        if force_torque.listen(link, cancel, ANSWER_S, answered) or heard:
            self._sensitivity = protocol.decode_sensitivity(bytes(heard))
        link.write(DynpickCommand.FILTER_1.value + DynpickCommand.START.value)
        rated = tuple(protocol.ZERO_COUNT / per_unit for per_unit in self._sensitivity)
        # The sensor has no readable serial number: the port replaces it.
        return force_torque.SensorDescription(
            Identity("WACOH-TECH", "Dynpick", self._address, ""), rated, PERIOD_S
        )

    def take(self, data: bytes) -> list[force_torque.WrenchReading]:
        """Return the plausible samples."""
        return [self._reading(r) for r in self._decoder.feed(data) if self._plausible(r)]

    def stop(self, link: force_torque.SensorLink) -> None:
        """End the stream."""
        link.write(DynpickCommand.STOP.value)

    def _plausible(self, record: DynpickRecord) -> bool:
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

    def _near(self, first: DynpickRecord, second: DynpickRecord) -> bool:
        leap: int = max(map(abs, map(sub, first.counts, second.counts)))
        return leap <= self._settings.max_step

    def _reading(self, record: DynpickRecord) -> force_torque.WrenchReading:
        missed, self._missed = self._missed, 0
        low, high = self._settings.saturation
        overload = min(record.counts) <= low or max(record.counts) >= high
        return force_torque.WrenchReading(record.wrench(self._sensitivity), missed, overload)
