"""Cards that report faults, refusals and questions."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from typing import Protocol

from touchdown.app.shell.activity import is_run_active, start_obstacle
from touchdown.app.shell.errors import log
from touchdown.backend.bench import Session
from touchdown.backend.core import (
    Event,
    Fault,
    FaultRaised,
    FaultsReset,
    Noticed,
    Paused,
    PhaseEntered,
    Refused,
    RefusedError,
    RunFinished,
    RunStarted,
    Said,
)
from touchdown.widgets.shell import STOPPED, CardQuestion, CardText, FaultCards


def fault_card(fault: Fault, at: str) -> CardText:
    """Return the card of a fault; ``at`` is the wall-clock time of day."""
    device = f"\nDevice: {fault.device}" if fault.device else ""
    details = (
        f"{fault.what}\n{fault.consequence}\n{fault.next_step}\nCode: {fault.code}{device}\n{at}"
    )
    return CardText(
        fault.code, fault.what, fault.consequence, fault.next_step, details, reset=True, at=at
    )


def stopped_card(at: str) -> CardText:
    """Return the card of a STOP."""
    return CardText(
        STOPPED,
        "Stopped by the operator.",
        "The run ends and new motion is refused; the grip is kept.",
        "Look at the bench, then press Reset.",
        at=at,
    )


def refusal_card(error: RefusedError, at: str) -> CardText:
    """Return the card of an order by hand that was refused or ended."""
    consequence = "The order was refused or has ended."
    return CardText(error.reason, error.detail, consequence, "", reset=False, at=at, passing=True)


class ShowStatus(Protocol):
    """Shows a sentence in the foot; with ``holds`` only as long as that is true."""

    def __call__(self, text: str, holds: Callable[[], bool] | None = None) -> None:
        """Show it."""


def log_event(fact: Event) -> None:
    """Write one plain line of the log for what an operator will ask about later."""
    if isinstance(fact, RunStarted):
        log.info("run %s: %s, %s on %s, seed %s",
                 fact.run_id, fact.activity, fact.piece, fact.bottom, fact.seed)  # fmt: skip
    elif isinstance(fact, RunFinished):
        log.info("run %s %s %s", fact.run_id, fact.ending, fact.reason)
    elif isinstance(fact, FaultRaised):
        log.warning("fault %s: %s", fact.fault.code, fact.fault.what)
    elif isinstance(fact, FaultsReset):
        log.info("reset by the operator")
    elif isinstance(fact, Paused):
        log.warning("paused %s: %s", fact.fault.code, fact.fault.what)
    elif isinstance(fact, Noticed):
        log.warning("noticed %s: %s", fact.fault.code, fact.fault.what)
    elif isinstance(fact, Refused):
        log.info("refused %s: %s", fact.reason, fact.text)


def show_event(fact: Event, bench: Session | None, cards: FaultCards, say: ShowStatus) -> None:
    """Show a fact to the operator, if it is one that the frame tells."""
    if isinstance(fact, PhaseEntered | RunFinished):
        cards.clear(cards.obstacles)
    if isinstance(fact, FaultRaised):
        cards.show_card(fault_card(fact.fault, time_of_day()))
    elif isinstance(fact, Refused):
        cards.show_card(refusal_card(RefusedError(fact.reason, fact.text), time_of_day()))
    elif isinstance(fact, FaultsReset):
        cards.clear()
        why = "" if bench is None else start_obstacle(bench)
        if bench is not None and why:
            say(f"{why}.", lambda: start_obstacle(bench) == why)
    elif isinstance(fact, Paused | Noticed):
        waits = isinstance(fact, Paused)
        card = fault_card(fact.fault, time_of_day())
        cards.show_card(replace(card, reset=False, obstacle=waits, notice=not waits))
    elif isinstance(fact, RunStarted):
        say("")
        cards.pass_on()
    elif isinstance(fact, Said):
        say(fact.text)
    elif isinstance(fact, RunFinished) and fact.ending != "finished":
        was = "failed" if fact.ending == "failed" else f"was {fact.ending}"
        say(f"The run {was}: {fact.reason}")


def time_of_day() -> str:
    """Return the time of day, as cards show it."""
    return f"{datetime.now():%H:%M:%S}"


ENDED_QUESTION = "It has ended, and no piece is held. Close the window?"
"""Asked in place of a question about something that ended while it stood."""

EXIT_TIMEOUT_S = 5.0
"""So long after it was closed the program may hold on to what does not end."""


def exit_after_timeout(after_s: float = EXIT_TIMEOUT_S) -> None:
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


class CloseConfirmation:
    """Asks, and closes on the answer. ``allowed``: nothing is asked any more."""

    def __init__(
        self, cards: FaultCards, stop: Callable[[], None], close: Callable[[], object]
    ) -> None:
        self._cards, self._stop, self._close = cards, stop, close
        self._asked: CardQuestion | None = None
        self.allowed = False

    def may_close(self, bench: Session | None) -> bool:
        """Return whether nothing is left alone; else ask."""
        question = None if self.allowed or bench is None else self._question(bench)
        if question is None:
            return True
        self._ask(question)
        return False

    def draw(self, bench: Session) -> None:
        """Keep the question true while it stands: what it asks about may have ended meanwhile."""
        if self._asked is None or self._cards.asks is not self._asked:
            return
        now = self._question(bench) or CardQuestion(
            ENDED_QUESTION, (("Stay", _stay), ("Close", self._close_now))
        )
        if now.text != self._asked.text:
            self._ask(now)

    def _question(self, bench: Session) -> CardQuestion | None:
        if is_run_active(bench):
            what, stay = "A run is active and a piece may be held.", "Keep running"
        elif bench.hand is not None and bench.hand.active:
            what, stay = "The bench is being moved by hand.", "Continue"
        elif bench.hand is not None and bench.hand.holding:
            answers = (("Stay", _stay), ("Close, keep the grip", self._stop_and_close))
            return CardQuestion("A piece is held. Close the window?", answers)
        else:
            return None
        answers = ((stay, _stay), ("Stop and close", self._stop_and_close))
        return CardQuestion(f"{what} Stop and close? The grip is kept.", answers)

    def _ask(self, question: CardQuestion) -> None:
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
