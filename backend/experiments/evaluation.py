"""Evaluation of existing models and strategies in the second world.

A study gives the same seeds and draws to bench and second world: groups of presses, and whole
trials. Results are paired by group.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest
from typing import Any

from touchdown.backend.config import SimulationSettings, StackSettings, bench_sha256
from touchdown.backend.experiments import tables
from touchdown.backend.experiments.document import ReportTable, format_estimate, format_percent
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    format_change,
    iou_change,
)
from touchdown.backend.experiments.strategies import count_outcomes, network_params
from touchdown.backend.jobs import JobSpec, JobStore

PRESSES_SEED, TRIALS_SEED = 5_000_000, 6_000_000
GROUPS_PER_JOB, PROBES, TRIALS_PER_JOB = 10, 3, 2
BENCH = "bench"  # world that the others are compared with
POOLED = "pooled"  # over the bottoms of a study
Json = dict[str, Any]
JsonMapping = Mapping[str, Any]
Cell = tuple[str, str, str]  # world, bottom, strategy ("" for presses)


def press_scores(parts: Sequence[JsonMapping], model: str) -> Json:
    """Return the IoU, point accuracy and stability scores of one model on pressed groups."""
    scores = [part["models"][model] for part in parts]
    figures: Json = {
        name: estimate_mean([value for s in scores for value in s["patch"][name]]).as_json()
        for name in ("iou", "accuracy", "iou_true")
    }
    for n in ("1", "2", "3"):
        binary, left_out = VerdictCounts(0, 0, 0, 0), 0
        for part, score in zip(parts, scores, strict=True):
            counts, close = tables.score_verdicts(score["says"][n], part["margin_mm"], interface=1)
            binary, left_out = binary + counts, left_out + close
        figures[f"stable_{n}"] = {**binary.as_json(), "too_close": left_out}
    figures["slipped"] = estimate_mean([part["slipped"] for part in parts]).value
    for name in ("rejected", "left_out"):
        figures[name] = sum(part[name] for part in parts)
    return figures


@dataclass(frozen=True, slots=True)
class DomainShift:
    """Comparison of the simulated bench with the second world.

    ``models``: source (job or file) by name in the tables; strategies read the first one, unless
    they need no model. ``groups`` of presses and ``trials`` are those of each bottom. ``first``:
    number of the first group and trial in a cell; models are selected on later ones. ``there``:
    world that is compared with the bench.
    """

    bench: SimulationSettings
    code: str
    piece: str
    models: Mapping[str, str]
    bottoms: tuple[str, ...] = ("short", "long")
    strategies: tuple[str, ...] = ("paper", "fused")
    groups: int = 40
    trials: int = 20
    first: int = 0
    there: str = "elsewhere"

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, the first ones of every cell first, for comparable partial results."""
        turns = zip_longest(*self._cells().values())
        return [spec for specs in turns for spec in specs if spec]

    def _cells(self) -> dict[Cell, list[JobSpec]]:
        return {
            (world, bottom, strategy): list(self._jobs(world, bottom, strategy))
            for world in (BENCH, self.there)
            for bottom in self.bottoms
            for strategy in ("", *self.strategies)
        }

    def _jobs(self, world: str, bottom: str, strategy: str) -> Iterator[JobSpec]:
        dumped = self.bench.model_dump(mode="json")
        params: Json = {"bench": dumped, "piece": self.piece, "bottom": bottom}
        if world != BENCH:
            params["world"] = world
        cell = tables.CELL_SEEDS * (
            10 * tables.PIECES.index(self.piece) + tables.TABLE_BOTTOMS.index(bottom)
        )
        if not strategy:
            kind, first, total, size = "static", PRESSES_SEED, self.groups, GROUPS_PER_JOB
            count, inputs = "groups", tuple(sorted(set(self.models.values())))
            params |= {"models": dict(self.models), "probes": PROBES, "fused": sorted(self.models)}
        else:
            kind, first, total, size = "beyond", TRIALS_SEED, self.trials, TRIALS_PER_JOB
            given = next(iter(self.models.values()))
            count, inputs, method = "trials", (given,), StackSettings()
            params |= {"strategy": strategy, "method": method.model_dump(mode="json")}
            params |= network_params(strategy, method)
        code = tables.job_code(kind, self.code)
        for k in range(0, total, size):
            own = {**params, count: min(size, total - k)}
            yield JobSpec(kind, own, first + cell + self.first + k, inputs, code)

    def answer(self, store: JobStore) -> Json:
        """Return the finished results of both worlds, by cell and pooled over bottoms."""
        found = self._finished(store)
        return {
            "format": "touchdown-elsewhere/1",
            "simulated": True,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "piece": self.piece,
            "first": self.first,
            "models": dict(self.models),
            "presses": [
                {"world": world, "bottom": bottom, "model": model, **press_scores(parts, model)}
                for (world, bottom, strategy), parts in found.items()
                if not strategy and parts
                for model in parts[0]["models"]
            ],
            "changes": [change for bottom in (*self.bottoms, POOLED)
                        for change in _changes(found, bottom, self.there)],
            "trials": [
                {"world": world, "bottom": bottom, "strategy": strategy,
                 **count_outcomes([trial for part in parts for trial in part["trials"]])}
                for (world, bottom, strategy), parts in found.items()
                if strategy and parts
            ],
        }  # fmt: skip

    def _finished(self, store: JobStore) -> dict[Cell, list[Json]]:
        """Return the results of the jobs that are finished in both worlds.

        By cell, and pooled over the bottoms.
        """
        found: dict[Cell, list[Json]] = {}
        cells = self._cells()
        for (world, bottom, strategy), jobs in cells.items():
            same = zip(
                *(cells[other, bottom, strategy] for other in (BENCH, self.there)), strict=True
            )
            ready = [all(store.has(spec.id) for spec in specs) for specs in same]
            done = [dict(store.result(spec.id)) for spec, ok in zip(jobs, ready, strict=True) if ok]
            for over in (bottom, POOLED):
                found.setdefault((world, over, strategy), []).extend(done)
        return found


def _changes(found: Mapping[Cell, Sequence[Json]], bottom: str, other: str) -> Iterator[Json]:
    """Yield the paired changes per model between worlds and between models in one world."""
    here, there = (found.get((world, bottom, ""), []) for world in (BENCH, other))
    if not here:
        return
    names = list(here[0]["models"])
    across = list(zip(here, there, strict=True))
    for name in names:
        yield {"what": "drop", "bottom": bottom, "from": name, "to": name,
               **iou_change(across, name, name)}  # fmt: skip
    for world, parts in zip((BENCH, other), (here, there), strict=True):
        same = list(zip(parts, parts, strict=True))
        for old, new in combinations(names, 2):
            yield {"what": world, "bottom": bottom, "from": old, "to": new,
                   **iou_change(same, old, new)}  # fmt: skip


def shift_tables(answer: JsonMapping) -> list[ReportTable]:
    """Return the tables of presses, of paired changes and of trials in both worlds."""
    presses = [
        (
            name,
            *_compared(here["iou"], there["iou"]),
            *_compared(here["stable_1"]["accuracy"], there["stable_1"]["accuracy"]),
            " / ".join(
                format_percent(scores["stable_1"]["unsafe"]["value"]) for scores in (here, there)
            ),
        )
        for name, here, there in _in_both_worlds(answer["presses"], "model")
    ]
    changes = [
        (
            f"{c['from']}: bench to elsewhere"
            if c["what"] == "drop"
            else f"{c['what']}: {c['from']} to {c['to']}",
            c["bottom"],
            format_change(c),
            str(c["n"]),
        )
        for c in answer["changes"]
    ]
    trials = [
        (
            name,
            f"{here['placed']['n']} / {there['placed']['n']}",
            *_compared(here["placed"], there["placed"]),
            *_compared(here["unsafe"], there["unsafe"]),
        )
        for name, here, there in _in_both_worlds(answer["trials"], "strategy")
    ]
    return [
        ReportTable.of_texts(
            "Presses: IoU %, stability right after one probe %; bench, elsewhere, change",
            ("model", "IoU", "elsewhere", "", "right", "elsewhere", "", "unsafe"),
            presses,
        ),
        ReportTable.of_texts(
            "Change of the IoU in points, group by group",
            ("what", "bottom", "change", "groups"),
            changes,
        ),
        ReportTable.of_texts(
            "Trials: placed %, unsafe %; bench, elsewhere, change",
            ("strategy", "trials", "placed", "elsewhere", "", "unsafe", "elsewhere", ""),
            trials,
        ),
    ]


def _in_both_worlds(
    cells: Sequence[JsonMapping], key: str
) -> Iterator[tuple[str, JsonMapping, JsonMapping]]:
    """Yield the name (value of ``key`` and bottom) and the cells on the bench and elsewhere."""
    found = {(c[key], c["bottom"], c["world"]): c for c in cells}
    worlds = sorted({world for _, _, world in found})  # the bench first
    for what, bottom in dict.fromkeys((what, bottom) for what, bottom, _ in found):
        here, there = (found.get((what, bottom, world)) for world in worlds)
        if here is not None and there is not None:
            yield f"{what} {bottom}", here, there


def _compared(here: JsonMapping, there: JsonMapping) -> tuple[str, str, str]:
    """Return two estimates and their difference in points as texts."""
    known = here["value"] is not None and there["value"] is not None
    change = f"{100 * (there['value'] - here['value']):+.1f}" if known else ""
    return format_estimate(here), format_estimate(there), change
