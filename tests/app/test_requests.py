"""The Stack page asks the operator of a trial on devices; keys and buttons answer."""

import json
import os
from dataclasses import asdict

import pytest
from PySide6.QtCore import QEvent, Qt, QTimer
from PySide6.QtGui import QKeyEvent, QKeySequence, QShortcut
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
from touchdown.app.shell import restore_form
from touchdown.app.stack.workspace import StackMemory
from touchdown.backend.core.events import (
    HandOverAwaited,
    OutcomeAwaited,
    PhaseEntered,
    PhotoKept,
    RunFinished,
    SetUpAwaited,
    TrialFinished,
)
from touchdown.backend.core.values import Outcome
from touchdown.backend.devices.protocols import RobotMode
from touchdown.backend.runs.recorder import BOOKMARKS_NAME, Bookmark, read_bookmarks
from touchdown.backend.runs.requests import RunState

PNG = b"\x89PNG\r\n\x1a\n" + bytes(40)
ASKED = OutcomeAwaited(3.0, Outcome.FELL, "The opening fingers met a lateral force of 2.4 N.")


@pytest.fixture
def stack(live, bench):
    live.go("stack")
    bench.tell_start()
    bench.set_state(RunState.RUNNING, trial=1, trials=1)
    settle(live)
    return live.workspaces["stack"]


def press(main, key):
    QTest.keyClick(main.window.windowHandle(), key)


def test_the_scene_is_pictured_and_a_key_says_that_it_is_set(live, bench, stack):
    trial = stack.page.trial
    assert not trial.isVisible()
    bench.events.publish(SetUpAwaited(0.0, "pot", "short", (6.2, -3.4), holds=False))
    settle(live)
    assert trial.isVisible()
    assert trial.picture.scene.offset_mm == (6.2, -3.4)
    assert "+6.2" in trial.text.text()
    assert not stack.page.belief_panel.isVisible()
    press(live, Qt.Key.Key_Y)
    assert bench.answers == [True]
    assert not trial.isVisible()
    assert stack.page.belief_panel.isVisible()
    press(live, Qt.Key.Key_Y)
    assert bench.answers == [True], "nothing is asked any more"
    bench.events.publish(HandOverAwaited(1.0, "pot", gives=True))
    settle(live)
    trial.no.click()
    assert bench.answers == [True, False]


def ask(live, bench):
    bench.prompt.ask()
    bench.events.publish(ASKED)
    settle(live)


@pytest.mark.parametrize(
    ("key", "seen"),
    [
        (Qt.Key.Key_1, Outcome.PLACED),
        (Qt.Key.Key_2, Outcome.FELL),
        (Qt.Key.Key_3, Outcome.KNOCKED_OVER),
        (Qt.Key.Key_Y, ASKED.proposed),
    ],
)
def test_one_key_says_what_became_of_it(live, bench, stack, key, seen):
    ask(live, bench)
    roles = {o: b.property("role") for o, b in stack.page.trial.outcomes.items()}
    assert [o for o, role in roles.items() if role == "primary"] == [ASKED.proposed]
    press(live, key)
    assert bench.prompt.seen == (seen, "")
    assert not stack.page.trial.isVisible()


def test_a_void_trial_needs_its_reason_and_is_listed(live, bench, stack):
    ask(live, bench)
    press(live, Qt.Key.Key_4)
    assert bench.prompt.seen is None
    trial = stack.page.trial
    assert trial.reason.hasFocus()
    QTest.keyClicks(trial.reason, "2 hands were in the way")
    assert bench.prompt.seen is None, "keys of a text field judge nothing"
    QTest.keyClick(trial.reason, Qt.Key.Key_Return)
    assert bench.prompt.seen == (Outcome.ABORTED, "2 hands were in the way")
    why = "Void: 2 hands were in the way."
    bench.events.publish(TrialFinished(4.0, 1, 7, Outcome.ABORTED, why, 3, None, None))
    settle(live)
    assert "0 of 1 placed" in stack.page.score.words
    assert f"Trial 1: {why}" in stack.page.score.words


def test_a_picture_goes_beside_the_journal(live, bench, stack, tmp_path, qtbot):
    bench.run_folder = tmp_path / "run"
    ask(live, bench)
    told = []
    bench.events.subscribe(lambda fact: told.append(fact) if isinstance(fact, PhotoKept) else None)
    for name, content in (("a.png", PNG), ("b.png", PNG), ("c.png", b"text")):
        (tmp_path / name).write_bytes(content)
        stack.attended.add_photo(tmp_path / name)
    qtbot.waitUntil(lambda: not stack.attended._files.busy, timeout=60_000)
    assert [fact.path for fact in told] == ["trial-001-1.png", "trial-001-2.png"]
    assert (tmp_path / "run" / "photos" / "trial-001-2.png").read_bytes() == PNG
    assert "no picture" in live.cards.card("PHOTO").text.what


def test_what_is_asked_goes_when_the_run_goes_on(live, bench, stack):
    ask(live, bench)
    bench.events.publish(PhaseEntered(5.0, "lift", 1))
    settle(live)
    assert not stack.page.trial.isVisible()
    press(live, Qt.Key.Key_1)
    assert bench.prompt.seen is None


PLACES = ["window", "combo", "spin box", "line edit", "combo popup", "menu", "message box",
          "file dialog"]  # fmt: skip

PAGES = ("operate", "collect", "train", "stack", "review")


def press_stop(key):
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
        press_stop(Qt.Key.Key_F12)
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
        press_stop(Qt.Key.Key_F12)
        assert bench.stops == count, state
        settle(live)
        assert live.bar.pill.state.word == "STOPPED", state
        live.reset()


@pytest.mark.promise("W2")
def test_f12_stops_inside_a_modal_loop(live, bench):
    box = QMessageBox(QMessageBox.Icon.NoIcon, "t", "text", parent=live.window)
    QTimer.singleShot(0, box, lambda: press_stop(Qt.Key.Key_F12))
    QTimer.singleShot(50, box, box.close)
    box.exec()
    assert bench.stops == 1


@pytest.mark.promise("W2")
def test_space_stops_only_while_something_moves(live, bench):
    live.workspaces["stack"].page.belief.setFocus()
    press_stop(Qt.Key.Key_Space)
    assert bench.stops == 0
    bench.devices["arm"].mode = RobotMode.MOVING
    press_stop(Qt.Key.Key_Space)
    assert bench.stops == 1, "the arm moves without a run"
    bench.devices["arm"].mode = RobotMode.READY
    bench.set_state(RunState.RUNNING)
    settle(live)
    live.workspaces["stack"].page.run.cancel.setFocus()
    press_stop(Qt.Key.Key_Space)
    assert bench.stops == 2
    assert bench.engine.orders == [], "the button with the focus is not pressed"


@pytest.mark.parametrize("key", [Qt.Key.Key_F12, Qt.Key.Key_Space])
def test_no_shortcut_takes_a_stop_away(live, bench, key):
    taken = []
    QShortcut(QKeySequence(key), live.window).activated.connect(lambda: taken.append(key))
    bench.set_state(RunState.RUNNING)
    press_stop(key)
    assert (bench.stops, taken) == (1, [])


@pytest.mark.promise("W2")
def test_space_is_a_space_in_a_text_field(live, bench):
    bench.set_state(RunState.RUNNING)
    live.workspaces["stack"].page.run._seed.setFocus()
    QApplication.processEvents()
    press_stop(Qt.Key.Key_Space)
    assert bench.stops == 0


@pytest.mark.promise("W2")
def test_a_held_key_is_one_stop(live, bench):
    window = live.window.windowHandle()
    for repeat in (False, True, True):
        event = QKeyEvent(
            QEvent.Type.KeyPress, Qt.Key.Key_F12, Qt.KeyboardModifier.NoModifier, autorep=repeat
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
    press_stop(Qt.Key.Key_F12)
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


@pytest.fixture
def row(live, bench, tmp_path):
    """The sheet of planned runs with two runs of a file."""
    live.go("stack")
    workspace = live.workspaces["stack"]
    (tmp_path / "row.toml").write_text(
        '[[run]]\npiece = "barrel"\nseed = 5\n[[run]]\nbottom = "hex20"\n'
    )
    workspace._plan()
    workspace.planned.add_file(tmp_path / "row.toml")
    return workspace.planned


def end(live, bench, row, ending="finished"):
    bench.tell_start(trials=1)
    bench.tell_end()
    bench.events.publish(RunFinished(bench.clock_s(), "run", ending, ""))
    settle(live)
    row.look()
    assert row.runs[-1].result == "", "the run is not over while the bench is not idle"
    bench.set_state(RunState.IDLE)
    row.look()


def test_planned_runs_follow_each_other_in_the_order_of_the_list(live, bench, row, tmp_path):
    usual = live.workspaces["stack"].page.run.form()
    row.add_form()
    sheet = row
    sheet.list.setCurrentRow(2)
    sheet.buttons["Up"].click()
    pairs = [(run.piece, run.bottom) for run in row.runs]
    usual_pair = usual.piece, usual.bottom
    assert pairs == [("barrel", usual.bottom), usual_pair, (usual.piece, "hex20")]
    sheet.buttons["Start"].click()
    assert (bench.started[-1].piece, bench.started[-1].seed) == ("barrel", 5)
    assert not sheet.buttons["Start"].isEnabled()
    assert "running" in sheet.list.item(0).text()
    sheet.list.setCurrentRow(0)
    assert not sheet.buttons["Remove"].isEnabled()
    sheet.buttons["Down"].click()  # the run in progress may be moved
    end(live, bench, row)
    assert [run.result for run in row.runs] == ["", "1 of 1 trial placed", ""]
    assert bench.started[-1].piece == usual.piece
    # A kill now loses nothing: results and order are in the file.
    pages = json.loads((tmp_path / "window.json").read_text())["pages"]
    assert pages["stack"]["planned"] == [asdict(run) for run in row.runs]
    kept, dropped = restore_form(StackMemory(), pages["stack"])
    assert (list(kept.planned), dropped) == (row.runs, [])
    end(live, bench, row)
    end(live, bench, row)
    assert len(bench.started) == 3
    assert live.window.next_step.text.text().startswith("3 of 3 planned runs done")
    assert not row.on


def test_stop_and_a_run_that_did_not_finish_end_the_row(live, bench, row):
    row.start()
    live.stop()
    bench.set_state(RunState.RUNNING)
    end(live, bench, row, "stopped")
    assert row.runs[0].result == "1 of 1 trial placed, stopped"
    assert (row.on, len(bench.started)) == (False, 1)
    row.start()
    assert len(bench.started) == 1, "after STOP nothing starts before Reset"
    live.reset()
    row.start()
    assert len(bench.started) == 2


@pytest.mark.parametrize("ending", ["cancelled", "failed"])
def test_no_run_follows_one_that_did_not_finish(live, bench, row, ending):
    row.start()
    bench.set_state(RunState.RUNNING)
    end(live, bench, row, ending)
    assert row.runs[0].result == f"1 of 1 trial placed, {ending}"
    assert (row.on, len(bench.started)) == (False, 1)


def test_on_devices_a_person_starts_every_run_and_stop_ends_the_row(live, bench, row, monkeypatch):
    monkeypatch.setattr(bench, "simulated", False)
    row.start()
    end(live, bench, row)
    assert (row.on, len(bench.started)) == (True, 1)
    assert "hex20 waits" in live.cards.asks.text
    live.stop()
    row.look()
    assert not row.on
    assert "STOP ended the row" in row.said.text()
    live.reset()
    row.look()
    assert len(bench.started) == 1
    live.cards.asks.answers[1][1]()
    assert len(bench.started) == 2
    assert live.cards.asks is None


@pytest.mark.parametrize(
    ("text", "said"),
    [("", "No [[run]] can be read"), (None, "This is not a file."), ("[[run]", "line 1, column 6"),
     ("run = [3]", "wrong entries: 3"),
     ('[[run]]\npiece = "moon"', "Run 1 has wrong entries: piece"),
     ("[[run]]\n[[run]]\ntrials = 0", "Run 2 has wrong entries: trials"),
     ("[[run]]\nseed = 1.5", "seed"), ("[[run]]\ncolour = 3", "colour"),
     ("[[run]]\nseed = 2026-11-26", "seed")],
)  # fmt: skip
def test_a_file_of_runs_that_is_wrong_adds_none(live, row, tmp_path, text, said):
    form, before = live.workspaces["stack"].page.run.form(), list(row.runs)
    file = tmp_path / "wrong.toml"
    os.mkfifo(file) if text is None else file.write_text(text)
    row.add_file(file)
    assert said in live.cards.card("INPUT").text.what
    assert row.runs == before
    assert live.workspaces["stack"].page.run.form() == form


def test_a_moment_of_a_run_gets_a_bookmark_beside_its_log(live, bench, tmp_path):
    live.go("stack")
    note = live.workspaces["stack"].note
    press(live, Qt.Key.Key_B)
    assert "No recorded run" in live.window._message.text()
    bench.run_folder = tmp_path / "run"
    bench.set_state(RunState.RUNNING, trial=1)
    press(live, Qt.Key.Key_B)
    at_s = bench.clock_s()
    bench.turn(2.0)
    note.field.setText("  it  slipped? ")
    note.save.click()
    assert not note.isVisible()
    mark = Bookmark(1, pytest.approx(at_s, abs=0.01), "it slipped?")
    assert read_bookmarks(tmp_path / "run" / BOOKMARKS_NAME) == [mark]
