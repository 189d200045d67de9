"""Evaluation of existing models and strategies on other benches and in the second world.

A study gives the same seeds and draws to every bench: groups of presses, and whole trials. Results
are paired by group. ``DomainShift`` compares the simulated bench with the second world,
``NuisanceSensitivity`` scales each nuisance of the bench from 0 to 3.

Domain randomisation trains on probes whose mountings are benches with their own settings: nuisance
sizes and the laws of gel, grip, contact and friction are drawn per mounting from wide ranges around
the given bench. The ranges were chosen by hand and are not fitted to the second world.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, zip_longest
from typing import Any, Literal

import numpy as np

from touchdown.backend.config import SimulationSettings, StackSettings, bench_sha256
from touchdown.backend.experiments.document import (
    PictureGallery,
    Report,
    ReportPicture,
    ReportSection,
    ReportTable,
    curves_chart,
    format_estimate,
    format_percent,
)
from touchdown.backend.experiments.nuisances import (
    NUISANCES,
    Nuisance,
    randomise_bench,
    scale_nuisance,
)
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    format_change,
    iou_change,
)
from touchdown.backend.experiments.strategies import count_outcomes, network_params
from touchdown.backend.experiments.tables import (
    CELL_SEEDS,
    PIECES,
    TABLE_BOTTOMS,
    TRAINING_BOTTOMS,
    job_code,
    paper_training,
    score_verdicts,
    training_job,
)
from touchdown.backend.experiments.trials import WORLDS
from touchdown.backend.jobs import JobSpec, JobStore
from touchdown.backend.learning import DeviceName

PRESSES_SEED, TRIALS_SEED = 5_000_000, 6_000_000
GROUPS_PER_JOB, PROBES, TRIALS_PER_JOB = 10, 3, 2
EVALUATED_STRATEGIES = (
    "paper",
    "paper-calibrated",
    "fused",
    "zero-wrench",
)  # the last two use no model of a piece
POOLED = "pooled"  # over the bottoms of a study
Json = dict[str, Any]
JsonMapping = Mapping[str, Any]
Cell = tuple[str, str, str]  # bench, bottom, strategy with its model ("" for presses)
Cells = Mapping[Cell, Sequence[JobSpec]]


@dataclass(frozen=True, slots=True)
class BenchStudy:
    """Presses and trials with the same seeds on several ``benches``.

    ``benches``: world (of ``WORLDS``) and settings by name. ``models``: source (job or file) by
    name. ``strategies``: strategy and source of its model by name in the tables. ``groups`` of
    presses and ``trials`` are those of each bottom; ``first``: number of the first one.
    """

    benches: Mapping[str, tuple[str, SimulationSettings]]
    code: str
    piece: str
    bottoms: tuple[str, ...]
    models: Mapping[str, str]
    strategies: Mapping[str, tuple[str, str]]
    groups: int
    trials: int
    first: int = 0

    def cells(self) -> dict[Cell, list[JobSpec]]:
        """Return the jobs of every cell."""
        return {
            (bench, bottom, name): list(self._jobs(bench, bottom, name))
            for bench in self.benches
            for bottom in self.bottoms
            for name in ("", *self.strategies)
        }

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, the first ones of every cell first, for comparable partial results."""
        return [spec for specs in zip_longest(*self.cells().values()) for spec in specs if spec]

    def _jobs(self, bench: str, bottom: str, name: str) -> Iterator[JobSpec]:
        world, settings = self.benches[bench]
        dumped = settings.model_dump(mode="json")
        params: Json = {"bench": dumped, "piece": self.piece, "bottom": bottom}
        if world != "bench":
            params["world"] = world
        cell = CELL_SEEDS * (10 * PIECES.index(self.piece) + TABLE_BOTTOMS.index(bottom))
        if not name:
            kind, first, total, size = "static", PRESSES_SEED, self.groups, GROUPS_PER_JOB
            count, inputs = "groups", tuple(sorted(set(self.models.values())))
            params |= {"models": dict(self.models), "probes": PROBES, "fused": sorted(self.models)}
        else:
            kind, first, total, size = "beyond", TRIALS_SEED, self.trials, TRIALS_PER_JOB
            (strategy, source), method = self.strategies[name], StackSettings()
            count, inputs = "trials", (source,)
            params |= {"strategy": strategy, "method": method.model_dump(mode="json")}
            params |= network_params(strategy, method)
        code = job_code(kind, self.code)
        for k in range(0, total, size):
            own = {**params, count: min(size, total - k)}
            yield JobSpec(kind, own, first + cell + self.first + k, inputs, code)

    def answer(self, name: str, bench: SimulationSettings) -> Json:
        """Return the head of a result file of the format ``name``."""
        return {
            "format": f"touchdown-{name}/1",
            "simulated": True,
            "bench_sha256": bench_sha256(bench),
            "code": self.code,
            "piece": self.piece,
        }


def finished_results(cells: Cells, store: JobStore, *benches: str) -> dict[Cell, list[Json]]:
    """Return the results of the jobs that are finished on all of ``benches``.

    By cell, and pooled over the bottoms.
    """
    found: dict[Cell, list[Json]] = {}
    for (bench, bottom, strategy), jobs in cells.items():
        if bench not in benches:
            continue
        same = zip(*(cells[other, bottom, strategy] for other in benches), strict=True)
        ready = [all(store.has(spec.id) for spec in specs) for specs in same]
        done = [dict(store.result(spec.id)) for spec, ok in zip(jobs, ready, strict=True) if ok]
        for over in (bottom, POOLED):
            found.setdefault((bench, over, strategy), []).extend(done)
    return found


def job_effort(spec: JobSpec) -> int:
    """Return the relative duration of a job of presses or trials."""
    p = spec.params
    slow = 4 if "world" in p else 1
    return slow * (int(p["groups"]) * PROBES if "groups" in p else 5 * int(p["trials"]))


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
            counts, close = score_verdicts(score["says"][n], part["margin_mm"], interface=1)
            binary, left_out = binary + counts, left_out + close
        figures[f"stable_{n}"] = {**binary.as_json(), "too_close": left_out}
    figures["slipped"] = estimate_mean([part["slipped"] for part in parts]).value
    for name in ("rejected", "left_out"):
        figures[name] = sum(part[name] for part in parts)
    return figures


def _trial_counts(parts: Iterable[JsonMapping]) -> Json:
    return count_outcomes([trial for part in parts for trial in part["trials"]])


FACTORS = (0.0, 0.5, 1.0, 2.0, 3.0)
MODEL, BENCH = "FT+Tac", "bench"


@dataclass(frozen=True, slots=True)
class NuisanceSensitivity:
    """Sensitivity of ``model`` (a job or file) to each nuisance, scaled one at a time."""

    bench: SimulationSettings
    code: str
    piece: str
    model: str
    bottoms: tuple[str, ...] = ("short", "long")
    strategy: str = "paper"
    groups: int = 20
    trials: int = 0
    nuisances: tuple[Nuisance, ...] = NUISANCES

    def study(self) -> BenchStudy:
        """Return the study; the bench itself and the ends of the range come first."""
        benches = {BENCH: ("bench", self.bench)}
        for factor in (0.0, 3.0, 0.5, 2.0):
            for nuisance in self.nuisances:
                scaled = scale_nuisance(self.bench, nuisance, factor)
                benches[_bench_name(nuisance, factor)] = ("bench", scaled)
        strategies = {self.strategy: (self.strategy, self.model)} if self.trials else {}
        return BenchStudy(
            benches, self.code, self.piece, self.bottoms, {MODEL: self.model}, strategies,
            self.groups, self.trials,
        )  # fmt: skip

    def jobs(self) -> list[JobSpec]:
        """Return every job once."""
        return self.study().jobs()

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        return job_effort(spec)

    def answer(self, store: JobStore) -> Json:
        """Return the finished results: one row per nuisance and factor."""
        study = self.study()
        cells = study.cells()
        return {
            **study.answer("sensitivity", self.bench),
            "bottoms": list(self.bottoms),
            "model": self.model,
            "strategy": self.strategy,
            "nuisances": [
                {
                    "name": nuisance.name,
                    "title": nuisance.title,
                    "keys": list(nuisance.keys),
                    "limit": nuisance.limit,
                    "at": list(self._rows(nuisance, cells, store)),
                }
                for nuisance in self.nuisances
            ],
        }

    def _rows(self, nuisance: Nuisance, cells: Cells, store: JobStore) -> Iterator[Json]:
        for factor in FACTORS:
            bench = _bench_name(nuisance, factor)
            found = finished_results(cells, store, *{BENCH: 0, bench: 0})
            if not (presses := found[bench, POOLED, ""]):
                continue
            row: Json = {"factor": factor, **press_scores(presses, MODEL)}
            changes = {
                bottom: iou_change(
                    list(zip(found[BENCH, bottom, ""], found[bench, bottom, ""], strict=True)),
                    MODEL, MODEL,
                )
                for bottom in (POOLED, *self.bottoms)
            }  # fmt: skip
            row["iou_change"] = changes.pop(POOLED)
            row["iou_change_on"] = changes
            if trials := found.get((bench, POOLED, self.strategy)):
                row["trials"] = _trial_counts(trials)
            yield row


def _bench_name(nuisance: Nuisance, factor: float) -> str:
    return BENCH if factor == 1.0 else f"{nuisance.name} {factor:g}"


def sensitivity_table(answer: JsonMapping) -> ReportTable:
    """Return the change of IoU at each factor and stability at both ends, by nuisance."""
    rows = []
    for nuisance in answer["nuisances"]:
        at = {row["factor"]: row for row in nuisance["at"]}
        changes = [format_change(at.get(factor, {}).get("iou_change")) for factor in FACTORS]
        right = [format_estimate(stability_of(at[f])) if f in at else "" for f in FACTORS[::2]]
        limit = f", draws end at {nuisance['limit']}" if nuisance["limit"] else ""
        rows.append((f"{nuisance['title']}{limit}", *changes[:2], *changes[3:], *right))
    header = ("nuisance", "0", "0.5", "2", "3", "stable right, 0", "1", "3")
    title = "Change of the IoU in points, paired by group; stability right, %"
    return ReportTable.of_texts(title, header, rows)


def sensitivity_report(answer: JsonMapping) -> Report:
    """Return the report: one chart per nuisance, and the table of changes."""
    about = (
        f"{answer['piece'].title()} on {' and '.join(answer['bottoms'])}, one model as it is, "
        f"bench {answer['bench_sha256'][:16]}, program {answer['code']}. Each nuisance alone is 0 "
        "to 3 times as large as on the bench; all else, seeds included, stays. IoU of single "
        "presses, and stability right after one press, on as many stable as unstable places. "
        "Bars: 95 % intervals, each value for itself. Values of one chart share their presses, so "
        "that small changes mean more than the bars say: see the table."
    )
    charts = tuple(ReportPicture(_chart(n)) for n in answer["nuisances"] if n["at"])
    parts = (PictureGallery("", charts), sensitivity_table(answer))
    title = "Touchdown: sensitivity to each nuisance of the bench"
    return Report(title, (about,), (ReportSection("", (), parts),))


def _chart(nuisance: JsonMapping) -> str:
    curves, bars = {}, {}
    for name, get in (("IoU", iou_of), ("stability right", stability_of)):
        estimates = [[get(row)[key] for key in ("value", "low", "high")] for row in nuisance["at"]]
        values = np.array(estimates, dtype=np.float64)  # None becomes NaN
        curves[name], bars[name] = values[:, 0], values[:, 1:]
    factors = np.array([row["factor"] for row in nuisance["at"]])
    units = ("times its size on the bench", "")
    return curves_chart(nuisance["title"], factors, curves, units, span=(0.3, 1.0), bars=bars)


# mountings: drawn by the bench; randomised: each with its own nuisance sizes and laws
CollectionKind = Literal["mountings", "randomised"]
# first seed of the mountings, disjoint from the tables; number of seeds per outline
FIRST_SEED, OUTLINE_SEEDS = 7_000_000, 10_000
TRAINING_PROBES, PROBES_PER_GRIP, GRIPS_PER_MOUNTING, EPOCHS = 2000, 5, 10, 30


@dataclass(frozen=True, slots=True)
class RandomisedTraining:
    """Jobs of one model: ``probes`` over each training outline, then the paper's training.

    Each collection job is one mounting and holds all its settings in its spec.
    """

    bench: SimulationSettings
    code: str
    piece: str
    collected: CollectionKind
    probes: int = TRAINING_PROBES
    epochs: int = EPOCHS
    device: DeviceName = "auto"

    @property
    def name(self) -> str:
        """Name of the model in tables."""
        return f"{MODEL} {self.collected}"

    def data(self) -> list[JobSpec]:
        """Return the collection jobs, one per mounting."""
        size, code = PROBES_PER_GRIP * GRIPS_PER_MOUNTING, job_code("simulate", self.code)
        found = []
        for k, bottom in enumerate(TRAINING_BOTTOMS):
            for first in range(0, self.probes, size):
                seed = FIRST_SEED + OUTLINE_SEEDS * k + first // size
                randomised = self.collected == "randomised"
                bench = randomise_bench(self.bench, seed) if randomised else self.bench
                params = {
                    "piece": self.piece,
                    "bottom": bottom,
                    "episodes": min(size, self.probes - first),
                    "probes_per_grip": PROBES_PER_GRIP,
                    "grips_per_mounting": GRIPS_PER_MOUNTING,
                    "bench": bench.model_dump(mode="json"),
                }
                found.append(JobSpec("simulate", params, seed, (), code))
        return found

    def training(self) -> JobSpec:
        """Return the training job."""
        settings = paper_training(MODEL, self.epochs)
        return training_job((self.piece, "patch"), settings, self.device, self.data(), self.code)

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job (unit of ``job_effort``)."""
        if spec.kind == "train":
            return math.ceil(self.probes * self.epochs / 20)
        return int(spec.params["episodes"]) // 2


@dataclass(frozen=True, slots=True)
class DomainShift:
    """Comparison of the simulated bench with the second world.

    ``models``: source (job or file) by name in the tables. ``trained``: models that are trained
    first, on their own collections. Strategies read the first of ``models`` and each of
    ``trained``, unless they need no model. ``first``: number of the first group and trial in a
    cell; models are selected on later ones.
    """

    bench: SimulationSettings
    code: str
    piece: str
    models: Mapping[str, str]
    bottoms: tuple[str, ...] = ("short", "long")
    strategies: tuple[str, ...] = ("paper", "fused")
    groups: int = 40
    trials: int = 20
    trained: tuple[RandomisedTraining, ...] = ()
    first: int = 0

    def study(self) -> BenchStudy:
        """Return the study of both worlds."""
        trained = {plan.name: plan.training().id for plan in self.trained}
        given = next(iter(self.models.values()))
        strategies = {name: (name, given) for name in self.strategies}
        for strategy in self.strategies:
            if strategy not in EVALUATED_STRATEGIES[-2:]:
                strategies |= {f"{strategy}, {n}": (strategy, s) for n, s in trained.items()}
        return BenchStudy(
            {world: (world, self.bench) for world in WORLDS}, self.code, self.piece, self.bottoms,
            {**self.models, **trained}, strategies, self.groups, self.trials, self.first,
        )  # fmt: skip

    def jobs(self) -> list[JobSpec]:
        """Return all jobs; those of the trainings come first."""
        made = [spec for plan in self.trained for spec in (*plan.data(), plan.training())]
        return [*made, *self.study().jobs()]

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        training = spec.kind in ("simulate", "train")
        return self.trained[0].effort(spec) if training else job_effort(spec)

    def answer(self, store: JobStore) -> Json:
        """Return the finished results of both worlds, by cell and pooled over bottoms."""
        study = self.study()
        found = finished_results(study.cells(), store, *WORLDS)
        return {
            **study.answer("elsewhere", self.bench),
            "first": self.first,
            "models": dict(study.models),
            "presses": [
                {"world": world, "bottom": bottom, "model": model, **press_scores(parts, model)}
                for (world, bottom, strategy), parts in found.items()
                if not strategy and parts
                for model in parts[0]["models"]
            ],
            "changes": [change for bottom in (*self.bottoms, POOLED)
                        for change in _changes(found, bottom)],
            "trials": [
                {"world": world, "bottom": bottom, "strategy": strategy, **_trial_counts(parts)}
                for (world, bottom, strategy), parts in found.items()
                if strategy and parts
            ],
        }  # fmt: skip


def _changes(found: Mapping[Cell, Sequence[Json]], bottom: str) -> Iterator[Json]:
    """Yield the paired changes per model between worlds and between models in one world."""
    here, there = (found.get((world, bottom, ""), []) for world in WORLDS)
    if not here:
        return
    names = list(here[0]["models"])
    across = list(zip(here, there, strict=True))
    for name in names:
        yield {"what": "drop", "bottom": bottom, "from": name, "to": name,
               **iou_change(across, name, name)}  # fmt: skip
    for world, parts in zip(WORLDS, (here, there), strict=True):
        same = list(zip(parts, parts, strict=True))
        for old, new in combinations(names, 2):
            yield {"what": world, "bottom": bottom, "from": old, "to": new,
                   **iou_change(same, old, new)}  # fmt: skip


def shift_tables(answer: JsonMapping) -> list[ReportTable]:
    """Return the tables of presses, of paired changes and of trials in both worlds."""
    presses = [
        (
            name,
            *_compared(iou_of(here), iou_of(there)),
            *_compared(stability_of(here), stability_of(there)),
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
    for what, bottom in dict.fromkeys((what, bottom) for what, bottom, _ in found):
        here, there = (found.get((what, bottom, world)) for world in WORLDS)
        if here is not None and there is not None:
            yield f"{what} {bottom}", here, there


def _compared(here: JsonMapping, there: JsonMapping) -> tuple[str, str, str]:
    """Return two estimates and their difference in points as texts."""
    known = here["value"] is not None and there["value"] is not None
    change = f"{100 * (there['value'] - here['value']):+.1f}" if known else ""
    return format_estimate(here), format_estimate(there), change


def iou_of(scores: JsonMapping) -> Json:
    """Return the IoU estimate of ``press_scores``."""
    return dict(scores["iou"])


def stability_of(scores: JsonMapping) -> Json:
    """Return the stability accuracy after one probe of ``press_scores``."""
    return dict(scores["stable_1"]["accuracy"])
