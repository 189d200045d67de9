"""Calibrate the guard and count its alarms: ``python -m tests.guard_study --out DIR``.

On the bench itself and in the second world, on the bottoms of the tables. No trial is in two of the
three sets: calibration, sequences on the bench, runs in
the second world. Writes the calibration beside the network, and ``guard.json``, which
``tests.fusion_tables`` renders; resumes.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import (
    FusedSettings,
    SimulationSettings,
    StackSettings,
    bench_sha256,
    load_simulation,
)
from touchdown.backend.core import package_version
from touchdown.backend.experiments import PIECES
from touchdown.backend.experiments.certification import CONVEX, fresh_scene
from touchdown.backend.experiments.document import ReportTable
from touchdown.backend.experiments.statistics import estimate_rate
from touchdown.backend.experiments.strategies import (
    SINGLE_BOTTOMS,
    network_params,
    uninformed_model,
)
from touchdown.backend.experiments.trials import (
    FRESH,
    WORLDS,
    XY,
    SceneSetup,
    grasped_piece_in,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.jobs import (
    JobContext,
    JobSpec,
    JobStore,
    SerialExecutor,
    run_campaign,
    source_hash,
)
from touchdown.backend.learning import use_one_thread
from touchdown.backend.learning.fused import (
    ALARM,
    GuardCalibration,
    GuardFile,
    PowerMartingale,
    ScoreRanks,
    guard_path,
    shipped_path,
    signal_score,
)
from touchdown.backend.placement import FusedStrategy, load_network_of
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene

Json = dict[str, Any]
SOURCES = "touchdown.backend.experiments.trials"
GUARD_FORMAT = "touchdown-guard-study/1"
GUARD_SEED, SET_SEEDS = 95_000_000, 1_000_000  # disjoint from all other trials
CALIBRATION, OWN, ELSEWHERE = range(3)
RESAMPLED = 1000
Cell = tuple[str, str]  # piece; bottom, or ``FRESH`` for one of its own in every trial
Score = Callable[[Json], float]


def score_of(trial: Json) -> float:
    """Return the score of a counted trial."""
    inputs, unseen = trial["distances"]
    return signal_score((inputs, unseen))


def inputs_score(trial: Json) -> float:
    """Return the score by the inputs of the network alone."""
    return signal_score((trial["distances"][0], 0.0))


@dataclass(frozen=True, slots=True)
class GuardStudy:
    """Calibration with ``calibration`` trials of each cell, and alarms of the guard.

    ``sequences`` of ``length`` trials on the bench and ``runs`` of ``most`` trials in the second
    world, both over random cells. ``weights``: file of the network, "" for the one that ships.
    """

    bench: SimulationSettings
    code: str
    cells: tuple[Cell, ...]
    calibration: int = 40
    sequences: int = 5
    length: int = 200
    runs: int = 50
    most: int = 20
    weights: str = ""

    def bench_jobs(self, part: int) -> list[JobSpec]:
        """Return the trials of the calibration, or the other ones on the bench; a job a cell."""
        own = -(-self.sequences * self.length // len(self.cells))
        count = self.calibration if part == CALIBRATION else own
        return [
            self._job("bench", [cell] * count, SET_SEEDS * part + 10_000 * k)
            for k, cell in enumerate(self.cells if count else ())
        ]

    def run_jobs(self) -> list[JobSpec]:
        """Return the runs in the second world, each over random cells."""
        drawn = [np.random.default_rng([GUARD_SEED, run]).integers(len(self.cells), size=self.most)
                 for run in range(self.runs)]  # fmt: skip
        return [
            self._job("elsewhere", [self.cells[k] for k in places],
                      SET_SEEDS * ELSEWHERE + 1000 * run)
            for run, places in enumerate(drawn)
        ]  # fmt: skip

    def jobs(self) -> list[JobSpec]:
        """Return all jobs."""
        return [*self.bench_jobs(CALIBRATION), *self.bench_jobs(OWN), *self.run_jobs()]

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        return len(spec.params["cells"])

    def trials(self, store: JobStore, part: int) -> list[Json]:
        """Return the trials on the bench of a set; none until all are done."""
        jobs = self.bench_jobs(part)
        return _trials_of(store, jobs) if all(store.has(spec.id) for spec in jobs) else []

    def answer(self, store: JobStore) -> Json:
        """Return the alarms in the finished trials."""
        known, own = (self.trials(store, part) for part in (CALIBRATION, OWN))
        rng = np.random.default_rng(GUARD_SEED)
        mixed = [own[k] for k in rng.permutation(len(own))]
        firsts = range(0, self.sequences * self.length if own else 0, self.length)
        sequences = [mixed[first : first + self.length] for first in firsts]
        cells = [[t for t in own if (t["piece"], t["bottom"]) == cell] for cell in self.cells]
        runs = [
            _trials_of(store, [spec]) for spec in self.run_jobs() if known and store.has(spec.id)
        ]
        ends = [alarm_after(run, known) for run in runs]
        before = [t for run, end in zip(runs, ends, strict=True) for t in run[: end and end - 1]]
        counts = Counter(trial["piece"] for trial in known if trial["distances"])
        return {
            "format": GUARD_FORMAT,
            "simulated": True,
            "bench": self.bench.preset,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.run_jobs()[0].code,
            "fused_sha256": self.run_jobs()[0].params["fused_sha256"],
            "calibration": dict(counts),
            "length": self.length,
            "most": self.most,
            "own": {
                "outcomes": _outcomes(own),
                "sequences": _alarms(sequences, known),
                "one_cell": _alarms([cell for cell in cells if cell], known),
                "resampled": self._resampled([*known, *own], len(known), rng),
            },
            "elsewhere": {
                **_alarms(runs, known),
                "outcomes": _outcomes([trial for run in runs for trial in run]),
                "before_alarm": _outcomes(before),
            },
            "inputs_only": {
                "sequences": _alarms(sequences, known, inputs_score),
                "elsewhere": _alarms(runs, known, inputs_score),
            },
        }

    def _job(self, world: str, cells: Sequence[Cell], seed: int) -> JobSpec:
        return guard_job(world, self.bench, cells, GUARD_SEED + seed, self.weights, self.code)

    def _resampled(self, trials: list[Json], known: int, rng: np.random.Generator) -> Json:
        """Return the alarms where calibration and sequence are random parts of all trials."""
        counted = RESAMPLED if 0 < self.length <= len(trials) - known else 0
        drawn = [
            [trials[k] for k in rng.permutation(len(trials))[: known + self.length]]
            for _ in range(counted)
        ]
        alarms = sum(alarm_after(t[known:], t[:known]) is not None for t in drawn)
        return {"sequences": counted, "alarms": alarms}


def alarm_after(
    trials: Iterable[Json], known: Sequence[Json], score: Score = score_of
) -> int | None:
    """Return the number of trials until the alarm of a guard calibrated on ``known``, or None."""
    scores = _scores(known, score)
    ranks = ScoreRanks({piece: tuple(own) for piece, own in scores.items()})
    martingale = PowerMartingale()
    for count, trial in enumerate(trials, 1):
        if trial["distances"]:
            martingale.update(ranks.p_value(trial["piece"], score(trial)))
        if martingale.value >= ALARM:
            return count
    return None


def _trials_of(store: JobStore, jobs: Iterable[JobSpec]) -> list[Json]:
    return [trial for spec in jobs for trial in store.result(spec.id)["trials"]]


def _scores(trials: Iterable[Json], score: Score) -> dict[str, list[float]]:
    scores: dict[str, list[float]] = {}
    for trial in trials:
        if trial["distances"]:
            scores.setdefault(trial["piece"], []).append(score(trial))
    return scores


def _outcomes(trials: Iterable[Json]) -> Json:
    return dict(Counter(trial["outcome"] for trial in trials))


def _alarms(runs: Sequence[list[Json]], known: Sequence[Json], score: Score = score_of) -> Json:
    """Return the number of trials until each alarm, None without one, and their share."""
    ends = [alarm_after(run, known, score) for run in runs]
    alarms = sum(end is not None for end in ends)
    rate = estimate_rate(alarms, len(runs)).as_json()
    return {"runs": len(runs), "alarms": alarms, "rate": rate, "after": ends}


def guard_table(answer: Json) -> ReportTable:
    """Return the alarms as rows of a table."""
    own, there, inputs = answer["own"], answer["elsewhere"], answer["inputs_only"]
    length, most = answer["length"], answer["most"]
    rows = [
        (f"own bench, {length} trials over all cells", own["sequences"]),
        (f"own bench, {length} trials drawn again from all", own["resampled"]),
        ("own bench, all trials of one cell", own["one_cell"]),
        (f"second world, {most} trials", there),
        ("own bench, inputs of the network alone", inputs["sequences"]),
        ("second world, inputs of the network alone", inputs["elsewhere"]),
    ]
    return ReportTable.of_texts(
        "Alarms of the guard",
        ("trials", "runs", "alarms", "trials until the alarm, median (largest)"),
        [(name, str(row.get("runs", row.get("sequences"))), str(row["alarms"]), _after(row))
         for name, row in rows],
    )  # fmt: skip


def _after(row: Json) -> str:
    ends = [end for end in row.get("after", ()) if end is not None]
    return f"{np.median(ends):g} ({max(ends)})" if ends else "-"


def guard_job(
    world: str, bench: SimulationSettings, cells: Sequence[tuple[str, str]], seed: int,
    weights: str, code: str,
) -> JobSpec:  # fmt: skip
    """Return the job of one trial of ``fused`` for each (piece, bottom); see ``guard_trials``."""
    params = {
        "world": world,
        "bench": bench.model_dump(mode="json"),
        "cells": [list(cell) for cell in cells],
        "weights": weights,
        **network_params("fused", _fused(weights)),
    }
    return JobSpec(
        "guard-trials", params, seed, (), f"{code}+{source_hash(SOURCES, 'stack_in_lockstep')}"
    )


def guard_trials(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run one trial per cell, with the distances of its signals, for the guard of a network.

    A trial that ended before a decision, by an aborted press or a toppled support, has none.
    """
    use_one_thread()
    cells = enumerate(spec.params["cells"])
    return {"trials": [_guard_trial(spec.params, *cell, spec.seed + k) for k, cell in cells]}


def _guard_trial(p: Mapping[str, Any], piece: str, bottom: str, seed: int) -> Json:
    method = _fused(p["weights"])
    made: list[FusedStrategy] = []

    def create(scene: Scene, at: XY) -> FusedStrategy:
        made.append(FusedStrategy(grasped_piece_in(scene, None), method, at))
        return made[-1]

    case = SceneSetup.of_job({**p, "piece": piece}, *(() if bottom == FRESH else (bottom,)))
    if bottom == FRESH:
        family = FRESH if load_network_of(method.fused).card.outlines == "any" else CONVEX
        scene: Scene | None = fresh_scene(case.piece, seed, case.settings, family)
    else:
        scene = start_scene(case, seed)
    assert scene is not None  # on a single bottom there is always a place
    model, world = uninformed_model(case), WORLDS[p["world"]]
    (end,) = stack_in_lockstep([scene], model, method, EpisodeLimits(), create, world)
    decided = bool(end.steps) and end.steps[-1].action.kind != "shift"
    return {
        "piece": piece,
        "bottom": bottom,
        "seed": seed,
        "outcome": end.outcome.value,
        "probes": end.probes,
        "distances": [round(d, 6) for d in made[0].signal_distances()] if decided else None,
    }


def _fused(weights: str) -> StackSettings:
    return StackSettings(strategy="fused", fused=FusedSettings(weights=weights))


def calibration(study: GuardStudy, store: JobStore) -> GuardFile:
    """Return the calibration of the finished trials, for the file beside the network."""
    scores = _scores(study.trials(store, CALIBRATION), score_of)
    found = GuardCalibration(
        bench=study.bench.preset,
        bench_sha256=bench_sha256(study.bench),
        code=study.run_jobs()[0].code,
        date=datetime.now(UTC).date().isoformat(),
        scores={piece: tuple(sorted(own)) for piece, own in sorted(scores.items())},
    )
    sha256 = study.run_jobs()[0].params["fused_sha256"]
    return GuardFile(weights_sha256=sha256, benches=(found,))


def main() -> None:
    """Run the missing jobs and write the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--model", default="")
    parser.add_argument("--preset", default="bench-v1")
    for name, value in (("calibration", 40), ("sequences", 2), ("runs", 50), ("most", 5)):
        parser.add_argument(f"--{name}", type=int, default=value)
    args = parser.parse_args()
    study = GuardStudy(
        load_simulation(None, args.preset),
        package_version("touchdown"),
        tuple((piece, bottom) for piece in PIECES for bottom in SINGLE_BOTTOMS),
        args.calibration,
        args.sequences,
        runs=args.runs,
        most=args.most,
        weights=args.model,
    )
    (args.out / "jobs").mkdir(parents=True, exist_ok=True)
    store = JobStore(args.out / "jobs")
    executor = SerialExecutor({"guard-trials": guard_trials}, store)
    for _ in run_campaign(study.jobs(), executor, store):
        pass
    weights = Path(args.model) if args.model else shipped_path()
    content = calibration(study, store).model_dump_json(indent=1)
    guard_path(weights).write_text(f"{content}\n", "utf-8")
    answer = json.dumps(study.answer(store), indent=1, sort_keys=True)
    (args.out / "guard.json").write_text(f"{answer}\n", "utf-8")


if __name__ == "__main__":
    main()
