"""Whether the window may close: a run, a motion or a held piece is asked about first."""

from __future__ import annotations

from collections.abc import Callable

from app.activity import busy
from app.link import Link
from widgets.fault_cards import FaultCards, Question


class Closing:
    """Asks, and closes on the answer. ``allowed``: nothing is asked any more."""

    def __init__(
        self, cards: FaultCards, stop: Callable[[], None], close: Callable[[], object]
    ) -> None:
        self._cards, self._stop, self._close = cards, stop, close
        self.allowed = False

    def may_close(self, link: Link | None) -> bool:
        """Return whether nothing is left alone; else ask."""
        if self.allowed or link is None:
            return True
        if busy(link):
            what, stay = "A run is active and a piece may be held.", "Keep running"
        elif link.hand is not None and link.hand.active:
            what, stay = "The bench is being moved by hand.", "Go on"
        elif link.hand is not None and link.hand.holding:
            answers = (("Stay", _stay), ("Close, keep the grip", self._stop_and_close))
            self._cards.ask(Question("A piece is held. Close the window?", answers))
            return False
        else:
            return True
        answers = ((stay, _stay), ("Stop and close", self._stop_and_close))
        self._cards.ask(Question(f"{what} Stop and close? The grip is kept.", answers))
        return False

    def _stop_and_close(self) -> None:
        self._stop()
        self.allowed = True
        self._close()


def _stay() -> None:
    """Do nothing: it goes on."""
