"""Arrows, scales and labels: pure geometry against hand-made values."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PySide6.QtCore import QLineF, QRectF
from PySide6.QtGui import QColor, QImage, QPainter, QPen

from tests.screen_check import PaintRecorder
from tests.widgets.views.test_belief import force, is_colour, pixels
from touchdown.widgets.base import signed
from touchdown.widgets.plots import (
    CurveLine,
    CurvePlot,
    LineBuffer,
    PlotArea,
    ReliabilityPlot,
    nice_step,
    polygon_of,
    tick_text,
    ticks,
)
from touchdown.widgets.plots.axes import GridPainter, TraceBuckets, spread_labels
from touchdown.widgets.views import tactile
from touchdown.widgets.views.tactile import DimmedPicture


def test_an_arrow_starts_at_rest_and_ends_at_gain_times_the_displacement():
    strokes = tactile.arrow_segments(np.array([[10.0, 20.0]]), np.array([[4.0, -3.0]]))
    assert strokes[0, 0] == pytest.approx([10, 20, 10 + 12, 20 - 9])
    heads = strokes[0, 1:]
    assert heads[:, 2:] == pytest.approx(np.array([[22, 11], [22, 11]]))
    # Both strokes of the head lie behind the tip and on either side of the shaft.
    back = heads[:, :2] - [22, 11]
    assert (back @ [4, -3] < 0).all()
    assert np.prod(back @ [3, 4]) < 0
    # No displacement: no direction, no NaN.
    assert not tactile.arrow_segments(np.zeros((1, 2)), np.zeros((1, 2))).any()


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
    assert (tick_text(-0.001, 0.5), signed(-0.001)) == ("0.0", "+0.00")  # zero is not negative


@pytest.mark.parametrize("side", [40, 70, 110, 300])
def test_the_labels_of_a_grid_never_touch(theme, side):
    image, drawn = QImage(500, 400, QImage.Format.Format_RGB32), PaintRecorder()
    area = PlotArea(QRectF(60, 10, side, side), -0.034, 0.021, -0.034, 0.021)
    with drawn(), QPainter(image) as painter:
        GridPainter(painter, area, theme.tokens).grid(4, line="")
    below = [one.box for one in drawn.painted if one.box.top() > area.rect.bottom()]
    assert below
    assert all(a.right() < b.left() for a, b in pairwise(below))


def test_the_area_maps_corners_to_corners():
    area = PlotArea(QRectF(10, 20, 100, 50), -1, 1, 0, 5)
    assert (area.x(-1), area.x(1), area.y(0), area.y(5)) == (10, 110, 70, 20)
    polygon = area.polygon(np.array([-1.0, 1.0]), np.array([0.0, 5.0]))
    assert [(p.x(), p.y()) for p in polygon] == [(10, 70), (110, 20)]
    assert area.at(area.place(0.3, 4.0)) == pytest.approx((0.3, 4.0))
    assert polygon_of(np.empty((0, 2))).size() == 0


@given(st.lists(st.floats(-50, 350) | st.just(np.nan), min_size=3, max_size=3))
@example([np.nan, 5.0, 5.0])
def test_labels_never_overlap_and_stay_inside(wanted):
    placed = sorted(spread_labels(wanted, 14, 0, 300))
    assert all(b - a >= 14 - 1e-9 for a, b in pairwise(placed))
    assert placed[0] >= 0
    assert placed[-1] <= 300


LEVELS = {"x": -6.0, "y": 2.0, "z": 8.0}


@pytest.mark.parametrize("theme", ["light"], indirect=True)
def test_more_is_higher_and_each_axis_has_its_colour(qtbot, theme):
    plot = force(qtbot, theme)
    plot.add(1e-3 * np.arange(5000), np.tile(list(LEVELS.values()), (5000, 1)))
    rect = plot.area().rect
    inside = pixels(plot)[:, int(rect.left()) + 1 : int(rect.right()) - 1]
    zero, unit = rect.center().y(), rect.height() / 20.0
    for axis, level in LEVELS.items():
        curve = is_colour(inside, theme.tokens.colour(f"axis_{axis}"))
        rows = np.flatnonzero(curve.sum(axis=1) > 50)
        assert rows.mean() == pytest.approx(zero - level * unit, abs=1.5), axis


SIZE = (64, 48)


@pytest.fixture
def canvas(qapp):
    """Return what a drawing leaves on a black ground, as (48, 64) grey levels."""

    def drawn(draw):
        image = QImage(*SIZE, QImage.Format.Format_RGB32)
        image.fill(0)
        painter = QPainter(image)
        painter.setPen(QPen(QColor("#FFFFFF"), 2))
        draw(painter)
        painter.end()
        return (
            np.frombuffer(image.constBits(), np.uint8).reshape(SIZE[1], SIZE[0], 4)[..., 0].copy()
        )

    return drawn


def test_strokes_are_those_that_qt_draws_from_its_own_lines(canvas):
    rng, strokes = np.random.default_rng(3), LineBuffer()
    for count in (5, 40, 3, 0):
        lines = rng.uniform(0, 48, (count, 4))
        strokes.take(lines)
        some = canvas(lambda p, n=count: strokes.draw(p, n // 3, n))
        own = [QLineF(*line) for line in lines[count // 3 :].tolist()]
        assert (some == canvas(lambda p, own=own: p.drawLines(own) if own else None)).all()
        assert some.any() == bool(count)


def test_a_dimmed_picture_shows_nothing_of_the_one_before(canvas):
    picture, whole = DimmedPicture(), QRectF(0, 0, *SIZE)
    for shape, level in (((24, 32, 3), 200), ((24, 32, 3), 40), ((96, 128, 3), 120)):
        image = np.full(shape, level, np.uint8)
        for target in (whole, QRectF(8, 6, 20, 15)):
            grey = canvas(lambda p, i=image, t=target: picture.draw(p, t, i, 1.0, 0.5))
            inside = np.zeros((SIZE[1], SIZE[0]), bool)
            x, y, width, height = target.toRect().getRect()
            inside[y : y + height, x : x + width] = True
            assert (grey[inside] == level // 2).all()
            assert not grey[~inside].any()


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
    traces = TraceBuckets(3, buckets=10)
    traces.add(np.empty(0), np.empty((0, 3)))
    age_s, low, high = traces.ordered()
    assert np.isnan([low, high]).all()
    assert age_s[-1] == 0.0
    assert traces.empty


def test_a_title_without_room_ends_with_an_ellipsis(qtbot, theme):
    plot = CurvePlot(theme, "Loss per epoch (nats a point)")
    qtbot.addWidget(plot)
    assert plot.toolTip() == plot.accessibleName()
    for width in range(150, 190):
        plot.resize(width, 120)
        edge = pixels(plot)[: int(plot.area().rect.top()) - 3, -1]
        assert (edge == edge[0]).all(), f"a letter is cut off at {width} px"


def test_the_title_of_an_empty_plot_has_the_whole_view(qtbot, theme):
    for plot in (CurvePlot(theme, "Loss per epoch (nats a point)"), ReliabilityPlot(theme)):
        qtbot.addWidget(plot)
        plot.resize(plot.minimumSize())
        drawn = plot.grab().toImage()
        for x, y in ((1, 1), (plot.width() - 2, plot.height() - 2)):
            assert drawn.pixelColor(x, y) == theme.tokens.colour("bg")


def test_names_that_are_wider_than_a_plot_wrap_without_meeting(qtbot, theme):
    plot, drawn = ReliabilityPlot(theme), PaintRecorder()
    qtbot.addWidget(plot)
    names = ["A  error of the earliest run 0.043", "B  error of the second run 0.050"]
    plot.show_lines([CurveLine(name, ((0.2, 0.3), (0.8, 0.7)), "axis_x") for name in names])
    plot.resize(220, 180)
    with drawn():
        plot.grab()
    named = [one for one in drawn.painted if one.text in names]
    assert len(named) == len(names)
    assert not any(one.cut for one in named)
    assert named[0].box.bottom() <= named[1].box.top()


def test_time_that_jumps_back_starts_anew():
    traces = TraceBuckets(1, span_s=1.0, buckets=10)
    traces.add(np.array([50.0]), np.array([[-9.0]]))
    assert traces.largest() == 9.0
    traces.add(np.array([0.01]), np.array([[1.0]]))
    assert traces.largest() == 1.0


def test_a_block_longer_than_the_span_keeps_the_newest():
    traces = TraceBuckets(1, span_s=1.0, buckets=10)
    t_s = 1e-3 * np.arange(5000)
    traces.add(t_s, t_s[:, None])
    _, low, high = traces.ordered()
    assert np.isfinite(low).all()
    assert np.nanmax(high) == pytest.approx(4.999)
    assert np.nanmin(low) >= 3.999
