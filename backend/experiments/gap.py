"""How much of the way from the paper's method to a ceiling a strategy goes.

One ceiling knows the outline of the bottom, the other that it is round only. Only what all three
did counts: the same trials, the same groups. The interval is that of a
bootstrap over seeds within each cell, the three always drawn together (Efron and Tibshirani, An
Introduction to the Bootstrap, 1993, ch. 13).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from backend.core.faults import InputError
from backend.core.flow import FloatArray, Outcome
from backend.experiments.beyond import CEILINGS
from backend.experiments.by_seed import Cell, answers_in, trials_in
from backend.experiments.scoring import FUSED
from backend.experiments.tables import UNSAFE, scored

PAPER = "paper"
DRAWS, LIMITS = 4000, (2.5, 97.5)
Json = dict[str, Any]
Count = Callable[[Json], Sequence[float]]
"""What one trial or answer adds to some sums."""


def gaps(
    trials: Mapping[Cell, Sequence[Json]], answers: Mapping[Cell, Mapping[int, Json]]
) -> list[Json]:
    """Return one row per strategy beside paper and ceiling, and per quantity; ``to`` which ceiling.

    ``trials``: finished trials of each cell; ``answers``: finished groups, by the seed of the
    first of them. ``share`` is None where the ceiling is no better than the paper, its interval
    where that is so in more draws than lie beyond one end of it.
    """
    rows = []
    by_seed = {cell: {t["seed"]: t for t in some} for cell, some in trials.items()}
    for name, to in _ways(by_seed):
        three = _shared(by_seed, name, to)
        rows.append({**_row(name, "placed", _counted(three, _placed), _mean), "to": to})
        rows.append({**_row(name, "unsafe", _counted(three, _unsafe), _mean), "to": to})
    for name, to in _ways(answers):
        three = _shared(answers, name, to)
        for n in map(str, FUSED):
            counts = _counted(three, lambda answer, n=n: _verdicts(answer, n))  # type: ignore[misc]
            rows.append({**_row(name, f"balanced, n = {n}", counts, _balanced), "to": to})
    return rows


def quantity(row: Mapping[str, Any]) -> str:
    """Return what a row is about, and which ceiling is meant if not the highest."""
    to = row.get("to", CEILINGS[0])
    return str(row["what"]) if to == CEILINGS[0] else f"{row['what']}, to {to}"


def merged_gaps(stored: Sequence[tuple[str, Mapping[str, Any]]]) -> list[Json]:
    """Return the rows over several ``beyond.json``: what each is called, and its content.

    Raises ``InputError`` where two of them hold the same cell of a strategy, or another bench.
    """
    trials: dict[Cell, list[Json]] = {}
    answers: dict[Cell, dict[int, Json]] = {}
    benches = {answer["bench_sha256"] for _, answer in stored}
    if len(benches) > 1:
        raise InputError("They were made on different benches.", "--beyond", "Name those of one.")
    for name, answer in stored:
        for mine, more in ((trials, trials_in(answer)), (answers, answers_in(answer))):
            for cell in sorted(mine.keys() & more.keys()):
                what = f"{' '.join(cell)} stands in another of the files too."
                raise InputError(what, name, "Name one file for each strategy and cell.")
            mine.update(more)  # type: ignore[arg-type]
    return gaps(trials, answers)


def _ways(found: Mapping[Cell, Any]) -> list[tuple[str, str]]:
    """Return who is asked on the way to which ceiling."""
    names = dict.fromkeys(strategy for strategy, _, _ in found)
    if PAPER not in names:
        return []
    asked = [name for name in names if name not in (PAPER, *CEILINGS)]
    return [(name, to) for to in CEILINGS if to in names for name in asked]


def _shared(
    found: Mapping[Cell, Mapping[int, Json]], name: str, to: str
) -> list[list[tuple[Json, ...]]]:
    """Return by cell what paper, ``name`` and the ceiling have in common, in this order."""
    cells = []
    for piece, bottom in dict.fromkeys((p, b) for _, p, b in found):
        three = [found.get((s, piece, bottom), {}) for s in (PAPER, name, to)]
        seeds = sorted(set(three[0]) & set(three[1]) & set(three[2]))
        if seeds:
            cells.append([tuple(part[seed] for part in three) for seed in seeds])
    return cells


def _counted(cells: Sequence[Sequence[tuple[Json, ...]]], count: Count) -> list[FloatArray]:
    """Return for each cell (seeds, 3, sums)."""
    return [
        np.array([[count(one) for one in three] for three in cell], dtype=np.float64)
        for cell in cells
    ]


def _placed(trial: Json) -> Sequence[float]:
    return float(trial["outcome"] == Outcome.PLACED.value), 1.0


def _unsafe(trial: Json) -> Sequence[float]:
    return float(trial["outcome"] in UNSAFE), 1.0


def _mean(sums: FloatArray) -> FloatArray:
    return np.asarray(sums[..., 0] / sums[..., 1])


def _verdicts(answer: Json, n: str) -> Sequence[float]:
    counts = scored(answer["likely"][n], answer["margin_mm"], interface=1)[0]
    return (
        counts.both,
        counts.both + counts.missed,
        counts.neither,
        counts.neither + counts.unsafe,
        len(answer["margin_mm"]),
    )


def _balanced(sums: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore"):
        return np.asarray(0.5 * (sums[..., 0] / sums[..., 1] + sums[..., 2] / sums[..., 3]))


def _row(
    name: str, what: str, counts: Sequence[FloatArray], value: Callable[[FloatArray], FloatArray]
) -> Json:
    row: Json = dict.fromkeys(("paper", "own", "ceiling", "share", "share_low", "share_high"))
    row.update(strategy=name, what=what, n=0)
    if not counts:
        return row
    total = np.sum([cell.sum(axis=0) for cell in counts], axis=0)
    values = value(total)
    row["n"] = int(total[0, -1])
    for key, one in zip(("paper", "own", "ceiling"), values.tolist(), strict=True):
        row[key] = None if np.isnan(one) else one
    upwards = what != "unsafe"
    share = _share(values, upwards=upwards)
    if np.isnan(share):
        return row
    row["share"] = float(share)
    drawn = _share(value(_drawn(counts)), upwards=upwards)
    known = drawn[~np.isnan(drawn)]
    if len(known) > (1.0 - LIMITS[0] / 100.0) * DRAWS:
        row["share_low"], row["share_high"] = np.percentile(known, LIMITS).tolist()
    return row


def _share(values: FloatArray, *, upwards: bool) -> FloatArray:
    """Return the share (...) of values (..., 3); NaN where the ceiling is no better."""
    paper, own, ceiling = np.moveaxis(values, -1, 0)
    way = ceiling - paper
    better = way > 0.0 if upwards else way < 0.0
    return np.asarray(np.where(better, (own - paper) / np.where(better, way, 1.0), np.nan))


def _drawn(counts: Sequence[FloatArray]) -> FloatArray:
    """Return (draws, 3, sums): seeds of every cell drawn again, with replacement."""
    rng = np.random.Generator(np.random.PCG64(993))
    total = np.zeros((DRAWS, *counts[0].shape[1:]))
    for cell in counts:
        often = rng.multinomial(len(cell), np.full(len(cell), 1.0 / len(cell)), DRAWS)
        total += np.tensordot(often.astype(np.float64), cell, axes=1)
    return total
