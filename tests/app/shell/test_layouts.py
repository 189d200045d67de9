"""A chip opens the raw fields of its device, and they stay live."""

from __future__ import annotations

import json
import logging
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLabel,
    QSpinBox,
    QWidget,
)

from tests.app.conftest import opened, settle
from touchdown.app.shell import ErrorBox, log, log_to, move_on_screen
from touchdown.app.shell.actions import is_plain_key, key_refusal
from touchdown.app.shell.errors import BOX_SIZE, REMEMBERED_TEXTS, REPEAT_INTERVAL_S, RepeatFilter
from touchdown.app.shell.layouts import VERSION, SavedLayouts, load_layouts
from touchdown.app.shell.settings import write_stored
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.runs.requests import RunState
from touchdown.widgets.base.panel import ColumnArrangement, Columns
from touchdown.widgets.shell.keys import PaletteEntry, best_matches, match_score


@pytest.mark.promise("W6")
def test_a_click_on_a_chip_opens_its_device_and_follows_it(live, bench, qtbot):
    bench.devices["gripper"].describe = lambda: {
        "kind": "stand-in",
        "width_mm": -1.25,
        "x_mm": -3.0,
    }
    qtbot.mouseClick(live.bar.chips["gripper"], Qt.MouseButton.LeftButton)
    sheet = live.inspect.sheet
    assert sheet.isVisible()
    assert not sheet.isModal()
    shown = sheet.rows()
    assert shown["serial"] == "0001"
    assert shown["state"] == "ready"
    assert shown["kind"] == "stand-in"
    assert shown["width_mm"] == "\N{MINUS SIGN}1.25"
    assert shown["x_mm"] == "\N{MINUS SIGN}3"
    received = int(shown["received"])
    bench.turn(0.4)
    live._chips._drawn_s = 0.0
    settle(live)
    assert int(sheet.rows()["received"]) == received + 10
    qtbot.mouseClick(live.bar.chips["arm"], Qt.MouseButton.LeftButton)
    assert sheet.key == "arm"
    assert "width_mm" not in sheet.rows()
    sheet.close()


def test_a_press_that_leaves_the_chip_opens_nothing(live, qtbot):
    chip = live.bar.chips["arm"]
    QTest.mousePress(chip, Qt.MouseButton.LeftButton)
    QTest.mouseRelease(chip, Qt.MouseButton.LeftButton, pos=chip.rect().bottomRight() * 3)
    assert live.inspect.sheet is None
    chip.setFocus()
    QTest.keyClick(chip, Qt.Key.Key_Return)
    assert live.inspect.sheet.isVisible()
    live.inspect.sheet.close()


def test_reconnect_runs_beside_the_window_and_says_how_it_went(live, bench, qtbot):
    device = bench.devices["gripper"]
    device.close = lambda: None
    device.connect = lambda timeout_s, cancel: None
    live.inspect.open("gripper")
    bench.set_state(RunState.RUNNING)
    live.inspect.draw()
    assert not live.inspect.sheet.reconnect.isEnabled()
    bench.set_state(RunState.IDLE)
    live.inspect.draw()
    live.inspect.sheet.reconnect.click()
    qtbot.waitUntil(lambda: not live.inspect._connecting, timeout=60_000)
    settle(live)
    assert "gripper is connected again" in live.window._message.text()


@pytest.mark.promise("C6", "W6")
def test_another_serial_number_is_a_card(live, bench, qtbot):
    device = bench.devices["tactile_left"]
    device.close = lambda: None

    def swapped(timeout_s, cancel):
        device.identity = Identity("Touchdown", "stand-in", "0002", "1")

    device.connect = swapped
    live.inspect.open("tactile_left")
    live.inspect.sheet.reconnect.click()
    qtbot.waitUntil(lambda: not live.inspect._connecting, timeout=60_000)
    settle(live)
    assert "0002 answers instead of 0001" in live.cards.card("OTHER-DEVICE").text.what


@pytest.mark.promise("W8")
def test_workspaces_have_their_keys_and_stand_in_the_order_of_the_rail(main):
    keys = [(name, main.actions.action(name).shortcut().toString()) for name in main.workspaces]
    order = [n for n in ("operate", "collect", "train", "stack", "review") if n in main.workspaces]
    assert [name for name, _ in keys] == order
    wanted = {"operate": "1", "collect": "2", "train": "3", "stack": "4", "review": "5"}
    assert keys == [(name, f"Ctrl+{wanted[name]}") for name in order]


@pytest.mark.parametrize(
    ("key", "typed"),
    [("N", True), ("Shift+G", True), ("Left", True), ("F5", False), ("Ctrl+N", False),
     ("Alt+1", False), ("[", True), ("", False)],
)  # fmt: skip
def test_which_keys_could_be_typed(key, typed):
    assert is_plain_key(key) is typed


def test_a_key_that_has_a_meaning_is_refused_by_name(main):
    for name, key, word in (
        ("stack.pause", "A", "Approve"),
        ("stack.pause", "F12", "STOP"),
        ("stack.pause", "space", "STOP"),
        ("stack.pause", "Ctrl+K", "Find a command"),
        ("stack.pause", "Nonsense+Q", "is no key"),
        ("theme", "P", "Pause"),
        ("nothing", "P", "no command"),
        ("operate.probe", "Left", "Jog"),
    ):
        assert word in key_refusal(main.actions.rows, name, key), key
        assert main.actions.change_key(name, key) == key_refusal(main.actions.rows, name, key)
    for key in ("Left", "G"):  # keys of another workspace
        assert key_refusal(main.actions.rows, "stack.pause", key) == ""


@pytest.mark.promise("W11")
def test_a_changed_key_survives_a_restart_and_acts(main, tmp_path):
    assert main.actions.change_key("stack.pause", "F9") == ""
    assert main.actions.change_key("stack.fit", "") == ""
    main.remember()
    with opened(tmp_path) as again:
        assert again.actions.action("stack.pause").shortcut().toString() == "F9"
        assert again.actions.action("stack.fit").shortcut().toString() == ""
        assert again.actions.change_key("stack.pause", "P") == ""
        assert "stack.pause" not in again.actions.changed


def test_remembered_keys_that_clash_are_dropped_and_named(qapp, tmp_path):
    path = tmp_path / "window.json"
    path.write_text('{"version": 2, "keys": {"stack.pause": "F12", "theme": "Ctrl+Y"}}')
    with opened(tmp_path) as main:
        assert main.actions.action("stack.pause").shortcut().toString() == "P"
        assert main.actions.action("theme").shortcut().toString() == "Ctrl+Y"
        assert "stack.pause" in main.cards.card("SETTINGS").text.what


@pytest.mark.promise("W11")
def test_every_action_has_text_tip_and_a_place_in_the_palette(main):
    names = {choice.name for choice in main.dialogs._choices()}
    for row in main.actions.rows:
        if row.command is not None:
            action = main.actions.action(row.id)
            assert action.text()
            assert action.toolTip()
            assert row.id in names


# -- palette ---------------------------------------------------------------------------------------

CHOICES = [
    PaletteEntry("a", "Operate", "Probe once", "F5"),
    PaletteEntry("b", "Operate", "Zero force and moment", "Z"),
    PaletteEntry("c", "Everywhere", "Full screen", "F11"),
    PaletteEntry("d", "Stack", "Pause or resume", "P"),
]


@pytest.mark.parametrize(
    ("query", "first"),
    [("probe", "a"), ("prb", "a"), ("zero", "b"), ("zfm", "b"), ("full", "c"), ("fs", "c"),
     ("PAUSE", "d"), ("resume", "d"), ("stack", "d")],
)  # fmt: skip
def test_a_part_of_the_name_finds_it(query, first):
    assert best_matches(query, CHOICES)[0].name == first


def test_what_does_not_occur_is_not_found():
    assert best_matches("qqq", CHOICES) == []
    assert match_score("ba", "ab") is None
    assert [c.name for c in best_matches("", CHOICES)] == ["a", "b", "c", "d"]


@pytest.mark.promise("W11")
def test_the_palette_works_with_keys_alone(live, qtbot):
    live.actions.action("palette").trigger()
    palette = live.dialogs.palette
    assert palette.isVisible()
    assert not palette.isModal()
    QTest.keyClicks(palette.field, "next theme")
    assert palette.shown()[0] == "theme"
    before = live.look.choice
    QTest.keyClick(palette.field, Qt.Key.Key_Return)
    assert not palette.isVisible()
    assert live.look.choice != before
    qtbot.waitUntil(lambda: live.theme.tokens.name != before, timeout=60_000)


def test_a_command_of_another_page_brings_that_page(live):
    live.actions.action("palette").trigger()
    palette = live.dialogs.palette
    QTest.keyClicks(palette.field, "look for new recordings")
    QTest.keyClick(palette.field, Qt.Key.Key_Down)
    QTest.keyClick(palette.field, Qt.Key.Key_Up)
    QTest.keyClick(palette.field, Qt.Key.Key_Return)
    assert live.window.front == "review"


def test_a_key_is_changed_from_the_palette(live, qtbot):
    live.actions.action("palette").trigger()
    palette = live.dialogs.palette
    QTest.keyClicks(palette.field, "change key of pause or resume")
    QTest.keyClick(palette.field, Qt.Key.Key_Return)
    asker = live.dialogs.asker
    assert asker.isVisible()
    QTest.keyClick(asker, Qt.Key.Key_A)
    assert "already means" in asker.said.text()
    QTest.keyClick(asker, Qt.Key.Key_F9)
    assert live.actions.action("stack.pause").shortcut().toString() == "F9"
    QTest.keyClick(asker, Qt.Key.Key_Escape)
    assert not asker.isVisible()


def test_the_key_sheet_shows_the_keys_of_now(live):
    live.actions.change_key("stack.pause", "F9")
    live.actions.action("keys").trigger()
    settle(live)
    assert live.dialogs.sheet.isVisible()
    assert not live.dialogs.sheet.isModal()
    texts = {label.text() for label in live.dialogs.sheet.findChildren(QLabel)}
    assert {"F9", "F12", "Ctrl+1", "PgUp"} <= texts
    live.dialogs.sheet.close()


# -- names -----------------------------------------------------------------------------------------


@pytest.mark.promise("W12")
def test_every_widget_that_takes_the_focus_has_a_name(live):
    """A screen reader must find a word for whatever Tab reaches, on every page."""
    nameless = []
    for name, workspace in live.workspaces.items():
        live.go(name)
        for widget in workspace.page.findChildren(QWidget):
            reached = bool(widget.focusPolicy() & Qt.FocusPolicy.TabFocus)
            # A page, the list inside a combo box and the field inside a spin box are not reached.
            inside = isinstance(widget.parent().parent(), QComboBox) or isinstance(
                widget.parent(), QAbstractSpinBox
            )
            text = getattr(widget, "text", None)
            named = widget.accessibleName() or (callable(text) and text())
            if reached and not inside and not named and widget.objectName() != "frame":
                nameless.append((name, type(widget).__name__))
    nameless += [
        widget
        for widget in live.window.findChildren(QWidget)
        if isinstance(widget, (QAbstractButton, QComboBox, QSpinBox))
        and not (widget.accessibleName() or getattr(widget, "text", str)())
        and not widget.objectName().startswith("qt_")
        and not isinstance(widget.parent(), (QComboBox, QSpinBox))
    ]
    assert nameless == []


SCREEN = QRect(0, 0, 1920, 1080)


@pytest.fixture
def columns(qtbot):
    panels = {name: QWidget() for name in ("a", "b", "c")}
    for panel in panels.values():
        panel.setProperty("role", "card")
        panel.setMinimumWidth(50)
    made = Columns(tuple(zip(panels.values(), (2, 1, 1), strict=True)), panels)
    qtbot.addWidget(made)
    made.resize(816, 100)
    made.show()
    return made


def test_usual_shares_are_kept_at_every_width(columns):
    assert columns.sizes() == [400, 200, 200]
    columns.resize(1616, 100)
    QApplication.processEvents()
    assert columns.sizes() == [800, 400, 400]


def test_a_panel_left_out_gives_its_room_to_the_others(columns):
    columns.show_panel("a", shown=False)
    QApplication.processEvents()
    assert columns.sizes() == [0, 404, 404]
    columns.show_panel("a", shown=True)
    QApplication.processEvents()
    assert columns.sizes() == [400, 200, 200]


def test_edges_move_only_while_unlocked(columns):
    edge = columns.handle(1)

    def drag():
        QTest.mousePress(edge, Qt.MouseButton.LeftButton, pos=QPoint(2, 50))
        QTest.mouseMove(edge, QPoint(82, 50))
        QTest.mouseRelease(edge, Qt.MouseButton.LeftButton, pos=QPoint(82, 50))
        return columns.sizes()[0]

    assert drag() == 400
    columns.lock(False)
    assert drag() == pytest.approx(480, abs=6)
    share = columns.arrangement().shares[0]
    assert share == pytest.approx(0.6, abs=0.01)
    edge.setFocus()
    QTest.keyClick(edge, Qt.Key.Key_Left)
    assert columns.arrangement().shares[0] < share


@pytest.mark.parametrize(
    "bad",
    [
        ColumnArrangement((0.5, 0.5)),
        ColumnArrangement((1.0, 0.0, 0.0)),
        ColumnArrangement((float("nan"), 0.5, 0.5)),
        ColumnArrangement((0.9, 0.9, 0.9)),
        ColumnArrangement((0.4, 0.3, 0.3), frozenset({"gone"})),
    ],
)
def test_what_does_not_fit_is_refused_with_a_reason(columns, bad):
    assert columns.misfit(bad)
    with pytest.raises(ValueError, match=r"\w"):
        columns.show_arrangement(bad)
    assert columns.arrangement() == columns.usual


def test_a_book_survives_the_disk(tmp_path):
    book = SavedLayouts(
        locked=False,
        present={"stack": ColumnArrangement((0.5, 0.25, 0.25), frozenset({"Trials"}))},
        saved={"stack": {"wide map": ColumnArrangement((0.25, 0.5, 0.25))}},
    )
    write_stored(tmp_path / "layouts.json", VERSION, book)
    assert load_layouts(tmp_path / "layouts.json") == (book, "")


@pytest.mark.promise("D8", "W8")
@pytest.mark.parametrize(
    "content",
    [
        b"\xff\xfe",
        b"{",
        b"[]",
        b'{"version": 99}',
        b'{"version": 1}',
        b'{"version": 1, "locked": true, "present": {"stack": 3}, "saved": {}}',
        b'{"version": 1, "locked": true, "present": {"stack": {"shares": ["x"], "hidden": []}}, '
        b'"saved": {}}',
    ],
)
def test_a_bad_file_is_one_notice_and_kept_aside(tmp_path, content):
    path = tmp_path / "layouts.json"
    path.write_bytes(content)
    book, notice = load_layouts(path)
    assert book == SavedLayouts()
    (kept,) = tmp_path.glob("layouts-aside-*.json")
    assert kept.name in notice
    assert kept.read_bytes() == content


def test_a_saved_layout_comes_back_after_a_restart(main, tmp_path):
    main.layouts.toggle_lock()
    main.layouts.turn_panel("stack", "Trials")
    assert main.layouts.save("stack", "no score") == ""
    main.layouts.reset("stack")
    assert main.layouts.present("stack") == "Usual"
    main.close()
    with opened(tmp_path) as again:
        assert not again.layouts.locked
        assert again.layouts.names("stack") == ("no score",)
        again.layouts.choose("stack", "no score")
        assert again.workspaces["stack"].page.score.isHidden()
        again.actions.action("layout").trigger()
        assert again.layouts.present(again.window.front) == "Usual"


@pytest.mark.promise("W8")
def test_a_layout_of_another_version_is_told_once(main, tmp_path):
    main.close()
    path = tmp_path / "layouts.json"
    raw = json.loads(path.read_text())
    raw["present"]["stack"]["shares"] = [0.5, 0.5]
    path.write_text(json.dumps(raw))
    with opened(tmp_path) as again:
        assert again.cards.codes == ("SETTINGS",)
        assert "stack (2 columns instead of 3)" in again.cards.card("SETTINGS").text.what
        assert len(list(tmp_path.glob("layouts-aside-*.json"))) == 1
        assert again.layouts.present("stack") == "Usual"


@pytest.mark.promise("W8")
def test_a_locked_layout_keeps_its_panels_and_the_menu_says_so(live):
    live.go("stack")
    live.layouts.turn_panel("stack", "Trials")
    assert not live.workspaces["stack"].page.score.isHidden()
    live.actions.action("layouts").trigger()
    entries = {action.text(): action for action in live.layout_menu.menu.actions()}
    assert entries["Usual"].isChecked()
    assert entries["Locked"].isChecked()
    assert not entries["Trials"].isEnabled()
    live.layout_menu.menu.close()
    entries["Locked"].trigger()
    assert not live.layouts.locked
    live.layouts.toggle_lock()


def test_the_menu_offers_a_layout_saved_under_a_name(live):
    live.go("stack")
    live.actions.action("save-layout").trigger()
    asker = live.layout_menu.asker
    QTest.keyClicks(asker.field, "mine")
    QTest.keyClick(asker.field, Qt.Key.Key_Return)
    assert not asker.isVisible()
    live.actions.action("layouts").trigger()
    menu = live.layout_menu.menu
    entries = {action.text(): action for action in menu.actions()}
    assert "mine" in entries
    menu.close()
    entries["Delete 'mine'"].trigger()
    assert live.layouts.names("stack") == ()
    live.go("review")
    live.actions.action("layouts").trigger()
    assert not menu.actions()[0].isEnabled()
    menu.close()


@pytest.mark.promise("W8")
@pytest.mark.parametrize(
    ("window", "screens", "expected"),
    [
        (QRect(100, 100, 1600, 900), [SCREEN], QRect(100, 100, 1600, 900)),
        (QRect(1850, 100, 1600, 900), [SCREEN], QRect(320, 100, 1600, 900)),
        (QRect(5000, 5000, 1600, 900), [SCREEN], QRect(320, 180, 1600, 900)),
        (QRect(0, -400, 1600, 900), [SCREEN], QRect(0, 0, 1600, 900)),
        (QRect(3000, 0, 2500, 1500), [SCREEN], QRect(0, 0, 1920, 1080)),
        (QRect(2000, 50, 1600, 900), [SCREEN, QRect(1920, 0, 1920, 1080)],
         QRect(2000, 50, 1600, 900)),
        (QRect(0, 0, 1600, 940), [QRect(0, 0, 1280, 800)], QRect(0, 0, 1280, 800)),
        (QRect(0, 0, 2600, 900), [SCREEN, QRect(1920, 0, 1920, 1080)], QRect(0, 0, 2600, 900)),
    ],
    ids=["whole", "too far right", "nowhere", "title above", "too large", "second screen",
         "small screen", "over two screens"],
)  # fmt: skip
def test_a_window_is_pulled_back_to_where_it_can_be_taken_hold_of(window, screens, expected):
    assert move_on_screen(window, screens) == expected


FRAME_S, LASTS_S = 0.016, 60.0


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    # A file of a window before would see every record, too, and its filter counts on the record.
    before, log.handlers = log.handlers, []
    log_to(tmp_path)
    yield tmp_path
    written, log.handlers = log.handlers, before
    for handler in written:
        handler.close()


def fail(box: ErrorBox, text: str) -> None:
    try:
        raise RuntimeError(text)
    except RuntimeError:
        box.exception(*sys.exc_info(), "the window")


def wind(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let the records of the log carry a hand-wound time; return it."""
    now = [1000.0]
    make = logging.getLogRecordFactory()

    def made(*args: object, **kinds: object) -> logging.LogRecord:
        record = make(*args, **kinds)
        record.created = now[0]
        return record

    monkeypatch.setattr(logging, "_logRecordFactory", made)
    return now


@pytest.mark.promise("D12")
def test_the_same_error_in_every_frame_is_counted_and_written_now_and_then(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    box, now = ErrorBox(), wind(monkeypatch)
    frames = round(LASTS_S / FRAME_S)
    for _ in range(frames):
        fail(box, "broken paint")
        now[0] += FRAME_S
    now[0] += REPEAT_INTERVAL_S
    fail(box, "broken paint")
    (text,) = [path.read_text() for path in folder.iterdir()]
    written = text.count("ERROR uncaught in the window")
    assert LASTS_S / REPEAT_INTERVAL_S <= written <= LASTS_S / REPEAT_INTERVAL_S + 2
    told = [int(line[1:].split()[0]) for line in text.splitlines() if "times more" in line]
    # None is forgotten: written ones and counted ones are all that came.
    assert written + sum(told) == frames + 1
    cards = 0
    while box.take() is not None:
        cards += 1
    assert cards == BOX_SIZE


@pytest.mark.promise("P6")
def test_an_error_whose_text_changes_is_known_by_where_it_was_raised(folder: Path) -> None:
    box = ErrorBox()
    for number in range(50):
        fail(box, f"thread {number}")
    (text,) = [path.read_text() for path in folder.iterdir()]
    assert text.count("ERROR uncaught in the window") == 1


@pytest.mark.promise("D12")
def test_errors_that_are_never_the_same_fill_no_disk(folder: Path) -> None:
    for number in range(2500):
        log.error("error %d %s", number, "x" * 2000)
    sizes = [path.stat().st_size for path in folder.iterdir()]
    assert sum(sizes) <= 10_000_000
    assert (folder / "app.log").read_text().count("error 2499") == 1
    (repeats,) = [f for h in log.handlers for f in h.filters if isinstance(f, RepeatFilter)]
    assert len(repeats._seen) == REMEMBERED_TEXTS


@pytest.mark.promise("D9")
def test_what_a_terminal_would_obey_is_written_as_its_number(folder: Path) -> None:
    log.error("piece %s", "\x1b[2Jcup\r\x07 \u00e4")
    (text,) = [path.read_text() for path in folder.iterdir()]
    assert text.endswith("piece \\x1b[2Jcup\\x0d\\x07 \u00e4\n")


def test_the_log_file_has_utc_times_with_their_offset(folder: Path, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "Asia/Tokyo")
        time.tzset()
        log.warning("hello")
    time.tzset()
    stamp, level, text = (folder / "app.log").read_text("utf-8").split(maxsplit=2)
    at = datetime.fromisoformat(stamp)
    assert (at.utcoffset(), level, text) == (timedelta(0), "WARNING", "hello\n")
    assert abs(datetime.now(UTC) - at) < timedelta(minutes=5)
