"""What cannot be saved stays in sight; what is saved can be taken back, also after a restart."""

import sqlite3
from contextlib import closing

import pytest

from tests.app.label.conftest import CTRL, KEY, SHIFT
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import Fault, FaultError

FULL = Fault("DISK-FULL", "The disk is full.", "Nothing was saved.", "Make room.")


def content(desk):
    """Return what anybody can read of every label."""
    found = {}
    for entry in desk.workspace.presenter.dataset.episodes():
        r = desk.book.head(entry.uuid)
        found[entry.uuid] = (r.label, r.source, r.state, r.verdict, r.reason,
                             desk.book.marks(entry.uuid))  # fmt: skip
    return found


@pytest.fixture
def failing(desk, monkeypatch):
    """Every save fails until it is mended."""
    real, broken = desk.book.accept, [True]

    def accept(*args, **more):
        if broken:
            raise FaultError(FULL)
        return real(*args, **more)

    monkeypatch.setattr(desk.book, "accept", accept)
    return broken.clear


def test_a_failed_save_blocks_the_way_until_it_is_saved(desk, failing):
    uuid = desk.uuid
    desk.do(KEY.Key_Return)
    assert desk.page.banner.isVisible()
    assert "The disk is full. Make room." in desk.page.banner.text.text()
    assert desk.page.strip.saved == "unsaved"
    for key in (KEY.Key_PageDown, KEY.Key_PageUp, KEY.Key_Right, KEY.Key_D, KEY.Key_X):
        desk.do(key)
        assert desk.uuid == uuid
        assert not desk.page.choice.isVisible()
    desk.do(KEY.Key_Return)
    assert desk.page.banner.isVisible()
    failing()
    desk.do(KEY.Key_Return)
    assert not desk.page.banner.isVisible()
    assert desk.book.head(uuid).state == "submitted"
    assert desk.uuid != uuid


def test_a_grip_that_could_not_be_saved_is_corrected_by_the_repetition(desk, monkeypatch):
    uuid, real, broken = desk.uuid, desk.book.bulk, [True]

    def bulk(*args):
        if broken:
            raise FaultError(FULL)
        return real(*args)

    monkeypatch.setattr(desk.book, "bulk", bulk)
    desk.do(KEY.Key_Right, KEY.Key_K)
    assert "The disk is full. Make room." in desk.page.banner.text.text()
    assert desk.book.head(uuid).state == "submitted"
    broken.clear()
    desk.do(KEY.Key_Return)
    assert "of the grip moved by +0.10, +0.00 mm and accepted" in desk.page.message.text()
    assert not desk.page.banner.isVisible()


def test_a_failed_save_can_be_discarded(desk, failing):
    uuid, before = desk.uuid, desk.book.head(desk.uuid)
    desk.press(KEY.Key_Right)
    desk.do(KEY.Key_Return)
    assert desk.page.banner.isVisible()
    desk.do(KEY.Key_Escape)
    assert not desk.page.banner.isVisible()
    assert desk.book.head(uuid) == before
    assert desk.now.edit.label == before.label
    desk.do(KEY.Key_PageDown)
    assert desk.uuid != uuid


def test_what_the_database_raises_is_shown_as_well(desk, monkeypatch):
    def fail(*_args, **_more):
        raise sqlite3.OperationalError("disk I/O error")

    monkeypatch.setattr(desk.book, "set", fail)
    desk.do(KEY.Key_Right)
    assert "disk I/O error" in desk.page.banner.text.text()


def test_a_label_without_a_second_copy_is_saved_and_said_to_have_none(desk, monkeypatch):
    def fail(*_args):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as broken:
        broken.setattr(type(desk.workspace.presenter.dataset.journal), "catch_up", fail)
        uuid = desk.uuid
        desk.do(KEY.Key_Return)
        assert desk.book.head(uuid).state == "submitted"
        assert desk.uuid != uuid
        assert desk.page.banner.text.text().startswith("The label is saved")
        assert "No space left on device" in desk.page.banner.text.text()
        assert not desk.page.banner.again.isVisible()
    desk.do(KEY.Key_Return)
    assert not desk.page.banner.isVisible()


def test_a_backup_that_fails_is_told_beside_the_saved_label(desk, monkeypatch):
    dataset, uuid = desk.workspace.presenter.dataset, desk.uuid
    monkeypatch.setattr(type(dataset.backups), "age", None)
    monkeypatch.setattr(dataset.database, "copy_to", lambda target: target.write_bytes(b"half"))
    desk.do(KEY.Key_Return)
    assert desk.book.head(uuid).state == "submitted"
    assert "could not be copied" in desk.page.banner.text.text()


@pytest.mark.promise("D4")
def test_what_waits_for_another_program_is_counted_and_done_in_order(desk, qtbot):
    """A second connection holds the dataset; each try gives up after 20 ms instead of 2 s."""
    dataset, first = desk.workspace.presenter.dataset, desk.uuid
    dataset.database.first("PRAGMA busy_timeout = 20")
    with closing(sqlite3.connect(dataset.database.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        desk.press(KEY.Key_Return)
        qtbot.waitUntil(lambda: desk.saving.waiting == 1, timeout=60_000)
        desk.press(KEY.Key_Return)
        desk.press(KEY.Key_PageUp)
        assert desk.saving.waiting == 3
        assert "3 waiting actions" in desk.page.banner.text.text()
        assert desk.page.banner.isVisible()
        assert not desk.page.banner.again.isVisible()
        assert desk.uuid == first
        assert desk.book.head(first).state != "submitted"
        other.execute("ROLLBACK")
    desk.settle()
    assert not desk.page.banner.isVisible()
    # Both labels are saved, and the key that came last went back to the second.
    assert desk.book.head(first).state == "submitted"
    assert desk.uuid != first
    assert desk.book.head(desk.uuid).state == "submitted"


def work(desk):
    """Do some of everything, with keys."""
    desk.do(KEY.Key_Right, KEY.Key_Return)
    desk.do(KEY.Key_Return)
    desk.do(KEY.Key_D, KEY.Key_4)
    desk.do(KEY.Key_X, KEY.Key_V, KEY.Key_U)
    desk.type("2,2")
    desk.do(KEY.Key_Return, KEY.Key_PageDown)


@pytest.mark.promise("W13")
@pytest.mark.slow
def test_undo_and_redo_reach_back_over_restarts(start):
    desk = start()
    before = content(desk)
    work(desk)
    after = content(desk)
    assert after != before
    desk = start()
    steps = 0
    while desk.book._stack("Ann").undo:
        desk.do((KEY.Key_Z, CTRL) if steps % 2 else KEY.Key_U)
        steps += 1
        if steps == 3:
            desk = start()
    assert content(desk) == before
    assert steps == 8
    desk = start()
    while desk.book._stack("Ann").redo:
        desk.do((KEY.Key_U, SHIFT))
    assert content(desk) == after


def test_what_was_nudged_last_is_saved_when_the_window_closes(start):
    desk = start()
    uuid, before = desk.uuid, desk.book.head(desk.uuid).label
    desk.press(KEY.Key_Right)
    desk = start()
    assert desk.book.head(uuid).label.x_um == before.x_um + 100


def test_anothers_later_change_stands_in_the_way_of_undo(desk):
    uuid = desk.uuid
    desk.do(KEY.Key_Return)
    desk.enter_as("Bob")
    desk.book.reject("Bob", uuid, "tilt")
    desk.enter_as("Ann")
    desk.do(KEY.Key_U)
    assert "Bob" in desk.page.message.text()
    assert desk.book.head(uuid).state == "rejected"


def test_the_source_of_what_nobody_touched_never_changes(desk):
    uuid = desk.uuid
    desk.do(KEY.Key_V, KEY.Key_S)
    head = desk.book.head(uuid)
    assert (head.source, head.verdict) == ("commanded", "stable")
    desk.do(KEY.Key_U, (KEY.Key_U, SHIFT))
    assert desk.book.head(uuid).source == "commanded"
    desk.press(KEY.Key_Right)
    desk.press(KEY.Key_Left)  # there and back: nothing was set
    desk.do(KEY.Key_Return)
    assert desk.book.head(uuid).source == "commanded"
    assert desk.book.head(uuid).state == "submitted"


def test_restoring_a_version_makes_a_new_one(desk):
    uuid, first = desk.uuid, desk.book.head(desk.uuid)
    desk.do(KEY.Key_Up)
    desk.page.side.history.choose(1)
    desk.page.side.history.restore.click()
    desk.settle()
    history = desk.book.history(uuid)
    assert len(history) == 3
    assert (history[2].label, history[2].source) == (first.label, "commanded")


def test_a_label_is_never_taken_from_the_episode_before(desk):
    desk.type("4,4")
    desk.do(KEY.Key_Return, KEY.Key_Return)
    assert desk.now.edit.label != Label(4000, 4000, 0, 200)
    assert not desk.now.edit.changed
