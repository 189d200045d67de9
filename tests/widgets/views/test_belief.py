"""Every view: empty, one value, 1000 values, NaN, in every theme; and never blank or invented."""

from dataclasses import replace

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QImage, QPainter
from PySide6.QtWidgets import QApplication

from tests.app.stand_in import REST, action, belief, stability
from touchdown.backend.core.values import (
    MarkerField,
    Outcome,
    PlaceAction,
    Stability,
    SupportKind,
    TactileFrame,
)
from touchdown.widgets.base import Age, Theme
from touchdown.widgets.plots import TracePlot, draw_message
from touchdown.widgets.shell.devices import ChipValue, DeviceChip
from touchdown.widgets.shell.state import PillState, StatePill
from touchdown.widgets.views.belief import OUTLINES, BeliefScene, BeliefView, describe_scene
from touchdown.widgets.views.decision import DecisionPanel, decision_text, question_text, signed_mm
from touchdown.widgets.views.offset import OffsetScene, OffsetView
from touchdown.widgets.views.probe_maps import BeliefPanel, ProbeStrip
from touchdown.widgets.views.scene import SideBody, SideScene, SideView
from touchdown.widgets.views.scores import Score, ScorePanel
from touchdown.widgets.views.tactile import TactileView

SIZE = (420, 320)


def pixels(widget):
    image = widget.grab().toImage().convertToFormat(QImage.Format.Format_RGB888)
    rows = np.frombuffer(image.constBits(), np.uint8).reshape(image.height(), -1)
    return rows[:, : 3 * image.width()].reshape(image.height(), image.width(), 3).astype(float)


def shown(qtbot, widget):
    qtbot.addWidget(widget)
    widget.resize(*SIZE)
    return widget


def is_colour(pixels, colour, tolerance=30):
    """Return where pixels (h, w, 3) have about a colour."""
    return np.abs(pixels - QColor(colour).getRgb()[:3]).max(axis=2) < tolerance


def coloured(widget, colour, tolerance=30):
    return int(is_colour(pixels(widget), colour, tolerance).sum())


def axis_colours(theme):
    return [theme.tokens.colour(f"axis_{axis}") for axis in "xyz"]


def force(qtbot, theme):
    return shown(qtbot, TracePlot(theme, "Force", "F", "N", 10.0))


def tactile(qtbot, theme):
    view = shown(qtbot, TactileView(theme, "left"))
    view.resize(320, 240)
    return view


def frame(grey):
    image = np.broadcast_to(grey, (240, 320, 3)).astype(np.uint8)
    return TactileFrame("left", 1, 0.1, image)


RAMP = np.linspace(0, 255, 320)[None, :, None]


def field(displacement, state=None):
    state = np.zeros(63, np.uint8) if state is None else state
    return MarkerField("left", 1, 0.1, REST + displacement, displacement, state, 1.0)


def test_tactile_without_a_frame_says_so(qtbot, theme):
    view = tactile(qtbot, theme)
    view.show_age(Age.NEVER, float("inf"), "The bench is being prepared.")
    assert pixels(view).std() > 5  # the sentence
    assert view.seen() == (0, 0)


def test_tactile_shows_image_and_arrows(qtbot, theme):
    view = tactile(qtbot, theme)
    view.show_frame(frame(RAMP), None)
    view.show_age(Age.FRESH, 0.0, "")
    assert pixels(view).std() > 20
    without = coloured(view, "#F5EA26")
    view.show_frame(frame(RAMP), field(np.full((63, 2), 9.0)))
    assert coloured(view, "#F5EA26") > without + 300
    assert view.seen() == (63, 63)


@pytest.mark.promise("W5")
def test_a_stale_picture_is_dimmed_and_dated_then_removed(qtbot, theme):
    view = tactile(qtbot, theme)
    view.show_frame(frame(200), None)
    view.show_age(Age.FRESH, 0.0, "")
    assert pixels(view)[20:200, 20:200].mean() == pytest.approx(140, abs=2), "dimmed to 70 %"
    view.show_age(Age.STALE, 0.3, "")
    assert pixels(view)[100:200, 20:200].mean() == pytest.approx(70, abs=2)
    assert coloured(view, "#F9C800") > 200
    view.show_age(Age.GONE, 2.1, "The camera is lost.")
    corner = pixels(view)[5:40, 5:300]
    assert (corner == corner[0, 0]).all()


def test_inferred_and_lost_markers_and_nan_are_drawn_without_error(qtbot, theme):
    view = tactile(qtbot, theme)
    state = np.arange(63, dtype=np.uint8) % 3
    displacement = np.full((63, 2), 3.0)
    displacement[::5] = np.nan
    view.show_frame(frame(RAMP), field(displacement, state))
    view.show_age(Age.FRESH, 0.0, "")
    assert coloured(view, "#FFFFFF", 20) > 100  # hollow rings and crosses
    assert view.seen() == (21, 63)


def test_traces_without_data_show_no_line(qtbot, theme):
    plot = force(qtbot, theme)
    for colour in axis_colours(theme):
        assert coloured(plot, colour, 4) == 0
    assert plot.summary() == "Force: waiting for data"


@pytest.mark.parametrize("count", [1, 1000])
def test_traces_of_one_and_of_1000_values(qtbot, theme, count):
    plot = force(qtbot, theme)
    t_s = 1e-3 * np.arange(count)
    plot.add(t_s, np.stack([np.full(count, v) for v in (-5.0, 2.0, 7.0)], axis=1))
    plot.show_age(Age.FRESH, 0.0, "")
    for colour in axis_colours(theme):
        assert coloured(plot, colour) > 5
    assert "Fz 7.00" in plot.summary()


def test_a_force_of_zero_has_no_negative_sign(qtbot, theme):
    plot, pictures = force(qtbot, theme), []
    for zero in (-0.001, 0.001):
        plot.add(np.zeros(1) + 2.0 + zero, np.array([[3.0, zero, 7.0]]))
        assert "Fy 0.00" in plot.summary()
        pictures.append(pixels(plot)[:, int(plot.area().rect.right()) + 5 :])
    np.testing.assert_array_equal(*pictures)


def test_read_outs_keep_their_places_whatever_the_curves_do(qtbot, theme):
    plot = force(qtbot, theme)
    places = []
    for t_s, values in ((0.0, (-5.0, 2.0, 7.0)), (1.0, (7.0, -5.0, 2.0))):
        plot.add(t_s + 1e-3 * np.arange(900), np.tile(values, (900, 1)))
        right = int(plot.area().rect.right()) + 5
        column = pixels(plot)[:, right:]
        rows = [np.flatnonzero(is_colour(column, c).any(axis=1)) for c in axis_colours(theme)]
        places.append([float(row.mean()) for row in rows])
    assert places[0] == pytest.approx(places[1], abs=1.5)
    assert places[0] == sorted(places[0])


def test_traces_with_nan_break_the_line(qtbot, theme):
    plot = force(qtbot, theme)
    values = np.full((4000, 3), 5.0)
    values[1000:3000] = np.nan
    plot.add(1e-3 * np.arange(4000), values)
    plot.grab()
    assert 0 < plot.points_drawn <= 2 * 110  # two stretches of 1 s, 36 buckets a second


def test_a_live_curve_has_at_most_two_points_per_pixel_column(qtbot, theme):
    plot = force(qtbot, theme)
    plot.add(1e-3 * np.arange(20_000), np.random.default_rng(0).normal(size=(20_000, 3)))
    plot.grab()
    assert 0 < plot.points_drawn <= 2 * plot.area().rect.width()


def test_the_range_grows_in_round_steps_and_shrinks_only_on_fit(qtbot, theme):
    plot = force(qtbot, theme)
    plot.add(np.array([0.0]), np.array([[12.0, 0, 0]]))
    assert plot.limit == 20.0
    plot.add(np.array([60.0]), np.array([[1.2, 0, 0]]))
    assert plot.limit == 20.0
    plot.fit()
    assert plot.limit == 2.0


def scene(margin=-1.0, **more):
    offset = (4.0, 2.0)
    return BeliefScene(belief(2, offset), stability(offset, margin), (offset,),
                       action(offset, margin).step_mm, (0.3, -0.2), True, **more)  # fmt: skip


def test_belief_shows_the_map_and_its_marks_and_the_truth_where_given(qtbot, theme):
    view = shown(qtbot, BeliefView(theme))
    assert pixels(view).std() > 3
    assert describe_scene(view.scene) == "No probe in this trial yet"
    view.show_scene(scene())
    for _ in range(5):
        before = pixels(view)
    assert (view.renders, view.paints) == (2, 6), "drawn once a scene"
    assert coloured(view, "#FDE737", 30) > 500  # the bright end of cividis
    assert "margin -1.0 mm" in view.accessibleDescription()
    turn = np.linspace(0, 2 * np.pi, 40)
    view.show_scene(scene(truth=np.stack([10 * np.cos(turn), 10 * np.sin(turn)], 1)))
    assert np.abs(pixels(view) - before).max() > 100


@pytest.mark.parametrize("hull", [0, 1, 2, 3])
def test_degenerate_hulls_and_nan_are_drawn(qtbot, theme, hull):
    view = shown(qtbot, BeliefView(theme))
    margin = float("-inf") if hull < 3 else float("nan")
    centre = (float("nan"), 0.0) if hull == 3 else (1.0, 1.0)
    points = np.arange(2.0 * hull).reshape(hull, 2)
    odd = Stability(False, margin, SupportKind.NO_ESTIMATE, points, centre, "belief")
    view.show_scene(BeliefScene(belief(1, (0.0, 0.0)), odd, ((0.0, 0.0),)))
    assert pixels(view).std() > 10


def test_the_frame_holds_path_and_covered_cells():
    x, y, half = scene().frame_mm()
    centres = belief(2, (4.0, 2.0)).cell_centres_mm()[belief(2, (4.0, 2.0)).covered]
    assert (np.abs(centres - (x, y)) <= half).all()


@pytest.mark.promise("W15")
def test_the_decision_names_the_backend_numbers():
    text = decision_text(stability((4.0, 2.0), -2.1), action((4.0, 2.0), -2.1))
    assert text.tone == "bad"
    assert text.margin == "\N{MINUS SIGN}2.1 mm"
    assert "2.1 mm outside" in text.text
    good = decision_text(stability((1.0, 0.0), 1.6), action((1.0, 0.0), 1.6))
    assert good.tone == "good"
    assert "Would stand" in good.result


def test_no_number_is_made_up():
    assert signed_mm(float("nan")) == "no estimate"
    assert signed_mm(float("-inf")) == "no support"
    assert signed_mm(1.64) == "+1.6 mm"
    assert decision_text(None, None).tone == ""


def test_the_question_is_shown_only_when_asked(qtbot, theme):
    panel = DecisionPanel()
    qtbot.addWidget(panel)
    assert not panel.approve.isVisibleTo(panel)
    panel.show_question("Release here?")
    assert panel.approve.isVisibleTo(panel)
    panel.show_question("")
    assert not panel.approve.isVisibleTo(panel)


def test_an_empty_map_has_no_grid_behind_its_message(qtbot, theme, monkeypatch):
    drawn = []
    monkeypatch.setattr("touchdown.widgets.views.belief.draw_mm_grid", lambda *_: drawn.append(1))
    view = shown(qtbot, BeliefView(theme))
    view.grab()
    assert not drawn
    view.show_scene(scene())
    view.grab()
    assert drawn


def test_face_hull_and_true_overlap_differ_in_style_or_colour():
    looks = {(style, colour.name()) for _, style, colour in OUTLINES.values()}
    assert len(looks) == len(OUTLINES) == 3


def test_the_question_names_the_act():
    release = PlaceAction("release", (0.0, 0.0), None, False, "")
    assert question_text(release) == ("Press once more and release here?", "Release")
    assert question_text(replace(release, kind="ask")) == ("Go on probing?", "Go on")


@pytest.mark.parametrize("trials", [0, 1, 1000])
def test_score_of_none_one_and_1000(qtbot, theme, trials):
    panel = shown(qtbot, ScorePanel(theme))
    outcomes = tuple(list(Outcome)[k % 5] for k in range(trials))
    panel.show_score(Score(outcomes, trials, (0.1, 0.9) if trials else None))
    assert pixels(panel).std() > 5


def map_with_strip(qtbot, theme, size):
    strip = ProbeStrip(theme, lambda _: None)
    panel = BeliefPanel(theme, "Belief map", strip)
    strip.show_probes([(scene(), f"{k}: est. +1.0 mm") for k in range(3)], 2)
    qtbot.addWidget(panel)
    panel.resize(*size)
    panel.show()
    QApplication.processEvents()
    return panel, strip


def test_the_small_maps_go_where_they_leave_the_map_more(qtbot, theme):
    high, below = map_with_strip(qtbot, theme, (420, 600))
    wide, beside = map_with_strip(qtbot, theme, (520, 420))
    assert (below.upright, beside.upright) == (False, True)
    assert below.y() >= high.view.geometry().bottom()
    assert beside.x() >= wide.view.geometry().right()
    assert high.view.area().rect.width() > 270
    assert wide.view.area().rect.width() > 270
    wide.resize(420, 600)
    QApplication.processEvents()
    assert wide.view.area().rect == high.view.area().rect, "it depends on the room alone"


@pytest.mark.promise("W10")
def test_small_maps_have_the_chosen_colours_those_to_come_as_well(qtbot, theme):
    panel, strip = map_with_strip(qtbot, theme, (420, 600))
    panel.maps.setCurrentIndex(1)
    strip.show_probes([(scene(), str(k)) for k in range(4)], 3)
    names = {panel.view.map_name, *(small.view.map_name for small in strip.thumbnails)}
    assert names == {"viridis"}


@pytest.mark.parametrize("count", [0, 1, 30])
def test_probe_strip(qtbot, theme, count):
    chosen = []
    strip = shown(qtbot, ProbeStrip(theme, chosen.append))
    strip.show_probes([(scene(), str(k)) for k in range(count)], count - 1)
    assert len(strip.thumbnails) == count
    strip.grab()
    if count:
        qtbot.mouseClick(strip.thumbnails[0], Qt.MouseButton.LeftButton)
        assert chosen == [0]
    strip.show_probes([], -1)
    assert strip.thumbnails == []


@pytest.mark.promise("W10")
def test_every_pill_shape_differs_in_grey(qtbot, theme):
    pill = StatePill(theme)
    qtbot.addWidget(pill)
    seen = []
    for shape in ("ring", "disc", "play", "bars", "square", "triangle", "diamond", "bang"):
        pill.show_state(PillState("X", shape, "grey"))
        pill.resize(pill.sizeHint())
        seen.append(pixels(pill).mean(axis=2)[:, 8:33])
    for i, one in enumerate(seen):
        for other in seen[i + 1 :]:
            assert (np.abs(one - other) > 60).sum() >= 8


def test_chip_and_side_view(qtbot, theme):
    chip = shown(qtbot, DeviceChip(theme, "Arm"))
    chip.show_value(ChipValue("stale", "stale 0.4 s", 3))
    assert chip.accessibleName() == "Arm: stale, stale 0.4 s"
    view = shown(qtbot, SideView(theme))
    empty = pixels(view)
    bottom = SideBody("short", 10, 10, 24, 0, -24)
    for tilt in (0.0, 1.2):
        turn = (np.cos(tilt / 2), 0.0, np.sin(tilt / 2), 0.0)
        piece = SideBody("pot", 7.5, 15, 38, 2.0, 0.0, turn)
        hand = None if tilt else (2.0, 1.0, 30.0)
        view.show_scene(SideScene((bottom,), piece, hand, 15.0, -24.0, "Pot on Short"))
        assert np.abs(pixels(view) - empty).max() > 60


def test_words_of_an_empty_view_take_the_lines_they_need(qapp):
    def ink(width):
        image = QImage(width, 160, QImage.Format.Format_RGB32)
        image.fill(0)
        painter = QPainter(image)
        draw_message(painter, image.rect(), Theme(), "No probe in this trial yet", "It follows.")
        painter.end()
        rows = {y for y in range(160) for x in range(width) if image.pixel(x, y) & 0xFFFFFF}
        return max(rows) - min(rows)

    # One line more of the title; the detail stays below it.
    assert ink(140) > 1.4 * ink(400)


def test_names_of_bottom_and_piece_can_be_read_in_every_theme(qtbot, theme):
    turn = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    disc = 9.0 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    view = shown(qtbot, OffsetView(theme, lambda _at_mm: None, lambda: None))
    drawn = []
    for names in (None, ("short", "pot")):
        view.show_scene(OffsetScene(disc, disc, (6.0, -3.0), names=names))
        drawn.append(pixels(view))
    added = np.abs(drawn[1] - drawn[0]).max(axis=2) > 60
    ink = added & is_colour(drawn[1], theme.tokens.colour("text"), 60)
    bottom = slice(SIZE[0] // 2 - 90, SIZE[0] // 2 - 5)
    assert ink[:, bottom].sum() > 30
