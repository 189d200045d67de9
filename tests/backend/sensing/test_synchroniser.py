from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.values import FINGERS, Finger, MarkerField, MarkerState, Recording
from touchdown.backend.sensing.episode import synchronise

ONSET_S = 12.3456
TICKS_S = ONSET_S + 0.1 * np.arange(1, 21)


def displacement(finger: Finger, t_s: float) -> np.ndarray:
    """A field linear in time, so that linear interpolation must be exact; every number differs."""
    index = np.arange(126.0).reshape(63, 2)
    sign = 1.0 if finger == "left" else -1.0
    return sign * (0.01 * index + (t_s - ONSET_S) * (1.0 + index / 126.0))


def field(finger: Finger, number: int, t_s: float) -> MarkerField:
    moved = displacement(finger, t_s)
    return MarkerField(finger, number, t_s, moved + 100.0, moved, np.zeros(63, np.uint8), 1.0)


def frame_times(period_s: float = 0.04, phase_s: float = 0.013) -> np.ndarray:
    return ONSET_S - 0.3 + phase_s + period_s * np.arange(int(2.4 / period_s))


def record(
    left: list[MarkerField] | None = None,
    right: list[MarkerField] | None = None,
    wrench_t_s: np.ndarray | None = None,
    wrench: np.ndarray | None = None,
) -> Recording:
    own = {"left": left, "right": right}
    fields: list[MarkerField] = []
    for finger in FINGERS:
        given = own[finger]
        fields += (
            [field(finger, i, float(t)) for i, t in enumerate(frame_times())]
            if given is None
            else given
        )
    t_s = ONSET_S - 0.3 + 1e-3 * np.arange(2400) if wrench_t_s is None else wrench_t_s
    values = np.outer(t_s - ONSET_S, np.arange(1.0, 7.0)) if wrench is None else wrench
    empty = np.zeros((0, 3))
    return Recording(t_s, values, tuple(fields), (), np.zeros(0), empty, np.zeros(6))


def test_linear_signals_are_met_exactly() -> None:
    ticks = synchronise(record(), ONSET_S)
    for finger, name in zip(ticks.fingers, FINGERS, strict=True):
        for i, t_s in enumerate(TICKS_S):
            np.testing.assert_allclose(
                finger.displacement_px[i], displacement(name, t_s), atol=1e-9
            )
    # The mean of a ramp over (tick - 0.1, tick] of 100 samples lies 49.5 samples before the last.
    i = np.arange(20)
    last = np.floor((TICKS_S - (ONSET_S - 0.3)) * 1e3 + 1e-6) * 1e-3 - 0.3
    np.testing.assert_allclose(ticks.wrench[i, 0], last - 0.0495, atol=1e-9)
    np.testing.assert_allclose(ticks.wrench[:, 5], 6 * ticks.wrench[:, 0])


def test_order_of_the_252_numbers() -> None:
    rows = synchronise(record(), ONSET_S).observation()
    assert rows.shape == (20, 258)
    assert rows.dtype == np.float32
    for sensor, finger in enumerate(FINGERS):
        moved = displacement(finger, TICKS_S[4])
        for axis in (0, 1):
            for row, column in ((0, 0), (3, 7), (6, 8)):
                index = ((sensor * 2 + axis) * 7 + row) * 9 + column
                assert rows[4, index] == pytest.approx(moved[row * 9 + column, axis], abs=1e-5)


def test_skew_is_the_distance_to_the_nearest_frame() -> None:
    ticks = synchronise(record(), ONSET_S)
    times = frame_times()
    expected = max(min(abs(t - tick) for t in times) for tick in TICKS_S)
    assert ticks.skew_s == pytest.approx(expected, abs=1e-12)


def test_frame_on_the_tick_needs_no_other() -> None:
    exact = [field("left", i, float(t)) for i, t in enumerate(TICKS_S)]
    ticks = synchronise(record(left=exact), ONSET_S)
    assert ticks.left.near.all()
    np.testing.assert_allclose(ticks.left.displacement_px[0], exact[0].displacement_px)


def test_nothing_is_extrapolated() -> None:
    early = [field("left", i, float(t)) for i, t in enumerate(frame_times()) if t < ONSET_S + 1.99]
    ticks = synchronise(record(left=early), ONSET_S)
    assert np.isnan(ticks.left.displacement_px[19]).all()
    assert not ticks.left.near[19]
    late = [field("left", i, float(t)) for i, t in enumerate(frame_times()) if t > ONSET_S + 0.101]
    ticks = synchronise(record(left=late), ONSET_S)
    assert np.isnan(ticks.left.displacement_px[0]).all()


@pytest.mark.promise("C5")
def test_long_holes_are_not_bridged() -> None:
    kept = [
        field("left", i, float(t))
        for i, t in enumerate(frame_times())
        if not ONSET_S + 0.72 < t < ONSET_S + 1.18
    ]
    ticks = synchronise(record(left=kept), ONSET_S)
    in_hole = (TICKS_S > ONSET_S + 0.72) & (TICKS_S < ONSET_S + 1.18)
    assert np.array_equal(np.isnan(ticks.left.displacement_px[:, 0, 0]), in_hole)
    assert ticks.left.hole_s > 0.44
    assert np.isfinite(ticks.right.displacement_px).all()


def test_no_frames_at_all() -> None:
    ticks = synchronise(record(left=[]), ONSET_S)
    assert np.isnan(ticks.left.displacement_px).all()
    assert not ticks.left.near.any()
    assert ticks.skew_s == np.inf
    assert ticks.left.hole_s == pytest.approx(2.0)


def test_field_with_nan_is_a_frame_that_never_came() -> None:
    fields = [field("left", i, float(t)) for i, t in enumerate(frame_times())]
    moved = fields[20].displacement_px.copy()
    moved[5, 1] = np.nan
    bad = fields[20]
    fields[20] = MarkerField(
        "left", 20, bad.t_s, bad.position_px.copy(), moved, bad.state.copy(), 1.0
    )
    with_bad = synchronise(record(left=fields), ONSET_S)
    without = synchronise(record(left=fields[:20] + fields[21:]), ONSET_S)
    np.testing.assert_array_equal(with_bad.left.displacement_px, without.left.displacement_px)
    assert np.isfinite(with_bad.left.displacement_px).all()
    assert (with_bad.left.dropped, without.left.dropped) == (0, 1)


def test_marker_states_of_both_frames_count() -> None:
    fields = [field("left", i, float(t)) for i, t in enumerate(frame_times())]
    state = np.zeros(63, np.uint8)
    state[7], state[8] = MarkerState.INFERRED, MarkerState.LOST
    first = next(i for i, f in enumerate(fields) if f.t_s > TICKS_S[9])
    old = fields[first]
    fields[first] = MarkerField(
        "left", first, old.t_s, old.position_px.copy(), old.displacement_px.copy(), state, 1.0
    )
    ticks = synchronise(record(left=fields), ONSET_S)
    assert ticks.left.inferred[9, 7]
    assert ticks.left.lost[9, 8]
    assert not ticks.left.lost[9, 7]
    assert ticks.left.inferred.sum() == 2


def test_wrench_needs_80_percent_and_finite_samples() -> None:
    t_s = ONSET_S - 0.3 + 1e-3 * np.arange(2400)
    values = np.ones((2400, 6))
    in_fifth = (t_s > TICKS_S[4] - 0.1) & (t_s <= TICKS_S[4])
    keep = np.ones(2400, dtype=bool)
    keep[np.flatnonzero(in_fifth)[:19]] = False
    ticks = synchronise(record(wrench_t_s=t_s[keep], wrench=values[keep].copy()), ONSET_S)
    assert np.isfinite(ticks.wrench).all()
    keep[np.flatnonzero(in_fifth)[:21]] = False
    ticks = synchronise(record(wrench_t_s=t_s[keep], wrench=values[keep].copy()), ONSET_S)
    assert np.flatnonzero(np.isnan(ticks.wrench[:, 2])).tolist() == [4]
    values[np.flatnonzero(in_fifth)[50], 3] = np.nan
    ticks = synchronise(record(wrench_t_s=t_s, wrench=values), ONSET_S)
    assert np.flatnonzero(np.isnan(ticks.wrench[:, 2])).tolist() == [4]


def test_no_wrench_is_missing_not_zero() -> None:
    ticks = synchronise(record(wrench_t_s=np.zeros(0), wrench=np.zeros((0, 6))), ONSET_S)
    assert np.isnan(ticks.wrench).all()
