"""Comparison of strategies as tables and a report.

A paired change is the
difference of a strategy to the paper's method on common seeds; a strategy with settings in its name
is compared with the same strategy without them. Intervals are a bootstrap over seeds
within each cell, all strategies always drawn together (Efron and Tibshirani, An Introduction to the
Bootstrap, 1993, ch. 13). A seed is one mounting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from touchdown.backend.core import FloatArray, Outcome
from touchdown.backend.experiments import document
from touchdown.backend.experiments.nuisances import band_benches
from touchdown.backend.experiments.statistics import evidence, sequential_decision
from touchdown.backend.experiments.strategies import (
    CEILING,
    Cell,
    ClosedLoopComparison,
    base_strategy,
    released_unsafely,
)
from touchdown.backend.experiments.tables import UNSAFE_OUTCOMES
from touchdown.backend.jobs import JobSpec, JobStore
from touchdown.backend.learning import rate_interval

PAPER = "paper"
ROUND_TRIALS = 10  # trials of every cell between two looks at a comparison that may stop early
BOOTSTRAP_DRAWS, INTERVAL_PERCENTILES = 4000, (2.5, 97.5)
OUTCOME_QUANTITIES = {"placed": (Outcome.PLACED.value,), "unsafe": UNSAFE_OUTCOMES}
SHARES = ("placed %", "unsafe % of trials", "of released")
CHANGE_COLUMNS = (
    "strategy", "from", "of", "n", "reference %", "own %", "change", "only reference", "only own",
    "p", "evidence",
)  # fmt: skip
POOLED_NAMES = {"one": "one bottom", "two": "two bottoms", "fresh": "fresh outlines"}
Json = dict[str, Any]
Trials = Mapping[Cell, Sequence[Json]]  # finished trials of each cell
Sums = Mapping[Cell, Mapping[int, Sequence[float]]]  # event and count of a trial, by seed


def _outcome_sums(trials: Trials, quantity: str) -> Sums:
    among = OUTCOME_QUANTITIES[quantity]
    return {
        cell: {t["seed"]: (float(t["outcome"] in among), 1.0) for t in some}
        for cell, some in trials.items()
    }


def paired_changes(trials: Trials) -> list[Json]:
    """Return one row per quantity and strategy: its ``change`` from a reference on common seeds.

    ``reference``: the paper's strategy, or that without the settings in the name; its value is
    ``paper``. ``only_paper`` and ``only_own`` count the trials with this result under one of both
    strategies; ``p``: two-sided exact test on them (McNemar). If no trial differs, the interval is
    the exact bound of the share of trials that do.
    """
    return [
        row
        for what in OUTCOME_QUANTITIES
        for sums in [_outcome_sums(trials, what)]
        for name, reference in _compared_names(sums)
        for row in _change((name, reference), what, _shared(sums, (reference, name)))
    ]


def discordant_pairs(trials: Trials, quantity: str) -> dict[str, tuple[int, int]]:
    """Return for each strategy the trials with this result under it alone, and under its reference
    alone, on common seeds of all cells.

    ``quantity``: placed or unsafe. References are those of ``paired_changes``.
    """
    sums = _outcome_sums(trials, quantity)
    return {
        name: _discordant(_shared(sums, (reference, name)))
        for name, reference in _compared_names(sums)
    }


def _discordant(counts: Sequence[FloatArray]) -> tuple[int, int]:
    """Return the numbers of pairs with an event under the second and under the first alone."""
    differ = [cell[:, 1, 0] - cell[:, 0, 0] for cell in counts]
    return sum(int((d > 0).sum()) for d in differ), sum(int((d < 0).sum()) for d in differ)


def decided_strategies(trials: Trials, quantity: str) -> dict[str, Literal["more", "less"] | None]:
    """Return for each strategy if it has the result more or less often than its reference, None
    while that is open. May be looked at after any number of trials.
    """
    counts = discordant_pairs(trials, quantity)
    return {name: sequential_decision(*pair, len(counts)) for name, pair in counts.items()}


def placed_of_ceiling(trials: Trials) -> list[Json]:
    """Return for each strategy the ratio of its placed trials to those of the ceiling, on common
    seeds.
    """
    rows = []
    sums = _outcome_sums(trials, "placed")
    names = dict.fromkeys(strategy for strategy, _, _ in sums)
    for name in names if CEILING in names else ():
        counts = _shared(sums, (CEILING, name))
        total = np.sum([cell.sum(axis=0) for cell in counts], axis=0)
        if name == CEILING or not counts or not total[0, 0]:
            continue
        drawn = _bootstrap_sums(counts)[..., 0]
        ratio = drawn[:, 1] / np.maximum(drawn[:, 0], 1.0)
        low, high = np.percentile(ratio, INTERVAL_PERCENTILES).tolist()
        row = {"strategy": name, "ceiling": CEILING, "n": int(total[0, -1])}
        rows.append({**row, "value": total[1, 0] / total[0, 0], "low": low, "high": high})
    return rows


def _compared_names(found: Mapping[Cell, Any]) -> list[tuple[str, str]]:
    names = dict.fromkeys(strategy for strategy, _, _ in found)
    references = {n: base_strategy(n) if base_strategy(n) != n else PAPER for n in names}
    return [(n, r) for n, r in references.items() if n != PAPER and r in names]


def _change(names: tuple[str, str], what: str, counts: Sequence[FloatArray]) -> list[Json]:
    """Return the row of a change, none without common seeds; ``names``: strategy, reference."""
    if not counts:
        return []
    every = np.concatenate(counts)
    paper, own = _mean(every.sum(axis=0)).tolist()
    name, reference = names
    row: Json = {"strategy": name, "what": what, "n": int(every[:, 0, -1].sum())}
    row |= {"reference": reference, "paper": paper, "own": own, "change": own - paper}
    if (every[:, 0] != every[:, 1]).any():
        drawn = _mean(_bootstrap_sums(counts))
        row["low"], row["high"] = np.percentile(
            drawn[:, 1] - drawn[:, 0], INTERVAL_PERCENTILES
        ).tolist()
    else:
        row["high"] = rate_interval(0, len(every))[1]
        row["low"] = -row["high"]
    # Imported here: the window shows stored comparisons only.
    from scipy.stats import binomtest

    row["only_own"], row["only_paper"] = _discordant(counts)
    apart = row["only_paper"] + row["only_own"]
    row["p"] = float(binomtest(row["only_own"], apart).pvalue) if apart else 1.0
    return [row]


def _shared(sums: Sums, names: Sequence[str]) -> list[FloatArray]:
    """Return by cell an array (seeds, strategies, sums) of the seeds that all strategies have."""
    cells = []
    for piece, bottom in dict.fromkeys((p, b) for _, p, b in sums):
        parts = [sums.get((s, piece, bottom), {}) for s in names]
        seeds = sorted(set.intersection(*map(set, parts)))
        if seeds:
            cells.append(np.array([[part[seed] for part in parts] for seed in seeds], np.float64))
    return cells


def _mean(sums: FloatArray) -> FloatArray:
    return np.asarray(sums[..., 0] / sums[..., 1])


def _bootstrap_sums(counts: Sequence[FloatArray]) -> FloatArray:
    """Return (draws, strategies, sums) over resampled seeds of every cell."""
    rng = np.random.default_rng(993)
    total = np.zeros((BOOTSTRAP_DRAWS, *counts[0].shape[1:]))
    for cell in counts:
        often = rng.multinomial(len(cell), np.full(len(cell), 1.0 / len(cell)), BOOTSTRAP_DRAWS)
        total += np.tensordot(often.astype(np.float64), cell, axes=1)
    return total


@dataclass(frozen=True, slots=True)
class StrategyComparison:
    """Comparison ``loops``, whose trials may be repeated on other benches.

    ``band``: number of benches around that of ``loops`` on which its trials are repeated.
    """

    loops: ClosedLoopComparison
    band: int = 0

    def band_loops(self) -> list[tuple[dict[str, float], ClosedLoopComparison]]:
        """Return the factors of the nuisances and the closed loops of each bench of the band."""
        benches = band_benches(self.loops.bench, self.band) if self.band else []
        return [(factors, replace(self.loops, bench=bench)) for factors, bench in benches]

    def next_round(self, store: JobStore, quantity: str) -> list[JobSpec]:
        """Return the jobs of the next ``ROUND_TRIALS`` trials of every cell, of the undecided
        strategies and their references; none when all is decided or done.
        """
        found = decided_strategies(self.loops.trials_of(store), quantity)
        names = {name for name, way in found.items() if way is None}
        names |= {base_strategy(n) if base_strategy(n) != n else PAPER for n in names}
        todo = [
            job
            for job in self.loops.jobs()
            if job.params["strategy"] in names and not store.has(job.id)
        ]
        first = min((self.loops.first_trial(job) for job in todo), default=0)
        last = ROUND_TRIALS * (first // ROUND_TRIALS + 1)
        return [job for job in todo if self.loops.first_trial(job) < last]

    def jobs(self) -> list[JobSpec]:
        """Return the jobs of all."""
        around = [job for _, loops in self.band_loops() for job in loops.jobs()]
        return [*self.loops.jobs(), *around]

    def answer(self, store: JobStore, quantity: str | None = None) -> Json:
        """Return all finished results; ``quantity``: the one on which it may have stopped early."""
        found, trials = self.loops.table(store), self.loops.trials_of(store)
        found["changes"] = paired_changes(trials)
        found["of_ceiling"] = placed_of_ceiling(trials)
        if self.band:
            kept = ("bench_sha256", "sources", "pooled")
            tables = [(factors, loops.table(store)) for factors, loops in self.band_loops()]
            found["band"] = [{"factors": f, **{k: t[k] for k in kept}} for f, t in tables]
        if quantity is not None:
            decided = decided_strategies(trials, quantity)
            found["stopped"] = {"quantity": quantity, "round": ROUND_TRIALS, "decided": decided}
        return found


def comparison_tables(answer: Mapping[str, Any]) -> list[document.ReportTable]:
    """Return the tables of a result; one more with an oracle."""
    of_texts = document.ReportTable.of_texts
    pooled = [row for row in answer["pooled"] if "outline" not in row]
    first = of_texts(
        "Closed loop, simulated; 95 % intervals",
        ("strategy", "trials", *SHARES, "outcomes", "probes", "spare"),
        map(_closed_loop_row, (*answer["cells"], *pooled)),
    )
    others = [
        of_texts(
            "Fresh outlines by class, all pieces; 95 % intervals",
            ("strategy", "outline", "trials", *SHARES),
            [_class_row(row) for row in answer["pooled"] if "outline" in row],
        ),
        of_texts(
            "Faces that are not flat: trials in which a place has a margin of 1 mm, and placed "
            "of them; 95 % intervals",
            ("strategy", "bottoms", "trials", "possible %", "placed of possible %"),
            [_uneven_row(row) for row in answer["pooled"] if "possible" in row],
        ),
        _band_table(answer, pooled),
        of_texts(
            "Placed, as a share of what the ceiling places; common trials, 95 % intervals",
            ("strategy", "ceiling", "n", "share %"),
            [
                (row["strategy"], row["ceiling"], str(row["n"]), document.format_estimate(row))
                for row in answer.get("of_ceiling") or ()
            ],
        ),
        of_texts(
            "Change from the reference, common seeds; 95 % intervals",
            CHANGE_COLUMNS,
            map(_change_row, answer.get("changes") or ()),
        ),
    ]
    return [first, *(table for table in others if table.rows)]


def _band_table(answer: Mapping[str, Any], pooled: Sequence[Json]) -> document.ReportTable:
    """Return placed and unsafe over the benches of the band: least, median, most."""
    band, rows = answer.get("band") or (), []
    for own in pooled if band else ():
        same = [
            row
            for bench in band
            for row in bench["pooled"]
            if _name(row) == _name(own) and "outline" not in row
        ]
        texts = []
        for quantity in ("placed", "unsafe", "unsafe_of_released"):
            texts.append(document.format_percent(own[quantity]["value"]))
            values = [v for row in same if (v := row[quantity]["value"]) is not None]
            ends = np.percentile(values, (0, 50, 100)) if values else ()
            texts.append(" / ".join(map(document.format_percent, ends)))
        trials = sum(row["placed"]["n"] for row in same)
        rows.append((_name(own), str(len(same)), str(trials), *texts))
    head = [column for share in SHARES for column in (share, "band")]
    title = f"Bench, and {len(band)} benches around it: least / median / most"
    return document.ReportTable.of_texts(title, ("strategy", "benches", "trials", *head), rows)


def _closed_loop_row(cell: Json) -> tuple[str | document.TableEntry, ...]:
    outcomes = ", ".join(f"{w.replace('_', ' ')} {n}" for w, n in cell["outcomes"].items())
    left, placed = cell.get("left_out", 0), document.format_estimate(cell["placed"])
    return (
        _name(cell),
        str(cell["placed"]["n"]),
        document.TableEntry(placed, jobs=tuple(cell.get("jobs", ())), seed=cell.get("seed")),
        document.format_estimate(cell["unsafe"]),
        document.format_estimate(released_unsafely(cell["outcomes"]).as_json()),
        outcomes + (f"; {left} left out" if left else ""),
        _format_number(cell["probes"]),
        _format_number(cell["excess_probes_median"]),
    )


def _class_row(cell: Json) -> tuple[str, ...]:
    shares = cell["placed"], cell["unsafe"], cell["unsafe_of_released"]
    count = str(cell["placed"]["n"])
    return cell["strategy"], cell["outline"], count, *map(document.format_estimate, shares)


def _uneven_row(cell: Json) -> tuple[str, ...]:
    bottoms = cell.get("outline") or POOLED_NAMES[cell["tower"]]
    shares = map(document.format_estimate, (cell["possible"], cell["there"]))
    return cell["strategy"], bottoms, str(cell["possible"]["n"]), *shares


def _change_row(row: Json) -> tuple[str, ...]:
    shown = f"{100 * row['change']:+.1f}"
    if row["low"] is not None:
        shown += f" ({100 * row['low']:+.1f} to {100 * row['high']:+.1f})"
    only = [str(row.get(key, "")) for key in ("only_paper", "only_own")]
    shares = [document.format_percent(row[key]) for key in ("paper", "own")]
    only.append(f"{row['p']:.2g}" if "p" in row else "")
    only.append(f"{_row_evidence(row):.3g}" if "p" in row else "")
    names = row["strategy"], row.get("reference", PAPER)
    return *names, row["what"], str(row["n"]), *shares, shown, *only


def _row_evidence(row: Json) -> float:
    """Return the larger evidence of both directions, halved as in a two-sided test."""
    pair = row["only_own"], row["only_paper"]
    return 0.5 * max(evidence(*pair), evidence(*reversed(pair)))


def _name(cell: Json) -> str:
    parts: Sequence[str] = (cell["strategy"], cell.get("piece", "pooled"))
    over = cell.get("bottom") or POOLED_NAMES.get(cell.get("tower", ""), "")
    return " ".join((*parts, over)).strip()


def _format_number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def stopped_text(stopped: Mapping[str, Any]) -> str:
    """Return a sentence on a comparison that could stop early."""
    quantity, words = stopped["quantity"], {"more": "more", "less": "less", None: "undecided"}
    found = [f"{name} {words[way]}" for name, way in stopped["decided"].items()]
    often = f"{quantity} more or less often than the reference"
    return (
        f"Looked at after every {stopped['round']} trials of a cell, {often}: {', '.join(found)}."
    )


def comparison_report(answer: Mapping[str, Any]) -> document.Report:
    """Return the report on a result of ``touchdown experiment beyond``."""
    text = (
        "Closed loops count every trial, whatever its outcome; unsafe: fell or knocked over, of "
        "all trials (harm per trial), or fell, of the releases; "
        "spare: probes beyond the least number, median. Towers: the upper bottom stands off the "
        "lower one by 0 to 6 mm; those on which the piece has no stable place are left out."
    )
    parts = tuple(table for table in comparison_tables(answer) if table.rows)
    if stopped := answer.get("stopped"):
        text += f" {stopped_text(stopped)}"
    names = dict.fromkeys(cell["strategy"] for cell in answer["cells"])
    networks = ", ".join(
        f"{piece} {source[:8]}" for piece, source in answer.get("models", {}).items()
    )
    source = f"Program {answer['code']}, networks: {networks or 'none'}."
    return document.Report(
        "Touchdown: strategies beyond the paper",
        (f"Bench {answer['bench_sha256'][:16]}.",),
        (document.ReportSection(f"Strategies: {', '.join(names)}", (text, source), parts),),
    )
