"""The servo button of the top bar: off at a press, on after it was held for a second."""

from __future__ import annotations

from app.cards import refusal_card
from app.fact_cards import clock
from app.link import Link
from backend.core.faults import RefusedError
from widgets.fault_cards import FaultCards
from widgets.top_bar import TopBar


class ServoSwitch:
    """Carries the operator's wish to the arm, and shows how its motors are."""

    def __init__(self, link: Link, bar: TopBar, cards: FaultCards) -> None:
        self._link, self._bar, self._cards = link, bar, cards
        bar.servo.ordered = self._switch

    def draw(self) -> None:
        """Show whether the motors are on, off, or unknown."""
        hand = self._link.hand
        if hand is None:
            self._bar.servo.show_state(None)
        else:
            self._bar.servo.show_state(hand.powered, busy=hand.switching)

    def _switch(self, on: bool) -> None:
        hand = self._link.hand
        if hand is None:
            return
        try:
            hand.servo(on)
        except RefusedError as error:
            self._cards.show_card(refusal_card(error, clock()))
