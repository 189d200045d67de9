"""Change of models and strategies from the simulated bench to the second world.

Domain randomisation trains on probes whose mountings are benches with their own settings: nuisance
sizes and the laws of gel, grip, contact and friction are drawn per mounting from wide ranges around
the given bench. The ranges were chosen by hand and are not fitted to the second world.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from touchdown.backend.config import SimulationSettings, bench_sha256
from touchdown.backend.experiments.evaluation import (
    EVALUATED_STRATEGIES,
    NUISANCES,
    WORLDS,
    EvaluationBench,
    job_effort,
    press_jobs,
    scale_nuisance,
    trial_jobs,
)
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    format_change,
    iou_change,
)
from touchdown.backend.experiments.strategies import count_outcomes
from touchdown.backend.experiments.tables import (
    TRAINING_BOTTOMS,
    job_code,
    paper_training,
    score_verdicts,
    training_job,
)
from touchdown.backend.jobs import JobSpec, JobStore
from touchdown.backend.learning import DeviceName

# mountings: drawn by the bench; randomised: each with its own nuisance sizes and laws
CollectionKind = Literal["mountings", "randomised"]
# first seed of the mountings, disjoint from the tables; number of seeds per outline
FIRST_SEED, OUTLINE_SEEDS = 7_000_000, 10_000
PROBES, PROBES_PER_GRIP, GRIPS_PER_MOUNTING, EPOCHS = 2000, 5, 10, 30
NUISANCE_FACTORS = (0.5, 2.0)  # range of the scale of every nuisance
# Range of the log-uniform factor on a value of the bench (``section.name``); one factor for both
# numbers of a pair.
LAW_FACTORS: Mapping[str, tuple[float, float]] = {
    "grasp.shear_n_mm": (0.5, 2.0),
    "grasp.normal_n_mm": (0.5, 2.0),
    "grasp.torsion_nmm_rad": (0.5, 2.0),
    "grasp.limit_radius_mm": (0.6, 1.6),
    "grasp.hysteresis_share": (0.3, 5.0),
    "grasp.hysteresis_s": (0.1, 2.0),
    "face.foundation_range_n_mm3": (0.3, 10.0),
    "face.tangential_n_mm3": (0.5, 4.0),
    ".mu": (0.6, 1.5),
    ".mu_grip": (0.75, 2.0),
    "tactile.mm_per_px": (0.9, 1.3),
    "tactile.roll_off_mm": (0.6, 1.6),
    "tactile.dilation": (0.3, 3.0),
}
_RNG_STREAM = 993  # separates these draws from those of the bench


def randomise_bench(bench: SimulationSettings, seed: int) -> SimulationSettings:
    """Return the randomised bench of the mounting ``seed``; reproducible for the same bench and
    seed.
    """
    rng = np.random.default_rng([seed, _RNG_STREAM])
    for nuisance in NUISANCES:
        bench = scale_nuisance(bench, nuisance, _factor(rng, NUISANCE_FACTORS))
    content = bench.model_dump(mode="json")
    for key, limits in LAW_FACTORS.items():
        section, name = key.split(".")
        values, factor = content[section] if section else content, _factor(rng, limits)
        values[name] = _times(values[name], factor)
    return SimulationSettings.model_validate(content)


@dataclass(frozen=True, slots=True)
class RandomisedTraining:
    """Jobs of one model: ``probes`` over each training outline, then the paper's training.

    Each collection job is one mounting and holds all its settings in its spec.
    """

    bench: SimulationSettings
    code: str
    piece: str
    collected: CollectionKind
    inputs: str = "FT+Tac"
    probes: int = PROBES
    epochs: int = EPOCHS
    device: DeviceName = "auto"

    @property
    def name(self) -> str:
        """Name of the model in tables."""
        return f"{self.inputs} {self.collected}"

    def data(self) -> list[JobSpec]:
        """Return the collection jobs, one per mounting."""
        size = PROBES_PER_GRIP * GRIPS_PER_MOUNTING
        return [
            self._mounting(FIRST_SEED + OUTLINE_SEEDS * k + first // size, bottom,
                           min(size, self.probes - first))
            for k, bottom in enumerate(TRAINING_BOTTOMS)
            for first in range(0, self.probes, size)
        ]  # fmt: skip

    def training(self) -> JobSpec:
        """Return the training job."""
        settings = paper_training(self.inputs, self.epochs)
        return training_job((self.piece, "patch"), settings, self.device, self.data(), self.code)

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job (unit of ``evaluation.job_effort``)."""
        if spec.kind == "train":
            return math.ceil(self.probes * self.epochs / 20)
        return int(spec.params["episodes"]) // 2

    def _mounting(self, seed: int, bottom: str, episodes: int) -> JobSpec:
        bench = self.bench if self.collected == "mountings" else randomise_bench(self.bench, seed)
        params = {
            "piece": self.piece,
            "bottom": bottom,
            "episodes": episodes,
            "probes_per_grip": PROBES_PER_GRIP,
            "grips_per_mounting": GRIPS_PER_MOUNTING,
            "bench": bench.model_dump(mode="json"),
        }
        return JobSpec("simulate", params, seed, (), job_code("simulate", self.code))


def _factor(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    low, high = np.log(limits)
    return float(np.exp(rng.uniform(low, high)))


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (int, float)):
        return factor * value
    return None if value is None else [factor * part for part in value]


FORMAT = "touchdown-elsewhere/1"
Json = dict[str, Any]


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

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, alternating between the worlds for comparable partial results."""
        lists = [jobs for _, jobs in self._cells()]
        longest = max(map(len, lists))
        asked = [jobs[k] for k in range(longest) for jobs in lists if k < len(jobs)]
        made = [spec for plan in self.trained for spec in (*plan.data(), plan.training())]
        return made + asked

    def effort(self, spec: JobSpec) -> int:
        """Return the relative duration of a job."""
        if spec.kind.startswith("asked-"):
            return job_effort(spec)
        return self.trained[0].effort(spec)

    def answer(self, store: JobStore) -> Json:
        """Return the finished results of both worlds, by cell and pooled over bottoms."""
        found: dict[_Cell, list[Json]] = {}
        cells = dict(self._cells())
        for (world, bottom, strategy), jobs in cells.items():
            same = zip(*(cells[other, bottom, strategy] for other in WORLDS), strict=True)
            both = [all(store.has(spec.id) for spec in specs) for specs in same]
            done = [store.result(spec.id) for spec, ok in zip(jobs, both, strict=True) if ok]
            for over in (bottom, "pooled"):
                found.setdefault((world, over, strategy), []).extend(done)
        return {
            "format": FORMAT,
            "simulated": True,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "piece": self.piece,
            "first": self.first,
            "models": self._asked(),
            "presses": [
                {"world": world, "bottom": bottom, "model": model, **press_scores(parts, model)}
                for (world, bottom, strategy), parts in found.items()
                if not strategy and parts
                for model in parts[0]["models"]
            ],
            "changes": [change for bottom in (*self.bottoms, "pooled")
                        for change in _changes(found, bottom)],
            "trials": [
                {
                    "world": world,
                    "bottom": bottom,
                    "strategy": strategy,
                    **count_outcomes([trial for part in parts for trial in part["trials"]]),
                }
                for (world, bottom, strategy), parts in found.items()
                if strategy and parts
            ],
        }  # fmt: skip

    def _asked(self) -> dict[str, str]:
        return {**self.models, **{plan.name: plan.training().id for plan in self.trained}}

    def _cells(self) -> Iterator[tuple[_Cell, list[JobSpec]]]:
        """Yield world, bottom and strategy ("" for presses) with their jobs."""
        given, *_ = self.models.items()
        for bottom in self.bottoms:
            for world in WORLDS:
                pair, place = (self.piece, bottom), EvaluationBench(world, self.bench, self.first)
                jobs = press_jobs(place, pair, self._asked(), self.groups, self.code)
                yield (world, bottom, ""), jobs
                for strategy in self.strategies:
                    trained = () if strategy in EVALUATED_STRATEGIES[-2:] else self.trained
                    for name, source in (given, *((t.name, t.training().id) for t in trained)):
                        word = strategy if name == given[0] else f"{strategy}, {name}"
                        chosen = (strategy, source)
                        jobs = trial_jobs(place, pair, chosen, self.trials, self.code)
                        yield (world, bottom, word), jobs


_Cell = tuple[str, str, str]  # world, bottom, strategy with its model ("" for presses)


def _changes(found: Mapping[_Cell, Sequence[Json]], bottom: str) -> Iterator[Json]:
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


def press_scores(parts: Sequence[Mapping[str, Any]], model: str) -> Json:
    """Return the IoU, point accuracy and stability scores of one model on pressed groups."""
    scores = [part["models"][model] for part in parts]
    figures: Json = {
        name: estimate_mean([value for s in scores for value in s[name]]).as_json()
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


def press_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return rows of IoU and stability by model and bottom: bench, second world, difference."""
    rows = []
    for name, here, there in _in_both_worlds(answer["presses"], "model"):
        row = [name]
        for get in (iou_of, stability_of):
            row += _compared(get(here), get(there))
        shares = [c["stable_1"]["unsafe"]["value"] for c in (here, there)]
        unsafe = ["" if share is None else f"{100 * share:.0f}" for share in shares]
        rows.append((*row, " / ".join(unsafe)))
    return rows


def change_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return one row per paired change: comparison, bottom, points, number of groups."""
    rows: list[tuple[str, ...]] = []
    for change in answer["changes"]:
        old, new = change["from"], change["to"]
        what = f"{old}: bench to elsewhere" if old == new else f"{change['what']}: {old} to {new}"
        rows.append((what, change["bottom"], format_change(change), str(change["n"])))
    return rows


def trial_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return rows of placed and unsafe trials by strategy and bottom: bench, second world,
    difference.
    """
    rows = []
    for name, here, there in _in_both_worlds(answer["trials"], "strategy"):
        row = [name, f"{here['placed']['n']} / {there['placed']['n']}"]
        for rate in ("placed", "unsafe"):
            row += _compared(here[rate], there[rate])
        rows.append(tuple(row))
    return rows


def _in_both_worlds(cells: Sequence[Json], key: str) -> Iterator[tuple[str, Json, Json]]:
    """Yield the name (value of ``key`` and bottom) and the cells on the bench and elsewhere."""
    found = {(c[key], c["bottom"], c["world"]): c for c in cells}
    for what, bottom in dict.fromkeys((what, bottom) for what, bottom, _ in found):
        here, there = (found.get((what, bottom, world)) for world in WORLDS)
        if here is not None and there is not None:
            yield f"{what} {bottom}", here, there


def _compared(here: Json, there: Json) -> list[str]:
    return [format_interval(here), format_interval(there), format_drop(here, there)]


def format_interval(estimate: Json) -> str:
    """Format an estimate in percent with its interval; "" without a value."""
    if estimate["value"] is None:
        return ""
    value, low, high = (100 * estimate[key] for key in ("value", "low", "high"))
    return f"{value:.1f} ({low:.0f} to {high:.0f})"


def format_drop(here: Json, there: Json) -> str:
    """Format the difference of two estimates in points."""
    if here["value"] is None or there["value"] is None:
        return ""
    return f"{100 * (there['value'] - here['value']):+.1f}"


def iou_of(scores: Mapping[str, Any]) -> Json:
    """Return the IoU estimate of ``press_scores``."""
    found: Json = scores["iou"]
    return found


def stability_of(scores: Mapping[str, Any]) -> Json:
    """Return the stability accuracy after one probe of ``press_scores``."""
    found: Json = scores["stable_1"]["accuracy"]
    return found
