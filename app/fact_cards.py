"""What a fact of the bench says in the frame: a card, or a sentence in the foot."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime

from app.activity import why_no_run
from app.cards import card_of, refusal_card
from app.link import Link
from backend.core.facts import (
    Fact,
    FaultRaised,
    FaultsReset,
    Refused,
    RunFinished,
    RunStarted,
    Said,
)
from backend.core.faults import RefusedError
from widgets.fault_cards import FaultCards


def tell(fact: Fact, link: Link | None, cards: FaultCards, say: Callable[[str], None]) -> None:
    """Show a fact to the operator, if it is one that the frame tells."""
    if isinstance(fact, FaultRaised):
        cards.show_card(card_of(fact.fault, clock()))
    elif isinstance(fact, Refused):
        cards.show_card(refusal_card(RefusedError(fact.reason, fact.text), clock()))
    elif isinstance(fact, FaultsReset):
        cards.clear()
        if link is not None and why_no_run(link):
            say(f"{why_no_run(link)}.")
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
