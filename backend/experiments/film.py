"""The course of a trial as a strip of belief maps, probe by probe."""

from __future__ import annotations

import html

from backend.core.facts import ActionChosen, BeliefUpdated, StabilityJudged
from backend.core.flow import FloatArray
from backend.experiments.closed_loop import TrialEnd
from backend.experiments.figures import belief_svg

FILM = "film.html"
"""File of a job with courses of its trials."""


def film_strip(end: TrialEnd, outline_mm: FloatArray) -> str:
    """Return the strip as HTML; ``outline_mm`` (k, 2) is the true support, in true places.

    The map is kept in commanded places, which differ from the true ones by the errors of grasp and
    print; the outline is drawn where the last probe shows it to be.
    """
    panels = []
    last = end.steps[-1].offset_mm if end.steps else (0.0, 0.0)
    true = end.true_mm or last
    shift = (last[0] - true[0], last[1] - true[1])
    for number, step in enumerate(end.steps, start=1):
        picture = belief_svg(
            BeliefUpdated(0.0, step.map, number),
            StabilityJudged(0.0, step.stability, number),
            ActionChosen(0.0, step.action, number, 0.0),
            outline_mm + shift,
        )
        panels.append(
            f'<div class="probe"><b>Probe {number}</b>{picture}'
            f"<p>{html.escape(step.action.reason)}</p></div>"
        )
    word = end.outcome.value.replace("_", " ")
    return (
        f'<div class="strip">{"".join(panels)}</div>'
        f'<p class="end">Seed {end.seed}: {word}. {html.escape(end.reason)}</p>'
    )
