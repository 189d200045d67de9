"""Bounded buffers against a plain list: the newest wins, losses are counted, old are refused."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.faults import StaleSampleError
from touchdown.backend.core.streams import SampleStream, Stream


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


def test_readers_do_not_disturb_each_other():
    stream = Stream("s", 4)
    for i in range(3):
        stream.put(i, i)
    assert stream.since(0)[0] == stream.since(0)[0] == [0, 1, 2]


def test_an_old_item_is_no_observation_but_may_be_shown():
    stream = Stream("left", 4)
    with pytest.raises(StaleSampleError, match="no sample yet"):
        stream.latest(0.0, 1.0)
    stream.put(1.0, "a")
    assert stream.latest(1.05, 0.05 + 1e-9) == "a"
    with pytest.raises(StaleSampleError, match="left: newest sample is 200 ms old"):
        stream.latest(1.2, 0.1)
    assert stream.newest() == "a"


@pytest.mark.parametrize("now", [float("nan")])
def test_a_clock_that_is_no_number_makes_every_sample_stale(now):
    stream = Stream("s", 1)
    stream.put(0.0, 1)
    with pytest.raises(StaleSampleError):
        stream.latest(now, 1.0)


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
