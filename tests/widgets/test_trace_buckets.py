"""Buckets against a brute-force oracle: no peak is lost, no gap is filled, no zero is invented."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchdown.widgets.plots.axes import TraceBuckets


def oracle(t_s, values, span_s, buckets):
    width = span_s / buckets
    index = np.floor(t_s / width + 1e-9).astype(int)
    low = np.full(buckets, np.nan)
    high = np.full(buckets, np.nan)
    for k in range(buckets):
        inside = values[index == index[-1] - buckets + 1 + k]
        inside = inside[np.isfinite(inside)]
        if len(inside):
            low[k], high[k] = inside.min(), inside.max()
    return low, high


@given(
    blocks=st.lists(st.integers(1, 90), min_size=1, max_size=12),
    pauses=st.lists(st.integers(0, 400), min_size=12, max_size=12),
    seed=st.integers(0, 1000),
)
@settings(max_examples=40, deadline=None)
def test_any_blocks_give_the_oracle(blocks, pauses, seed):
    rng = np.random.default_rng(seed)
    traces = TraceBuckets(1, span_s=1.0, buckets=50)
    start, all_t, all_v = 0, [], []
    for count, pause in zip(blocks, pauses, strict=False):
        t_s = 1e-3 * (start + np.arange(1, count + 1))
        values = rng.normal(size=(count, 1))
        values[rng.random(count) < 0.1] = np.nan
        traces.add(t_s, values)
        start += count + pause
        all_t.append(t_s)
        all_v.append(values[:, 0])
    _, low, high = traces.ordered()
    expected = oracle(np.concatenate(all_t), np.concatenate(all_v), 1.0, 50)
    np.testing.assert_array_equal(low[:, 0], expected[0])
    np.testing.assert_array_equal(high[:, 0], expected[1])


def test_nothing_is_nan_not_zero():
    age_s, low, high = TraceBuckets(3, buckets=10).ordered()
    assert np.isnan(low).all()
    assert np.isnan(high).all()
    assert age_s[-1] == 0.0
    assert TraceBuckets(3).empty


def test_one_sample_spike_survives():
    traces = TraceBuckets(1, span_s=10.0, buckets=100)
    values = np.zeros((9000, 1))
    values[4321] = 41.3
    traces.add(1e-3 * np.arange(9000), values)
    assert traces.largest() == pytest.approx(41.3)


def test_time_that_jumps_back_starts_anew():
    traces = TraceBuckets(1, span_s=1.0, buckets=10)
    traces.add(np.array([50.0]), np.array([[9.0]]))
    traces.add(np.array([0.01]), np.array([[1.0]]))
    _, _, high = traces.ordered()
    assert np.nanmax(high) == 1.0


def test_a_block_longer_than_the_span_keeps_the_newest():
    traces = TraceBuckets(1, span_s=1.0, buckets=10)
    t_s = 1e-3 * np.arange(5000)
    traces.add(t_s, t_s[:, None])
    _, low, high = traces.ordered()
    assert np.isfinite(low).all()
    assert np.nanmax(high) == pytest.approx(4.999)
    assert np.nanmin(low) >= 3.999


def test_nothing_to_add_is_fine():
    traces = TraceBuckets(2)
    traces.add(np.empty(0), np.empty((0, 2)))
    assert traces.empty
