"""One press is one stop, whatever is open and wherever the focus is."""

import pytest
from PySide6.QtCore import Qt, QTimer
from PySide6.QtGui import QKeySequence, QShortcut
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QFileDialog,
    QLineEdit,
    QMenu,
    QMessageBox,
    QSpinBox,
)

from tests.app.conftest import settle
from touchdown.backend.devices.protocols import RobotMode
from touchdown.backend.runs.requests import RunState

PLACES = ["window", "combo", "spin box", "line edit", "combo popup", "menu", "message box",
          "file dialog"]  # fmt: skip

PAGES = ("operate", "collect", "train", "stack", "review")


def press(key):
    """Press a key as the window system delivers it: to the window in front."""
    window = (
        QApplication.activePopupWidget()
        or QApplication.activeModalWidget()
        or QApplication.activeWindow()
    )
    QTest.keyClick(window.windowHandle(), key)


def field_of(main, kind):
    """Return a field of the page in front; a page without one gets one of its own."""
    page = main.workspaces[main.window.front].page
    for field in page.findChildren(kind):
        if field.isVisible() and field.isEnabled() and field.objectName() != "qt_spinbox_lineedit":
            return field
    field = (QSpinBox if kind is QAbstractSpinBox else kind)(page)
    if isinstance(field, QComboBox):
        field.addItems(["one", "two"])
    field.show()
    return field


def put_focus(main, place):
    """Open what the case names; return what closes it again."""
    kinds = {"combo": QComboBox, "spin box": QAbstractSpinBox, "line edit": QLineEdit}
    if place in kinds:
        field_of(main, kinds[place]).setFocus()
    elif place == "combo popup":
        combo = field_of(main, QComboBox)
        combo.showPopup()
        return combo.hidePopup
    elif place == "menu":
        menu = QMenu(main.window)
        menu.addAction("one")
        menu.popup(main.window.mapToGlobal(main.window.rect().center()))
        return menu.close
    elif place == "message box":
        box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=main.window)
        box.open()
        return box.close
    elif place == "file dialog":
        dialog = QFileDialog(main.window)
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.open()
        return dialog.close
    return lambda: None


@pytest.mark.promise("W2")
@pytest.mark.parametrize("page", PAGES)
def test_f12_stops_exactly_once_from_everywhere(live, bench, qtbot, page):
    live.go(page)
    for count, place in enumerate(PLACES, 1):
        close = put_focus(live, place)
        QApplication.processEvents()
        press(Qt.Key.Key_F12)
        assert bench.stops == count, place
        assert bench.interlock.latched, place
        close()
        live.reset()
        QApplication.processEvents()
        assert not bench.interlock.latched


@pytest.mark.promise("R14", "W2")
def test_f12_stops_in_every_state(live, bench):
    for count, state in enumerate(RunState, 1):
        bench.set_state(state)
        settle(live)
        press(Qt.Key.Key_F12)
        assert bench.stops == count, state
        settle(live)
        assert live.bar.pill.state.word == "STOPPED", state
        live.reset()


@pytest.mark.promise("W2")
def test_f12_stops_inside_a_modal_loop(live, bench):
    box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=live.window)
    QTimer.singleShot(0, box, lambda: press(Qt.Key.Key_F12))
    QTimer.singleShot(50, box, box.close)
    box.exec()
    assert bench.stops == 1


@pytest.mark.promise("W2")
def test_space_stops_only_while_something_moves(live, bench):
    live.workspaces["stack"].page.belief.setFocus()
    press(Qt.Key.Key_Space)
    assert bench.stops == 0
    bench.set_state(RunState.RUNNING)
    press(Qt.Key.Key_Space)
    assert bench.stops == 1


@pytest.mark.parametrize("key", [Qt.Key.Key_F12, Qt.Key.Key_Space])
def test_no_shortcut_takes_a_stop_away(live, bench, key):
    taken = []
    QShortcut(QKeySequence(key), live.window).activated.connect(lambda: taken.append(key))
    bench.set_state(RunState.RUNNING)
    press(key)
    assert (bench.stops, taken) == (1, [])


def test_space_stops_while_the_arm_moves_without_a_run(live, bench):
    bench.devices["arm"].mode = RobotMode.MOVING
    press(Qt.Key.Key_Space)
    assert bench.stops == 1


@pytest.mark.promise("W2")
def test_space_is_a_space_in_a_text_field(live, bench):
    bench.set_state(RunState.RUNNING)
    live.workspaces["stack"].page.run._seed.setFocus()
    QApplication.processEvents()
    press(Qt.Key.Key_Space)
    assert bench.stops == 0


def test_space_never_presses_a_button_while_moving(live, bench):
    bench.set_state(RunState.RUNNING)
    settle(live)
    live.workspaces["stack"].page.run.cancel.setFocus()
    press(Qt.Key.Key_Space)
    assert bench.stops == 1
    assert bench.engine.orders == []


@pytest.mark.promise("W2")
def test_a_held_key_is_one_stop(live, bench):
    from PySide6.QtCore import QEvent
    from PySide6.QtGui import QKeyEvent

    window = live.window.windowHandle()
    for repeat in (False, True, True):
        event = QKeyEvent(
            QEvent.Type.KeyPress,
            Qt.Key.Key_F12,
            Qt.KeyboardModifier.NoModifier,
            autorep=repeat,
        )
        QApplication.sendEvent(window, event)
    assert bench.stops == 1


def test_the_button_stops_on_the_press(live, bench, qtbot):
    qtbot.mousePress(live.bar.stop, Qt.MouseButton.LeftButton)
    assert bench.stops == 1
    qtbot.mouseRelease(live.bar.stop, Qt.MouseButton.LeftButton)
    assert bench.stops == 1


@pytest.mark.promise("W7")
def test_stop_needs_reset_before_the_next_start(live, bench, qtbot):
    press(Qt.Key.Key_F12)
    settle(live)
    assert not live.workspaces["stack"].page.run.start.isEnabled()
    assert live.cards.codes == ("STOPPED",)
    live.cards.card("STOPPED")._act()
    assert bench.resets == 1
    settle(live)
    assert live.cards.codes == ()
    assert live.workspaces["stack"].page.run.start.isEnabled()


def test_stop_before_a_bench_is_there_is_harmless(main, qtbot):
    main.window.show()
    qtbot.waitExposed(main.window, timeout=60_000)
    QTest.keyClick(main.window.windowHandle(), Qt.Key.Key_F12)
    assert main.cards.codes == ()


def test_the_words_never_promise_an_emergency_stop(live):
    assert "software" in live.bar.stop.text()
    assert "emergency" not in live.bar.stop.text().lower()
