"""From the bytes of a Dynpick to stamped wrenches; losses, jumps and overload are noticed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from backend.config.hardware import DynpickSettings, ForceTorqueSettings
from backend.core.flow import FloatArray
from backend.wire import dynpick
from backend.wire.dynpick import Record

PERIOD_S = 0.001


class DynpickSamples:
    """Decodes a stream; the caller owns the port and the clock.

    The sensor has no checksum, so one sample that leaps by more than ``max_step`` counts is left
    out; if the next agrees with it, the load really changed.
    """

    def __init__(
        self, settings: DynpickSettings, mounting: ForceTorqueSettings, sensitivity: Sequence[float]
    ) -> None:
        self._settings, self._sensitivity = settings, tuple(sensitivity)
        self._turn = mounting.sign * np.array(mounting.rotation)
        self._decoder = dynpick.records()
        self._last: Record | None = None
        self._kept: Record | None = None
        self._newest_s = -np.inf
        self.lost = 0
        self.overload = False

    @property
    def bad_in_a_row(self) -> int:
        """Records refused since the last good one."""
        return self._decoder.bad_in_a_row

    def accept(self, arrival_s: float, data: bytes) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and wrenches (n, 6), N and N·m in tool axes, of the bytes ``data``.

        The newest is stamped ``arrival_s``, those that came with it one period apart before it.
        """
        records = [record for record in self._decoder.feed(data) if self._plausible(record)]
        values = np.array([self._value(record) for record in records]).reshape(-1, 6)
        return self._stamps(arrival_s, len(records)), values

    def _plausible(self, record: Record) -> bool:
        last, self._last = self._last, record
        if last is not None:
            gap = (record.tick - last.tick - self._settings.tick_step) % 10
            self.lost += gap // self._settings.tick_step
        near = self._kept is None or self._near(record, self._kept)
        if not near and (last is None or last is self._kept or not self._near(record, last)):
            self.lost += 1
            return False
        self._kept = record
        low, high = self._settings.saturation
        self.overload |= any(count <= low or count >= high for count in record.counts)
        return True

    def _near(self, first: Record, second: Record) -> bool:
        pairs = zip(first.counts, second.counts, strict=True)
        return max(abs(a - b) for a, b in pairs) <= self._settings.max_step

    def _value(self, record: Record) -> FloatArray:
        wrench = record.wrench(self._sensitivity)
        force, torque = self._turn @ wrench.force_n, self._turn @ wrench.torque_nm
        return np.concatenate([force, torque])

    def _stamps(self, arrival_s: float, count: int) -> FloatArray:
        stamps = arrival_s - PERIOD_S * np.arange(count - 1, -1, -1.0)
        if count and stamps[0] <= self._newest_s:
            stamps = np.linspace(self._newest_s, arrival_s, count + 1)[1:]
        if count:
            self._newest_s = float(stamps[-1])
        return stamps
