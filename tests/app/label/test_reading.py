"""Between two episodes the former one stays in sight: nothing flashes, no key comes too early."""

import threading

from tests.app.label.conftest import KEY


def test_the_former_episode_stays_in_sight_until_the_next_is_there(desk, monkeypatch):
    presenter, gate = desk.workspace.presenter, threading.Event()
    read = presenter._prefetch._read
    monkeypatch.setattr(presenter._prefetch, "_read", lambda uuid: (gate.wait(120), read(uuid))[1])
    page, first = desk.page, desk.uuid
    view, frame = page.film.views["left"], page.film.views["left"]._frame
    far = presenter.walk.order[30]
    presenter.go_to(30)
    desk.press(KEY.Key_Return)  # meant for the episode that is asked for, not for the one in sight
    page.repaint()
    assert presenter.walk.uuid == far
    assert desk.uuid == first
    assert view._frame is frame
    assert page.view.scene is not None
    assert desk.book.head(first).state == desk.book.head(far).state == "draft"
    gate.set()
    desk.settle()
    assert desk.book.head(far).state == "submitted"
    assert desk.book.head(first).state == "draft"
    assert desk.uuid == presenter.walk.order[31]
    assert page.film.views["left"]._frame is not frame


def test_an_empty_queue_keeps_nothing_of_the_former_episode(desk):
    page = desk.page
    assert page.view_panel.detail.text()
    assert page.basis.text()
    assert page.forces.trace is not None
    desk.workspace.presenter.choose_queue("conflicts")
    desk.settle()
    assert desk.workspace.presenter.walk.uuid is None
    assert page.view.scene is None
    assert page.forces.trace is None
    for line in (page.view_panel.detail, page.verdict, page.basis, page.model_line):
        assert line.text() == ""


def test_where_nothing_was_in_sight_the_page_says_that_it_loads(desk, monkeypatch):
    presenter, gate, page = desk.workspace.presenter, threading.Event(), desk.page
    presenter.choose_queue("conflicts")
    desk.settle()
    assert page.nothing.title.text() == "There are no conflicts"
    read = presenter._prefetch._read
    monkeypatch.setattr(presenter._prefetch, "_read", lambda uuid: (gate.wait(120), read(uuid))[1])
    presenter.choose_queue("unlabelled")
    desk._qtbot.waitUntil(lambda: presenter.walk.uuid is not None, timeout=60_000)
    assert page.nothing.isVisible()
    assert page.nothing.title.text() == "Loading the episode"
    assert not page.nothing.button.isVisible(), "there is nothing to do but wait"
    gate.set()
    desk.settle()
    assert not page.nothing.isVisible()
    assert page.view.scene is not None
