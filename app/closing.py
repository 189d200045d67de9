"""Whether the window may close: a run, a motion or a held piece is asked about first."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

from app.activity import busy
from app.error_hooks import log
from app.link import Link
from widgets.fault_cards import FaultCards, Question

ENDED = "It has ended, and no piece is held. Close the window?"
"""Asked in place of a question about something that ended while it stood."""

LAST_S = 5.0
"""So long after it was closed the program may hold on to what does not end."""


def end_for_sure(after_s: float = LAST_S) -> None:
    """End this process once ``after_s`` have passed, if it is still there; returns at once.

    For a window that was closed in order: a thread that hangs then must not keep the program.
    """

    def end() -> None:
        names = ", ".join(sorted(thread.name for thread in threading.enumerate()))
        log.error("ended by force; still there: %s", names)
        os._exit(1)

    last = threading.Timer(after_s, end)
    last.name, last.daemon = "last word", True
    last.start()


class Closing:
    """Asks, and closes on the answer. ``allowed``: nothing is asked any more."""

    def __init__(
        self, cards: FaultCards, stop: Callable[[], None], close: Callable[[], object]
    ) -> None:
        self._cards, self._stop, self._close = cards, stop, close
        self._asked: Question | None = None
        self.allowed = False

    def may_close(self, link: Link | None) -> bool:
        """Return whether nothing is left alone; else ask."""
        question = None if self.allowed or link is None else self._question(link)
        if question is None:
            return True
        self._ask(question)
        return False

    def draw(self, link: Link) -> None:
        """Keep the question true while it stands: what it asks about may have ended meanwhile."""
        if self._asked is None or self._cards.asks is not self._asked:
            return
        now = self._question(link) or Question(ENDED, (("Stay", _stay), ("Close", self._close_now)))
        if now.text != self._asked.text:
            self._ask(now)

    def _question(self, link: Link) -> Question | None:
        if busy(link):
            what, stay = "A run is active and a piece may be held.", "Keep running"
        elif link.hand is not None and link.hand.active:
            what, stay = "The bench is being moved by hand.", "Go on"
        elif link.hand is not None and link.hand.holding:
            answers = (("Stay", _stay), ("Close, keep the grip", self._stop_and_close))
            return Question("A piece is held. Close the window?", answers)
        else:
            return None
        answers = ((stay, _stay), ("Stop and close", self._stop_and_close))
        return Question(f"{what} Stop and close? The grip is kept.", answers)

    def _ask(self, question: Question) -> None:
        self._asked = question
        self._cards.ask(question)

    def _stop_and_close(self) -> None:
        self._stop()
        self._close_now()

    def _close_now(self) -> None:
        self.allowed = True
        self._close()


def _stay() -> None:
    """Do nothing: it goes on."""
