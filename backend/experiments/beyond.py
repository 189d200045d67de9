"""Strategies beyond the paper and the ceiling, on the episodes of Table 3: closed-loop counts.

A cell is one piece over one bottom under one strategy, cut into jobs of a few trials, so that an
interrupted experiment goes on where it stopped and a table can be read at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, get_args

import numpy as np

from backend.config.bench_facts import bench_sha256
from backend.config.load import parse
from backend.config.method import StackSettings, StrategyName, TowerSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import Outcome
from backend.experiments.by_seed import trial_lines
from backend.experiments.ceiling import CeilingReasoner
from backend.experiments.closed_loop import (
    Model,
    TrialEnd,
    held_in,
    pick_and_place_in_lockstep,
    stack_in_lockstep,
)
from backend.experiments.formats import BEYOND_FORMAT
from backend.experiments.given_models import load_model
from backend.experiments.models import batch_model
from backend.experiments.recipes import CELL_SEEDS, PIECES, STACKING_SEED
from backend.experiments.scenes import Case, start_scene
from backend.experiments.statistics import rate
from backend.experiments.tables import UNSAFE
from backend.experiments.worlds import Setting
from backend.jobs.running import Workplace
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore
from backend.learning.device import one_thread
from backend.objects.catalogue import load_catalogue
from backend.objects.shapes import inset_mm
from backend.objects.surface import face_points
from backend.objects.tower import Tower, judge
from backend.placement.below import Below
from backend.placement.fused import network_of
from backend.placement.strategies import begin
from backend.placement.strategy import XY, Reasoner
from backend.sensing.episode import EpisodeLimits
from backend.simulation.scene import Scene

FORMAT = BEYOND_FORMAT
SINGLE = ("short", "long", "hex20", "rect12x28")
"""The first two are those of the tables, with the same seeds."""
TOWERS = ("short+long", "short+hex20", "short+rect12x28")
"""Bottom-up; the first is that of the tables."""
BOTTOMS = (*SINGLE, *TOWERS)
TOWER_CELLS = 5
"""Cells of towers come so many after those of the bottom that is touched."""
CEILINGS = ("ceiling", "ceiling-diameter")
"""Knowing the bench and the outline; knowing the bench and that the bottom is round."""
STRATEGIES: tuple[str, ...] = (*get_args(StrategyName), *CEILINGS)
CHUNK, TOWER_CHUNK = 2, 10
"""Trials of a job; ten that press side by side on towers take half the time of five times two."""
ENTRY = 992
"""Draws the errors of entries, apart from those of the bench."""
EXACT_MM, GRID_MM = 1e-6, 0.25
STEP_MM, SURE_MM = 3.0, 0.2
"""For the least number of probes: longest step, and how far inside the stable region to be."""
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Beyond:
    """What to compare. ``models``: by piece the job or file that the model FT+Tac comes from."""

    bench: SimulationSettings
    code: str
    models: Mapping[str, str]
    pieces: tuple[str, ...] = ("pot",)
    bottoms: tuple[str, ...] = ("short", "long")
    strategies: tuple[str, ...] = ("paper", "fused", "ceiling")
    trials: int = 50
    entry_sigma_mm: float | None = 1.0
    """How well the simulated operator measures where the upper bottom stands; None: no entry, and
    nobody thinks of the tower."""
    method: StackSettings = field(default_factory=StackSettings)

    def jobs(self) -> list[JobSpec]:
        """Return all jobs: the first trials of every cell come first."""
        return [
            self._job(piece, bottom, strategy, first)
            for first in range(0, self.trials, CHUNK)
            for piece in self.pieces
            for bottom in self.bottoms
            for strategy in self.strategies
            if not (strategy in CEILINGS and bottom in TOWERS)
            if first % _chunk(bottom) == 0
        ]

    def trials_of(self, store: JobStore) -> dict[tuple[str, str, str], list[Json]]:
        """Return all finished trials by strategy, piece and bottom."""
        cells: dict[tuple[str, str, str], list[Json]] = {}
        for spec in self.jobs():
            p = spec.params
            trials = store.result(spec.id)["trials"] if store.has(spec.id) else []
            cells.setdefault((p["strategy"], p["piece"], p["bottom"]), []).extend(trials)
        return cells

    def left_out(self, store: JobStore) -> dict[tuple[str, str, str], int]:
        """Return on how many towers no trial could be made, likewise."""
        found: dict[tuple[str, str, str], int] = {}
        for spec in self.jobs():
            p = spec.params
            cell = p["strategy"], p["piece"], p["bottom"]
            none = store.result(spec.id)["left_out"] if store.has(spec.id) else 0
            found[cell] = found.get(cell, 0) + none
        return found

    def table(self, store: JobStore) -> Json:
        """Return the counts of all finished trials, by cell and pooled by strategy."""
        cells, left_out = self.trials_of(store), self.left_out(store)
        traces = traces_of(self.jobs(), store)
        return {
            "format": FORMAT,
            "bench_sha256": bench_sha256(self.bench),
            "code": self.code,
            "models": dict(self.models),
            "cells": [
                {
                    "strategy": s,
                    "piece": piece,
                    "bottom": bottom,
                    **counted(trials),
                    "left_out": left_out[s, piece, bottom],
                    **traces[s, piece, bottom],
                    "trials": trial_lines(trials),
                }
                for (s, piece, bottom), trials in cells.items()
            ],
            "pooled": [
                {"strategy": s, "tower": tower, **counted(trials)}
                for s in self.strategies
                for tower, bottoms in (("one", SINGLE), ("two", TOWERS))
                if (trials := _of(cells, s, bottoms))
            ],
        }

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return how long a job takes compared with others, for the time that is left."""
        return int(spec.params["trials"]) * (100 if spec.params["strategy"] in CEILINGS else 3)

    def _job(self, piece: str, bottom: str, strategy: str, first: int) -> JobSpec:
        source = "" if strategy in (*CEILINGS, "pick-and-place") else self.models[piece]
        touched = SINGLE.index(bottom.split("+")[-1])
        cell = 10 * PIECES.index(piece) + touched + (TOWER_CELLS if bottom in TOWERS else 0)
        params: Json = {
            "bench": self.bench.model_dump(mode="json"),
            "method": self.method.model_dump(mode="json"),
            "piece": piece,
            "bottom": bottom,
            "strategy": strategy,
            "trials": min(_chunk(bottom), self.trials - first),
        }
        params |= network_named(strategy, self.method)
        if bottom in TOWERS:
            params["entry_sigma_mm"] = self.entry_sigma_mm
        seed = STACKING_SEED + CELL_SEEDS * cell + first
        return JobSpec("beyond", params, seed, (source,) if source else (), self.code)


def network_named(strategy: str, method: StackSettings) -> Json:
    """Return what a job of ``strategy`` says of its network: another one makes another job."""
    if strategy != "fused":
        return {}
    return {"fused_sha256": network_of(method.fused).card.weights_sha256}


def _chunk(bottom: str) -> int:
    """Return how many trials a job has at most."""
    return TOWER_CHUNK if bottom in TOWERS else CHUNK


def traces_of(jobs: Iterable[JobSpec], store: JobStore) -> dict[tuple[str, str, str], Json]:
    """Return the first seed and the finished jobs of each cell: strategy, piece, bottom."""
    found: dict[tuple[str, str, str], Json] = {}
    for spec in jobs:
        p = spec.params
        cell = p["strategy"], p["piece"], p["bottom"]
        trace = found.setdefault(cell, {"seed": spec.seed, "jobs": []})
        if store.has(spec.id):
            trace["jobs"].append(spec.id)
    return found


def _of(
    cells: Mapping[tuple[str, str, str], Sequence[Json]], strategy: str, bottoms: tuple[str, ...]
) -> list[Json]:
    """Return all trials of a strategy over some bottoms."""
    return [
        t for (s, _, b), trials in cells.items() if s == strategy and b in bottoms for t in trials
    ]


def counted(trials: Sequence[Mapping[str, Any]]) -> Json:
    """Count outcomes: placed, unsafe releases, probes of the placed, and how many were spare."""
    outcomes = [trial["outcome"] for trial in trials]
    placed = [trial for trial in trials if trial["outcome"] == Outcome.PLACED.value]
    spare = [t["probes"] - t["least_probes"] for t in placed]
    return {
        "outcomes": {word: outcomes.count(word) for word in sorted(set(outcomes))},
        "placed": rate(len(placed), len(trials)).as_json(),
        "unsafe": rate(sum(word in UNSAFE for word in outcomes), len(trials)).as_json(),
        "probes": float(np.mean([t["probes"] for t in placed])) if placed else None,
        "excess_probes_median": float(np.median(spare)) if spare else None,
    }


def beyond(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Run some trials of one cell; every trial counts, whatever its outcome."""
    p, catalogue = spec.params, load_catalogue()
    bench = parse(SimulationSettings, p["bench"], "job")
    case = Case.of(catalogue, p["piece"], tuple(p["bottom"].split("+")), bench)
    one_thread()
    scenes = [scene for k in range(p["trials"]) if (scene := start_scene(case, spec.seed + k))]
    method, limits = parse(StackSettings, p["method"], "job"), EpisodeLimits()
    strategy = p["strategy"]
    ends: list[TrialEnd] = []
    if not scenes:
        pass
    elif strategy == "pick-and-place":
        ends = pick_and_place_in_lockstep(scenes, method, limits)
    elif strategy in CEILINGS:
        begun = knowing(case, diameter_known=strategy == CEILINGS[0])
        ends = stack_in_lockstep(scenes, no_model(case), method, limits, begun)
    else:
        model = batch_model(load_model(spec.inputs[0], place.store), case.piece)
        chosen = StackSettings.model_validate({**p["method"], "strategy": strategy})
        sigma_mm = p.get("entry_sigma_mm")
        told = None if sigma_mm is None else _told(case, sigma_mm, chosen, model)
        ends = stack_in_lockstep(scenes, model, chosen, limits, told)
    return {
        "bench_sha256": bench_sha256(bench),
        "left_out": p["trials"] - len(scenes),
        "trials": [
            {**end.as_json(), "least_probes": least_probes(scene)}
            for scene, end in zip(scenes, ends, strict=True)
        ],
    }


def least_probes(scene: Scene) -> int:
    """Return how many probes one would need who knew everything: at the start, then every 3 mm.

    The way is that to the centre of the bottom: nearest for round ones, near it for the others. On
    a tower it is that to the nearest place of a grid at which every interface holds.
    """
    start = np.asarray(scene.start_mm)
    if len(scene.bottoms.bodies) > 1:
        return 1 + ceil(_way_on_tower_mm(scene) / STEP_MM)
    length = float(np.hypot(*start))
    towards = start / max(length, 1e-9)
    for way in np.arange(0.0, length, 0.05):
        x, y = start - way * towards
        body = scene.piece.body((float(x), float(y)))
        if judge(Tower((*scene.bottoms.bodies, body))).margin_mm >= SURE_MM:
            return 1 + ceil(way / STEP_MM)
    return 1 + ceil(length / STEP_MM)


def _way_on_tower_mm(scene: Scene) -> float:
    """Return the distance from the start to where the whole tower holds; 0 if there is none."""
    bodies = scene.bottoms.bodies
    steps = np.diff([body.at_mm for body in bodies], axis=0)
    offset_mm = tuple((float(x), float(y)) for x, y in steps)
    below = Below(bodies, offset_mm, EXACT_MM, scene.piece.mass_g)
    touched = bodies[-1].upper
    assert touched is not None
    reach = max(touched.half_extents_mm)
    line = np.arange(-reach, reach + GRID_MM, GRID_MM)
    com = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    least = np.minimum(inset_mm(touched, com), below.insets_mm(com).min(axis=0))
    places = com[least >= SURE_MM] - np.asarray(scene.piece.com_xy_mm)
    if not len(places):
        return 0.0
    return float(np.hypot(*(places - np.asarray(scene.start_mm)).T).min())


def _told(
    case: Case, sigma_mm: float, settings: StackSettings, model: Model
) -> Callable[[Scene, XY], Reasoner]:
    """Begin trials on towers with what a simulated operator measured: truth and an error."""

    def begun(scene: Scene, at: XY) -> Reasoner:
        rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([scene.seed, ENTRY])))
        steps = np.diff([body.at_mm for body in scene.bottoms.bodies], axis=0)
        entered = steps + sigma_mm * rng.standard_normal(steps.shape)
        offset_mm = tuple((float(x), float(y)) for x, y in entered)
        entry = TowerSettings(offset_mm=offset_mm, sigma_mm=sigma_mm)
        below = Below.entered(case.piece, case.bottoms, entry)
        return begin(held_in(scene, model.base_rate, below), settings, at)

    return begun


def knowing(case: Case, *, diameter_known: bool) -> Callable[[Scene, XY], Reasoner]:
    """Return how the ceiling begins a trial."""
    setting = Setting(case.piece, case.bottoms[0], case.settings, diameter_known)
    return lambda scene, at: CeilingReasoner(setting, at, scene.seed)


def no_model(case: Case) -> Model:
    """Return a model that answers nothing: the ceiling reads the signals themselves."""
    points = face_points(case.piece.face)
    return Model(lambda seen: np.full((len(seen), len(points)), 0.5), points, None)
