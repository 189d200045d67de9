"""The tour: real places, every page, by keys alone, in nobody's way, once by itself."""

import json

import pytest
from PySide6.QtCore import QPoint, QRect, QSize, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication

from tests.app.conftest import settle
from touchdown.widgets.shell.tour import card_position

KEY = Qt.Key


@pytest.mark.parametrize("size", [(1280, 720), (1600, 940)])
def test_every_stop_lights_its_place_and_the_card_stands_in_the_window(live, size):
    live.window.resize(*size)
    live.actions.action("tour").trigger()
    # No page is made before its stop.
    assert [ws.name for ws in live.workspaces.ready] == ["stack"]
    pages, tour = [], live.tour
    for at in range(len(tour.stops)):
        QApplication.processEvents()
        tour.fit()
        place, hole = tour.stops[at].place(), tour.spotlight.hole
        assert place.isVisible(), tour.stops[at].title
        corner = place.mapTo(live.window, QPoint(0, 0))
        assert hole.contains(QRect(corner, place.size()).intersected(live.window.rect()))
        assert live.window.rect().contains(tour.card.geometry())
        assert tour.card.text.height() >= tour.card.text.heightForWidth(tour.card.text.width())
        pages.append(live.window.front)
        # Collect has a meaning of its own for Enter; the tour comes first.
        QTest.keyClick(live.window.windowHandle(), KEY.Key_Return)
    assert not tour.active
    assert set(pages) >= set(live.workspaces)


def test_it_is_in_nobodys_way_and_esc_ends_it(live, bench):
    live.tour.begin()
    assert not live.toured
    QTest.keyClick(live.window.windowHandle(), KEY.Key_F12)
    assert bench.stops == 1
    settle(live)
    assert live.tour.active
    QApplication.processEvents()
    cards = QRect(live.cards.mapTo(live.window, QPoint(0, 0)), live.cards.size())
    assert live.cards.isVisible()
    assert not live.tour.card.geometry().intersects(cards)
    live.reset()
    settle(live)
    QApplication.processEvents()
    assert not live.cards.isVisible()
    assert live.tour.card.y() < cards.bottom()
    while live.window.front != "train":
        live.tour.turn(1)
    # On this page Esc cancels a training; the tour comes first.
    QTest.keyClick(live.window.windowHandle(), KEY.Key_Escape)
    assert not live.tour.active
    assert live.tour.card is None
    assert live.toured


def test_one_can_go_back_and_begin_again(live):
    live.tour.begin()
    assert not live.tour.card.back.isEnabled()
    QTest.keyClick(live.tour.card.next, Qt.Key.Key_Return)
    assert live.tour.at == 1
    live.tour.card.back.click()
    assert live.tour.at == 0
    live.tour.begin()
    assert live.tour.at == 0
    live.tour.end()


def test_it_begins_by_itself_once_on_the_simulated_bench(main, bench, tmp_path):
    bench.simulated = False
    main.tour_due = True
    main.attach(bench)
    assert not main.tour.active
    bench.simulated = True
    first = main.window.front
    main.go("collect")
    main.attach(bench)
    assert not main.tour.active  # work has begun: no page and no focus is taken away
    main.go(first)
    main.attach(bench)
    assert main.tour.active
    # A crash in the middle does not bring it back: it would take the page in front away.
    assert json.loads((tmp_path / "window.json").read_text())["toured"] is True
    main.tour.end()
    main.attach(bench)
    assert not main.tour.active


@pytest.mark.parametrize(
    ("hole", "side"),
    [
        (QRect(0, 0, 300, 200), "right"),
        (QRect(900, 0, 300, 200), "left"),
        (QRect(0, 0, 1200, 100), "below"),
        (QRect(0, 600, 1200, 100), "above"),
    ],
)
def test_the_card_stands_beside_its_place(hole, side):
    card, window = QSize(320, 150), QRect(0, 0, 1200, 700)
    stands = QRect(card_position(hole, card, window), card)
    assert window.contains(stands)
    assert not stands.intersects(hole)
    assert {
        "right": stands.left() > hole.right(),
        "left": stands.right() < hole.left(),
        "below": stands.top() > hole.bottom(),
        "above": stands.bottom() < hole.top(),
    }[side]
