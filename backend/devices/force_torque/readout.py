"""From the readings of a sensor to stamped wrenches in tool axes; what is no measurement is NaN."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from backend.config.hardware import ForceTorqueSettings
from backend.core.flow import FloatArray
from backend.devices.force_torque.language import Reading
from backend.devices.force_torque.sample_clock import SampleClock
from backend.wire.wrench import NO_WRENCH, Wrench

LEAST_S = 1e-6
"""Stamps rise by at least this much."""
LATE_S = 0.01
"""A delay of the wire up to this is no loss, if nobody says otherwise."""


class Readout:
    """Counts what is missing and notices a stuck sensor; the caller owns the clock.

    ``late_s``: how late the wire may be without a loss. ``numbered``: the sensor's own count shows
    every loss; else a loss that nobody counted is found by what comes late ever after.

    ``stuck``: the newest ``stuck_after`` samples or more are equal to the last digit, which no
    living sensor is. ``overload`` and ``trouble`` stay once they have been seen.
    """

    def __init__(
        self,
        settings: ForceTorqueSettings,
        period_s: float,
        late_s: float = LATE_S,
        *,
        numbered: bool = False,
    ) -> None:
        self._settings, self.period_s = settings, period_s
        self._clock, self._numbered = SampleClock(period_s, late_s), numbered
        self._number = 0
        self._turn = settings.sign * np.array(settings.rotation)
        self._newest_s = -np.inf
        self._last: Wrench | None = None
        self._equal = 0
        self.lost = 0
        self.overload = False
        self.trouble = ""

    @property
    def stuck(self) -> bool:
        """Whether the sensor repeats itself."""
        return self._equal + 1 >= self._settings.stuck_after

    def accept(
        self, arrival_s: float, readings: Sequence[Reading]
    ) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and wrenches (n, 6), N and N·m in tool axes.

        Stamps follow the count of the sensor along the line of least delay, less the latency: a
        burst that comes late is spread over the time in which it was measured.
        """
        told = np.array([self._valid(reading) for reading in readings], dtype=np.float64)
        values = (told.reshape(-1, 2, 3) @ self._turn.T).reshape(-1, 6)
        return self._stamps(arrival_s - 1e-3 * self._settings.latency_ms, readings), values

    def _valid(self, reading: Reading) -> Wrench:
        """Return what a reading says in axes of the sensor, NaN where that is no measurement."""
        self.lost += reading.missed
        self.overload |= reading.overload
        self.trouble = self.trouble or reading.trouble
        self._equal = self._equal + 1 if reading.wrench == self._last else 0
        self._last = reading.wrench
        valid = not (reading.overload or reading.trouble or self.stuck)
        return reading.wrench if valid else NO_WRENCH

    def _stamps(self, arrival_s: float, readings: Sequence[Reading]) -> FloatArray:
        if not readings:
            return np.empty(0)
        numbers = self._number + np.cumsum([reading.missed + 1 for reading in readings])
        self._number = int(numbers[-1])
        missing = self._clock.feed(arrival_s, self._number)
        self.lost += 0 if self._numbered else missing
        stamps = self._clock.taken_s(numbers)
        if stamps[0] <= self._newest_s:
            # The line was too late so far: time goes on, as slowly as it takes.
            last_s = max(float(stamps[-1]), self._newest_s + LEAST_S * len(stamps))
            stamps = np.linspace(self._newest_s, last_s, len(readings) + 1)[1:]
        self._newest_s = float(stamps[-1])
        return np.asarray(stamps, dtype=np.float64)
