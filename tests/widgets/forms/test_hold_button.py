"""Every way of losing a held button or key ends the hold, once, for mouse, touch and key."""

import pytest
from PySide6.QtCore import QEvent, QPoint, QPointF, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLineEdit, QMessageBox, QStackedWidget, QWidget

from touchdown.widgets.forms.fields import (
    LEAST_PX,
    MOUSE,
    RENEW_MS,
    SLACK_PX,
    HoldButton,
    HoldState,
)

KEY = Qt.Key.Key_Left
NEVER_MS = 3_600_000  # until the next renewal, where a test counts them


class Desk(QStackedWidget):
    """A window with two pages; the first has a hold-to-run button and a text field."""

    def __init__(self):
        super().__init__()
        self.page, self.other = QWidget(), QWidget()
        self.addWidget(self.page)
        self.addWidget(self.other)
        self.field = QLineEdit(self.page)
        self.field.move(10, 120)
        self.renewed, self.causes, self.allowed = [], [], True
        self.hold = HoldState(self.page, self._renew, self.causes.append)
        self.button = HoldButton("+X", "+x", "Jog plus X", self.hold)
        self.button.setParent(self.page)
        self.button.setGeometry(40, 40, 60, 60)
        self.second = HoldButton("+Y", "+y", "Jog plus Y", self.hold)
        self.second.setParent(self.page)
        self.second.setGeometry(200, 40, 60, 60)
        self.page.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.resize(400, 200)

    def _renew(self, what):
        self.renewed.append(what)
        return self.allowed

    def keyPressEvent(self, event):  # noqa: N802
        if event.key() == KEY and not event.isAutoRepeat():
            self.hold.press(self.page, "-x", event.key())


@pytest.fixture
def desk(qtbot):
    made = Desk()
    made.hold._timer.setInterval(NEVER_MS)
    qtbot.addWidget(made)
    in_front(qtbot, made)
    made.page.setFocus()
    return made


def in_front(qtbot, window):
    with qtbot.waitActive(window, timeout=60_000):
        window.show()
        window.activateWindow()


@pytest.fixture
def touch():
    return QTest.createTouchDevice()


def begin(desk, source, touch):
    if source == "mouse":
        QTest.mousePress(desk.button, Qt.MouseButton.LeftButton)
    elif source == "touch":
        QTest.touchEvent(desk.button, touch).press(0, QPoint(30, 30), desk.button).commit()
    else:
        QTest.keyPress(desk, KEY)
    assert desk.hold.held
    assert len(desk.renewed) == 1


def show_dialog(desk):
    desk.box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=desk)
    desk.box.open()
    QApplication.processEvents()
    desk.box.close()


def refuse(desk):
    desk.allowed = False
    desk.hold._beat()


def leave_program(_desk):
    application = QApplication.instance()
    application.applicationStateChanged.emit(Qt.ApplicationState.ApplicationInactive)


ENDS = {
    "hide": lambda desk: desk.hold._widget.hide(),
    "disable": lambda desk: desk.hold._widget.setEnabled(False),
    "close": lambda desk: desk.close(),
    "other page": lambda desk: desk.setCurrentWidget(desk.other),
    "deactivated": lambda desk: QApplication.sendEvent(desk, QEvent(QEvent.Type.WindowDeactivate)),
    "blocked": lambda desk: QApplication.sendEvent(desk, QEvent(QEvent.Type.WindowBlocked)),
    "dialog": show_dialog,
    "focus moved": lambda desk: desk.field.setFocus(),
    "program left": leave_program,
    "second axis": lambda desk: desk.hold.press(desk.second, "+y", MOUSE),
    "refused": refuse,
    "other key": lambda desk: QTest.keyPress(desk, Qt.Key.Key_Up),
    "state left": lambda desk: desk.hold.end("the bench is not ready"),
}


@pytest.mark.promise("W3", "H3", "H4", "H5", "H6", "H8", "H9", "H10", "H11", "H13")
@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS)
@pytest.mark.parametrize("source", ["mouse", "touch", "key"])
def test_it_ends_once_and_is_renewed_no_more(desk, touch, source, end, qtbot):
    begin(desk, source, touch)
    end(desk)
    assert not desk.hold.held
    assert len(desk.causes) == 1
    assert not desk.hold._timer.isActive()
    assert not desk.button.isDown()
    count = len(desk.renewed)
    desk.hold._beat()
    assert len(desk.renewed) == count, "a beat that was on its way renews nothing"


@pytest.mark.promise("H4")
def test_another_window_ends_it_and_none_begins_behind_that(desk, touch, qtbot):
    begin(desk, "mouse", touch)
    other = QWidget()
    qtbot.addWidget(other)
    in_front(qtbot, other)
    assert not desk.hold.held
    desk.hold.press(desk.button, "+x", MOUSE)
    assert not desk.hold.held
    assert desk.renewed == ["+x"]


@pytest.mark.promise("H1")
def test_letting_go_ends_it(desk, touch):
    begin(desk, "mouse", touch)
    QTest.mouseRelease(desk.button, Qt.MouseButton.LeftButton)
    begin_again = len(desk.renewed)
    assert desk.causes == ["released"]
    QTest.touchEvent(desk.button, touch).press(0, QPoint(30, 30), desk.button).commit()
    QTest.touchEvent(desk.button, touch).release(0, QPoint(30, 30), desk.button).commit()
    QTest.keyPress(desk, KEY)
    QTest.keyRelease(desk, KEY)
    assert desk.causes == ["released"] * 3
    assert len(desk.renewed) == begin_again + 2


@pytest.mark.promise("H2")
@pytest.mark.parametrize(("away", "held"), [(SLACK_PX - 1, True), (SLACK_PX + 2, False)])
def test_the_pointer_may_leave_by_the_slack_only(desk, touch, away, held):
    begin(desk, "mouse", touch)
    QTest.mouseMove(desk.button, QPoint(desk.button.width() + away, 30))
    desk.button._follow(QPointF(desk.button.width() - 1 + away, 30.0))
    assert desk.hold.held is held


@pytest.mark.promise("H7")
def test_auto_repeat_is_one_hold_without_extra_renewals(desk):
    QTest.keyPress(desk, KEY)
    for _ in range(20):
        for kind in (QEvent.Type.KeyRelease, QEvent.Type.KeyPress):
            event = QKeyEvent(kind, KEY, Qt.KeyboardModifier.NoModifier, autorep=True)
            QApplication.sendEvent(desk, event)
    assert desk.renewed == ["-x"]
    assert desk.hold.held
    QTest.keyRelease(desk, KEY)
    assert desk.causes == ["released"]


@pytest.mark.promise("H1")
def test_only_the_source_that_began_it_lets_it_go(desk, touch):
    begin(desk, "mouse", touch)
    desk.hold.release(int(KEY))
    assert desk.hold.held
    desk.hold.release(MOUSE)
    assert not desk.hold.held


def test_it_is_renewed_while_held(desk, qtbot):
    desk.hold._timer.setInterval(RENEW_MS)
    QTest.mousePress(desk.button, Qt.MouseButton.LeftButton)
    qtbot.waitUntil(lambda: len(desk.renewed) >= 4, timeout=60_000)
    assert set(desk.renewed) == {"+x"}


@pytest.mark.promise("H13")
def test_a_refused_press_holds_nothing(desk):
    desk.allowed = False
    QTest.mousePress(desk.button, Qt.MouseButton.LeftButton)
    assert desk.causes == ["refused"]
    assert not desk.hold.held


def test_the_button_takes_no_focus_and_is_large(desk):
    assert desk.button.focusPolicy() is Qt.FocusPolicy.NoFocus
    assert min(desk.button.minimumWidth(), desk.button.minimumHeight()) >= LEAST_PX
    assert desk.button.accessibleName()
    QTest.keyClick(desk, Qt.Key.Key_Space)
    assert desk.renewed == []


@pytest.mark.promise("H14")
def test_destruction_ends_the_renewals(qtbot):
    desk = Desk()
    in_front(qtbot, desk)
    QTest.mousePress(desk.button, Qt.MouseButton.LeftButton)
    renewed, causes = desk.renewed, desk.causes
    assert renewed
    desk.close()
    desk.deleteLater()
    QApplication.sendPostedEvents(desk, QEvent.Type.DeferredDelete)
    assert len(causes) == 1
    count = len(renewed)
    qtbot.wait(150)
    assert len(renewed) == count
