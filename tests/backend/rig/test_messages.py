"""Connecting in the safe order, one device at a time, and only the device that was meant."""

from __future__ import annotations

import io
import json
import math
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.backend.devices.waiting import until
from tests.backend.rig.hosted import Hosted
from tests.backend.rig.scripted import LINES, held, scripted
from touchdown.backend.bench.emulator_registry import emulate
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core import (
    InputError,
    ManualClock,
    RawStreams,
    RefusedError,
    SampleStream,
    Stream,
)
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.melfa.driver import MelfaArm
from touchdown.backend.emulation.serving import EmulationChoice
from touchdown.backend.rig import diagnostics as looking
from touchdown.backend.rig.connection import BenchConnection
from touchdown.backend.rig.diagnostics import SensorTiming, examine_devices, measure_timing
from touchdown.backend.rig.memory import (
    BACKEND_BEAT,
    NOTES,
    POSES,
    PREFIX,
    RIG_BEAT,
    ROUNDS,
    STATE,
    WRENCH,
    attach,
    drop,
    make,
)
from touchdown.backend.rig.messages import (
    KINDS,
    LENGTH,
    MOST_BYTES,
    Channel,
    ParentProcess,
    is_dying,
    pack,
)
from touchdown.backend.runs.manual_control import latch_device_faults


def made(**more):
    devices, log = scripted()
    return BenchConnection(devices, **more), devices, log


def connect(connection, *names):
    connection.begin(*names)
    assert connection.wait(60.0)


def line(connection, name):
    return next(line for line in connection.lines() if line.name == name)


def states(connection):
    return {line.name: line.state for line in connection.lines()}


def test_all_are_connected_the_arm_last_and_the_bench_is_told_once():
    told = []
    connection, _, log = made()
    connection.when_ready = lambda: told.append("ready")
    assert set(states(connection).values()) == {"closed"}
    connect(connection)
    assert log == [f"connect {name}" for name in LINES]
    assert told == ["ready"]
    assert connection.ready
    assert {line.steps for line in connection.lines()} == {4}
    connection.close()
    assert log[-5:] == [f"close {name}" for name in reversed(LINES)]


def test_each_step_shows_while_it_goes_on():
    connection, devices, _ = made()
    devices["gripper"].hold = held()
    connection.begin()
    until(lambda: line(connection, "gripper").state == "connecting")
    assert line(connection, "arm").state == "waiting"
    assert line(connection, "tactile_left").state == "ready"
    with pytest.raises(RefusedError, match="Wait until"):
        connection.begin()
    devices["gripper"].hold.set()
    assert connection.wait(60.0)
    assert connection.ready


def test_one_that_fails_says_at_which_step_and_the_others_go_on():
    connection, devices, log = made()
    devices["tactile_left"].fails_at = "configure"
    connect(connection)
    failed = line(connection, "tactile_left")
    assert (failed.state, failed.steps) == ("failed", 2)
    assert failed.fault.next_step == "Look at it."
    assert connection.missing() == ("tactile_left",)
    devices["tactile_left"].fails_at = ""
    log.clear()
    connect(connection, ("tactile_left",))
    assert log == ["connect tactile_left"], "the others are left alone"
    assert connection.ready


def test_a_driver_that_fails_in_its_own_way_is_told_and_the_others_go_on(monkeypatch):
    connection, devices, _ = made()

    def broken(limit_s, cancel):
        raise KeyError("gain")

    monkeypatch.setattr(devices["tactile_left"], "connect", broken)
    connect(connection)
    failed = line(connection, "tactile_left")
    assert failed.fault.code == "DRIVER-FAILED"
    assert "tactile_left failed: KeyError: 'gain'" in failed.fault.what
    assert connection.missing() == ("tactile_left",)


def test_the_arm_is_not_switched_on_without_the_wrist_sensor():
    connection, devices, log = made()
    devices["force_torque"].fails_at = "reach"
    connect(connection)
    assert line(connection, "arm").fault.code == "NO-WRIST"
    assert "connect arm" not in log


def test_another_device_than_the_first_time_is_closed_again():
    connection, devices, _ = made()
    connect(connection)
    devices["tactile_right"].lose()
    devices["tactile_right"].serial = "other"
    connect(connection, ("tactile_right",))
    found = line(connection, "tactile_right")
    assert (found.state, found.fault.code) == ("failed", "OTHER-DEVICE")
    assert "other answers instead of tactile_right-1" in found.fault.what


@pytest.mark.promise("C6")
def test_a_number_of_the_file_is_asked_for_from_the_start():
    connection, _, _ = made(serials={"gripper": "G7", "arm": ""})
    connect(connection)
    assert line(connection, "gripper").fault.code == "OTHER-DEVICE"
    assert line(connection, "arm").state == "ready"


def test_cancel_ends_it_where_it_is():
    connection, devices, log = made()
    devices["gripper"].hold = held()
    connection.begin()
    until(lambda: line(connection, "gripper").state == "connecting")
    connection.cancel()
    assert connection.wait(60.0)
    assert states(connection) == dict(zip(LINES, ["ready"] * 3 + ["failed", "closed"], strict=True))
    assert "connect arm" not in log


def test_a_lost_device_is_told_and_its_line_says_what_to_do():
    connection, devices, _ = made()
    connect(connection)
    interlock = Interlock()
    latch_device_faults(devices.values(), interlock)
    assert not interlock.latched
    devices["force_torque"].lose()
    latch_device_faults(devices.values(), interlock)
    assert [fault.code for fault in interlock.faults] == ["LINK"]
    assert line(connection, "force_torque").fault.next_step == "Plug it in."
    connect(connection)
    assert connection.ready
    assert line(connection, "force_torque").fault is None


def test_one_device_is_disconnected_and_the_arm_goes_first_of_all():
    connection, _, log = made()
    connect(connection)
    log.clear()
    connection.disconnect(("tactile_left",))
    connection.wait(60.0)
    assert log == ["close tactile_left"]
    connection.disconnect()
    connection.wait(60.0)
    assert log[1] == "close arm"


def test_a_bench_that_cannot_be_used_says_why():
    def refuse():
        raise InputError("There is no piece 'x'.", "lab.toml", "Correct it.")

    connection, _, _ = made()
    connection.when_ready = refuse
    connect(connection)
    assert "There is no piece" in str(connection.trouble)


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(looking, "LIMIT_S", 0.3)
    monkeypatch.setattr(looking, "LISTEN_S", 0.05)


def test_each_device_is_asked_and_the_arm_stays_off(short, tmp_path):
    served = [emulate(EmulationChoice(kind, port=None)) for kind in ("dynpick", "wsg", "melfa")]
    tables = {}
    for one in served:
        one.start()
        for name, table in one.bench.items():
            first, _, second = name.partition(".")
            place = tables.setdefault(first, {})
            (place.setdefault(second, {}) if second else place).update(table)
    tables["gelsight"] = {"by_id": str(tmp_path), "names": str(tmp_path), "nodes": str(tmp_path)}
    try:
        found = {f.device: f for f in examine_devices(HardwareSettings.model_validate(tables))}
        controller = served[2].fronts[0]._device.controller
        assert not controller.servo
    finally:
        for one in served:
            one.close()
    assert [f.ok for f in found.values()] == [True, False, False, True, True]
    assert "Dynpick" in found["force_torque"].detail
    assert "12345" in found["gripper"].detail
    assert found["arm"].detail.endswith("not switched on")
    assert "No camera with the number" in found["tactile_left"].detail
    assert found["tactile_left"].fix


def test_an_arm_that_is_away_says_what_to_check(short):
    settings = HardwareSettings.model_validate(
        {"melfa": {"host": "127.0.0.1", "r3": {"port": 9, "stop_port": 9}},
         "ft": {"driver": "dynpick", "address": "socket://127.0.0.1:9"},
         "wsg": {"host": "127.0.0.1", "port": 9}},
    )  # fmt: skip
    found = list(examine_devices(settings))
    assert not any(f.ok for f in found)
    assert all(f.fix for f in found)
    assert "cable" in found[-1].fix
    assert MelfaArm.name == found[-1].device


LIMIT_S = 30.0
PLAIN = st.sampled_from([None, True, 0, -1, 10**30, 0.5, math.nan, math.inf, "", "x"])
JSON = PLAIN | st.lists(PLAIN, max_size=3) | st.dictionaries(st.sampled_from("ab"), PLAIN)
ORDERS = st.sampled_from(["arm.move_to", "arm.jog", "arm.servo", "gripper.grip", "wrist.fly", ""])
NAMES = st.sampled_from(
    ["id", "order", "args", "stops", "faults", "limits", "motion", "lease_until_s", "fault"]
)
MESSAGES = st.builds(
    lambda kind, order, rest: pack({"order": order, **rest, "kind": kind}),
    # A retreat needs no content to make sense.
    st.sampled_from(sorted(KINDS - {"retreat"})),
    ORDERS,
    st.dictionaries(NAMES, JSON, max_size=5),
)


def listen(content, take):
    """Let one end of a pipe hear ``content``; return how often it was told that it ended."""
    ended = []
    channel = Channel(io.BytesIO(content), io.BytesIO(), take, lambda: ended.append(True))
    channel.start()
    channel.close()
    channel.join(LIMIT_S)
    assert not any(thread.is_alive() for thread in (channel._speaker, channel._listener))
    return len(ended)


@pytest.fixture(scope="module")
def rig():
    made = Hosted().connected()
    yield made
    made.close()


@settings(max_examples=150)
@given(st.binary(max_size=200), st.booleans())
def test_bytes_that_are_no_messages_end_the_pipe(content, framed):
    heard = []
    assert listen(LENGTH.pack(len(content)) + content if framed else content, heard.append) == 1
    assert all(message["kind"] in KINDS for message in heard)


@pytest.mark.parametrize(
    "content",
    [
        LENGTH.pack(MOST_BYTES + 1) + b"x" * 100,
        LENGTH.pack(0xFFFFFFFF),
        LENGTH.pack(60_000) + b"[" * 60_000,
        LENGTH.pack(60_000) + b"{}",
        LENGTH.pack(4) + b"\xff\xfe\x00\x01",
    ],
    ids=["too long", "endless", "deep", "cut", "no text"],
)
def test_hostile_lengths_and_depths_end_the_pipe_too(content):
    assert listen(content, lambda message: None) == 1


@pytest.mark.promise("P8", "P9")
@settings(max_examples=60)
@given(st.lists(MESSAGES, min_size=1, max_size=4))
def test_messages_of_a_known_kind_with_senseless_content_move_nothing(rig, messages):
    """Whoever speaks so is gone for the rig, or is answered with an error: nothing moves."""
    sent = len(rig.arms.wires.packets)
    before = rig.arm.describe()["z_mm"]
    assert listen(b"".join(messages), rig.host.take) == 1
    rig.rounds(0.008)
    assert len(rig.arms.wires.packets) > sent
    assert rig.arm.describe()["z_mm"] == before
    assert rig.log.count("stop gripper") == len(rig.log)


@pytest.mark.promise("P8", "P9")
def test_a_pipe_full_of_nonsense_stops_an_arm_that_moves(rig):
    rig.host.take({"kind": "reset", "stops": 10**6, "faults": 10**6})
    stops = rig.arms.wires.stops
    nonsense = LENGTH.pack(2) + json.dumps([]).encode()
    channel = Channel(io.BytesIO(nonsense), io.BytesIO(), rig.host.take, rig.host.abandon)
    channel.start()
    channel.close()
    channel.join(LIMIT_S)
    assert rig.arms.wires.stops == stops + 1
    assert rig.rounds(0.004)


@pytest.mark.promise("P8", "P9")
@settings(max_examples=30)
@given(
    st.sampled_from([STATE, WRENCH, POSES, ROUNDS, NOTES]),
    st.integers(-(2**62), 2**62),
    st.integers(0, 2**32 - 1),
)
def test_shared_memory_full_of_noise_is_read_without_a_crash(word, count, seed):
    memory, path = make()
    drop(path)
    words = memory._words.copy()
    noise = np.random.default_rng(seed).integers(0, 256, len(memory._pages), dtype=np.uint8)
    np.frombuffer(memory._pages, np.uint8)[:] = noise
    memory._words[:] = words
    memory._words[word] = count
    assert memory.seen() is None
    assert memory.notes() == []
    for ring in (memory.wrench, memory.poses, memory.rounds):
        t_s, values, cursor = ring.since(0)
        assert (len(t_s), len(values), cursor) == (0, 0, ring.count)


@pytest.fixture
def both():
    mine, path = make()
    other = attach(path)
    drop(path)
    assert not path.parent.exists()
    return mine, other


def block(first, count, channels=6):
    t_s = 1e-3 * np.arange(first, first + count)
    return t_s, np.arange(first, first + count)[:, None] + np.zeros(channels)


def test_one_side_reads_what_the_other_has_put(both):
    mine, other = both
    mine.wrench.put(*block(0, 5))
    t_s, values, cursor = other.wrench.since(0)
    assert (t_s == block(0, 5)[0]).all()
    assert (values[:, 3] == np.arange(5)).all()
    mine.wrench.put(*block(5, 2))
    assert other.wrench.since(cursor)[1][:, 0].tolist() == [5, 6]
    mine.beat(BACKEND_BEAT)
    mine.permit(1.25)
    assert (other.count(BACKEND_BEAT), other.count(RIG_BEAT), other.lease_until_s) == (1, 0, 1.25)


def test_a_slow_reader_gets_the_newest_and_never_waits(both):
    mine, other = both
    size = mine.wrench.capacity
    for first in range(0, 3 * size, size // 2):
        mine.wrench.put(*block(first, size // 2))
    t_s, values, cursor = other.wrench.since(10)
    assert (len(t_s), cursor) == (size, 3 * size)
    assert values[0, 0] == 2 * size
    # More at once than there is room for: the newest of it.
    mine.wrench.put(*block(0, size + 7))
    assert other.wrench.since(cursor)[1][:, 0].tolist() == list(range(7, size + 7))


def test_no_record_is_read_torn():
    """A writer that never rests: each row read is of one piece."""
    mine, path = make()
    other = attach(path)
    drop(path)
    stop = threading.Event()

    def write():
        first = 0
        while not stop.is_set():
            mine.poses.put(*block(first, 700, 3))
            first += 700

    thread = threading.Thread(target=write)
    thread.start()
    read, cursor = 0, 0
    try:
        for _ in range(20_000):
            t_s, values, cursor = other.poses.since(cursor)
            assert (values == values[:, :1]).all()
            assert np.allclose(t_s, 1e-3 * values[:, 0])
            read += len(t_s)
            if read > 20_000:
                break
            # The writer may have been interrupted within a piece: it has its turn.
            stop.wait(1e-4)
    finally:
        stop.set()
        thread.join()
    assert read > 0


def test_a_state_is_read_whole_or_not_at_all(both):
    mine, other = both
    assert other.seen() is None
    mine.show({"arm": {"state": "ready", "text": "x" * 5000}})
    assert other.seen()["arm"]["state"] == "ready"
    mine.show({"arm": 1})
    assert other.seen() == {"arm": 1}
    with pytest.raises(ValueError, match="too long"):
        mine.show({"arm": "x" * 20_000})
    assert other.seen() == {"arm": 1}


def test_notes_are_kept_in_order_and_cut_where_too_long(both):
    mine, other = both
    for k in range(1030):
        mine.note(0.001 * k, f"note {k}" if k < 1029 else "é" * 400)
    notes = other.notes()
    assert len(notes) == 1024
    assert notes[0] == (pytest.approx(0.006), "note 6")
    assert notes[-1][1] == "é" * 240


@pytest.mark.promise("P11")
def test_what_a_killed_program_left_is_swept_at_the_next_start():
    gone = subprocess.run(
        [sys.executable, "-c", "from touchdown.backend.rig.memory import make; print(make()[1])"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    left = Path(gone.stdout.strip())
    assert left.exists()
    assert left.parent.name.startswith(PREFIX)
    _, path = make()
    drop(path)
    assert not left.exists()


# proc(5): pid, name, state, five numbers, flags, ...; the 31st field holds the waiting signals.
ALIVE = (
    b"14714 (%b) %b 14713 14714 597 0 -1 %d 240 890 0 10 0 0 0 1 20 0 1 0 2435368 4861952 569 "
    b"18446744073709551615 94098241773568 94098242562973 140724841936160 0 0 %d 0 65536 0 81922 "
    b"1 0 0 17 0 0 0 0 0 0 94098242796272 94098242844516 94098707435520 140724841937790 "
    b"140724841937805 140724841937805 140724841938922 0\n"
)
NORMAL, EXITING = 0x400100, 0x400104
KILL, TERM = 1 << 8, 1 << 14


@pytest.mark.promise("P9")
@pytest.mark.parametrize(
    ("state", "flags", "signals", "found"),
    [
        (b"S", NORMAL, 0, False),
        (b"R", NORMAL, TERM, False),  # it may have a handler for that one
        (b"R", NORMAL, KILL, True),
        (b"D", EXITING, 0, True),
        (b"Z", EXITING, 0, True),
    ],
)
@pytest.mark.parametrize("name", [b"python", b"a) Z 4 (b", b") ) S"])
def test_a_killed_process_is_known_before_it_gets_a_processor_to_die_on(
    name, state, flags, signals, found
):
    assert is_dying(ALIVE % (name, state, flags, signals)) is found


@pytest.mark.parametrize("line", [b"", b"14714 (python", b"14714 (python) S 1 2"])
def test_half_a_line_says_nothing(line):
    assert is_dying(line) is False


# A grandchild that only tells how its parent is; the parent waits to be killed.
CHILD = """
import subprocess, sys
subprocess.Popen([sys.executable, "-c", sys.argv[1]])
sys.stdin.read()
"""
GRANDCHILD = """
import sys, time
from touchdown.backend.rig.messages import ParentProcess
parent = ParentProcess()
print(parent.gone(), flush=True)
while not parent.gone():
    time.sleep(0.001)
print("gone", flush=True)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="asks the files of Linux")
def test_the_death_of_a_parent_is_seen_and_its_life_too():
    mine = ParentProcess()
    assert not mine.gone()
    mine.close()
    command = [sys.executable, "-c", CHILD, GRANDCHILD]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout.readline() == "False\n"
        os.kill(child.pid, signal.SIGKILL)
        # Nobody has taken note of its end yet: for its child it has the same number all the while.
        assert child.stdout.readline() == "gone\n"


class Sensor:
    """Delivers a sample every ``period_us``, stamped ``delay_us`` before it comes."""

    def __init__(self, stream, period_us: int, delay_us: int, silent=range(0)) -> None:
        self.stream, self._period_us, self._delay_us = stream, period_us, delay_us
        self._silent = silent

    def come(self, before_us: int, now_us: int) -> None:
        for at_us in range(before_us + 1, now_us + 1):
            if at_us % self._period_us or at_us // self._period_us in self._silent:
                continue
            t_s = 1e-6 * (at_us - self._delay_us)
            if isinstance(self.stream, SampleStream):
                self.stream.put(np.array([t_s]), np.zeros((1, 1)))
            else:
                self.stream.put(t_s, SimpleNamespace(t_s=t_s))


@pytest.fixture
def report() -> dict[str, SensorTiming]:
    clock = ManualClock()
    sensors = (
        Sensor(SampleStream("steady", 1, 10_000), 4000, 1000),
        Sensor(SampleStream("late", 1, 10_000), 40_000, 30_000),
        Sensor(Stream("holes", 10_000), 10_000, 0, silent=range(50, 56)),
        Sensor(Stream("silent", 10_000), 10_000, 0, silent=range(10**6)),
    )

    def wait(seconds: float) -> None:
        before_us = clock.now_us
        clock.advance(round(1e6 * seconds))
        for sensor in sensors:
            sensor.come(before_us, clock.now_us)

    samples, poses, left, right = (sensor.stream for sensor in sensors)
    raw = RawStreams({"left": left, "right": right}, samples, poses)
    return {one.name: one for one in measure_timing(raw, clock.now_s, wait, 2.0)}


def test_each_sensor_is_told_by_its_rate_its_age_and_its_gaps(report):
    steady, late, holes = report["steady"], report["late"], report["holes"]
    assert steady.rate_hz == pytest.approx(250.0)
    assert (steady.spread_ms, steady.gap_ms) == pytest.approx((0.0, 4.0), abs=1e-6)
    assert steady.age_ms == pytest.approx(1.0)
    assert late.rate_hz == pytest.approx(25.0)
    assert (late.age_ms, late.late_ms) == pytest.approx((30.0, 30.0))
    assert holes.rate_hz == pytest.approx(193 / 1.99)
    assert holes.gap_ms == pytest.approx(70.0)
    assert holes.age_ms == pytest.approx(0.0, abs=1e-6)


def test_of_a_silent_sensor_nothing_is_told(report):
    assert report["silent"].samples == 0
    assert math.isnan(report["silent"].rate_hz)
