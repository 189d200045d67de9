"""From bytes to stamped wrenches: stamps, losses, jumps, mounting."""

import numpy as np
import pytest

from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.devices.dynpick.driver import PERIOD_S, DynpickDriver
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.dynpick.protocol import DynpickRecord, encode_record
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.supervision import RateMonitor
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults
from touchdown.backend.sensing.zeroing import WrenchDriftEstimator

ZERO = 0x2000
PER_UNIT = (100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0)


class Samples:
    """Language and readout of one connection, without a wire."""

    def __init__(self, **mounting):
        settings = HardwareSettings.model_validate({"dynpick": {"sensitivity": PER_UNIT}})
        self.language = DynpickDriver(settings, "")
        self.readout = WrenchStamper(ForceTorqueSettings(**mounting), PERIOD_S)

    def accept(self, arrival_s, data):
        return self.readout.accept(arrival_s, self.language.take(data))

    @property
    def lost(self):
        return self.readout.lost

    @property
    def overload(self):
        return self.readout.overload


samples = Samples


def stream(*loads, tick=0):
    return b"".join(
        encode_record(DynpickRecord((tick + i) % 10, (ZERO + x, ZERO, ZERO, ZERO, ZERO, ZERO)))
        for i, x in enumerate(loads)
    )


def test_a_burst_is_spread_by_the_period():
    stamps, values = samples().accept(5.0, stream(100, 200, 300))
    assert stamps == pytest.approx([4.998, 4.999, 5.0])
    assert values[:, 0] == pytest.approx([1.0, 2.0, 3.0])


def test_stamps_rise_even_if_bursts_overlap():
    reading = samples()
    first, _ = reading.accept(5.0, stream(0))
    second, _ = reading.accept(5.001, stream(*[0] * 8, tick=1))
    assert np.all(np.diff(np.concatenate([first, second])) > 0)
    assert second[-1] == 5.001


def test_a_record_in_two_reads_is_one_sample():
    reading = samples()
    content = stream(100)
    assert len(reading.accept(1.0, content[:10])[0]) == 0
    stamps, values = reading.accept(1.5, content[10:])
    assert stamps == [1.5]
    assert values.shape == (1, 6)


def test_missing_ticks_are_counted():
    reading = samples()
    reading.accept(1.0, stream(0, 0))
    reading.accept(1.1, stream(0, tick=5))
    assert reading.lost == 3


@pytest.mark.promise("S2")
def test_one_leap_is_left_out_and_counted():
    reading = samples()
    _, values = reading.accept(1.0, stream(0, 0, 5000, 0, 0))
    assert values[:, 0].tolist() == [0.0] * 4
    assert reading.lost == 1


@pytest.mark.promise("S2")
def test_a_leap_that_stays_is_a_load():
    _, values = samples().accept(1.0, stream(0, 0, 5000, 5001, 5002))
    assert values[:, 0] == pytest.approx([0.0, 0.0, 50.01, 50.02])


@pytest.mark.promise("S2")
def test_two_different_leaps_are_both_left_out():
    _, values = samples().accept(1.0, stream(0, 0, 5000, -5000, 0))
    assert values[:, 0].tolist() == [0.0] * 3


def test_the_ends_of_the_range_are_an_overload():
    reading = samples()
    reading.accept(1.0, stream(0x1FFE))
    assert not reading.overload
    reading.accept(1.1, stream(0x1FFF, tick=1))
    assert reading.overload


def test_mounting_and_sign_turn_force_and_torque():
    quarter = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    content = encode_record(DynpickRecord(0, (ZERO + 100, ZERO, ZERO, ZERO + 100, ZERO, ZERO)))
    _, values = samples(rotation=quarter, sign=-1).accept(1.0, content)
    assert values[0] == pytest.approx([0.0, -1.0, 0.0, 0.0, -0.1, 0.0])


def test_an_emulated_sensor_that_slows_down_is_slow_and_not_silent_and_gets_its_pace_back():
    faults, now_s = Faults("force_torque"), 0.0
    faults.begin(now_s)
    rng = np.random.default_rng(4)
    sensor = EmulatedDynpick(lambda now_s: (0.0, 0.0, rng.normal(-10.0, 0.1), 0.0, 0.0, 0.0))
    sensor.pace.faults = faults
    sensor.receive(now_s, b"S")
    made, rate, oldest_s = samples(), RateMonitor(), 0.0

    def deliver(seconds):
        nonlocal now_s, oldest_s
        for _ in range(round(100 * seconds)):
            now_s += 0.01
            stamps_s, _ = made.accept(now_s, sensor.due(now_s))
            rate.note(float(stamps_s[-1]), len(stamps_s), lambda: 1.0 / PERIOD_S)
            oldest_s = max(oldest_s, now_s - float(stamps_s[-1]))
        return rate.slow_since_s

    assert deliver(1.5) is None
    faults.inject(now_s, "slow", 2.5, hz=450.0)
    assert deliver(2.5) == pytest.approx(1.5, abs=0.6)
    assert deliver(6.0) is None
    assert made.readout._clock.period_s == pytest.approx(PERIOD_S, rel=1e-3)
    assert oldest_s < 0.3, "no fault: it was never silent"


@pytest.mark.promise("S8")
def test_an_emulated_sensor_that_drifts_is_named_by_what_the_reader_reads():
    faults, now_s, watch = Faults("force_torque"), 0.0, WrenchDriftEstimator()
    faults.begin(now_s)
    hangs = add_noise(lambda now_s: (0.0, 0.0, -14.7, 0.0, 0.0, 0.0))
    sensor = EmulatedDynpick(apply_faults(hangs, faults))
    sensor.pace.faults = faults
    sensor.receive(now_s, b"S")
    language = DynpickDriver(HardwareSettings(), "")
    readout = WrenchStamper(ForceTorqueSettings(), PERIOD_S)
    faults.inject(6.0, "drift", n_per_s=0.05)
    while now_s < 30.0 and not ((found := watch.drift()) and found.named):
        now_s += 0.1
        stamps_s, wrench = readout.accept(now_s, language.take(sensor.due(now_s)))
        watch.feed(stamps_s, wrench[:, :3])
    assert 0.45 < 0.05 * (now_s - 6.0) < 0.75, "before it reaches 1 N"
    assert found.moved_n == pytest.approx(0.05 * (now_s - 6.0), abs=0.1)
