"""Pictures: displacement sizes, and what every picture can: zoom, move, enlarge, copy, save."""

from itertools import combinations

import numpy as np
import pytest
from PySide6.QtCore import QPoint, QPointF, Qt
from PySide6.QtGui import QGuiApplication, QWheelEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QFileDialog, QMessageBox, QStackedWidget, QWidget

from tests.app.stand_in import REST, StandInBench, belief
from touchdown.backend.core.values import MarkerField, MarkerState, TactileFrame
from touchdown.widgets.base import Age, hbox
from touchdown.widgets.base.theme import Theme, colour_table
from touchdown.widgets.plots import DistributionView, RecordedTraces, TracePlot, WrenchTrace
from touchdown.widgets.plots.pictures import WHOLE
from touchdown.widgets.views.belief import BeliefScene, BeliefView
from touchdown.widgets.views.offset import OffsetView
from touchdown.widgets.views.tactile import (
    FULL_PX,
    LOOKS,
    TactileView,
    magnitude_picture,
    magnitude_px,
)


def field(shift, lost=()):
    state = np.zeros(63, dtype=np.uint8)
    state[list(lost)] = MarkerState.LOST
    return MarkerField("left", 1, 0.0, REST + shift, shift, state, 1.0)


def test_the_peak_is_at_the_marker_that_moved():
    shift = np.zeros((63, 2))
    shift[31] = (FULL_PX, 0.0)
    picture = magnitude_picture(field(shift), "grey")[:, :, 0]
    v, u = np.unravel_index(int(picture.argmax()), picture.shape)
    assert (u, v) == pytest.approx(tuple(REST[31]), abs=1.0)
    assert picture.max() >= 250
    assert picture[0, 0] == 0


def test_halfway_between_two_markers_is_their_mean():
    shift = np.zeros((63, 2))
    shift[30] = shift[31] = (0.0, 6.0)
    picture = magnitude_picture(field(shift), "grey")[:, :, 0]
    u, v = np.rint((REST[30] + REST[31]) / 2).astype(int)
    assert picture[v, u] == pytest.approx(255 * 6.0 / FULL_PX, abs=2)


def test_a_lost_marker_makes_no_peak_and_all_lost_is_level():
    shift = np.full((63, 2), (3.0, 0.0))
    shift[10] = (90.0, 0.0)
    assert magnitude_px(field(shift, lost=[10])) == pytest.approx(np.full((7, 9), 3.0))
    assert magnitude_px(field(shift, lost=range(63))).max() == 0.0


def test_colours_are_those_of_the_map_in_the_order_of_the_camera():
    full = np.full((63, 2), (FULL_PX, 0.0))
    picture = magnitude_picture(field(full), "cividis")
    assert picture.shape == (240, 320, 3)
    assert tuple(picture[120, 160][::-1]) == tuple(colour_table("cividis")[255])


def test_every_look_draws_something_else(qtbot):
    bench = StandInBench()
    bench.press = 1.0
    bench.turn(0.04)
    view = TactileView(Theme(), "left")
    qtbot.addWidget(view)
    view.resize(320, 240)
    view.show_frame(bench.frames["left"].newest(), bench.fields["left"].newest())
    view.show_age(view._age.FRESH, 0.0, "")
    pictures = []
    for look, _ in LOOKS:
        view.show_look(look)
        pictures.append(view.grab().toImage())
    assert not any(one == other for one, other in combinations(pictures, 2))


# -- what every picture can ------------------------------------------------------------------------


def traces(theme):
    view, t_s = TracePlot(theme, "Force", "F", "N", 10.0), np.linspace(0, 10, 500)
    view.add(t_s, np.stack([t_s, -t_s, 0.5 * t_s], axis=1))
    return view


def recorded(theme):
    view, t_s = RecordedTraces(theme, (0, 1, 2), lambda _: None), np.linspace(0, 2, 400)
    view.show_trace(WrenchTrace(t_s, np.stack([t_s] * 6, axis=1)))
    return view


def belief_view(theme):
    view = BeliefView(theme)
    view.show_scene(BeliefScene(belief(1, (0.0, 0.0)), path=((0.0, 0.0),)))
    return view


def gel(theme):
    """The upper left quarter of the image is white, the rest black."""
    view, image = TactileView(theme, "left"), np.zeros((240, 320, 3), np.uint8)
    image[:120, :160] = 255
    view.show_frame(TactileFrame("left", 1, 0.1, image), None)
    view.show_age(Age.FRESH, 0.0, "")
    view.show_look("image")
    return view


VIEWS = {
    "gel": gel, "belief": belief_view, "traces": traces, "recorded": recorded,
    "offset": lambda theme: OffsetView(theme, lambda _: None, lambda: None),
    "distribution": lambda theme: DistributionView(theme, "Distribution", lambda _: None),
}  # fmt: skip


@pytest.fixture
def picture(request, qtbot):
    made = VIEWS[getattr(request, "param", "gel")](Theme())
    qtbot.addWidget(made)
    made.resize(400, 300)
    made.show()
    return made


def wheel(view, at, notches=1):
    event = QWheelEvent(
        QPointF(at), QPointF(view.mapToGlobal(at)), QPoint(), QPoint(0, 120 * notches),
        Qt.MouseButton.NoButton, Qt.KeyboardModifier.NoModifier, Qt.ScrollPhase.NoScrollPhase,
        False,
    )  # fmt: skip
    QApplication.sendEvent(view, event)
    return event.isAccepted()


@pytest.mark.parametrize("picture", VIEWS, indirect=True)
def test_the_wheel_zooms_about_the_pointer_and_a_drag_moves_the_picture(picture):
    rect, whole = picture.area().rect, picture.area()
    at = (rect.topLeft() + 0.3 * (rect.bottomRight() - rect.topLeft())).toPoint()
    before = picture.area().at(QPointF(at))
    assert wheel(picture, at, 3)
    near, factor = picture.area(), 1.25**3
    assert near.at(QPointF(at)) == pytest.approx(before)
    assert whole.x1 - whole.x0 == pytest.approx(factor * (near.x1 - near.x0))
    up = 1.0 if picture.unit == "" else factor
    assert whole.y1 - whole.y0 == pytest.approx(up * (near.y1 - near.y0)), "a plot: time alone"
    picture.grab()
    button = Qt.MouseButton.MiddleButton if picture.editable else Qt.MouseButton.LeftButton
    QTest.mousePress(picture, button, pos=at)
    QTest.mouseMove(picture, at + QPoint(10, 0))
    QTest.mouseRelease(picture, button, pos=at + QPoint(10, 0))
    moved = picture.area()
    assert moved.x0 - near.x0 == pytest.approx(-10 * (near.x1 - near.x0) / rect.width())
    assert wheel(picture, at, -9)
    assert (picture.zoom, wheel(picture, at, -1)) == (WHOLE, False), "the page gets the wheel"


def test_a_zoomed_gel_shows_the_part_under_the_pointer_and_one_to_one_its_pixels(picture):
    wheel(picture, picture.area().place(80.0, 60.0).toPoint(), 6)
    image, rect = picture.grab().toImage(), picture.area().rect.toRect()
    shades = {image.pixelColor(x, y).lightness() for x in (rect.left() + 2, rect.right() - 2)
              for y in (rect.top() + 2, rect.bottom() - 2)}  # fmt: skip
    assert shades == {255}
    picture.show_actual_size()
    area = picture.area()
    assert area.rect.width() * picture.devicePixelRatioF() == pytest.approx(area.x1 - area.x0)
    assert area.rect.height() == pytest.approx(area.y0 - area.y1)


@pytest.mark.parametrize(
    ("picture", "at", "said"),
    [("gel", (80.0, 60.0), "x 80, y 60 px"), ("belief", (0.0, 0.0), "x +0.0, y +0.0 mm; p 1.00"),
     ("traces", (-5.0, 0.0), "Fx +5.0, Fy \N{MINUS SIGN}5.0, Fz +2.5 N"),
     ("recorded", (1.0, 0.0), "+1.00 s: Fx +1.0, Fy +1.0, Fz +1.0")],
    indirect=["picture"],
)  # fmt: skip
def test_the_crosshair_has_the_values_and_no_picture_that_is_kept(
    picture, at, said, monkeypatch, tmp_path
):
    assert said in picture.reading(*at)
    picture.setFocus()
    framed, plain = picture.grab().toImage(), picture._grab().toImage()
    assert framed != plain, "the frame of the focus is seen but not kept"
    QTest.mouseMove(picture, picture.area().place(*at).toPoint())
    assert picture.grab().toImage() != framed
    picture.copy()
    assert QGuiApplication.clipboard().pixmap().toImage() == plain
    paths, warned = [tmp_path / "a.png", tmp_path / "no" / "a.png"], []
    monkeypatch.setattr(QMessageBox, "warning", lambda *a: warned.append(a[-1]))
    for path in paths:
        monkeypatch.setattr(QFileDialog, "getSaveFileName", lambda *a, p=path, **k: (str(p), ""))
        picture.save()
    assert (paths[0].exists(), len(warned)) == (True, 1)
    assert str(paths[1]) in warned[0]


def test_a_double_click_enlarges_to_the_page_and_escape_puts_back(qtbot):
    stack, page = QStackedWidget(), QWidget()
    left, right = gel(Theme()), QWidget()
    hbox((left, 1), (right, 1), parent=page)
    stack.addWidget(page)
    qtbot.addWidget(stack)
    stack.resize(800, 500)
    stack.show()
    QApplication.processEvents()
    before = left.geometry()
    QTest.mouseDClick(left, Qt.MouseButton.LeftButton)
    assert left.geometry() == page.rect()
    stack.resize(900, 600)
    assert left.geometry() == page.rect()
    QTest.keyClick(left, Qt.Key.Key_Escape)
    stack.resize(800, 500)
    qtbot.waitUntil(lambda: left.geometry() == before)
    assert left.isVisible()


def test_keys_reach_every_command_of_a_picture(picture):
    assert picture.focusPolicy() & Qt.FocusPolicy.TabFocus
    assert picture.contextMenuPolicy() is Qt.ContextMenuPolicy.ActionsContextMenu
    texts = [action.text().replace("&", "") for action in picture.actions()]
    for word in ("Zoom in", "Zoom out", "Fit", "1:1", "Enlarge", "Copy", "Save"):
        assert any(text.startswith(word) for text in texts), word
    picture.actions()[0].trigger()
    before, _ = picture.area(), picture.setFocus()
    QTest.keyClick(picture, Qt.Key.Key_Right, Qt.KeyboardModifier.ControlModifier)
    assert picture.area().x0 > before.x0
    picture.actions()[2].trigger()
    assert picture.zoom == WHOLE
