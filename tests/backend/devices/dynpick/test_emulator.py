"""The reader with a Dynpick against the emulated sensor, over TCP and over a pseudo terminal."""

import random
import sys
import threading
import time

import numpy as np
import pytest

from tests.backend.devices.codecs.vectors import data
from tests.backend.devices.waiting import until
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices import DeviceState, make_force_torque
from touchdown.backend.devices.dynpick import EmulatedDynpick, protocol
from touchdown.backend.devices.dynpick.driver import PERIOD_S as DRIVER_PERIOD_S
from touchdown.backend.devices.dynpick.driver import DynpickDriver
from touchdown.backend.devices.dynpick.protocol import (
    RECORD_BYTES,
    DynpickCommand,
    DynpickRecord,
    encode_record,
)
from touchdown.backend.devices.force_torque.driver import WrenchReading
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.emulation import Faults, PtyServer, TcpServer, add_noise, apply_faults
from touchdown.backend.sensing.episode import wrench_on_ticks
from touchdown.backend.sensing.zeroing import WrenchDriftEstimator

LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
LEAST = 1 / np.array([65.47, 65.44, 65.08, 1638.5, 1639.25, 1640.75])  # one count of each axis

TREMBLE = tuple(2.0 * LEAST)  # A living sensor never repeats itself


def trembling(load=LOAD):
    return add_noise(lambda now_s: load, TREMBLE)


def make(address, **dynpick):
    ft = {"driver": "dynpick", "address": address}
    settings = HardwareSettings.model_validate({"ft": ft, "dynpick": dynpick})
    return make_force_torque(settings, time.monotonic)


FRONTS = [TcpServer, *([PtyServer] if sys.platform != "win32" else [])]


@pytest.fixture(params=FRONTS, ids=["tcp", "pty"][: len(FRONTS)])
def front(request):
    made = request.param(EmulatedDynpick(trembling()))
    made.start()
    yield made
    made.close()


@pytest.fixture
def driver(front):
    made = make(front.url)
    yield made
    made.close()


def connect(driver):
    driver.connect(5.0, threading.Event())


def test_start_up_and_shutdown_go_in_the_documented_order(front, driver):
    connect(driver)
    assert driver.rated == pytest.approx(8192 * LEAST)
    driver.close()
    until(lambda: b"".join(e.data for e in front.log if e.incoming).endswith(b"E"))
    assert b"".join(e.data for e in front.log if e.incoming) == b"Ep1FSE"


def test_a_lost_byte_costs_one_sample(front, driver):
    connect(driver)
    spoilt = threading.Event()

    def lose_one(out):
        if len(out) < 27 or spoilt.is_set():
            return out
        spoilt.set()
        return out[:10] + out[11:]

    front.damage = lose_one
    until(spoilt.is_set)
    before = driver.samples.count
    until(lambda: driver.samples.count >= before + 20)
    assert driver.state is DeviceState.READY
    assert driver.health.lost >= 1
    assert np.all(np.abs(driver.samples.since(0).values - LOAD) <= 12 * LEAST)
    assert driver.describe()["resynchronised"] == 1


def test_a_sensor_that_tells_nonsense_is_not_scaled_by_it(front, driver):
    front.damage = lambda out: out.replace(b"65.470", b"00.000")
    with pytest.raises(FaultError):
        connect(driver)
    assert driver.samples.count == 0


@pytest.mark.promise("S4")
def test_a_port_that_is_not_there_is_a_fault():
    driver = make("/dev/no-such-port")
    told = r"The port /dev/no-such-port cannot be opened: No such file or directory\."
    with pytest.raises(FaultError, match=told):
        connect(driver)


def test_an_older_sensor_is_scaled_by_the_settings():
    front = TcpServer(EmulatedDynpick(trembling(), tells_sensitivity=False))
    front.start()
    driver = make(front.url, sensitivity=(50.0,) * 6)
    connect(driver)
    driver.close()
    front.close()
    assert driver.samples.since(0).values[0, 2] == pytest.approx(-10.5 * 65.08 / 50, abs=0.5)


def emulated(**options):
    return EmulatedDynpick(lambda now_s: LOAD, **options)


def test_a_record_of_a_known_load_is_the_published_one():
    sensor = emulated()
    for _ in range(3):
        sensor.receive(0.0, b"R")
    assert sensor.receive(0.0, b"R") == data("dynpick-sample")


def test_answers_are_the_published_ones():
    sensor = emulated()
    assert sensor.receive(0.0, b"p") == data("dynpick-sensitivity-reply")
    assert sensor.receive(0.0, b"T") == data("dynpick-temperature-reply")
    assert sensor.receive(0.0, b"4F0F") == data("dynpick-filter-reply")
    assert emulated(tells_sensitivity=False).receive(0.0, b"p") == b""


def test_the_stream_keeps_its_rate_and_divider():
    sensor = emulated()
    assert sensor.receive(1.0, b"S") == b""
    records = protocol.records().feed(sensor.due(1.0999))
    assert len(records) == 100
    assert [record.tick for record in records[:11]] == [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 0]
    sensor.receive(1.1, b"4F")
    assert len(protocol.records().feed(sensor.due(1.2))) == pytest.approx(25, abs=1)
    sensor.receive(1.2, b"E")
    assert sensor.due(9.0) == b""


def test_after_a_pause_old_records_are_lost_and_the_tick_tells():
    sensor = emulated()
    sensor.receive(0.0, b"S")
    first = protocol.records().feed(sensor.due(0.0))
    rest = protocol.records().feed(sensor.due(1.0))
    assert len(first) == 1
    assert 200 <= len(rest) <= 202
    assert rest[-1].tick == 1000 % 10


def test_offset_reset_zeroes():
    sensor = emulated()
    sensor.receive(0.0, b"O")
    (record,) = protocol.records().feed(sensor.receive(0.0, b"R"))
    assert record.counts == (0x2000,) * 6


def test_a_load_beyond_the_range_saturates():
    sensor = EmulatedDynpick(lambda now_s: (500.0, -500.0, 0.0, 0.0, 0.0, 0.0))
    (record,) = protocol.records().feed(sensor.receive(0.0, b"R"))
    assert record.counts[:3] == (0x3FFF, 0, 0x2000)


ZERO = 0x2000
PER_UNIT = (100.0, 100.0, 100.0, 1000.0, 1000.0, 1000.0)


class Samples:
    """Language and readout of one connection, without a wire."""

    def __init__(self, **mounting):
        settings = HardwareSettings.model_validate({"dynpick": {"sensitivity": PER_UNIT}})
        self.language = DynpickDriver(settings, "")
        self.readout = WrenchStamper(ForceTorqueSettings(**mounting), DRIVER_PERIOD_S)

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


def test_missing_ticks_are_counted():
    reading = samples()
    reading.accept(1.0, stream(0, 0))
    reading.accept(1.1, stream(0, tick=5))
    assert reading.lost == 3


@pytest.mark.promise("S2")
@pytest.mark.parametrize(
    ("counts", "taken", "lost"),
    [
        ((0, 0, 5000, 0, 0), [0.0] * 4, 1),
        ((0, 0, 5000, -5000, 0), [0.0] * 3, 2),
        ((0, 0, 5000, 5001, 5002), [0.0, 0.0, 50.01, 50.02], 1),
    ],
)
def test_a_leap_is_left_out_and_counted_unless_it_stays(counts, taken, lost):
    reading = samples()
    _, values = reading.accept(1.0, stream(*counts))
    assert values[:, 0] == pytest.approx(taken)
    assert reading.lost == lost


def test_the_ends_of_the_range_are_an_overload():
    reading = samples()
    reading.accept(1.0, stream(0x1FFE))
    assert not reading.overload
    reading.accept(1.1, stream(0x1FFF, tick=1))
    assert reading.overload


@pytest.mark.promise("S8")
def test_an_emulated_sensor_that_drifts_is_named_by_what_the_reader_reads():
    faults, now_s, watch = Faults("force_torque"), 0.0, WrenchDriftEstimator()
    faults.begin(now_s)
    hangs = add_noise(lambda now_s: (0.0, 0.0, -14.7, 0.0, 0.0, 0.0))
    sensor = EmulatedDynpick(apply_faults(hangs, faults))
    sensor.pace.faults = faults
    sensor.receive(now_s, b"S")
    language = DynpickDriver(HardwareSettings(), "")
    readout = WrenchStamper(ForceTorqueSettings(), DRIVER_PERIOD_S)
    faults.inject(6.0, "drift", n_per_s=0.05)
    while now_s < 30.0 and not ((found := watch.drift()) and found.named):
        now_s += 0.1
        stamps_s, wrench = readout.accept(now_s, language.take(sensor.due(now_s)))
        watch.feed(stamps_s, wrench[:, :3])
    assert 0.45 < 0.05 * (now_s - 6.0) < 0.75, "before it reaches 1 N"
    assert found.moved_n == pytest.approx(0.05 * (now_s - 6.0), abs=0.1)


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
    means = wrench_on_ticks(told_s, wrench, ticks_s)
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
