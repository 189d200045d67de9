"""Layouts: locked until asked, saved under names, judged before use, never lost."""

import json
from datetime import datetime

import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QWidget

from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.shell.layouts import SavedLayouts, load_layouts, save_layouts
from touchdown.app.shell.window import move_on_screen
from touchdown.widgets.base.panel import ColumnArrangement, Columns

NOW = datetime(2026, 3, 4, 5, 6, 7)
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
    save_layouts(tmp_path / "layouts.json", book)
    assert load_layouts(tmp_path / "layouts.json", NOW) == (book, "")


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
    book, notice = load_layouts(path, NOW)
    assert book == SavedLayouts()
    assert "layouts-aside-20260304-050607.json" in notice
    assert (tmp_path / "layouts-aside-20260304-050607.json").read_bytes() == content
    assert not path.exists()


def test_a_saved_layout_comes_back_after_a_restart(main, qapp, tmp_path):
    main.layouts.toggle_lock()
    main.layouts.turn_panel("stack", "Trials")
    assert main.layouts.save("stack", "no score") == ""
    main.layouts.reset("stack")
    assert main.layouts.present("stack") == "Usual"
    main.close()
    again = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    try:
        assert not again.layouts.locked
        assert again.layouts.names("stack") == ("no score",)
        again.layouts.choose("stack", "no score")
        assert again.workspaces["stack"].page.score.isHidden()
        again.actions.action("layout").trigger()
        assert again.layouts.present(again.window.front) == "Usual"
    finally:
        again.close()
        again.window.deleteLater()
        again.deleteLater()


@pytest.mark.promise("W8")
def test_a_layout_of_another_version_is_told_once(main, qapp, tmp_path):
    main.close()
    path = tmp_path / "layouts.json"
    raw = json.loads(path.read_text())
    raw["present"]["stack"]["shares"] = [0.5, 0.5]
    path.write_text(json.dumps(raw))
    again = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    try:
        assert again.cards.codes == ("SETTINGS",)
        assert "stack (2 columns instead of 3)" in again.cards.card("SETTINGS").text.what
        assert len(list(tmp_path.glob("layouts-aside-*.json"))) == 1
        assert again.layouts.present("stack") == "Usual"
    finally:
        again.close()
        again.window.deleteLater()
        again.deleteLater()


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


def test_the_palette_offers_the_layouts_of_the_page_in_front(live):
    live.go("stack")
    live.actions.action("save-layout").trigger()
    asker = live.layout_menu.asker
    QTest.keyClicks(asker.field, "mine")
    QTest.keyClick(asker.field, Qt.Key.Key_Return)
    assert not asker.isVisible()
    live.actions.action("palette").trigger()
    palette = live.dialogs.palette
    QTest.keyClicks(palette.field, "layout: mine")
    shown = palette.list.currentItem().text()
    assert shown.startswith("Layout: mine")
    palette.close()
    live.go("review")
    assert live.dialogs.more() == []


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
