"""The course of a trial as a strip of belief maps, probe by probe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from backend.core.facts import ActionChosen, BeliefUpdated, StabilityJudged
from backend.core.flow import FloatArray
from backend.experiments.closed_loop import TrialEnd
from backend.experiments.figures import belief_svg

FILM = "film.json"
"""File of a job with courses of its trials."""


def film_of(end: TrialEnd, outline_mm: FloatArray) -> Mapping[str, Any]:
    """Return the strip, JSON-ready; ``outline_mm`` (k, 2) is the true support, in true places.

    The map is kept in commanded places, which differ from the true ones by the errors of grasp and
    print; the outline is drawn where the last probe shows it to be.
    """
    probes = []
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
        probes.append({"svg": picture, "why": step.action.reason})
    word = end.outcome.value.replace("_", " ")
    return {"end": f"Seed {end.seed}: {word}. {end.reason}", "probes": probes}
