"""The drop in the second world: models and strategies as they are, on the seeds of both worlds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from backend.config.bench_facts import bench_sha256
from backend.config.simulation import SimulationSettings
from backend.experiments.asking import STRATEGIES, WORLDS, Place, effort, presses_jobs, trials_jobs
from backend.experiments.beyond import counted
from backend.experiments.paired import iou_change, signed
from backend.experiments.randomised import RandomisedTraining
from backend.experiments.statistics import Binary, mean
from backend.experiments.tables import scored
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore

FORMAT = "touchdown-elsewhere/1"
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Both:
    """What to ask in both worlds. ``models``: name in the tables to the job or file it comes from.

    ``trained``: models that are made first, on collections of their own, and asked with the others.
    Strategies read the first of ``models`` and of each of ``trained``; some read none.
    ``first``: number of the first group and trial of a cell (choices are made on later ones).
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
        """Return all jobs: the two worlds take turns, so that what is finished can be compared."""
        lists = [jobs for _, jobs in self._cells()]
        longest = max(map(len, lists))
        asked = [jobs[k] for k in range(longest) for jobs in lists if k < len(jobs)]
        made = [spec for plan in self.trained for spec in (*plan.data(), plan.training())]
        return made + asked

    def effort(self, spec: JobSpec) -> int:
        """Return how long a job takes compared with others, for the time that is left."""
        if spec.kind.startswith("asked-"):
            return effort(spec)
        return self.trained[0].effort(spec)

    def answer(self, store: JobStore) -> Json:
        """Return what is finished in both worlds, by cell and pooled over bottoms."""
        found: dict[_Cell, list[Json]] = {}
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
            "first": self.first,
            "models": self._asked(),
            "presses": [
                {"world": world, "bottom": bottom, "model": model, **press_figures(parts, model)}
                for (world, bottom, strategy), parts in found.items()
                if not strategy and parts
                for model in _models_of(parts)
            ],
            "changes": [change for bottom in (*self.bottoms, "pooled")
                        for change in _changes(found, bottom)],
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
        }  # fmt: skip

    def _asked(self) -> dict[str, str]:
        """Return all models by name, the given ones first."""
        return {**self.models, **{plan.name: plan.training().id for plan in self.trained}}

    def _cells(self) -> Iterator[tuple[_Cell, list[JobSpec]]]:
        """Yield world, bottom and strategy ("" for presses) with their jobs."""
        given, *_ = self.models.items()
        for bottom in self.bottoms:
            for world in WORLDS:
                pair, place = (self.piece, bottom), Place(world, self.bench, self.first)
                jobs = presses_jobs(place, pair, self._asked(), self.groups, self.code)
                yield (world, bottom, ""), jobs
                for strategy in self.strategies:
                    trained = () if strategy in STRATEGIES[-2:] else self.trained
                    for name, source in (given, *((t.name, t.training().id) for t in trained)):
                        word = strategy if name == given[0] else f"{strategy}, {name}"
                        chosen = (strategy, source)
                        jobs = trials_jobs(place, pair, chosen, self.trials, self.code)
                        yield (world, bottom, word), jobs


_Cell = tuple[str, str, str]
"""World, bottom, and strategy with what it reads ("" for presses)."""


def _models_of(parts: Sequence[Mapping[str, Any]]) -> list[str]:
    return list(parts[0]["models"])


def _changes(found: Mapping[_Cell, Sequence[Json]], bottom: str) -> Iterator[Json]:
    """Yield by group what each model loses elsewhere, and what one has over another in a world."""
    here, there = (found.get((world, bottom, ""), []) for world in WORLDS)
    if not here:
        return
    names = _models_of(here)
    across = list(zip(here, there, strict=True))
    for name in names:
        yield {"what": "drop", "bottom": bottom, "from": name, "to": name,
               **iou_change(across, name, name)}  # fmt: skip
    for world, parts in zip(WORLDS, (here, there), strict=True):
        same = list(zip(parts, parts, strict=True))
        for old, new in combinations(names, 2):
            yield {"what": world, "bottom": bottom, "from": old, "to": new,
                   **iou_change(same, old, new)}  # fmt: skip


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


def change_rows(answer: Json) -> list[tuple[str, ...]]:
    """Return each paired change: what is compared, on which bottom, points, number of groups."""
    rows: list[tuple[str, ...]] = []
    for change in answer["changes"]:
        old, new = change["from"], change["to"]
        what = f"{old}: bench to elsewhere" if old == new else f"{change['what']}: {old} to {new}"
        rows.append((what, change["bottom"], signed(change), str(change["n"])))
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
