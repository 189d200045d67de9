"""The report on time: sensors of known rate, delay and gaps on a hand-wound clock."""

from __future__ import annotations

import math

import numpy as np
import pytest

from touchdown.backend.core.clock import ManualClock
from touchdown.backend.core.streams import SampleStream
from touchdown.backend.rig.diagnostics import SensorTiming, measure_timing


class Sensor:
    """Delivers a sample every ``period_us``, stamped ``delay_us`` before it comes."""

    def __init__(self, clock: ManualClock, period_us: int, delay_us: int, silent=range(0)) -> None:
        self.stream = SampleStream("sensor", 1, 10_000)
        self._clock, self._period_us, self._delay_us = clock, period_us, delay_us
        self._silent = silent

    def come(self, before_us: int) -> None:
        for at_us in range(before_us + 1, self._clock.now_us + 1):
            if at_us % self._period_us == 0 and at_us // self._period_us not in self._silent:
                self.stream.put(np.array([1e-6 * (at_us - self._delay_us)]), np.zeros((1, 1)))

    def newest(self) -> float:
        count = self.stream.count
        return self.stream.since(count - 1).t_s[-1] if count else math.nan

    def since(self, t_s: float) -> np.ndarray:
        return self.stream.window(t_s, math.inf).t_s


@pytest.fixture
def report() -> dict[str, SensorTiming]:
    clock = ManualClock()
    sensors = {
        "steady": Sensor(clock, 4000, 1000),
        "late": Sensor(clock, 40_000, 30_000),
        "holes": Sensor(clock, 10_000, 0, silent=range(50, 56)),
        "silent": Sensor(clock, 10_000, 0, silent=range(10**6)),
    }

    def wait(seconds: float) -> None:
        before_us = clock.now_us
        clock.advance(round(1e6 * seconds))
        for sensor in sensors.values():
            sensor.come(before_us)

    streams = {name: (one.newest, one.since) for name, one in sensors.items()}
    return {one.name: one for one in measure_timing(streams, clock.now_s, wait, 2.0)}


def test_each_sensor_is_told_by_its_rate_its_age_and_its_gaps(report) -> None:
    steady, late, holes = report["steady"], report["late"], report["holes"]
    assert steady.rate_hz == pytest.approx(250.0)
    assert (steady.spread_ms, steady.gap_ms) == pytest.approx((0.0, 4.0), abs=1e-6)
    assert steady.age_ms == pytest.approx(1.0)
    assert late.rate_hz == pytest.approx(25.0)
    assert (late.age_ms, late.late_ms) == pytest.approx((30.0, 30.0))
    assert holes.gap_ms == pytest.approx(70.0)
    assert holes.age_ms == pytest.approx(0.0, abs=1e-6)


def test_of_a_silent_sensor_nothing_is_told(report) -> None:
    assert report["silent"].samples == 0
    assert math.isnan(report["silent"].rate_hz)
