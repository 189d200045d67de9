"""Trials and groups one by one, a line each, as ``beyond.json`` keeps them beside its counts.

A trial: ``seed outcome probes least``, the last as in ``least_probes``. A job of groups: the seed
of its first, then for each ``margin:likely:released``: the true margin of all interfaces in mm
(``-`` where nothing is beneath), and what was said after the probes of ``FUSED``, 1 for yes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from backend.experiments.scoring import FUSED

Json = dict[str, Any]
Cell = tuple[str, str, str]
"""Strategy, piece, bottom."""
NOTHING = "-"
VERDICTS = ("likely", "says")


def trial_lines(trials: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return a line for each trial."""
    return [
        " ".join(str(t[k]) for k in ("seed", "outcome", "probes", "least_probes")) for t in trials
    ]


def group_lines(answers: Mapping[int, Mapping[str, Any]]) -> list[str]:
    """Return a line for each answer, by the seed of its first group."""
    return [
        " ".join([str(seed), *(_group(answer, g) for g in range(len(answer["margin_mm"])))])
        for seed, answer in sorted(answers.items())
    ]


def trials_in(answer: Mapping[str, Any]) -> dict[Cell, list[Json]]:
    """Return the trials of each cell of a ``beyond.json``; cells without lines have none."""
    found: dict[Cell, list[Json]] = {}
    for cell in answer["cells"]:
        for line in cell.get("trials", ()):
            seed, outcome, probes, least = line.split()
            trial = {"seed": int(seed), "outcome": outcome, "probes": int(probes)}
            found.setdefault(_cell(cell), []).append({**trial, "least_probes": int(least)})
    return found


def answers_in(answer: Mapping[str, Any]) -> dict[Cell, dict[int, Json]]:
    """Return margins and verdicts of each cell of a ``beyond.json``, by the first seed."""
    found: dict[Cell, dict[int, Json]] = {}
    for cell in answer.get("statics", {}).get("cells", ()):
        for line in cell.get("asked", ()):
            seed, *groups = line.split()
            found.setdefault(_cell(cell), {})[int(seed)] = _answer(groups)
    return found


def _cell(cell: Mapping[str, Any]) -> Cell:
    return cell["strategy"], cell["piece"], cell["bottom"]


def _group(answer: Mapping[str, Any], g: int) -> str:
    margin = answer["margin_mm"][g][1]
    bits = ["".join(str(int(answer[kind][str(n)][g])) for n in FUSED) for kind in VERDICTS]
    return ":".join([NOTHING if margin is None else f"{margin:g}", *bits])


def _answer(groups: Sequence[str]) -> Json:
    parts = [group.split(":") for group in groups]
    margins = [None if part[0] == NOTHING else float(part[0]) for part in parts]
    said = {
        kind: {str(n): [part[1 + v][k] == "1" for part in parts] for k, n in enumerate(FUSED)}
        for v, kind in enumerate(VERDICTS)
    }
    return {"margin_mm": [[m, m] for m in margins], **said}
