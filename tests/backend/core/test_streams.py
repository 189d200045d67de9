"""Shared values are immutable."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.backend.simulation.one_press import CASES, RMS_LIMIT_PX, press_both_ways
from touchdown.backend.core.faults import InputError, StaleSampleError
from touchdown.backend.core.scheduling import NICENESS, RepaintHold
from touchdown.backend.core.stalled_processes import STALLED_AFTER_S, ProcessStallDetector
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import (
    TACTILE_CHANNELS,
    BeliefMap,
    ContactPatch,
    Episode,
    EpisodeQuality,
    MarkerField,
    Recording,
    Stability,
    SupportKind,
    TactileFrame,
)


def test_arrays_of_values_are_read_only():
    patch = ContactPatch(np.zeros((4, 2)), np.zeros(4))
    with pytest.raises(ValueError, match="read-only"):
        patch.probability[0] = 1.0
    with pytest.raises(AttributeError):
        patch.probability = np.ones(4)
    frame = TactileFrame("left", 0, 0.0, np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        frame.image[:] = 1


def zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape)


OBSERVATION, OFFSET, GOOD = np.zeros((20, 258), np.float32), np.zeros(2), EpisodeQuality(True)
SEEN, CELLS = np.zeros(63, np.uint8), np.zeros((2, 3), bool)
WRONG = {
    "ContactPatch.probability has shape (4,) and type float64": lambda: ContactPatch(
        zeros(3, 2), zeros(4)
    ),
    "ContactPatch.points_mm has shape (3,)": lambda: ContactPatch(zeros(3), zeros(3)),
    "ContactPatch.points_mm has shape () and type list": lambda: ContactPatch(
        [[0.0, 0.0]], zeros(1)
    ),
    "ContactPatch.probability is not within": lambda: ContactPatch(zeros(2, 2), np.array([0, 1.1])),
    "ContactPatch.probability is not": lambda: ContactPatch(zeros(1, 2), np.array([-0.1])),
    "BeliefMap.covered has shape": lambda: BeliefMap(zeros(3, 3), CELLS, (0.0, 0.0), 1.0, 0),
    "BeliefMap.covered has shape (2, 3) and type float64": lambda: BeliefMap(
        zeros(2, 3), zeros(2, 3), (0.0, 0.0), 1.0, 0
    ),
    "BeliefMap.log_odds holds NaN": lambda: BeliefMap(
        np.full((2, 3), np.nan), CELLS, (0.0, 0.0), 1.0, 0
    ),
    "BeliefMap.pitch_mm is not pos": lambda: BeliefMap(zeros(2, 3), CELLS, (0.0, 0.0), np.nan, 0),
    "Episode.observation has shape": lambda: Episode("0", "pot", zeros(19, 258), OFFSET, 0.0, GOOD),
    "Episode.offset_mm has shape": lambda: Episode("0", "pot", OBSERVATION, zeros(3), 0.0, GOOD),
    "Episode.offset_mm is not finite": lambda: Episode(
        "0", "pot", OBSERVATION, np.array([0.0, np.nan]), 0.0, GOOD
    ),
    "MarkerField.position_px has": lambda: MarkerField(
        "left", 0, 0.0, zeros(62, 2), zeros(63, 2), SEEN, 1.0
    ),
    "MarkerField.state has shape (63,) and type float64": lambda: MarkerField(
        "left", 0, 0.0, zeros(63, 2), zeros(63, 2), zeros(63), 1.0
    ),
    "Recording.wrench has shape (5, 6)": lambda: Recording(
        zeros(4), zeros(5, 6), (), (), zeros(0), zeros(0, 3), zeros(6)
    ),
    "Stability.stable is True without": lambda: Stability(
        True, np.nan, SupportKind.AREA, zeros(3, 2), (0.0, 0.0), "belief"
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_value_refuses_content_that_it_cannot_hold(what: str) -> None:
    """A script sees the field, its shape and the one that is needed, not an error far away."""
    with pytest.raises(InputError, match=re.escape(what)) as refused:
        WRONG[what]()
    assert refused.value.where == what.split()[0]
    assert "'" not in refused.value.fix
    assert isinstance(refused.value, ValueError)  # damage of a file, for its reader


def test_a_value_keeps_what_was_not_measured() -> None:
    """NaN stays a value where the bench could not measure, and where a model gives no estimate."""
    assert np.isnan(ContactPatch(zeros(1, 2), np.array([np.nan])).probability).all()
    unusable = EpisodeQuality(False, ("no signal",))
    nothing = np.full((20, 258), np.nan, np.float32)
    assert Episode("0", "pot", nothing, np.full(2, np.nan), 0.0, unusable).observation.shape


def test_belief_cells_and_probabilities():
    belief = BeliefMap(
        np.array([[0.0, np.log(9.0), -np.log(9.0)]]), np.ones((1, 3), bool), (-1.0, 5.0), 2.0, 1
    )
    np.testing.assert_allclose(belief.probability, [[0.5, 0.9, 0.1]], rtol=0, atol=1e-15)
    assert belief.cell_centres_mm().tolist() == [[[-1.0, 5.0], [1.0, 5.0], [3.0, 5.0]]]
    extreme = BeliefMap(np.array([[-20.0, 20.0]]), np.ones((1, 2), bool), (0.0, 0.0), 1.0, 1)
    assert 0 < extreme.probability[0, 0] < 1e-8
    assert 1 - 1e-8 < extreme.probability[0, 1] < 1


def test_a_repaint_hold_ends_when_told_or_after_its_time():
    now = [10.0]
    hush = RepaintHold(lambda: now[0])
    assert not hush.on
    hush.begin(0.08)
    assert hush.on
    now[0] = 10.079
    assert hush.on
    now[0] = 10.081
    assert not hush.on
    hush.begin(0.08)
    hush.end()
    assert not hush.on


TWICE = """
import os
from touchdown.backend.core.scheduling import lower_priority
os.nice(5)
lower_priority()
lower_priority()
print(os.nice(0))
"""


@pytest.mark.skipif(os.name != "posix", reason="only there is a niceness")
def test_what_has_stepped_back_already_does_not_lower_priority_again():
    told = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True, check=True)
    assert int(told.stdout) == max(NICENESS, min(os.nice(0) + 5, 19))


BUSY = "print(flush=True)\nwhile True: sum(range(1000))"
WAITS = (
    "import threading\nprint(flush=True)\nlock = threading.Lock()\nlock.acquire()\nlock.acquire()"
)


@pytest.fixture
def child(request):
    with subprocess.Popen([sys.executable, "-c", request.param], stdout=subprocess.PIPE) as made:
        assert made.stdout.readline() == b"\n"
        yield made
        made.kill()


def looks(watch, until):
    """Look for as long as the outcome may still change; the clock of the looks is wound by hand."""
    now_s = 0.0
    for _ in range(10_000):
        now_s += STALLED_AFTER_S
        if watch.look(now_s) is until:
            return True
    return False


@pytest.mark.promise("P7", "P10")
@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="threads are seen on Linux only")
@pytest.mark.parametrize("child", [WAITS], indirect=True)
def test_one_that_waits_for_ever_stands_still_and_a_gone_one_does_not(child):
    watch = ProcessStallDetector(child.pid)
    assert not watch.look(0.0), "a first look knows nothing"
    assert looks(watch, True)
    assert not watch.look(1e8), "who has not looked for long knows nothing either"
    child.kill()
    child.wait()
    assert not watch.look(1e9)


@pytest.mark.promise("P7", "P10")
@pytest.mark.parametrize("child", [BUSY], indirect=True)
def test_one_that_is_stopped_stands_still_until_it_goes_on(child):
    watch = ProcessStallDetector(child.pid)
    assert not any(watch.look(k * STALLED_AFTER_S) for k in range(50)), "it wants to run"
    os.kill(child.pid, signal.SIGSTOP)
    assert looks(watch, True)
    os.kill(child.pid, signal.SIGCONT)
    assert looks(watch, False)


@given(st.integers(1, 8), st.lists(st.integers(0, 5), max_size=30))
def test_a_reader_gets_each_item_once_or_as_lost(capacity, bursts):
    stream, cursor, number, got, lost = Stream("s", capacity), 0, 0, [], 0
    for burst in bursts:
        for _ in range(burst):
            stream.put(float(number), number)
            number += 1
        items, cursor, missed = stream.since(cursor)
        assert missed == max(0, burst - capacity)
        assert items == list(range(number - burst + missed, number))
        got += items
        lost += missed
    assert len(got) + lost == number == stream.count


def test_an_old_sample_is_no_observation():
    stream = SampleStream("left", 1, 4)
    with pytest.raises(StaleSampleError, match="no sample yet"):
        stream.latest(0.0, 1.0)
    stream.put(np.array([1.0]), np.array([[2.0]]))
    assert stream.latest(1.05, 0.05 + 1e-9) == (1.0, 2.0)
    with pytest.raises(StaleSampleError, match="left: newest sample is 200 ms old"):
        stream.latest(1.2, 0.1)
    with pytest.raises(StaleSampleError):
        stream.latest(float("nan"), 1.0)


def test_between_takes_both_ends():
    stream = Stream("s", 10)
    for i in range(10):
        stream.put(0.1 * i, i)
    assert stream.between(0.2, 0.5) == [2, 3, 4, 5]
    assert stream.between(2.0, 3.0) == []


def test_clear_forgets_items_but_not_the_count():
    stream = Stream("s", 10)
    for i in range(3):
        stream.put(i, i)
    stream.clear()
    assert stream.newest() is None
    items, cursor, lost = stream.since(1)
    assert (items, cursor, lost) == ([], 3, 2)


@given(st.integers(1, 40), st.lists(st.integers(0, 40), max_size=20), st.integers(1, 5))
def test_the_ring_is_a_list_with_a_short_memory(capacity, blocks, every):
    ring, kept, cursor, total = SampleStream("ft", 2, capacity), [], 0, 0
    for turn, size in enumerate(blocks):
        size = min(size, capacity)
        numbers = np.arange(total, total + size, dtype=float)
        ring.put(1e-3 * numbers, np.stack([numbers, -numbers], axis=1))
        kept = (kept + list(numbers))[-capacity:]
        total += size
        window = ring.window(-np.inf, np.inf)
        assert window.values[:, 0].tolist() == kept
        if turn % every == 0:
            samples = ring.since(cursor)
            assert samples.lost == max(0, total - cursor - capacity)
            assert samples.values[:, 0].tolist() == list(range(cursor + samples.lost, total))
            cursor = samples.cursor
    assert ring.count == total


def test_window_takes_both_ends_and_returns_a_copy():
    ring = SampleStream("ft", 1, 100)
    t = np.arange(10.0)
    ring.put(t, t[:, None])
    samples = ring.window(3.0, 5.0)
    assert samples.t_s.tolist() == [3.0, 4.0, 5.0]
    samples.values[:] = 99.0
    assert ring.window(3.0, 5.0).values[:, 0].tolist() == [3.0, 4.0, 5.0]


def test_stale_missing_and_not_finite_samples_are_refused():
    ring = SampleStream("ft", 2, 10)
    with pytest.raises(StaleSampleError, match="no sample yet"):
        ring.latest(0.0, 1.0)
    ring.put(np.array([1.0]), np.array([[1.0, 2.0]]))
    t_s, values = ring.latest(1.001, 0.0015)
    assert (t_s, values.tolist()) == (1.0, [1.0, 2.0])
    with pytest.raises(StaleSampleError, match="100 ms old"):
        ring.latest(1.1, 0.0015)
    ring.put(np.array([2.0]), np.array([[np.nan, 2.0]]))
    with pytest.raises(StaleSampleError, match="not a finite number"):
        ring.latest(2.0, 1.0)
    ring.clear()
    with pytest.raises(StaleSampleError, match="no sample yet"):
        ring.latest(2.0, 1.0)


def test_after_clear_the_loss_is_counted():
    ring = SampleStream("ft", 1, 10)
    ring.put(np.arange(4.0), np.zeros((4, 1)))
    ring.clear()
    ring.put(np.array([9.0]), np.zeros((1, 1)))
    samples = ring.since(1)
    assert (samples.lost, samples.t_s.tolist(), samples.cursor) == (3, [9.0], 5)


def test_a_reader_never_sees_a_torn_block():
    """Time and value of one sample belong together while another thread writes."""
    ring, stop = SampleStream("ft", 1, 50), threading.Event()

    def write():
        number = 0
        while not stop.is_set():
            block = np.arange(number, number + 10, dtype=float)
            ring.put(block, 2 * block[:, None])
            number += 10

    writer = threading.Thread(target=write)
    writer.start()
    try:
        cursor = 0
        for _ in range(500):
            samples = ring.since(cursor)
            assert np.array_equal(samples.values[:, 0], 2 * samples.t_s)
            assert np.all(np.diff(samples.t_s) == 1)
            assert len(samples.t_s) % 10 == 0
            cursor = samples.cursor
    finally:
        stop.set()
        writer.join()


@pytest.mark.parametrize(("piece", "bottom", "seed"), CASES)
def test_one_press_felt_by_the_devices_is_the_one_simulated_in_bulk(
    piece, bottom, seed, monkeypatch
):
    press = press_both_ways(piece, bottom, seed, monkeypatch)
    assert press.computed_mm == pytest.approx(press.felt_mm, abs=0.05)
    moved_px = float(np.sqrt(np.mean(press.computed[:, :TACTILE_CHANNELS] ** 2)))
    assert moved_px > 2.0
    assert press.rms_px <= RMS_LIMIT_PX
    wrench = np.abs(press.felt - press.computed)[:, TACTILE_CHANNELS:]
    assert wrench[:, :3].max() < 0.15
    assert wrench[:, 3:].max() < 0.01
