"""Keys: one meaning in each context, found in the palette, changed without a conflict, kept."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QAbstractSpinBox, QComboBox, QLabel, QWidget

from tests.app.conftest import settle
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.actions import EVERYWHERE_CONTEXT, is_plain_key, key_refusal, portable_key
from touchdown.app.shell.errors import ErrorBox
from touchdown.widgets.shell.keys import PaletteEntry, best_matches, match_score


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


@pytest.mark.parametrize(
    ("name", "key", "word"),
    [
        ("stack.pause", "A", "Approve"),
        ("stack.pause", "F12", "STOP"),
        ("stack.pause", "space", "STOP"),
        ("stack.pause", "Ctrl+K", "Find a command"),
        ("stack.pause", "Nonsense+Q", "is no key"),
        ("theme", "P", "Pause"),
        ("nothing", "P", "no command"),
    ],
)
def test_a_key_that_has_a_meaning_is_refused_by_name(main, name, key, word):
    assert word in key_refusal(main.actions.rows, name, key)
    assert main.actions.change_key(name, key) == key_refusal(main.actions.rows, name, key)


def test_a_jog_key_cannot_be_given_away_in_operate(main):
    assert "Jog" in key_refusal(main.actions.rows, "operate.probe", "Left")
    assert key_refusal(main.actions.rows, "stack.pause", "Left") == ""


def test_two_workspaces_may_use_one_key(main):
    assert key_refusal(main.actions.rows, "stack.pause", "G") == ""


@pytest.mark.promise("W11")
def test_a_changed_key_survives_a_restart_and_acts(qapp, qtbot, tmp_path, main):
    assert main.actions.change_key("stack.pause", "F9") == ""
    assert main.actions.change_key("stack.fit", "") == ""
    main.remember()
    again = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    try:
        assert again.actions.action("stack.pause").shortcut().toString() == "F9"
        assert again.actions.action("stack.fit").shortcut().toString() == ""
        assert again.actions.change_key("stack.pause", "P") == ""
        assert "stack.pause" not in again.actions.changed
    finally:
        again.close()
        again.window.deleteLater()
        again.deleteLater()


def test_remembered_keys_that_clash_are_dropped_and_named(qapp, tmp_path):
    path = tmp_path / "window.json"
    path.write_text('{"version": 2, "keys": {"stack.pause": "F12", "theme": "Ctrl+Y"}}')
    main = TouchdownApp(qapp, ErrorBox(), path, tmp_path / "runs")
    try:
        assert main.actions.action("stack.pause").shortcut().toString() == "P"
        assert main.actions.action("theme").shortcut().toString() == "Ctrl+Y"
        assert "stack.pause" in main.cards.card("SETTINGS").text.what
    finally:
        main.close()
        main.window.deleteLater()
        main.deleteLater()


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
    assert nameless == []


def test_contexts_are_known(main):
    assert {row.context for row in main.actions.rows} <= {EVERYWHERE_CONTEXT, *main.workspaces}
    assert all(portable_key(row.key) for row in main.actions.rows if row.key)
