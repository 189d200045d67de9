"""How much of the way from the paper's method to the ceiling a strategy goes.

Only what all three did counts: the same trials, the same groups.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from backend.core.flow import Outcome
from backend.experiments.promises import scores
from backend.experiments.scoring import FUSED

PAPER, CEILING = "paper", "ceiling"
Json = dict[str, Any]
Cell = tuple[str, str, str]
"""Strategy, piece, bottom."""


def gaps(
    trials: Mapping[Cell, Sequence[Json]], answers: Mapping[Cell, Mapping[int, Json]]
) -> list[Json]:
    """Return one row per strategy beside paper and ceiling, and per quantity.

    ``trials``: finished trials of each cell; ``answers``: finished groups, by the seed of the
    first of them. ``share`` is None where the ceiling is not above the paper.
    """
    rows = []
    by_seed = {cell: {t["seed"]: t for t in some} for cell, some in trials.items()}
    for name in _names(by_seed):
        three = _shared(by_seed, name)
        rows.append(_row(name, "placed", [_placed(some) for some in three], len(three[0])))
    for name in _names(answers):
        three = _shared(answers, name)
        scored = [scores(some) for some in three]
        for n in map(str, FUSED):
            values = [one["likely"][n]["balanced"] for one in scored]
            rows.append(_row(name, f"balanced, n = {n}", values, scored[0]["groups"]))
    return rows


def _names(found: Mapping[Cell, Any]) -> list[str]:
    names = dict.fromkeys(strategy for strategy, _, _ in found)
    if not {PAPER, CEILING} <= names.keys():
        return []
    return [name for name in names if name not in (PAPER, CEILING)]


def _shared(found: Mapping[Cell, Mapping[int, Json]], name: str) -> tuple[list[Json], ...]:
    """Return what paper, ``name`` and ceiling have in common, in this order."""
    kept: tuple[list[Json], ...] = ([], [], [])
    for piece, bottom in dict.fromkeys((p, b) for _, p, b in found):
        three = [found.get((s, piece, bottom), {}) for s in (PAPER, name, CEILING)]
        for seed in sorted(set(three[0]) & set(three[1]) & set(three[2])):
            for part, one in zip(kept, three, strict=True):
                part.append(one[seed])
    return kept


def _placed(trials: Iterable[Json]) -> float | None:
    ends = [trial["outcome"] == Outcome.PLACED.value for trial in trials]
    return sum(ends) / len(ends) if ends else None


def _row(name: str, what: str, values: Sequence[float | None], n: int) -> Json:
    paper, own, ceiling = values
    share = None
    if paper is not None and own is not None and ceiling is not None and ceiling > paper:
        share = (own - paper) / (ceiling - paper)
    return {
        "strategy": name,
        "what": what,
        "n": n,
        "paper": paper,
        "own": own,
        "ceiling": ceiling,
        "share": share,
    }
