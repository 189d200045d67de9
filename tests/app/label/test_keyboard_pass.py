"""A person labels a whole queue with the keyboard, and nothing is lost on the way."""

import pytest
from PySide6.QtCore import Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.label.conftest import CTRL, KEY, SHIFT
from tests.app.stand_in import StandInBench


def test_no_key_of_the_page_moves_the_bench(start):
    desk, bench = start(), StandInBench()
    desk.main.attach(bench)
    assert not {"R", "N", "G", "A", "F5"} & {c.key for c in desk.workspace.commands}
    for key in (KEY.Key_R, KEY.Key_N, KEY.Key_G, KEY.Key_A, KEY.Key_F5, KEY.Key_Space):
        desk.do(key)
    desk.do(KEY.Key_Right, KEY.Key_Return, KEY.Key_X, KEY.Key_PageDown, KEY.Key_D, KEY.Key_2)
    assert (bench.started, bench.stops, bench.engine.orders) == ([], 0, [])


def test_arrows_nudge_by_whole_steps(desk):
    before = desk.now.edit.label
    alt = Qt.KeyboardModifier.AltModifier
    pause = desk.workspace.presenter.editing._nudging
    pause.setInterval(3_600_000)  # it is over when the test says so
    desk.press(KEY.Key_Right)
    desk.press(KEY.Key_Up, SHIFT)
    desk.press(KEY.Key_Left, alt)
    edit = desk.now.edit
    assert edit.label.x_um == before.x_um + 100 - 10
    assert edit.label.y_um == before.y_um + 1000
    pause.start(0)
    desk.settle()
    assert len(desk.book.history(desk.uuid)) == 2  # nudges in quick succession are one revision
    assert desk.page.strip.saved.endswith("rev 2")


def test_keys_pressed_while_a_save_is_under_way_follow_it_in_order(desk, hold_saves):
    first, second, third = desk.workspace.presenter.walk.order[:3]
    release = hold_saves(desk)
    for key in (KEY.Key_Return, KEY.Key_Return, KEY.Key_D, KEY.Key_1):
        desk.press(key)
    assert desk.book.head(first).state == "draft"
    release()
    desk.settle()
    assert [desk.book.head(u).state for u in (first, second, third)] == [
        "submitted", "submitted", "rejected",
    ]  # fmt: skip
    assert desk.book.head(third).reason == "slip in grasp"


def test_a_question_takes_only_its_own_keys(desk):
    uuid = desk.uuid
    desk.do(KEY.Key_D)
    assert desk.page.choice.isVisible()
    desk.do(KEY.Key_Return, KEY.Key_X, KEY.Key_Escape)
    assert not desk.page.choice.isVisible()
    assert desk.book.head(uuid).state == "draft"
    assert desk.book.marks(uuid) == {}


def test_another_reason_is_asked_for_in_words(desk):
    uuid = desk.uuid
    desk.do(KEY.Key_D, KEY.Key_9)
    desk.type("DUST")
    desk.do(KEY.Key_Return)
    assert desk.book.head(uuid).reason.upper() == "DUST"


def test_a_typed_displacement_that_makes_no_sense_stays_in_the_line(desk):
    uuid = desk.uuid
    desk.type("1.5")
    desk.do(KEY.Key_Return)
    assert desk.page.entry.isVisible()
    assert "Type x,y" in desk.page.message.text()
    desk.do(KEY.Key_Escape)
    assert not desk.page.entry.isVisible()
    assert len(desk.book.history(uuid)) == 1


def test_the_uncertainty_is_assumed_told_and_stated_by_a_key(start):
    desk = start(sigma_mm=None)
    first = desk.uuid
    desk.type("1,2")
    desk.do(KEY.Key_Return)
    assert not desk.page.choice.isVisible()
    assert desk.book.head(first).label.sigma_um == 200
    assert "sigma 0.20 mm" in desk.page.message.text()
    desk.do(KEY.Key_S)
    assert desk.page.choice.marked == "0.20 mm"
    desk.do(KEY.Key_Tab, KEY.Key_Return)
    assert desk.book.head(first).label.sigma_um == 300
    desk.do(KEY.Key_Return)
    second = desk.uuid
    desk.type("3,1")
    desk.do(KEY.Key_Return)
    assert desk.book.head(second).label.sigma_um == 300
    assert "sigma" not in desk.page.message.text()


def test_coordinates_typed_into_the_question_of_sigma_are_saved_whole_or_not_at_all(start):
    desk = start(sigma_mm=None)
    uuid = desk.uuid
    before = desk.book.head(uuid).label
    desk.do(KEY.Key_S)
    assert desk.page.choice.isVisible()
    assert not desk.page.choice.geometry().intersects(desk.page.view_panel.geometry())
    assert not desk.page.choice.geometry().intersects(desk.page.film_panel.geometry())
    desk.do(KEY.Key_D, KEY.Key_X, KEY.Key_S, KEY.Key_Space)
    assert desk.page.choice.isVisible()
    desk.type("-3.2,4.5,0.2")
    assert desk.page.entry.text() == "-3.2,4.5,0.2"
    assert not desk.page.choice.isVisible()
    assert (desk.book.head(uuid).label, desk.workspace.session.sigma_mm) == (before, None)
    desk.do(KEY.Key_Return)
    label = desk.book.head(uuid).label
    assert (label.x_um, label.y_um, label.sigma_um) == (-3200, 4500, 200)


def test_a_save_leaves_the_displacement_that_is_being_typed(start):
    desk = start(sigma_mm=None)
    uuid, before = desk.uuid, desk.book.head(desk.uuid).label
    desk.press(KEY.Key_Right)
    desk.type("-3.2")
    desk.settle()
    assert desk.book.head(uuid).label.x_um == before.x_um + 100
    assert not desk.page.choice.isVisible()
    desk.type(",4.5")
    assert desk.page.entry.text() == "-3.2,4.5"


def test_whoever_starts_first_is_asked_for_a_name(start):
    desk = start(person="")
    assert desk.workspace.presenter is None
    assert desk.page.words.isVisible()
    assert desk.page.nothing.title.text() == "No person is named yet"
    assert desk.page.nothing.button.text() == "Give your name (Ctrl+U)"
    desk.type("ANN")
    desk.do(KEY.Key_Return)
    assert desk.page.person.text().upper() == "ANN"
    assert desk.page.message.text() == ""
    assert desk.workspace.memory()["person"].upper() == "ANN"


def is_blank(view):
    """True if a view is of one colour."""
    image = view.grab().toImage().scaled(40, 40)
    return len({image.pixel(x, y) for x in range(40) for y in range(40)}) == 1


def test_an_empty_queue_says_so_once_and_offers_one_thing_to_do(desk):
    page, presenter = desk.page, desk.workspace.presenter
    views = (page.forces, page.moments, page.phase, *page.film.views.values())
    assert not any(is_blank(view) for view in views)
    presenter.choose_queue("returned")
    desk.settle()
    assert page.nothing.isVisible()
    assert page.nothing.title.text() == "None of your labels was rejected"
    assert all(is_blank(view) for view in views)
    assert not page.view.isVisible()
    assert (page.view.scene, page.forces.trace, presenter.walk.uuid) == (None, None, None)
    lines = (page.view_panel.detail, page.verdict, page.basis, page.model_line, page.message)
    assert [line.text() for line in lines] == [""] * 5
    assert page.strip.saved == ""
    page.nothing.button.click()
    popup = QApplication.activePopupWidget()
    for key in (KEY.Key_Home, KEY.Key_Return):
        QTest.keyClick(popup.window().windowHandle(), key)
    desk.settle()
    assert desk.page.queue.currentData() == "unlabelled"
    assert page.view.isVisible()
    assert not page.nothing.isVisible()
    assert not any(is_blank(view) for view in views)


def test_the_end_of_a_queue_shows_what_is_left_and_an_own_rejection_is_found_again(desk):
    page, presenter = desk.page, desk.workspace.presenter
    first, second, *others = presenter.walk.order
    for uuid in others:
        desk.book.delete("setup", uuid, "of no use here")
    presenter.choose_queue("unlabelled")
    desk.settle()
    desk.do(KEY.Key_D, KEY.Key_2)
    assert desk.uuid == second
    desk.do(KEY.Key_X, KEY.Key_Return)
    assert page.nothing.isVisible()
    assert page.nothing.title.text() == "Nothing is left to label"
    desk.do(KEY.Key_Return)
    desk.do(KEY.Key_U)
    assert desk.uuid == second
    desk.do(KEY.Key_Return)
    presenter.choose_queue("returned")
    desk.settle()
    assert (presenter.walk.order, desk.uuid) == ([first], first)
    presenter.choose_queue("coverage")
    desk.settle()
    assert desk.uuid == second
    desk.do(KEY.Key_Return)
    assert page.message.text() == "The end of the queue: 1 episode left. Ctrl+R reads it again."


@pytest.mark.parametrize(
    ("queue", "button"),
    [("doubt", "Let the model score the dataset (Ctrl+M)"), ("", "Collect probes (F2)")],
)
def test_what_an_empty_queue_offers_is_what_would_fill_it(desk, queue, button):
    presenter = desk.workspace.presenter
    if queue:
        presenter.choose_queue(queue)
    else:
        for entry in presenter.dataset.episodes():
            desk.book.delete("Ann", entry.uuid, "not needed")
        desk.press(KEY.Key_R, CTRL)
    desk.settle()
    assert desk.page.nothing.button.text() == button
    if not queue:
        desk.page.nothing.button.click()
        assert desk.main.workspaces["collect"].page.front == "collect"


def test_reading_ahead_holds_no_more_than_seven_episodes(desk):
    held = desk.workspace.presenter._prefetch._items
    for key in [KEY.Key_PageDown] * 20 + [KEY.Key_PageUp] * 5:
        desk.do(key)
        assert len(held) <= 7
        assert desk.uuid in held
