"""Faults of the bench as cards."""

from __future__ import annotations

from backend.core.faults import Fault, RefusedError
from widgets.fault_cards import STOPPED, CardText


def card_of(fault: Fault, at: str) -> CardText:
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
