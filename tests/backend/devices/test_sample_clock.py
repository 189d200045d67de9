"""Stamps of a wrist sensor whose samples come late and in bursts, on a hand-wound clock."""

import random

import numpy as np
import pytest

from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.devices.dynpick.driver import DynpickDriver
from touchdown.backend.devices.dynpick.emulator import EmulatedDynpick
from touchdown.backend.devices.dynpick.protocol import RECORD_BYTES, DynpickCommand
from touchdown.backend.devices.force_torque.driver import WrenchReading
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.emulation.fault_plan import add_noise
from touchdown.backend.sensing.episode import wrench_on_ticks

PERIOD_S = 0.001
BEGUN_S = 100.0
LEAST_SHARE = 0.8
STEADY_S = np.arange(BEGUN_S, BEGUN_S + 3.0, 0.004)
AFTER_S = np.arange(BEGUN_S + 3.1, BEGUN_S + 6.0, 0.004)


def reading(number, missed=0):
    return WrenchReading(Wrench((float(number), 0.0, 0.0), (0.0, 0.0, 0.0)), missed)


class Stream:
    """A sensor whose clock is off by ``off``; ``wakes`` are the times at which it is read."""

    def __init__(self, off=2e-4, *, numbered=False, nominal_s=PERIOD_S):
        self.readout = WrenchStamper(ForceTorqueSettings(), nominal_s, numbered=numbered)
        self.period_s = PERIOD_S * (1.0 + off)
        self.taken = 0
        self.true_s, self.told_s = [], []

    def read(self, now_s, lost=0, missed=0, at_once=2):
        """Read all that was taken up to ``now_s``, but for the first ``lost``, two at a time."""
        numbers = [*range(self.taken + lost, int((now_s - BEGUN_S) / self.period_s) + 1)]
        if not numbers:
            return
        self.taken = numbers[-1] + 1
        for i in range(0, len(numbers), at_once):
            some = numbers[i : i + at_once]
            readings = [reading(n, missed if n == numbers[0] else 0) for n in some]
            stamps, _ = self.readout.accept(now_s + 1e-4 * i / at_once, readings)
            self.told_s.extend(stamps)
            self.true_s.extend(BEGUN_S + n * self.period_s for n in some)

    def errors(self, after_s=0.0):
        true_s, told_s = np.array(self.true_s), np.array(self.told_s)
        return (told_s - true_s)[true_s >= BEGUN_S + after_s]


def wakes(seconds, stall_share=0.02, seed=4):
    """Times at which a busy computer comes to read: every 2 ms, or after up to 150 ms."""
    rng, now_s = random.Random(seed), BEGUN_S
    while now_s < BEGUN_S + seconds:
        now_s += rng.uniform(0.02, 0.15) if rng.random() < stall_share else 0.002
        yield now_s


@pytest.mark.parametrize("off", [-1e-3, 0.0, 5e-3])
def test_late_bursts_are_stamped_with_the_time_in_which_they_were_measured(off):
    stream = Stream(off)
    for now_s in wakes(12.0):
        stream.read(now_s)
    assert np.all(np.diff(stream.told_s) > 0)
    assert np.abs(stream.errors(after_s=4.0)).max() < 0.003
    assert stream.readout.lost == 0


def test_no_tick_lacks_a_whole_reading_because_the_computer_was_busy():
    stream = Stream()
    for now_s in wakes(6.0, stall_share=0.1):
        stream.read(now_s)
    told_s = np.array(stream.told_s)
    ticks_s = np.arange(BEGUN_S + 0.5, stream.true_s[-1], 0.1)
    wrench = np.repeat(np.array(stream.true_s)[:, None], 6, axis=1)
    means = wrench_on_ticks(told_s, wrench, ticks_s, LEAST_SHARE)
    assert np.isfinite(means).all()
    assert np.abs(means[:, 0] - (ticks_s - 0.05)).max() < 0.005


def test_samples_lost_without_a_number_are_a_gap_of_their_length_and_counted():
    stream = Stream(off=0.0)
    for now_s in (*STEADY_S, *AFTER_S):
        stream.read(float(now_s), lost=40 if now_s == AFTER_S[0] else 0)
    assert stream.readout.lost == pytest.approx(40, abs=2)
    assert np.abs(stream.errors(after_s=4.0)).max() < 0.003


def test_a_numbered_gap_is_one_at_once():
    stream = Stream(numbered=True)
    for now_s in (*STEADY_S, *AFTER_S):
        lost = 40 if now_s == AFTER_S[0] else 0
        stream.read(float(now_s), lost, missed=lost)
    assert stream.readout.lost == 40
    assert np.abs(stream.errors(after_s=1.0)).max() < 0.003


@pytest.mark.parametrize("period_s", [0.002, 0.01])
def test_a_sensor_set_to_a_slower_rate_is_believed_and_not_called_lossy(period_s):
    stream = Stream(off=period_s / PERIOD_S - 1.0)
    for now_s in wakes(5.0, stall_share=0.01):
        stream.read(now_s)
    assert stream.readout.lost == 0
    assert np.abs(stream.errors(after_s=2.0)).max() < 0.01


def test_a_long_stall_that_lost_nothing_is_no_loss():
    stream = Stream(off=0.0)
    for now_s in (*np.arange(100.0, 103.0, 0.004), *np.arange(104.5, 107.0, 0.004)):
        stream.read(float(now_s))
    assert stream.readout.lost == 0
    assert np.abs(stream.errors(after_s=1.0)).max() < 0.003


def test_a_first_read_that_was_late_is_put_right_and_time_never_goes_back():
    stream = Stream(off=0.0)
    for now_s in (100.3, *np.arange(100.302, 104.0, 0.002)):
        stream.read(float(now_s), at_once=400)
    assert np.all(np.diff(stream.told_s) > 0)
    assert np.abs(stream.errors(after_s=3.0)).max() < 0.003


def test_the_latency_lies_between_sample_and_arrival():
    readout = WrenchStamper(ForceTorqueSettings(latency_ms=5.0), PERIOD_S)
    stamps, _ = readout.accept(2.0, [reading(1), reading(2)])
    assert stamps == pytest.approx([1.994, 1.995])


def test_a_dynpick_behind_an_adapter_that_collects_keeps_its_rate():
    """Through the bytes: the adapter hands over every 16 ms what it has, some of it torn."""
    language, sensor = (
        DynpickDriver(HardwareSettings(), ""),
        EmulatedDynpick(add_noise(lambda now_s: (0.0,) * 6)),
    )
    readout = WrenchStamper(ForceTorqueSettings(), PERIOD_S)
    sensor.receive(0.0, DynpickCommand.START.value)
    told_s, rest = [], b""
    for k in range(1, 250):
        now_s = 0.016 * k
        content = rest + sensor.due(now_s)
        whole = len(content) - k % RECORD_BYTES
        content, rest = content[:whole], content[whole:]
        for i in range(0, len(content), 2 * RECORD_BYTES):
            stamps, _ = readout.accept(now_s, language.take(content[i : i + 2 * RECORD_BYTES]))
            told_s.extend(stamps)
    steps_s = np.diff(told_s[1000:])
    assert np.abs(steps_s - PERIOD_S).max() < 2e-4
    assert readout.lost == 0
