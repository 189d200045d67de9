"""Tables 1 to 3 of the paper: jobs, results as JSON rows, and the published numbers.

``resources/paper.toml`` holds the published numbers, in % except Table III (successes of 10); keys:
piece, bottom.
``Recipe`` lists the jobs and their dependencies at one ``Scale`` and runs nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from touchdown.backend.config import SimulationSettings, TrainingSettings, bench_sha256, read_toml
from touchdown.backend.core import Outcome
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    estimate_rate,
    verdict_changes,
)
from touchdown.backend.geometry import TOO_CLOSE_MM
from touchdown.backend.jobs import JobSpec, JobStore, source_hash
from touchdown.backend.learning import DeviceName, clustered_interval

# columns of all three tables
PAPER_CELLS = tuple(product(("mushroom", "barrel", "pot"), ("short", "long")))
PaperRow = Mapping[tuple[str, str], float]


def _paper_table(name: str) -> Mapping[str, PaperRow]:
    rows = _PAPER[name].items()
    return {key: dict(zip(PAPER_CELLS, values, strict=True)) for key, values in rows}


_PAPER = read_toml(Path(str(files("touchdown.resources"))) / "paper.toml")
PAPER_IOU, PAPER_POINT_ACCURACY = _paper_table("iou"), _paper_table("point_accuracy")
PAPER_STABILITY, PAPER_STACKING = _paper_table("stability"), _paper_table("stacking")
PAPER_RUNS = 10


PIECES = ("mushroom", "barrel", "pot")
TABLE_BOTTOMS = ("short", "long")
TRAINING_BOTTOMS = ("circle15", "circle25", "square15")
TOWER = ("short", "long")  # bottom-up: Long stands on Short, and Long is touched
NetworkHead = Literal["patch", "stability"]
# name in the tables, inputs, target of the network
MODELS: tuple[tuple[str, str, NetworkHead], ...] = (
    ("FT", "FT", "patch"),
    ("Tac", "Tac", "patch"),
    ("FT+Tac", "FT+Tac", "patch"),
    ("Implicit", "FT+Tac", "stability"),
)
# The seed ranges of cells do not overlap.
TRAINING_SEED, STATIC_SEED, STACKING_SEED, JIG_SEED = 21, 3_000_000, 4_000_000, 8_000_000
CELL_SEEDS = 10_000
# Samples of Tables 1 and 2, see ``statics``.
BALANCED, PAPER_PROTOCOL = "balanced", "paper"


# Module below experiments and function of each kind of job.
JOB_FUNCTIONS = {
    "simulate": ("job_kinds", "simulate_collection"),
    "train": ("job_kinds", "train_model"),
    "static": ("job_kinds", "evaluate_static"),
    "stack": ("job_kinds", "run_stacking"),
    "devices": ("job_kinds", "run_on_devices"),
    "beyond": ("strategies", "run_closed_loop"),
    "sequences": ("fusion", "probe_sequences"),
    "fuse": ("fusion", "train_fusion"),
    "fuse-join": ("fusion", "join_trained"),
    "certify": ("certification", "run_certified_scenes"),
}


def job_code(kind: str, version: str) -> str:
    """Return the version of a job: that of the program, and a hash of the sources it depends on."""
    module, function = JOB_FUNCTIONS[kind]
    return f"{version}+{source_hash(f'touchdown.backend.experiments.{module}', function)}"


def job_effort(spec: JobSpec) -> int:
    """Return the relative duration of a job, as a rule in units of 40 ms of one core."""
    p, kind = spec.params, spec.kind
    if kind in ("sequences", "fuse", "fuse-join"):
        return int(15 * p.get("steps", 200 if p.get("free") else 100))
    if kind in ("simulate", "train"):
        return int(p["episodes"] if kind == "simulate" else 500 * p["training"]["epochs"])
    if kind == "static":
        groups = p["groups"] if "groups" in p else p["mountings"] * p["grips"]
        return (10 if "world" in p else 3) * int(groups) * int(p["probes"])
    slow = 2000 if kind == "devices" else 300 if p.get("strategy") == "ceiling" else 10
    return slow * int(p["trials"]) * (4 if "world" in p else 1)


@dataclass(frozen=True, slots=True)
class Scale:
    """Size of an experiment: ``probes`` for training per outline, groups and trials per cell.

    ``mountings`` per cell of the paper's protocol, with ``grips`` grippings of ``fused`` probes.
    """

    name: str
    probes: int
    epochs: int
    groups: int
    trials: int
    mountings: int = 20
    grips: int = 4
    probes_per_grip: int = 50
    grips_per_mounting: int = 40
    fused: int = 5
    repeated: int = 0  # trials of each cell of Table 3 that are repeated on the devices


FULL = Scale("full", probes=2000, epochs=30, groups=400, trials=100, repeated=20)
QUICK = Scale("quick", probes=0, epochs=0, groups=40, trials=10, mountings=4)
# Tables 1 and 2 of models that exist
STABILITY = Scale("stability", probes=0, epochs=0, groups=200, trials=0, mountings=40)
SCALES = {scale.name: scale for scale in (FULL, QUICK, STABILITY)}


@dataclass(frozen=True)
class Recipe:
    """All jobs of Tables 1 to 3 on one bench.

    ``models``: for each piece and model name the hash of a trained file that replaces a training;
    ``code``: version of the program.
    """

    scale: Scale
    bench: SimulationSettings
    code: str
    models: Mapping[tuple[str, str], str] = field(default_factory=dict)
    pieces: tuple[str, ...] = PIECES
    device: DeviceName = "auto"  # of the training; another device changes the last digits

    def jobs(self) -> list[JobSpec]:
        """Return every job once, inputs before the jobs that need them."""
        found: dict[str, JobSpec] = {}
        for spec in self._all():
            found.setdefault(spec.id, spec)
        return list(found.values())

    def data(self, piece: str) -> list[JobSpec]:
        """Return the collections of training probes of ``piece``, one per outline."""
        scale = self.scale
        return [
            self._job(
                "simulate",
                TRAINING_SEED,
                piece=piece,
                bottom=bottom,
                episodes=scale.probes,
                probes_per_grip=scale.probes_per_grip,
                grips_per_mounting=scale.grips_per_mounting,
            )
            for bottom in TRAINING_BOTTOMS
        ]

    def training(self, piece: str, model: str) -> JobSpec:
        """Return the training of one model."""
        inputs, head = next((i, h) for name, i, h in MODELS if name == model)
        settings = paper_training(inputs, self.scale.epochs)
        params = {
            "piece": piece,
            "head": head,
            "training": settings.model_dump(mode="json"),
            "device": self.device,
        }
        data = tuple(spec.id for spec in self.data(piece))
        return JobSpec("train", params, settings.seed, data, job_code("train", self.code))

    def static(self, piece: str, bottom: str, protocol: str = BALANCED) -> JobSpec | None:
        """Return the evaluation of the models of ``piece`` over one bottom; None without any."""
        names = [name for name, _, _ in MODELS if self._source(piece, name)]
        if not names:
            return None
        sources = {name: self._source(piece, name) for name in names}
        first, sample = STATIC_SEED, {"groups": self.scale.groups}
        if protocol == PAPER_PROTOCOL:
            first = JIG_SEED
            sample = {"mountings": self.scale.mountings, "grips": self.scale.grips}
        return self._job(
            "static",
            first + CELL_SEEDS * self._cell(piece, bottom),
            needs=tuple(sorted({s for s in sources.values() if s})),
            piece=piece,
            bottom=bottom,
            models=sources,
            probes=self.scale.fused,
            **sample,
            **({"protocol": protocol} if protocol != BALANCED else {}),
        )

    def stacking(self, piece: str, bottoms: tuple[str, ...], strategy: str) -> JobSpec | None:
        """Return one cell of Table 3; None without trials, or without a model that it needs."""
        source = self._source(piece, "FT+Tac") if strategy != "pick-and-place" else ""
        if source is None or not self.scale.trials:
            return None
        tower = 5 if len(bottoms) > 1 else 0
        return self._job(
            "stack",
            STACKING_SEED + CELL_SEEDS * (self._cell(piece, bottoms[-1]) + tower),
            needs=(source,) if source else (),
            piece=piece,
            bottoms=list(bottoms),
            strategy=strategy,
            trials=self.scale.trials,
        )

    def devices(self, piece: str, bottoms: tuple[str, ...]) -> JobSpec | None:
        """Return the first trials of a cell on the stepped bench; None if the scale has none."""
        cell = self.stacking(piece, bottoms, "paper")
        if cell is None or not self.scale.repeated:
            return None
        params = {**cell.params, "trials": self.scale.repeated}
        return JobSpec("devices", params, cell.seed, cell.inputs, job_code("devices", self.code))

    def _all(self) -> Iterator[JobSpec]:
        for piece in self.pieces:
            if self.scale.probes:
                yield from self.data(piece)
                yield from (self.training(piece, name) for name, _, _ in MODELS)
        for piece in self.pieces:
            samples = product(TABLE_BOTTOMS, (BALANCED, PAPER_PROTOCOL))
            cells = [self.static(piece, bottom, protocol) for bottom, protocol in samples]
            for bottom in TABLE_BOTTOMS:
                cells += [self.stacking(piece, (bottom,), s) for s in ("pick-and-place", "paper")]
            cells.append(self.stacking(piece, TOWER, "paper"))
            cells += [
                self.devices(piece, tower) for tower in (*((b,) for b in TABLE_BOTTOMS), TOWER)
            ]
            yield from (cell for cell in cells if cell is not None)

    def _source(self, piece: str, model: str) -> str | None:
        if (piece, model) in self.models:
            return self.models[piece, model]
        return self.training(piece, model).id if self.scale.probes else None

    def _job(self, kind: str, seed: int, needs: tuple[str, ...] = (), **params: Any) -> JobSpec:
        params["bench"] = self.bench.model_dump(mode="json")
        return JobSpec(kind, params, seed, needs, job_code(kind, self.code))

    @staticmethod
    def _cell(piece: str, bottom: str) -> int:
        return 10 * PIECES.index(piece) + TABLE_BOTTOMS.index(bottom)


def paper_training(inputs: str, epochs: int) -> TrainingSettings:
    """Return the paper's training settings: a constant rate, and the last weights.

    The paper names neither a schedule nor an early stop.
    """
    return TrainingSettings.model_validate(
        {
            "modality": inputs,
            "epochs": epochs,
            "schedule": "constant",
            "keep": "last",
            "patience": epochs,
            # One mounting per outline; validation selects nothing.
            "divide_series": True,
        }
    )


TABLES_FORMAT = "touchdown-tables/1"
BEYOND_FORMAT = "touchdown-beyond/2"
# the first format lacks the towers that were left out
BEYOND_READABLE = ("touchdown-beyond/1", BEYOND_FORMAT)


COUNTS = ("1", "2", "3", "5")  # numbers of probes in Table 2
CALIBRATED = "calibrated"
EVEN = "even"  # the paper's fusion, judged at one half
PATCH_MODELS = tuple(name for name, _, head in MODELS if head == "patch")
OWN_MODEL = "FT+Tac"
UNSAFE_OUTCOMES = (Outcome.FELL.value, Outcome.KNOCKED_OVER.value)
Json = dict[str, Any]


def table_results(recipe: Recipe, store: JobStore) -> Json:
    """Return all finished results; the value of a missing cell is null."""
    return {
        "format": TABLES_FORMAT,
        "scale": recipe.scale.name,
        "code": recipe.code,
        **provenance(recipe.jobs(), store),
        "bench": recipe.bench.model_dump(mode="json"),
        "bench_sha256": bench_sha256(recipe.bench),
        "simulated": True,
        "table1": _table1(recipe, store, BALANCED),
        "table2": _table2(recipe, store, BALANCED),
        "table3": _table3(recipe, store),
        "paper_protocol": {
            "mountings": recipe.scale.mountings,
            "interactions": recipe.scale.mountings * recipe.scale.grips * recipe.scale.fused,
            "table1": _table1(recipe, store, PAPER_PROTOCOL),
            "table2": _table2(recipe, store, PAPER_PROTOCOL),
        },
        "bench_facts": _bench_facts(recipe, store),
    }


def provenance(jobs: Iterable[JobSpec], store: JobStore) -> Json:
    """Return the date, and the source hash of each kind of the finished ``jobs``."""
    codes = {spec.kind: spec.code for spec in jobs if store.has(spec.id)}
    sources = {kind: code.partition("+")[2] for kind, code in sorted(codes.items())}
    return {"date": datetime.now(UTC).date().isoformat(), "sources": sources}


def _cells(recipe: Recipe) -> Iterable[tuple[str, str]]:
    return ((piece, bottom) for piece in recipe.pieces for bottom in TABLE_BOTTOMS)


def _answer(spec: JobSpec | None, store: JobStore) -> Json | None:
    return store.result(spec.id) if spec is not None and store.has(spec.id) else None


def _table1(recipe: Recipe, store: JobStore, protocol: str) -> list[Json]:
    """Return one row per model and metric; intervals from the spread between mountings."""
    rows = []
    for metric, printed in (("iou", PAPER_IOU), ("accuracy", PAPER_POINT_ACCURACY)):
        for model in PATCH_MODELS:
            cells = []
            for piece, bottom in _cells(recipe):
                spec = recipe.static(piece, bottom, protocol)
                scores = (_answer(spec, store) or {"models": {}})["models"].get(model)
                cell = _cell(piece, bottom, spec, 0.01 * printed[model][piece, bottom])
                if scores:
                    cell |= estimate_mean(scores["patch"][metric]).as_json()
                    cell["against_truth"] = estimate_mean(scores["patch"][metric + "_true"]).value
                    cell["weights_sha256"] = scores["weights_sha256"]
                cells.append(cell)
            rows.append({"metric": metric, "model": model, "cells": cells, **_means(cells)})
    return rows


def _table2(recipe: Recipe, store: JobStore, protocol: str) -> list[Json]:
    """Return one row per method; each cell for the top interface alone, and for all interfaces.

    A row of another fusion than the paper's has the ``changes`` from it on the same groups. The
    intervals are by mounting.
    """
    rows = []
    methods = product((CALIBRATED, EVEN), COUNTS)
    for method in ("Implicit", *COUNTS, *map(" ".join, methods)):
        model = "Implicit" if method == "Implicit" else OWN_MODEL
        fusion, n = method.split() if " " in method else ("says", method)
        n = "1" if method == "Implicit" else n
        cells = []
        pooled, paired = VerdictSample(), VerdictSample()
        for piece, bottom in _cells(recipe):
            spec = recipe.static(piece, bottom, protocol)
            answer = _answer(spec, store) or {"models": {}}
            printed = PAPER_STABILITY.get(n, {}) if model == OWN_MODEL else PAPER_STABILITY[model]
            share = printed.get((piece, bottom))
            cell = _cell(piece, bottom, spec, None if share is None else 0.01 * share)
            verdicts = answer["models"].get(model, {})
            says = verdicts.get(fusion, {}).get(n)
            if says:
                mountings = answer.get("mounting", range(len(says)))
                where = [f"{piece} {bottom} {k}" for k in mountings]
                own = VerdictSample.of(says, answer["margin_mm"], where)
                cell["excluded"] = len(says) - len(own.said)
                top, _ = score_verdicts(says, answer["margin_mm"], interface=0)
                cell |= {**own.as_json(), "top_interface": top.as_json()}
                pooled += own
                if fusion != "says":
                    paired += VerdictSample.of(verdicts["says"][n], answer["margin_mm"], where)
            cells.append(cell)
        row: Json = {"method": method, "cells": cells, "pooled": pooled.as_json()}
        if paired.said:
            row["changes"] = verdict_changes(
                list(zip(paired.said, pooled.said, pooled.stands, strict=True)), pooled.mounting
            )
        rows.append(row)
    return rows


@dataclass(frozen=True, slots=True)
class VerdictSample:
    """Verdicts on cases outside the tolerance: said, true, and the mounting of each."""

    said: tuple[bool, ...] = ()
    stands: tuple[bool, ...] = ()
    mounting: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        says: Sequence[bool],
        margins_mm: Sequence[Sequence[float | None]],
        mountings: Sequence[str],
        interface: int = 1,
    ) -> VerdictSample:
        """Return the cases, judged by all interfaces or the top one (0).

        A margin of None means no support.
        """
        margins = (margin[interface] for margin in margins_mm)
        every = zip(says, margins, mountings, strict=True)
        kept = [case for case in every if case[1] is None or abs(case[1]) >= TOO_CLOSE_MM]
        return cls(
            tuple(said for said, _, _ in kept),
            tuple(margin is not None and margin > 0.0 for _, margin, _ in kept),
            tuple(where for _, _, where in kept),
        )

    def __add__(self, other: VerdictSample) -> VerdictSample:
        return VerdictSample(*(getattr(self, f) + getattr(other, f) for f in self.__slots__))

    def as_json(self) -> Json:
        """Return the counts; the interval of the accuracy is by mounting."""
        counts = VerdictCounts.of(self.said, self.stands).as_json()
        if self.said:
            right = np.equal(self.said, self.stands)
            low, high = clustered_interval(right, self.mounting)
            counts["accuracy"] |= {"low": low, "high": high}
            counts["mountings"] = len(set(self.mounting))
        return counts


def score_verdicts(
    says: Sequence[bool], margins_mm: Sequence[Sequence[float | None]], interface: int
) -> tuple[VerdictCounts, int]:
    """Return the counts of verdicts against margins, and the number of cases left out."""
    sample = VerdictSample.of(says, margins_mm, [""] * len(says), interface)
    return VerdictCounts.of(sample.said, sample.stands), len(says) - len(sample.said)


def _table3(recipe: Recipe, store: JobStore) -> list[Json]:
    """Return one row per tower and strategy. Every trial counts."""
    rows = []
    for printed, strategy in (("pick-and-place",) * 2, ("one", "paper"), ("two", "paper")):
        tower = "two" if printed == "two" else "one"
        cells = []
        for piece, bottom in _cells(recipe):
            if tower == "two" and bottom != TOWER[-1]:
                continue
            bottoms = TOWER if tower == "two" else (bottom,)
            spec = recipe.stacking(piece, bottoms, strategy)
            answer = _answer(spec, store)
            share = PAPER_STACKING[printed][piece, bottom] / PAPER_RUNS
            cell = _cell(piece, "+".join(bottoms), spec, share)
            if answer:
                cell |= stacking_cell(answer["trials"]) | {"left_out": answer["left_out"]}
                if strategy == "paper":
                    again = _answer(recipe.devices(piece, bottoms), store)
                    cell["devices"] = again and agreement(answer["trials"], again["trials"])
            cells.append(cell)
        done = [cell for cell in cells if "outcomes" in cell]
        placed = sum(cell["outcomes"].get(Outcome.PLACED.value, 0) for cell in done)
        unsafe = sum(cell["unsafe_releases"] for cell in done)
        trials = sum(cell["n"] for cell in done)
        rows.append(
            {
                "tower": tower,
                "strategy": strategy,
                "cells": cells,
                "pooled": estimate_rate(placed, trials).as_json(),
                "unsafe": estimate_rate(unsafe, trials).as_json(),
                "paper_pooled": 0.1 * sum(PAPER_STACKING[printed].values()) / len(PAPER_CELLS),
            }
        )
    return rows


def stacking_cell(trials: Sequence[Mapping[str, Any]]) -> Json:
    """Count the outcomes of one cell, for all interfaces and for the top one."""
    counts = Counter(trial["outcome"] for trial in trials)
    placed = counts[Outcome.PLACED.value]
    top = sum(bool(t["margins_mm"]) and (t["margins_mm"][-1] or -1.0) > 0.0 for t in trials)
    probes = [t["probes"] for t in trials if t["outcome"] == Outcome.PLACED.value]
    return {
        **estimate_rate(placed, len(trials)).as_json(),
        "outcomes": counts,
        "unsafe_releases": sum(counts[word] for word in UNSAFE_OUTCOMES),
        "top_interface": estimate_rate(top, len(trials)).as_json(),
        "probes": sum(probes) / len(probes) if probes else None,
    }


def agreement(batch: Sequence[Mapping[str, Any]], devices: Sequence[Mapping[str, Any]]) -> Json:
    """Compare the batch trials and the device trials of the same seeds."""
    mine = {trial["seed"]: trial for trial in batch}
    pairs = [(mine[trial["seed"]], trial) for trial in devices]
    placed = [
        sum(t["outcome"] == Outcome.PLACED.value for t in side) for side in zip(*pairs, strict=True)
    ]
    return {
        "trials": len(pairs),
        "same_outcome": sum(a["outcome"] == b["outcome"] for a, b in pairs),
        "placed_batch": placed[0],
        "placed_devices": placed[1],
        "probes_apart": sum(abs(a["probes"] - b["probes"]) for a, b in pairs) / len(pairs),
    }


def _bench_facts(recipe: Recipe, store: JobStore) -> Json:
    """Return the difficulty of the bench: slip, reliability and map IoU after three probes."""
    slipped, rejected, count = [], 0, 0
    charts = []
    for piece, bottom in _cells(recipe):
        answer = _answer(recipe.static(piece, bottom), store)
        if answer is None:
            continue
        slipped.append(answer["slipped"])
        rejected += answer["rejected"]
        count += len(answer["margin_mm"])
        ours = answer["models"].get(OWN_MODEL)
        if ours and "reliability" in ours:
            facts = {
                "piece": piece,
                "bottom": bottom,
                "map_iou": estimate_mean(ours["map_iou"]).as_json(),
            }
            charts.append({**facts, **ours["reliability"]})
    return {
        "slipped": sum(slipped) / len(slipped) if slipped else None,
        "rejected": rejected,
        "groups": count,
        "after_three_probes": charts,
    }


def _cell(piece: str, bottom: str, spec: JobSpec | None, printed: float | None) -> Json:
    """Return the common fields of a cell: piece, bottom, job, seed and the paper's number."""
    trace = {} if spec is None else {"job": spec.id, "seed": spec.seed}
    return {"piece": piece, "bottom": bottom, "paper": printed, **trace}


def _means(cells: Sequence[Json]) -> Json:
    values = [cell["value"] for cell in cells if cell.get("value") is not None]
    printed = [cell["paper"] for cell in cells]
    return {
        "mean": sum(values) / len(values) if len(values) == len(cells) else None,
        "paper_mean": sum(printed) / len(printed),
    }
