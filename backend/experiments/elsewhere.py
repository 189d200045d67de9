"""The drop in the second world: models and strategies as they are, on the seeds of both worlds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from backend.config.bench_facts import bench_sha256
from backend.config.simulation import SimulationSettings
from backend.experiments.asking import WORLDS, Place, presses_jobs, trials_jobs
from backend.experiments.beyond import counted
from backend.experiments.statistics import Binary, mean
from backend.experiments.tables import scored
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore

FORMAT = "touchdown-elsewhere/1"
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Both:
    """What to ask in both worlds. ``models``: name in the tables to the job or file it comes from.

    Strategies read the first of them.
    """

    bench: SimulationSettings
    code: str
    piece: str
    models: Mapping[str, str]
    bottoms: tuple[str, ...] = ("short", "long")
    strategies: tuple[str, ...] = ("paper", "outlines", "pressure")
    groups: int = 40
    trials: int = 20

    def jobs(self) -> list[JobSpec]:
        """Return all jobs: the two worlds take turns, so that what is finished can be compared."""
        lists = [jobs for _, jobs in self._cells()]
        longest = max(map(len, lists))
        return [jobs[k] for k in range(longest) for jobs in lists if k < len(jobs)]

    def answer(self, store: JobStore) -> Json:
        """Return what is finished in both worlds, by cell and pooled over bottoms."""
        found: dict[tuple[str, str, str], list[Json]] = {}
        cells = dict(self._cells())
        for (world, bottom, strategy), jobs in cells.items():
            same = zip(*(cells[other, bottom, strategy] for other in WORLDS), strict=True)
            both = [all(store.has(spec.id) for spec in specs) for specs in same]
            done = [store.result(spec.id) for spec, ok in zip(jobs, both, strict=True) if ok]
            found.setdefault((world, bottom, strategy), []).extend(done)
            found.setdefault((world, "pooled", strategy), []).extend(done)
        return {
            "format": FORMAT,
            "simulated": True,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "piece": self.piece,
            "models": dict(self.models),
            "presses": [
                {"world": world, "bottom": bottom, "model": model, **press_figures(parts, model)}
                for (world, bottom, strategy), parts in found.items()
                if not strategy and parts
                for model in self.models
            ],
            "trials": [
                {
                    "world": world,
                    "bottom": bottom,
                    "strategy": strategy,
                    **counted([trial for part in parts for trial in part["trials"]]),
                }
                for (world, bottom, strategy), parts in found.items()
                if strategy and parts
            ],
        }

    def _cells(self) -> Iterator[tuple[tuple[str, str, str], list[JobSpec]]]:
        """Yield world, bottom and strategy ("" for presses) with their jobs."""
        source = next(iter(self.models.values()))
        for bottom in self.bottoms:
            for world in WORLDS:
                pair, place = (self.piece, bottom), Place(world, self.bench)
                jobs = presses_jobs(place, pair, self.models, self.groups, self.code)
                yield (world, bottom, ""), jobs
                for strategy in self.strategies:
                    chosen = (strategy, source)
                    jobs = trials_jobs(place, pair, chosen, self.trials, self.code)
                    yield (world, bottom, strategy), jobs


def press_figures(parts: Sequence[Mapping[str, Any]], model: str) -> Json:
    """Return what one model says of pressed groups: IoU, points, stability after 1 to 3 probes."""
    scores = [part["models"][model] for part in parts]
    figures: Json = {
        name: mean([value for s in scores for value in s[name]]).as_json()
        for name in ("iou", "accuracy", "iou_true")
    }
    for n in ("1", "2", "3"):
        binary, left_out = Binary(0, 0, 0, 0), 0
        for part, score in zip(parts, scores, strict=True):
            counts, close = scored(score["says"][n], part["margin_mm"], interface=1)
            binary, left_out = binary + counts, left_out + close
        figures[f"stable_{n}"] = {**binary.as_json(), "too_close": left_out}
    figures["slipped"] = mean([part["slipped"] for part in parts]).value
    for name in ("rejected", "left_out"):
        figures[name] = sum(part[name] for part in parts)
    return figures


def press_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return model and bottom with IoU and stability: on the bench, elsewhere, and the drop."""
    cells = {(c["model"], c["bottom"], c["world"]): c for c in answer["presses"]}
    rows = []
    for model, bottom in dict.fromkeys((m, b) for m, b, _ in cells):
        here, there = (cells.get((model, bottom, world)) for world in WORLDS)
        if here is None or there is None:
            continue
        row = [f"{model} {bottom}"]
        for get in (_iou, _right):
            row += [interval(get(here)), interval(get(there)), drop(get(here), get(there))]
        unsafe = [percent(c["stable_1"]["unsafe"]["value"]) for c in (here, there)]
        rows.append((*row, " / ".join(unsafe)))
    return rows


def trial_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return strategy and bottom with trials placed and unsafe: here, elsewhere, and the drop."""
    cells = {(c["strategy"], c["bottom"], c["world"]): c for c in answer["trials"]}
    rows = []
    for strategy, bottom in dict.fromkeys((s, b) for s, b, _ in cells):
        here, there = (cells.get((strategy, bottom, world)) for world in WORLDS)
        if here is None or there is None:
            continue
        row = [f"{strategy} {bottom}", f"{here['placed']['n']} / {there['placed']['n']}"]
        for name in ("placed", "unsafe"):
            row += [interval(here[name]), interval(there[name]), drop(here[name], there[name])]
        rows.append(tuple(row))
    return rows


def interval(estimate: Json) -> str:
    """Write an estimate in per cent with its interval; "" without one."""
    if estimate["value"] is None:
        return ""
    value, low, high = (100 * estimate[key] for key in ("value", "low", "high"))
    return f"{value:.1f} ({low:.0f} to {high:.0f})"


def drop(here: Json, there: Json) -> str:
    """Write by how many points the second falls short of the first."""
    if here["value"] is None or there["value"] is None:
        return ""
    return f"{100 * (there['value'] - here['value']):+.1f}"


def percent(value: float | None) -> str:
    """Write a share in per cent."""
    return "" if value is None else f"{100 * value:.0f}"


def _iou(cell: Json) -> Json:
    found: Json = cell["iou"]
    return found


def _right(cell: Json) -> Json:
    found: Json = cell["stable_1"]["accuracy"]
    return found
