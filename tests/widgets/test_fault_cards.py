"""One card shows, STOP before all others; a refusal passes with the next order carried out."""

import pytest
from PySide6.QtWidgets import QWidget

from touchdown.widgets.shell.fault_cards import STOPPED, CardText, FaultCards, TopOverlay


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
    return [c.text.code for c in sorted(seen, key=cards.layout().indexOf)]


def test_further_cards_take_no_room_until_they_are_asked_for(cards):
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


def test_folded_cards_are_a_line_elsewhere_until_something_new_comes(qtbot):
    base, resets = QWidget(), []
    qtbot.addWidget(base)
    cards = FaultCards(lambda: resets.append(1))
    on_top = TopOverlay(cards, base)
    cards.strip.setParent(base)
    base.resize(1180, 630)
    base.show()
    cards.show_card(fault("FT-TRIP"))
    qtbot.waitUntil(lambda: cards.width() == 1180 and cards.y() == 0)
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
    del on_top
