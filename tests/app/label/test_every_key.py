"""Whatever the page can do is done by a key: no mouse, and no walk of Tab to a button."""

import pytest
from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QApplication

from tests.app.label.conftest import CTRL, ITEMS, KEY, SHIFT, WITHOUT_LABEL
from touchdown.app.label.page import LabelPage
from touchdown.app.shell.actions import portable_key
from touchdown.backend.annotations.values import Label

LABELLED = ITEMS - WITHOUT_LABEL
ALT = Qt.KeyboardModifier.AltModifier

BY_KEYS = {
    "row_chosen": ("previous", "next", "first", "last", "number"),
    "queue_chosen": ("queue",),
    "face_dragged": ("nudge-left-10", "nudge-right-100", "nudge-up-1000", "nudge-down-100"),
    "face_dropped": ("nudge-left-10",),
    "version_chosen": ("versions",),
    "displacement_typed": ("accept",),
    "key_typed": ("accept",),
    "retry_requested": ("accept",),
    "discard_requested": ("discard",),
    "search_changed": ("log",),
    "person_requested": ("person",),
    "command_requested": ("queue", "score", "person", "next"),
    "tab_chosen": ("versions", "agreement", "log", "bulk", "health"),
    "preview_requested": ("bulk",),
    "apply_requested": ("bulk",),
    "value_entered": ("bulk",),
    "health_requested": ("health",),
    "finding_chosen": ("findings",),
}
"""What a mouse can ask of the page, and the commands that ask for the same."""
BY_HAND = {"play"}
"""Space: the page takes it, a stop of the bench goes first."""


@pytest.mark.promise("W11")
def test_every_signal_of_the_page_and_every_command_has_a_key(desk):
    commands = {c.name: c for c in desk.workspace.commands}
    assert set(BY_KEYS) == {
        name for name, value in vars(LabelPage).items() if isinstance(value, Signal)
    }
    assert {name for names in BY_KEYS.values() for name in names} <= set(commands)
    assert {name for name, c in commands.items() if not c.key} == BY_HAND
    assert all(portable_key(c.key) for c in commands.values() if c.key)


def test_other_views_pictures_and_curves_come_by_keys(desk):
    desk.do(KEY.Key_E)
    assert front(desk) == 1
    assert "No two people" in desk.page.side.agreement.text()
    page = desk.page
    desk.do(KEY.Key_I)
    assert page.shots.isVisible()
    assert not page.film.isVisible()
    desk.do(KEY.Key_I)
    assert page.film.isVisible()
    desk.press(KEY.Key_W)
    popup = QApplication.activePopupWidget()
    assert popup is not None
    popup.close()
    desk.do(KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[desk.uuid].flagged


def front(desk):
    return desk.page.side.tab


def test_an_earlier_version_comes_back_by_its_digit_but_is_not_told_blind(desk):
    uuid, first = desk.uuid, desk.book.head(desk.uuid)
    desk.do(KEY.Key_O)
    assert "no earlier version" in desk.page.message.text()
    desk.do(KEY.Key_Up)
    desk.press(KEY.Key_E)  # another view: the question brings the versions to the front
    desk.do(KEY.Key_O)
    assert front(desk) == 0
    assert desk.page.choice.isVisible()
    desk.do(KEY.Key_1)
    head = desk.book.head(uuid)
    assert (head.label, head.source) == (first.label, first.source)
    assert len(desk.book.history(uuid)) == 3
    desk.workspace.session.queue = "gold"
    desk.do(KEY.Key_O)
    assert not desk.page.choice.isVisible()
    assert "No versions" in desk.page.message.text()


def test_many_labels_change_by_keys_and_back_by_one(desk):
    uuids = desk.workspace.presenter.walk.order
    before = {u: desk.book.head(u).label for u in uuids}
    desk.do(KEY.Key_B, KEY.Key_1)
    assert front(desk) == 3
    desk.type("0.5,-0.25")
    assert desk.page.bulk.value.text() == "0.5,-0.25"
    desk.do(KEY.Key_Return)
    assert {u: desk.book.head(u).label for u in uuids} == before
    assert desk.page.choice.accessibleName() == f"{LABELLED} labels will change."
    desk.do(KEY.Key_1)
    first = desk.book.head(uuids[0]).label
    assert (first.x_um, first.y_um) == (before[uuids[0]].x_um + 500, before[uuids[0]].y_um - 250)
    desk.do(KEY.Key_U)
    assert {u: desk.book.head(u).label for u in uuids} == before


def test_a_change_without_a_value_is_previewed_at_once_and_nonsense_keeps_the_line(desk):
    desk.do(KEY.Key_B, KEY.Key_4)
    assert desk.page.choice.accessibleName() == f"{LABELLED} labels will change."
    desk.do(KEY.Key_Escape, KEY.Key_Right)
    assert desk.page.bulk.apply.isEnabled()  # by whoever has a mouse
    assert desk.book.head(desk.uuid).state == "draft"
    desk.settle()
    desk.do(KEY.Key_B, KEY.Key_2)
    desk.type("x")
    desk.do(KEY.Key_Return)
    assert "Type an angle" in desk.page.bulk.found.text()
    assert QApplication.focusWidget() is desk.page.bulk.value
    desk.do(KEY.Key_Escape, KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[desk.uuid].flagged


def test_the_log_is_searched_and_left_by_keys(desk, qtbot):
    desk.do(KEY.Key_Return, KEY.Key_L)
    side = desk.page.side
    assert front(desk) == 2
    desk.type("ACCEPT")
    assert side.needle.text().lower() == "accept"
    side.needle.setText("accept")
    qtbot.waitUntil(lambda: side.log.count() == 1, timeout=60_000)
    uuid = desk.uuid
    desk.do(KEY.Key_Return)  # leaves the line, decides nothing
    assert (desk.uuid, desk.book.head(uuid).state) == (uuid, "draft")
    desk.do(KEY.Key_X)
    assert desk.workspace.presenter.walk.entries[uuid].flagged


def test_lines_to_type_have_captions_and_one_takes_the_number_of_a_place(desk):
    page = desk.page
    assert not page.caption.isVisible()
    desk.press(KEY.Key_U, CTRL)
    assert page.caption.isVisible()
    assert "name" in page.caption.text()
    desk.do(KEY.Key_Escape)
    assert not page.caption.isVisible()
    desk.press(KEY.Key_U, CTRL)
    desk.workspace.be("Ann")  # said in the other half meanwhile
    desk.settle()
    assert not page.caption.isVisible()
    assert QApplication.focusWidget() is page
    desk.press(KEY.Key_3)
    desk.settle()
    assert "x,y in mm" in page.caption.text()
    desk.do(KEY.Key_Escape)
    assert not page.caption.isVisible()
    order = desk.workspace.presenter.walk.order
    desk.do(KEY.Key_End)
    assert desk.uuid == order[-1]
    assert desk.page.queue_panel.detail.text() == f"{ITEMS} of {ITEMS}"
    desk.do(KEY.Key_Home)
    assert desk.uuid == order[0]
    desk.do(KEY.Key_Q)
    assert f"1 to {ITEMS}" in desk.page.caption.text()
    desk.type("12")
    desk.do(KEY.Key_Return)
    assert desk.uuid == order[11]
    for number in ("0", "55", "x"):
        desk.do(KEY.Key_Q)
        desk.type(number)
        desk.do(KEY.Key_Return)
        assert "no number" in desk.page.message.text()
        assert desk.uuid == order[11]


class TestWhileSigmaIsAsked:
    """An arrow that is pressed a moment too long moves the face; it is never lost."""

    @pytest.fixture
    def asked(self, start):
        desk = start(sigma_mm=None)
        desk.before = desk.book.head(desk.uuid).label
        desk.do(KEY.Key_Right)
        assert desk.page.choice.isVisible()
        return desk

    def test_arrows_move_the_face_and_all_is_saved_with_the_answer(self, asked):
        uuid, before = asked.uuid, asked.before
        at_s = asked.page.film.cursor_s
        asked.do(KEY.Key_Tab, KEY.Key_BracketLeft)
        assert asked.page.film.cursor_s < at_s  # looking closer is no answer
        for key in (KEY.Key_Right, (KEY.Key_Up, SHIFT), (KEY.Key_Left, ALT)):
            asked.do(key)
        asked.workspace.presenter.editing.nudged()  # the half second is over
        assert asked.page.choice.marked == "0.30 mm"  # the question stands as it was
        assert asked.book.head(uuid).label == before
        asked.do(KEY.Key_Return)
        assert asked.book.head(uuid).label == Label(
            before.x_um + 200 - 10, before.y_um + 1000, before.theta_mdeg, 300
        )
        assert len(asked.book.history(uuid)) == 2

    def test_what_is_left_unanswered_is_asked_again_and_kept(self, asked):
        uuid, before = asked.uuid, asked.before
        asked.do(KEY.Key_Right, KEY.Key_Escape)
        assert asked.page.strip.saved == "unsaved"
        asked.do(KEY.Key_PageDown)
        assert asked.page.choice.isVisible()
        asked.do(KEY.Key_Return)
        assert asked.book.head(uuid).label.x_um == before.x_um + 200

    def test_a_nudge_key_that_was_changed_still_moves_the_face(self, asked):
        assert asked.main.actions.change_key("collect.nudge-right-100", "Ctrl+Right") == ""
        x_um = asked.now.edit.label.x_um
        asked.do((KEY.Key_Right, CTRL))
        assert asked.now.edit.label.x_um == x_um + 100
        asked.do(KEY.Key_Right)
        assert asked.now.edit.label.x_um == x_um + 100


def test_a_nudge_while_sigma_is_said_anew_is_saved_with_it(desk):
    uuid, before = desk.uuid, desk.book.head(desk.uuid).label
    desk.do(KEY.Key_S)
    desk.press(KEY.Key_Right)
    desk.workspace.presenter.editing.nudged()
    assert desk.book.head(uuid).label == before
    desk.press(KEY.Key_Tab)
    desk.press(KEY.Key_Return)
    desk.settle()
    label = desk.book.head(uuid).label
    assert (label.x_um, label.sigma_um) == (before.x_um + 100, 300)
