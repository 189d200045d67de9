"""Views of the label page: what they say, what they answer, and never at the wrong instant."""

import sys

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QWidget

from tests.app.stand_in import REST
from tests.widgets.views.test_belief import coloured
from touchdown.backend.core.values import MarkerField, SupportKind
from touchdown.backend.geometry import circle, face_points, ring, square
from touchdown.backend.placement.equilibrium import resting_contact
from touchdown.widgets.forms.questions import ChoiceBar
from touchdown.widgets.lists.recordings import HistoryList, HistoryRow, LabelList, LabelListRow
from touchdown.widgets.plots.recorded_traces import (
    PhasePlot,
    RecordedTraces,
    WrenchTrace,
    min_max_per_column,
)
from touchdown.widgets.shell.state import StateStrip
from touchdown.widgets.views.film import FilmTrack, FilmView, latest
from touchdown.widgets.views.offset import (
    Ghost,
    OffsetScene,
    OffsetView,
    ghost_pen,
    offset_text,
    verdict_text,
)

POT = face_points(circle(15.0))
FACE, BOTTOM = circle(15.0).polygon(96), square(15.0).polygon()


def scene(offset, ghosts=()):
    f = resting_contact(POT, (0.0, 0.0), square(15.0), offset)
    return OffsetScene(BOTTOM, FACE, offset, 0.0, f.points_mm, f.touching, f.hull_mm, f.centre_mm,
                       f.margin_mm, f.support, f.too_close, 0.2, ghosts)  # fmt: skip


def count(widget, colour):
    return coloured(widget, colour, 12)


class TestOffsetView:
    @pytest.fixture
    def view(self, theme, qtbot):
        self.moves, self.drops = [], []
        made = OffsetView(theme, self.moves.append, lambda: self.drops.append(1))
        qtbot.addWidget(made)
        made.resize(420, 400)
        made.show()
        return made

    def press(self, view, *at_mm):
        QTest.mousePress(view, Qt.MouseButton.LeftButton, pos=view.area().place(*at_mm).toPoint())

    def drag(self, view, start_mm, end_mm):
        self.press(view, *start_mm)
        to = view.area().place(*end_mm).toPoint()
        QTest.mouseMove(view, to)
        QTest.mouseRelease(view, Qt.MouseButton.LeftButton, pos=to)

    def test_dragging_reports_where_the_face_is_wanted(self, view):
        view.show_scene(scene((2.0, 1.0)))
        self.drag(view, (3.0, 3.0), (5.0, 0.0))
        assert self.moves[-1] == pytest.approx((4.0, -2.0), abs=0.12)
        assert self.drops == [1]

    def test_a_face_without_a_place_is_called_to_the_press(self, view):
        view.show_scene(OffsetScene(BOTTOM, FACE))
        self.press(view, -4.0, 2.0)
        assert self.moves[0] == pytest.approx((-4.0, 2.0), abs=0.12)

    def test_what_may_not_be_changed_is_not_dragged(self, view):
        view.show_scene(scene((0.0, 0.0)))
        view.editable = False
        self.drag(view, (0.0, 0.0), (4.0, 0.0))
        assert (self.moves, self.drops) == ([], [])

    def test_more_contact_is_more_colour_and_the_hull_says_stands_or_falls(self, view, theme):
        t = theme.tokens
        view.show_scene(scene((8.0, 0.0)))
        far, bad = count(view, t.colour("axis_x")), count(view, t.colour("bad"))
        view.show_scene(scene((2.0, 0.0)))
        assert count(view, t.colour("axis_x")) > 1.5 * far
        assert bad > 20 > count(view, t.colour("bad"))
        assert count(view, t.colour("good")) > 20

    @pytest.mark.parametrize("offset", [(0.0, 0.0), (-12.0, 3.0), (20.0, -20.0), (99.99, -99.99)])
    def test_both_outlines_and_every_source_lie_within_the_square(self, view, offset):
        ghost = Ghost("model", (-offset[0] / 2, 30.0), 1.0)
        view.show_scene(scene(offset, (ghost,)))
        area = view.area()
        for outline, (x, y) in ((FACE, offset), (BOTTOM, (0, 0)), (FACE, ghost.offset_mm)):
            placed = outline + np.array([x, y])
            assert area.x0 < placed[:, 0].min() <= placed[:, 0].max() < area.x1
            assert area.y0 < placed[:, 1].min() <= placed[:, 1].max() < area.y1

    def test_the_hole_of_a_bottom_is_not_filled(self, view):
        colours = []
        for outline in (circle(24.0), ring(24.0, 12.0)):
            view.show_scene(OffsetScene(outline.path(96), FACE))
            at = view.area().place(2.5, 2.5).toPoint()
            colours.append(view.grab().toImage().pixelColor(at))
        view.show_scene(OffsetScene(circle(2.0).path(96), FACE))
        empty = view.grab().toImage().pixelColor(at)
        assert colours[1] == empty
        assert colours[0] != empty

    def test_the_scale_is_one_while_the_centre_is_over_the_bottom(self, view):
        reach = {scene((0.5 * k, 0.0)).reach_mm for k in range(-15, 16)}
        assert len(reach) == 1
        assert len({scene((0.1 * k, 0.0)).reach_mm for k in range(76, 200)}) <= 3

    def test_a_scale_that_grows_while_dragging_does_not_move_the_face(self, view):
        view.show_scene(scene((6.0, 0.0)))
        self.press(view, 6.0, 0.0)
        to = view.area().place(14.0, 0.0).toPoint()
        for _ in range(3):
            QTest.mouseMove(view, to)
            view.show_scene(scene(self.moves[-1]))
        assert view.scene.reach_mm > scene((6.0, 0.0)).reach_mm
        assert self.moves[-1] == pytest.approx((14.0, 0.0), abs=0.12)

    def test_each_source_has_its_colour_and_a_box_that_hides_it(self, view, theme):
        kinds = ("commanded", "measured", "scene", "model")
        view.resize(640, 480)
        view.show_scene(
            scene(
                (8.0, 0.0), tuple(Ghost(k, (-9.0 + 3 * n, 6.0), 0.0) for n, k in enumerate(kinds))
            )
        )
        colours = {kind: ghost_pen(kind, theme).color() for kind in kinds}
        assert len({colour.name() for colour in colours.values()}) == len(kinds)
        assert len({ghost_pen(kind, theme).style() for kind in kinds}) == len(kinds)
        for kind, box in view.legend.items():
            assert box.text() == kind
            assert kind in box.accessibleName()
            seen = count(view, colours[kind])
            box.click()
            # What stays is the line in the legend.
            assert count(view, colours[kind]) < seen - 25
        view.show_scene(scene((8.0, 0.0)))
        assert not any(box.isVisible() for box in view.legend.values())

    @pytest.mark.parametrize("size", [(300, 300), (420, 300), (300, 420), (900, 500)])
    def test_the_legend_covers_no_outline(self, view, size):
        view.resize(*size)
        view.show_scene(scene((4.0, -7.0), (Ghost("measured", (4.0, -7.0), 0.2),)))
        box = view.legend["measured"].geometry()
        assert view.area().rect.right() <= box.left() <= box.right() <= view.width()
        assert view.area().rect.right() <= view._label_at.left()
        assert box.bottom() <= view._label_at.top()

    def test_a_zoomed_face_is_still_dragged_and_the_middle_button_moves_the_picture(self, view):
        view.show_scene(scene((2.0, 1.0)))
        view.zoom_by(2.0)
        self.drag(view, (3.0, 3.0), (5.0, 0.0))
        assert self.moves[-1] == pytest.approx((4.0, -2.0), abs=0.12)
        before, at = view.area(), view.area().rect.center().toPoint()
        QTest.mousePress(view, Qt.MouseButton.MiddleButton, pos=at)
        QTest.mouseMove(view, at + QPoint(20, 0))
        QTest.mouseRelease(view, Qt.MouseButton.MiddleButton, pos=at)
        assert view.area().x0 < before.x0
        assert self.drops == [1]

    def test_the_ground_is_drawn_once_and_the_ghosts_when_they_change(self, view, monkeypatch):
        drawn = []
        from touchdown.widgets.views import offset

        for name in ("draw_bottom", "draw_ghosts"):
            real = getattr(offset, name)
            monkeypatch.setattr(offset, name, lambda *a, n=name, r=real: drawn.append(n) or r(*a))
        for k in range(5):
            view.show_scene(scene((2.0 + 0.1 * k, 0.0)))
            view.grab()
        assert drawn == ["draw_bottom", "draw_ghosts"]
        view.show_scene(scene((2.0, 0.0), (Ghost("model", (3.0, 0.0), 0.8),)))
        view.grab()
        assert drawn == ["draw_bottom", "draw_ghosts", "draw_ghosts"]


def test_verdicts_in_words():
    inside, outside = scene((2.0, 0.0)), scene((8.0, 0.0))
    assert verdict_text(inside) == (
        f"Would stand: centre of mass {inside.margin_mm:.1f} mm inside the hull"
    )
    assert verdict_text(outside).startswith("Would fall: centre of mass")
    assert verdict_text(scene((30.0, 0.0))) == "No contact: it would fall"
    assert verdict_text(OffsetScene(BOTTOM, FACE)) == "No displacement yet"
    near = OffsetScene(BOTTOM, FACE, (1.0, 0.0), points_mm=POT, touching=np.ones(len(POT), bool),
                       margin_mm=0.1, support=SupportKind.AREA, too_close=True)  # fmt: skip
    assert verdict_text(near).startswith("Too close to call")
    assert offset_text((1.5, -0.25), 0.1) == (
        "x +1.50, y \N{MINUS SIGN}0.25 mm \N{PLUS-MINUS SIGN} 0.10"
    )


def track(finger, stamps, field_stamps, decoded):
    def picture(index):
        decoded.append((finger, index))
        return np.full((240, 320, 3), index, np.uint8)

    fields = tuple(
        MarkerField(finger, k, t, REST, np.zeros((63, 2)), np.zeros(63, np.uint8), 1.0)
        for k, t in enumerate(field_stamps)
    )
    return FilmTrack(np.array(stamps), picture, np.array(field_stamps), fields)


class TestFilm:
    """Unequal rates, and a dropped frame: at every instant each view shows its own newest."""

    LEFT = (0.00, 0.04, 0.08, 0.12)
    RIGHT = (0.01, 0.11)  # the frames at 0.04 to 0.08 were dropped

    @pytest.fixture
    def film(self, theme, qtbot):
        self.decoded, self.sought = [], []
        made = FilmView(theme, self.seek)
        qtbot.addWidget(made)
        self.film = made
        reel = {"left": track("left", self.LEFT, self.LEFT, self.decoded),
                "right": track("right", self.RIGHT, (0.01, 0.05, 0.11), self.decoded)}  # fmt: skip
        made.take_reel(reel, (0.0, 0.12))
        made.show_cursor(0.07)
        return made

    def seek(self, t_s):
        self.sought.append(t_s)
        self.film.show_cursor(t_s)

    def test_stamps_and_not_indices_align_the_fingers(self, film):
        assert self.decoded == [("left", 1), ("right", 0)]  # and nothing else was decoded
        assert film.views["right"]._field.t_s == 0.05
        film.show_cursor(0.12)
        assert self.decoded[-2:] == [("left", 3), ("right", 1)]
        film.show_cursor(0.005)
        assert film.views["right"]._age.value == "gone"

    def test_stepping_visits_every_frame_of_either_finger_once(self, film):
        film.show_cursor(0.0)
        for _ in range(8):
            film.step(1)
        assert self.sought == sorted({*self.LEFT, *self.RIGHT} - {0.0})
        film.step(-1)
        assert self.sought[-1] == 0.11

    def test_playing_runs_to_the_end_and_stops(self, film, qtbot):
        film.play_or_pause()
        qtbot.waitUntil(lambda: not film.playing, timeout=60_000)
        assert self.sought[-1] == pytest.approx(0.12)
        assert all(b >= a for a, b in zip(self.sought, self.sought[1:], strict=False))

    def test_without_pictures_the_arrows_say_so(self, film):
        bare = track("left", (), self.LEFT, self.decoded)
        film.take_reel({"left": bare}, (0.0, 0.12))
        film.show_cursor(0.07)
        assert film.notes["left"].text() == "left, no picture kept"
        assert film.views["right"]._age.value == "gone"


def test_the_newest_sample_not_later_than_the_cursor():
    stamps = np.array([0.0, 0.04, 0.1])
    assert [latest(stamps, t) for t in (-0.1, 0.0, 0.0399, 0.04, 0.5)] == [-1, 0, 0, 1, 2]


def _traces(theme, *channels, seek=lambda _t_s: None):
    return RecordedTraces(theme, channels or (0, 1), seek)


class TestTraces:
    @pytest.fixture
    def trace(self):
        t_s = np.linspace(0, 2, 2001)
        return WrenchTrace(t_s, np.stack([k + t_s for k in range(6)], axis=1))

    def test_readings_stand_at_the_cursor(self, theme, qtbot, trace):
        plot = _traces(theme, 0, 1, 2)
        qtbot.addWidget(plot)
        plot.show_trace(trace)
        plot.show_cursor(1.0)
        assert plot.at_cursor().tolist() == [1, 2, 3, 4, 5, 6]
        assert plot.summary() == "Fx +1.0, Fy +2.0, Fz +3.0"
        plot.show_cursor(-1.0)
        assert np.isnan(plot.at_cursor()).all()

    def test_two_units_have_two_axes(self, theme, qtbot, trace):
        plot = _traces(theme, 2, 3)
        qtbot.addWidget(plot)
        plot.resize(400, 200)
        plot.show_trace(trace)
        assert plot.units == ("N", "N·m")
        assert plot.area("N").y1 != plot.area("N·m").y1
        assert count(plot, theme.tokens.colour("axis_x")) > 50
        assert count(plot, theme.tokens.colour("axis_z")) > 50

    def test_a_click_moves_the_cursor_to_its_time(self, theme, qtbot, trace):
        sought = []
        plot = _traces(theme, 0, seek=sought.append)
        qtbot.addWidget(plot)
        plot.resize(400, 200)
        plot.show_trace(trace)
        area = plot.area("N")
        at = QPointF(area.x(0.5), area.rect.center().y()).toPoint()
        QTest.mousePress(plot, Qt.MouseButton.LeftButton, pos=at)
        assert sought[-1] == pytest.approx(0.5, abs=0.01)

    @pytest.mark.parametrize("kind", [_traces, PhasePlot])
    def test_curves_are_drawn_again_only_after_a_change(
        self, theme, qtbot, trace, monkeypatch, kind
    ):
        plot, drawn = kind(theme), []
        qtbot.addWidget(plot)
        real = plot.draw_curves
        monkeypatch.setattr(plot, "draw_curves", lambda on, t: drawn.append(1) or real(on, t))
        plot.show_trace(trace)
        for _ in range(2):
            plot.show_cursor(1.0)
            plot.grab()
        assert len(drawn) == 1
        plot.resize(420, 200)
        plot.grab()
        assert len(drawn) == 2

    def test_thinning_keeps_a_spike(self):
        values = np.zeros(10_000)
        values[7777] = 9.0
        _, kept = min_max_per_column(np.arange(10_000) * 1e-3, values, 100)
        assert kept.max() == 9.0
        assert len(kept) <= 200

    @pytest.mark.parametrize("kind", [_traces, PhasePlot])
    def test_nothing_recorded_is_said(self, theme, qtbot, kind):
        view = kind(theme)
        qtbot.addWidget(view)
        view.show_trace(None)
        assert count(view, theme.tokens.colour("text")) > 10

    def test_the_phase_plot_follows_the_cursor(self, theme, qtbot, trace):
        plot = PhasePlot(theme)
        qtbot.addWidget(plot)
        plot.resize(240, 240)
        plot.show_trace(trace)
        plot.show_cursor(0.2)
        few = count(plot, theme.tokens.colour("axis_x"))
        plot.show_cursor(2.0)
        assert count(plot, theme.tokens.colour("axis_x")) > few


def label_list(theme, qtbot, chosen):
    rows = [LabelListRow(str(k), f"pot {k}", "now", "draft", ("flag",)) for k in range(10_000)]
    view = LabelList(theme, chosen.append)
    qtbot.addWidget(view)
    view.resize(240, 300)
    view.show_rows(rows)
    view.show()
    return view


def test_the_list_shows_ten_thousand_rows_and_picks_one(theme, qtbot):
    chosen = []
    view = label_list(theme, qtbot, chosen)
    view.choose(7000)
    box = view.visualRect(view.currentIndex())
    QTest.mouseClick(view.viewport(), Qt.MouseButton.LeftButton, pos=box.center())
    assert chosen == [7000]
    tip = view.model().index(3).data(Qt.ItemDataRole.AccessibleTextRole)
    assert tip == "pot 3, now, draft, flag"


def test_a_row_that_changes_lays_out_no_other(theme, qtbot):
    view = label_list(theme, qtbot, [])
    view.choose(5000)
    before = view.grab().toImage()
    asked = []
    sys.setprofile(lambda frame, *_: asked.append(frame.f_code.co_name))
    try:
        view.show_row(5000, LabelListRow("5000", "pot 5000", "now", "rejected"))
        view.choose(5001)
        picture = view.grab()
    finally:
        sys.setprofile(None)
    assert asked.count("rowCount") < 500
    assert picture.toImage() != before


def test_only_an_older_version_can_be_restored(theme, qtbot):
    asked = []
    view = HistoryList(asked.append)
    qtbot.addWidget(view)
    view.show_rows([HistoryRow("r2", 2, "draft: x", "Ann", "moved", True),
                    HistoryRow("r1", 1, "draft: y", "setup", "", False)])  # fmt: skip
    view.choose(0)
    assert not view.restore.isEnabled()
    view.choose(1)
    view.restore.click()
    assert asked == ["r1"]


def test_a_choice_answers_once_with_its_own_keys(theme, qtbot):
    parent = QWidget()
    qtbot.addWidget(parent)
    parent.resize(600, 400)
    bar, answers = ChoiceBar(parent), []
    with qtbot.waitActive(parent, timeout=60_000):
        parent.show()
        parent.activateWindow()
    bar.ask("Why?", [("1", "slip"), ("?", "unsure")], answers.append)
    QTest.keyClick(bar, Qt.Key.Key_4)
    assert bar.isVisible()
    QTest.keyClick(bar, "?")
    assert answers == ["unsure"]
    assert not bar.isVisible()


def test_the_strip_says_in_words_what_it_shows(theme, qtbot):
    strip = StateStrip(theme)
    qtbot.addWidget(strip)
    strip.resize(500, 30)
    strip.show_label("draft", ("model 4.1 off",), "saved 10:00:00, rev 2", warns=True)
    assert strip.accessibleName() == "draft, model 4.1 off, saved 10:00:00, rev 2"
    assert count(strip, theme.tokens.colour("pill_yellow")) > 50
