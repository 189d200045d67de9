"""Figures as the cells of a report say them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from backend.core.flow import Outcome
from backend.experiments.document import Entry

Json = Mapping[str, Any]


def entry_of(estimate: Json, printed: float | None = None, notes: tuple[str, ...] = ()) -> Entry:
    """Return a rate of 0..1 in % with its interval; ``printed``: the paper's, said below it."""
    paper = () if printed is None else (f"paper {percent(printed)}",)
    return Entry(percent(estimate.get("value")), interval_of(estimate), (*paper, *notes))


def interval_of(estimate: Json) -> str:
    """Return the 95 % interval in %, "" without a value."""
    if estimate.get("value") is None:
        return ""
    return f"({percent(estimate['low'])}-{percent(estimate['high'])})"


def percent(share: float | None) -> str:
    """Return a share in %, "-" for none."""
    return "-" if share is None else f"{100 * share:.1f}"


def counts_of(outcomes: Mapping[str, int]) -> str:
    """Return how many ended as placed / fell / knocked over / gave up / aborted."""
    return " / ".join(str(outcomes.get(outcome.value, 0)) for outcome in Outcome)
