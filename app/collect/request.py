"""From the form of the page to a request, and what is remembered of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields

from backend.runs.collect_plan import Pattern
from backend.runs.requests import CollectRequest
from widgets.episode_table import Arrangement
from widgets.target_panel import TargetForm


def request_of(form: TargetForm, person: str, *, campaign: str = "") -> CollectRequest:
    """Return the request of a form; with ``campaign`` the plan of that one holds."""
    patterns: dict[str, Pattern] = {"grid": "grid", "adaptive": "adaptive"}
    return CollectRequest(
        piece=form.piece,
        bottom=form.bottom,
        count=form.count,
        seed=form.seed,
        pattern=patterns.get(form.pattern, "random"),
        person=person,
        within_mm=form.within_mm or None,
        origin_mm=(form.origin_x_mm, form.origin_y_mm),
        check_origin=form.check_origin,
        campaign=campaign,
        ask=form.ask,
        probes_per_grip=form.probes_per_grip or None,
        hand_over=form.hand_over,
    )


def form_of(memory: Mapping[str, object]) -> tuple[TargetForm, list[str]]:
    """Return (form, names of what made no sense); those fields get their defaults."""
    default, known, dropped = TargetForm(), {}, []
    for entry in fields(TargetForm):
        value = memory.get(entry.name, getattr(default, entry.name))
        if type(value) is type(getattr(default, entry.name)):
            known[entry.name] = value
        else:
            dropped.append(entry.name)
    return TargetForm(**known), dropped  # type: ignore[arg-type]


def arrangement_of(memory: object) -> Arrangement:
    """Return columns and order of the list; raises ``ValueError`` for what makes no sense."""
    match memory:
        case None:
            return Arrangement()
        case {"columns": [*columns], "sort": str(sort), "descending": bool(descending)}:
            return Arrangement(tuple(str(name) for name in columns), sort, descending)
    raise ValueError("no columns")
