"""Arrows, scales and labels: pure geometry against hand-made values."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PySide6.QtCore import QRectF

from touchdown.widgets.plots.axes import (
    PlotArea,
    nice_step,
    polygon_of,
    spread_labels,
    tick_text,
    ticks,
)
from touchdown.widgets.views import tactile


def test_an_arrow_starts_at_rest_and_ends_at_gain_times_the_displacement():
    strokes = tactile.arrow_segments(np.array([[10.0, 20.0]]), np.array([[4.0, -3.0]]))
    assert strokes[0, 0] == pytest.approx([10, 20, 10 + 12, 20 - 9])
    heads = strokes[0, 1:]
    assert heads[:, 2:] == pytest.approx(np.array([[22, 11], [22, 11]]))
    # Both strokes of the head lie behind the tip and on either side of the shaft.
    back = heads[:, :2] - [22, 11]
    assert (back @ [4, -3] < 0).all()
    assert np.prod(back @ [3, 4]) < 0


def test_no_displacement_gives_no_direction_and_no_nan():
    strokes = tactile.arrow_segments(np.zeros((1, 2)), np.zeros((1, 2)))
    assert (strokes == 0).all()


def test_bins_grow_with_length():
    lengths = np.array([0.0, 0.4, 1.0, 2.0, 4.0, 6.0, 50.0])
    bins = tactile.colour_bins(np.stack([lengths, np.zeros(7)], axis=1))
    assert bins.tolist() == [0, 0, 1, 2, 3, 4, 5]
    assert len(tactile.BIN_COLOURS) == 6


def test_nice_steps():
    assert [nice_step(s, 5) for s in (1, 10, 40, 0.3)] == pytest.approx([0.2, 2, 10, 0.1])


@given(st.floats(0.01, 1e4), st.integers(2, 9))
def test_ticks_are_round_and_inside(half, count):
    found = ticks(-half, half, count)
    assert 0.0 in found
    assert max(found) <= half * (1 + 1e-9)
    assert 1 <= len(found) <= 2.6 * count + 1


def test_tick_text_has_a_true_minus_and_the_decimals_of_its_step():
    assert tick_text(-0.1, 0.05) == "\N{MINUS SIGN}0.10"
    assert tick_text(10, 5) == "10"


def test_the_area_maps_corners_to_corners():
    area = PlotArea(QRectF(10, 20, 100, 50), -1, 1, 0, 5)
    assert (area.x(-1), area.x(1), area.y(0), area.y(5)) == (10, 110, 70, 20)
    polygon = area.polygon(np.array([-1.0, 1.0]), np.array([0.0, 5.0]))
    assert [(p.x(), p.y()) for p in polygon] == [(10, 70), (110, 20)]


def test_an_empty_polygon():
    assert polygon_of(np.empty((0, 2))).size() == 0


@given(st.lists(st.floats(-50, 350), min_size=3, max_size=3))
def test_labels_never_overlap_and_stay_inside(wanted):
    placed = sorted(spread_labels(wanted, 14, 0, 300))
    assert all(b - a >= 14 - 1e-9 for a, b in pairwise(placed))
    assert placed[0] >= 0
    assert placed[-1] <= 300


def test_labels_of_nan_values_are_still_placed():
    assert np.isfinite(spread_labels([float("nan"), 5.0, 5.0], 14, 0, 300)).all()
