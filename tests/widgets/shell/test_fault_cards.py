"""One card shows, STOP before all others; a refusal passes with the next order carried out."""

import pytest
from PySide6.QtCore import QPoint, QRect, Qt
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication, QLabel, QPushButton, QWidget

from touchdown.widgets.base import ElidedLabel, Theme, load_resources, vbox
from touchdown.widgets.shell import STOPPED, CardQuestion, CardText, FaultCards, TopBar


@pytest.fixture
def cards(qtbot):
    made = FaultCards(lambda: None)
    qtbot.addWidget(made)
    return made


def refused(code):
    return CardText(code, f"{code} was refused.", "Nothing moves.", "", reset=False, passing=True)


def fault(code):
    return CardText(code, f"{code} happened.", "", "Press Reset.")


def shown(cards):
    """Codes of the cards that are seen, from the top."""
    seen = [c for c in map(cards.card, cards.codes) if not c.isHidden()]
    return [c.text.code for c in sorted(seen, key=cards._column.indexOf)]


def test_further_cards_take_no_room_until_they_are_asked_for(cards):
    cards.resize(1280, 300)
    cards.show_card(refused("LIMIT"))
    one_px = cards.sizeHint().height()
    for text in (fault("FT-TRIP"), refused("DRAGGING")):
        cards.show_card(text)
    assert cards.sizeHint().height() == one_px
    assert shown(cards) == ["FT-TRIP"]
    more = cards.card("FT-TRIP").more
    assert more.text() == "2 more"
    more.click()
    assert shown(cards) == ["FT-TRIP", "DRAGGING", "LIMIT"]
    assert more.text() == "Fewer"
    more.click()
    assert shown(cards) == ["FT-TRIP"]


def test_stop_lies_on_top_whatever_comes_after_it(cards):
    cards.show_card(fault(STOPPED))
    cards.show_card(fault("FT-TRIP"))
    for code in ("A", "B", "C", "D"):
        cards.show_card(refused(code))
    assert shown(cards) == [STOPPED]
    assert cards.codes == (STOPPED, "FT-TRIP", "C", "D"), "the oldest refusals made room"
    cards.clear()
    assert STOPPED not in cards.codes
    assert len(shown(cards)) == 1


def test_a_repetition_rises_and_a_success_withdraws_refusals_alone(cards):
    for text in (refused("LIMIT"), refused("DRAGGING"), refused("LIMIT")):
        cards.show_card(text)
    assert shown(cards) == ["LIMIT"]
    cards.show_card(fault("FT-TRIP"))
    cards.pass_on()
    assert cards.codes == ("FT-TRIP",)
    assert not cards.card("FT-TRIP").more.isVisibleTo(cards)
    cards.clear()
    assert cards.isHidden()


def test_a_repetition_shows_its_own_place_and_remedy(cards):
    cards.show_card(CardText("FILE", "It is too large.", "In a.toml.", "Shorten it."))
    cards.show_card(CardText("FILE", "It is empty.", "In b.toml.", ""))
    texts = [label.text() for label in cards.card("FILE").findChildren(QLabel)]
    assert texts[:2] == ["It is empty. (\N{MULTIPLICATION SIGN}2)", "In b.toml."]


def test_notices_of_one_start_are_cards_of_their_own_and_none_makes_room(cards):
    """Two things that a dataset healed are not one thing that happened twice."""

    def notice(what):
        return CardText("DATASET", what, "", "", reset=False, notice=True)

    for what in ("A folder was torn.", "The disk is nearly full.", "A folder was torn."):
        cards.show_card(notice(what))
    assert cards.codes == ("DATASET", "DATASET")
    assert cards.card("DATASET").count == 2
    for code in "ABCDEF":
        cards.show_card(refused(code))
    assert cards.codes.count("DATASET") == 2
    cards.card("DATASET")._act()
    assert cards.codes.count("DATASET") == 1, "each is dismissed by itself"


def based(qtbot, width):
    """Return a window with cards and their strip, and the list of resets."""
    QApplication.instance().setStyleSheet("")  # of another test: a focus frame would move buttons
    base, resets = QWidget(), []
    qtbot.addWidget(base)
    cards = FaultCards(lambda: resets.append(1))
    vbox(1, cards, cards.strip, parent=base, margins=(0, 0, 0, 0))
    base.resize(width, 630)
    base.show()
    return base, cards, resets


def test_folded_cards_are_a_line_elsewhere_until_something_new_comes(qtbot):
    _, cards, resets = based(qtbot, 1180)
    cards.show_card(fault("FT-TRIP"))
    qtbot.waitUntil(lambda: cards.width() == 1180)
    assert not cards.strip.isVisible()
    cards.card("FT-TRIP").fold.click()
    assert not cards.isVisible(), "nothing of the page is covered"
    assert cards.strip.isVisible()
    cards.show_card(fault("FT-TRIP"))
    assert not cards.isVisible(), "the same again was read already"
    cards.strip.reset.click()
    assert resets == [1]
    cards.show_card(refused("LIMIT"))
    assert shown(cards) == ["FT-TRIP"]
    assert cards.isVisible()
    assert not cards.strip.isVisible()
    cards.fold()
    cards.strip.show_all.click()
    assert shown(cards) == ["FT-TRIP"]
    cards.fold()
    cards.clear(cards.codes)
    assert not cards.strip.isVisible()


def test_a_question_and_a_stop_are_one_queue_and_no_button_takes_the_place_of_another(qtbot):
    base, cards, resets = based(qtbot, 900)
    answers = []

    def buttons():
        for _ in range(4):
            QApplication.processEvents()
        seen = [b for b in cards.findChildren(QPushButton) if b.isVisible()]
        return {b.text(): QRect(b.mapTo(base, QPoint(0, 0)), b.size()) for b in seen}

    def ask(word, **more):
        stay, go = (lambda: answers.append("stay")), (lambda: answers.append("close"))
        cards.ask(CardQuestion("A run is active.", (("Stay", stay), (word, go))), **more)

    ask("Stop and close")
    first = buttons()
    cards.show_card(CardText(STOPPED, "Stopped.", "The run ends.", "Press Reset."))
    stopped = buttons()
    assert "Reset" in stopped
    assert "Stay" not in stopped, "one at a time"
    ask("Close", front=False)
    assert set(buttons()) == set(stopped), "new words for the same question stay behind"
    assert buttons()["Reset"] == stopped["Reset"]
    for place in (first["Stay"], first["Stop and close"]):
        assert not any(place.intersects(stopped[text]) for text in ("Reset", "Fold", "Copy"))
    ask("Close")
    again = buttons()
    assert (again["Stay"], again["Close"].x()) == (first["Stay"], first["Stop and close"].x())
    assert "Reset" not in again
    QTest.keyClick(base.windowHandle(), Qt.Key.Key_Escape)
    assert answers == ["stay"]
    assert "Reset" in buttons()
    QTest.keyClick(base.windowHandle(), Qt.Key.Key_Escape)
    assert (answers, resets) == (["stay"], [])


@pytest.fixture
def bar(qapp, qtbot):
    """A bar at a font scale and width."""
    load_resources()
    theme = Theme()

    def build(scale, width):
        theme.apply(qapp, "dark", scale)
        bar = TopBar(theme, lambda: None)
        qtbot.addWidget(bar)
        bar.show_modes("Moving", "Normal")
        bar.show_hardware_stop("none")
        bar.resize(width, bar.sizeHint().height())
        bar.show()
        qtbot.waitExposed(bar, timeout=60_000)
        bar.fit()
        bar.resize(width, bar.sizeHint().height())
        QApplication.processEvents()
        return bar

    yield build
    theme.apply(qapp, "dark", 1.0)


def places(bar):
    parts = [bar.pill, bar.stop, *bar.chips.values(), bar.override, bar.servo]
    return [QRect(p.mapTo(bar, p.rect().topLeft()), p.size()) for p in parts]


@pytest.mark.parametrize("scale", [1.0, 1.2, 1.5, 2.0])
@pytest.mark.parametrize("width", [1280, 1600, 1920])
def test_nothing_is_cut_and_nothing_overlaps(bar, scale, width):
    bar = bar(scale, width)
    assert bar.minimumSizeHint().width() <= width
    areas = places(bar)
    for k, area in enumerate(areas):
        assert bar.rect().contains(area)
        assert not any(area.intersects(other) for other in areas[k + 1 :])
    for part in (bar.stop, bar.servo, *bar.chips.values()):
        assert part.width() >= part.sizeHint().width()


def test_little_room_first_costs_the_figures_then_a_second_row(bar):
    chip = "tactile_left"
    assert not bar(1.0, 1600).chips[chip].short
    assert not bar(1.0, 1280).chips[chip].short
    assert bar(1.0, 1100).chips[chip].short
    tightest = bar(2.0, 1280)
    assert not tightest.chips[chip].short
    assert tightest.chips[chip].geometry().height() * 2 < tightest.height()
    tightest.resize(3000, 120)
    QApplication.processEvents()
    row = {p.center().y() for p in places(tightest)[2:-2]} | {places(tightest)[0].center().y()}
    assert max(row) - min(row) <= 2


def test_a_cut_line_ends_in_an_ellipsis(qtbot):
    label = ElidedLabel("small")
    qtbot.addWidget(label)
    label.setText("Probe 1: contact on 28 % of the face")
    label.resize(90, 20)
    assert label.shown().endswith("\N{HORIZONTAL ELLIPSIS}")
    assert label.fontMetrics().horizontalAdvance(label.shown()) <= 90
    label.resize(900, 20)
    assert label.shown() == label.text()
    assert label.minimumSizeHint().width() == 0
