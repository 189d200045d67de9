"""What a fact of the bench says in the frame: a card, or a sentence in the foot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from typing import Protocol

from app.activity import why_no_run
from app.cards import card_of, refusal_card
from app.error_hooks import log
from app.link import Link
from backend.core.facts import (
    Fact,
    FaultRaised,
    FaultsReset,
    Noticed,
    Paused,
    PhaseEntered,
    Refused,
    RunFinished,
    RunStarted,
    Said,
)
from backend.core.faults import RefusedError
from widgets.fault_cards import FaultCards


class Say(Protocol):
    """Shows a sentence in the foot; with ``holds`` only as long as that is true."""

    def __call__(self, text: str, holds: Callable[[], bool] | None = None) -> None:
        """Show it."""


def note(fact: Fact) -> None:
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


def tell(fact: Fact, link: Link | None, cards: FaultCards, say: Say) -> None:
    """Show a fact to the operator, if it is one that the frame tells."""
    if isinstance(fact, PhaseEntered | RunFinished):
        cards.clear(cards.obstacles)
    if isinstance(fact, FaultRaised):
        cards.show_card(card_of(fact.fault, clock()))
    elif isinstance(fact, Refused):
        cards.show_card(refusal_card(RefusedError(fact.reason, fact.text), clock()))
    elif isinstance(fact, FaultsReset):
        cards.clear()
        why = "" if link is None else why_no_run(link)
        if link is not None and why:
            say(f"{why}.", lambda: why_no_run(link) == why)
    elif isinstance(fact, Paused | Noticed):
        waits = isinstance(fact, Paused)
        card = card_of(fact.fault, clock())
        cards.show_card(replace(card, reset=False, obstacle=waits, notice=not waits))
    elif isinstance(fact, RunStarted):
        say("")
        cards.pass_on()
    elif isinstance(fact, Said):
        say(fact.text)
    elif isinstance(fact, RunFinished) and fact.ending != "finished":
        was = "failed" if fact.ending == "failed" else f"was {fact.ending}"
        say(f"The run {was}: {fact.reason}")


def clock() -> str:
    """Return the time of day, as cards show it."""
    return f"{datetime.now():%H:%M:%S}"
