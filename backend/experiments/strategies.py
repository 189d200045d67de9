"""Jobs that compare strategies beyond the paper in closed-loop trials, those of Table 3.

A cell is one piece over one bottom under one strategy. It is split into jobs of a few trials, so
that an interrupted experiment resumes and a table can be read at any time. A name may carry
settings of the method, as in ``fused:policy.least_probes=2``.

On the bottom ``fresh`` every trial has an outline of its own, drawn by ``fresh_bottom``.

``beyond.json`` stores one line per trial beside the counts: ``seed outcome
probes least`` (``least`` as in ``least_probes``), and the class of a fresh outline; on a face that
is not flat the outline, its kind and the largest margin of any place (``best_margin_mm``).
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import ceil
from typing import Any, cast, get_args

import numpy as np

from touchdown.backend import config, geometry
from touchdown.backend.calibration import PoseReadings, WeighedPiece, estimate_held_piece
from touchdown.backend.core import Outcome, Pose, pose_rotation
from touchdown.backend.experiments import tables
from touchdown.backend.experiments.models import batch_model, load_model
from touchdown.backend.experiments.oracle import OracleSetting, OracleStrategy
from touchdown.backend.experiments.statistics import IntervalEstimate, estimate_rate
from touchdown.backend.experiments.trials import (
    FRESH,
    FRESH_TRIAL_SEED,
    WORLDS,
    BatchModel,
    BatchTrialResult,
    SceneSetup,
    bottom_facts,
    grasped_piece_in,
    pair_of,
    pick_and_place_in_lockstep,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.learning import use_one_thread
from touchdown.backend.placement import XY, Strategy, SupportTower, load_network_of, make_strategy
from touchdown.backend.runs import LEANS, LEARNED, StackRequest, StrategyChoice
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene, simulate_weighing, touched_margins_mm

Json = dict[str, Any]
Cell = tuple[str, str, str]  # strategy, piece, bottom
TRIAL_WORDS = ("seed", "outcome", "probes", "least_probes", "outline", "surface", "best_mm")
SURFACE_KINDS = ("tilted", "stepped", "domed")
POSSIBLE_MM = 1.0  # margin of a place at which a piece can be expected to be placed


def trial_lines(trials: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return one line per trial."""
    return [" ".join(str(t[k]) for k in TRIAL_WORDS if k in t) for t in trials]


# the first two are those of the tables, with the same seeds
SINGLE_BOTTOMS = ("short", "long", "hex20", "rect12x28")
# bottom-up; the first is that of the tables
TOWERS = ("short+long", "short+hex20", "short+rect12x28")
BOTTOMS = (*SINGLE_BOTTOMS, *TOWERS, FRESH)
TOWER_CELLS = 5  # offset of the cell number of a tower from that of its upper bottom
CEILING = "ceiling"  # the oracle, which knows bench and outline
STRATEGIES: tuple[str, ...] = (*get_args(StrategyChoice), CEILING)
EVALUATED_STRATEGIES = tuple(s for s in STRATEGIES if s not in (CEILING, "pick-and-place"))
# ten parallel trials on towers take half the time of five times two
TRIALS_PER_JOB, TOWER_TRIALS_PER_JOB = 2, 10  # the latter also on fresh outlines
COMPARED_PIECES = (*tables.PIECES, "brick")  # the last one is heavy enough to be weighed
ENTRY_STREAM = 992  # random stream of the entry errors, separate from the bench
ENTRY_SIGMA_MM = 1.0  # error of the simulated operator who measures the place of the upper bottom
EXACT_MM, GRID_MM = 1e-6, 0.25
# for the least number of probes: longest step, inset from the edge of the stable region
STEP_MM, SAFE_INSET_MM = 3.0, 0.2
REGION_GRID_MM = 0.5  # of places on a region
MODEL_FREE = (CEILING, *LEARNED, "pick-and-place")  # strategies without a model of the piece

CELL_KEYS = ("strategy", "piece", "bottom")


@dataclass(frozen=True, slots=True)
class ClosedLoopComparison:
    """Comparison of strategies: ``trials`` in closed loop of each cell.

    ``models``: by piece the job or file of the model FT+Tac. ``outline_seed``: hexadecimal seed of
    the fresh outlines.
    """

    bench: config.SimulationSettings
    code: str
    models: Mapping[str, str]
    pieces: tuple[str, ...] = ("pot",)
    bottoms: tuple[str, ...] = ("short", "long")
    strategies: tuple[str, ...] = ("paper", "fused", "ceiling")
    trials: int = 50
    method: config.StackSettings = field(default_factory=config.StackSettings)
    outline_seed: str = geometry.FRESH_SEED

    def jobs(self) -> list[JobSpec]:
        """Return the jobs of the trials; the first trials of every cell come first."""
        return [
            self._loop(piece, bottom, strategy, first)
            for first in range(0, self.trials, TRIALS_PER_JOB)
            for piece in self.pieces
            for bottom in self.bottoms
            for strategy in self.strategies
            if not (strategy == CEILING and bottom in TOWERS)
            if first % _chunk(bottom) == 0
        ]

    def trials_of(self, store: JobStore) -> dict[Cell, list[Json]]:
        """Return all finished trials by strategy, piece and bottom."""
        return {cell: _trials(done) for cell, (_, done) in _finished(self.jobs(), store).items()}

    def table(self, store: JobStore) -> Json:
        """Return the counts of all finished trials, by cell and pooled by strategy."""
        cells = _finished(self.jobs(), store)
        trials = {cell: _trials(done) for cell, (_, done) in cells.items()}
        return {
            "format": tables.BEYOND_FORMAT,
            "bench_sha256": config.bench_sha256(self.bench),
            "code": self.code,
            **tables.provenance(self.jobs(), store),
            "models": dict(self.models),
            "cells": [
                {
                    **dict(zip(CELL_KEYS, cell, strict=True)),
                    **count_outcomes(trials[cell]),
                    "left_out": sum(result["left_out"] for result in done.values()),
                    **trace,
                    "trials": trial_lines(trials[cell]),
                }
                for cell, (trace, done) in cells.items()
            ],
            "pooled": [
                {"strategy": s, "tower": tower, **outline, **count_outcomes(some)}
                for s in self.strategies
                for tower, outline, some in _pooled_groups(s, trials)
                if some
            ],
        }

    @staticmethod
    def first_trial(spec: JobSpec) -> int:
        """Return the number of the first trial of a job in its cell, from 0."""
        return (spec.seed - tables.STACKING_SEED) % tables.CELL_SEEDS

    def _loop(self, piece: str, bottom: str, strategy: str, first: int) -> JobSpec:
        params: Json = {"trials": min(_chunk(bottom), self.trials - first)}
        if bottom == FRESH:
            seed = FRESH_TRIAL_SEED + tables.CELL_SEEDS * COMPARED_PIECES.index(piece) + first
            params["outline_seed"] = self.outline_seed
        else:
            touched = SINGLE_BOTTOMS.index(bottom.split("+")[-1])
            cell = 10 * COMPARED_PIECES.index(piece) + touched
            cell += TOWER_CELLS * (bottom in TOWERS)
            seed = tables.STACKING_SEED + tables.CELL_SEEDS * cell + first
        return self._job("beyond", (strategy, piece, bottom), seed, params)

    def _job(self, kind: str, cell: Cell, seed: int, params: Json) -> JobSpec:
        strategy, piece, _ = cell
        source = "" if base_strategy(strategy) in MODEL_FREE else self.models[piece]
        params |= {
            "bench": self.bench.model_dump(mode="json"),
            "method": self.method.model_dump(mode="json"),
            **dict(zip(CELL_KEYS, cell, strict=True)),
            **network_params(strategy, self.method),
        }
        return JobSpec(
            kind, params, seed, (source,) if source else (), tables.job_code(kind, self.code)
        )


def _finished(jobs: Iterable[JobSpec], store: JobStore) -> dict[Cell, tuple[Json, dict[int, Json]]]:
    """Return of each cell its trace (first seed, finished jobs), and the results by first seed."""
    found: dict[Cell, tuple[Json, dict[int, Json]]] = {}
    for spec in jobs:
        cell = (spec.params["strategy"], spec.params["piece"], spec.params["bottom"])
        trace, done = found.setdefault(cell, ({"seed": spec.seed, "jobs": []}, {}))
        if store.has(spec.id):
            trace["jobs"].append(spec.id)
            done[spec.seed] = dict(store.result(spec.id))
    return found


def _trials(done: Mapping[int, Json]) -> list[Json]:
    return [trial for result in done.values() for trial in result["trials"]]


def base_strategy(name: str) -> str:
    """Return the strategy of a name with settings."""
    return name.partition(":")[0]


def method_of(name: str, method: config.StackSettings) -> config.StackSettings:
    """Return ``method`` with the strategy and the settings of a name, as ``fused:fused.risk=0.05``
    or ``fused:weigh=true``.

    Raises ``InputError`` for an unknown setting, or a value that is none.
    """
    strategy, *changes = name.split(":")
    content = StackRequest(strategy=cast("StrategyChoice", strategy)).method(method).model_dump()
    for change in changes:
        key, _, text = change.partition("=")
        group, _, field_name = key.partition(".")
        try:
            value = json.loads(text)
        except ValueError:
            value = text
        whole = {**dict(content.get(group) or {}), field_name: value} if field_name else value
        content[group] = whole
    return config.parse_settings(config.StackSettings, content, name)


def network_params(strategy: str, method: config.StackSettings) -> Json:
    """Return the job parameters that identify the network of ``strategy``."""
    if base_strategy(strategy) not in LEARNED:
        return {}
    rules = method_of(strategy, method).fused
    return {"fused_sha256": load_network_of(rules).card.weights_sha256}


def _chunk(bottom: str) -> int:
    return TOWER_TRIALS_PER_JOB if bottom in (*TOWERS, FRESH) else TRIALS_PER_JOB


def _pooled_groups(
    strategy: str, cells: Mapping[Cell, list[Json]]
) -> Iterator[tuple[str, Json, list[Json]]]:
    """Yield the trials of a strategy by number of bottoms, and by class of fresh outlines."""
    for tower, bottoms in (("one", SINGLE_BOTTOMS), ("two", TOWERS), (FRESH, (FRESH,))):
        chosen = [
            t for c, own in cells.items() if c[0] == strategy and c[2] in bottoms for t in own
        ]
        yield tower, {}, chosen
    classes = {name: (name,) for name in geometry.FRESH_CLASSES} | {
        "never trained on": geometry.UNTRAINED_CLASSES
    }
    for name, outlines in classes.items():
        yield FRESH, {"outline": name}, [t for t in chosen if t["outline"] in outlines]
    for kind in SURFACE_KINDS:
        yield FRESH, {"outline": kind}, [t for t in chosen if t.get("surface") == kind]


def count_outcomes(trials: Sequence[Mapping[str, Any]]) -> Json:
    """Count outcomes, unsafe releases, and probes of placed trials."""
    outcomes = [trial["outcome"] for trial in trials]
    placed = [trial for trial in trials if trial["outcome"] == Outcome.PLACED.value]
    spare = [t["probes"] - t["least_probes"] for t in placed]
    possible = [t for t in trials if float(t.get("best_mm", 0.0)) >= POSSIBLE_MM]
    there = estimate_rate(sum(t in placed for t in possible), len(possible)).as_json()
    uneven = {"possible": estimate_rate(len(possible), len(trials)).as_json(), "there": there}
    return {
        **(uneven if any("best_mm" in t for t in trials) else {}),
        "outcomes": {word: outcomes.count(word) for word in sorted(set(outcomes))},
        "placed": estimate_rate(len(placed), len(trials)).as_json(),
        "unsafe": estimate_rate(
            sum(word in tables.UNSAFE_OUTCOMES for word in outcomes), len(trials)
        ).as_json(),
        "unsafe_of_released": released_unsafely(Counter(outcomes)).as_json(),
        "probes": float(np.mean([t["probes"] for t in placed])) if placed else None,
        "excess_probes_median": float(np.median(spare)) if spare else None,
    }


def released_unsafely(outcomes: Mapping[str, int]) -> IntervalEstimate:
    """Return the share of the releases after which the piece fell, from counts of outcomes."""
    fell = outcomes.get(Outcome.FELL.value, 0)
    return estimate_rate(fell, fell + outcomes.get(Outcome.PLACED.value, 0))


def run_closed_loop(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run trials of one cell; every trial counts."""
    p = spec.params
    use_one_thread()
    seeds = range(spec.seed, spec.seed + p["trials"])
    cases = [SceneSetup.of_trial(p, seed) for seed in seeds]
    case = cases[0]
    world = WORLDS[p.get("world", "bench")]
    pairs = [
        (each, scene)
        for each, seed in zip(cases, seeds, strict=True)
        if (scene := start_scene(each, seed))
    ]
    scenes = [scene for _, scene in pairs]
    results: list[BatchTrialResult] = []
    if p["strategy"] == "pick-and-place" and scenes:
        method = config.parse_settings(config.StackSettings, p["method"], "job")
        results = pick_and_place_in_lockstep(scenes, method, world)
    elif scenes:
        method, model, create = _strategy_of(spec, place, pairs)
        results = stack_in_lockstep(scenes, model, method, EpisodeLimits(), create, world)
    return {
        "bench_sha256": config.bench_sha256(case.settings),
        "left_out": p["trials"] - len(scenes),
        "trials": [
            {
                **end.as_json(),
                "least_probes": least_probes(scene),
                **bottom_facts(p["bottom"], each, scene),
            }
            for (each, scene), end in zip(pairs, results, strict=True)
        ],
    }


def _strategy_of(
    spec: JobSpec, place: JobContext, pairs: Sequence[tuple[SceneSetup, Scene]]
) -> tuple[config.StackSettings, BatchModel, Callable[[Scene, XY], Strategy]]:
    """Return method, model and factory of the strategy of a job, for scenes and their set-ups."""
    p, case = spec.params, pairs[0][0]
    method, name = config.parse_settings(config.StackSettings, p["method"], "job"), p["strategy"]
    if name == CEILING:
        return method, uninformed_model(case), oracle_factory(pairs)
    method, model = method_of(name, method), uninformed_model(case)
    if spec.inputs:
        model = batch_model(load_model(spec.inputs[0], place.store), case.piece)
    return method, model, _informed_strategy(case, method, model)


def least_probes(scene: Scene) -> int:
    """Return the number of probes that complete knowledge would need: one, and one more every 3 mm.

    The path leads to the centre of the bottom: the shortest one for round bottoms, nearly so for
    others. On a region or a tower it leads to the nearest grid point where every interface holds.
    """
    start = np.asarray(scene.start_mm)
    if len(scene.bottoms.bodies) > 1 or scene.surface.kind == "region":
        return 1 + ceil(_way_on_grid_mm(scene) / STEP_MM)
    length = float(np.hypot(*start))
    towards = start / max(length, 1e-9)
    for way in np.arange(0.0, length, 0.05):
        x, y = start - way * towards
        body = scene.piece.body((float(x), float(y)))
        tower = geometry.Tower((*scene.bottoms.bodies, body))
        if geometry.judge_tower(tower, sign_only=True).margin_mm >= SAFE_INSET_MM:
            return 1 + ceil(way / STEP_MM)
    return 1 + ceil(length / STEP_MM)


def _way_on_grid_mm(scene: Scene) -> float:
    """Return the distance from the start to the nearest stable place; 0 if there is none."""
    bodies, own_mm = scene.bottoms.bodies, scene.piece.com_xy_mm
    reach = max(scene.surface.half_extents_mm)
    pitch = GRID_MM if len(bodies) > 1 else REGION_GRID_MM
    line = np.arange(-reach, reach + pitch, pitch)
    com = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    if len(bodies) > 1:
        steps = np.diff([body.at_mm for body in bodies], axis=0)
        offset_mm = tuple((float(x), float(y)) for x, y in steps)
        below = SupportTower(bodies, offset_mm, EXACT_MM, scene.piece.mass_g)
        inset = np.minimum(geometry.inset_mm(scene.surface, com), below.insets_mm(com).min(axis=0))
    else:
        inset = touched_margins_mm(scene, own_mm, com)
    places = com[inset >= SAFE_INSET_MM] - np.asarray(own_mm)
    if not len(places):
        return 0.0
    return float(np.hypot(*(places - np.asarray(scene.start_mm)).T).min())


def _informed_strategy(
    case: SceneSetup, settings: config.StackSettings, model: BatchModel
) -> Callable[[Scene, XY], Strategy]:
    """Create strategies that know what an operator enters and what a weighing measures."""

    def create(scene: Scene, at: XY) -> Strategy:
        below = None
        if len(case.bottoms) > 1:
            rng = np.random.default_rng([scene.seed, scene.number, ENTRY_STREAM])
            steps = np.diff([body.at_mm for body in scene.bottoms.bodies], axis=0)
            entered = steps + ENTRY_SIGMA_MM * rng.standard_normal(steps.shape)
            offset_mm = tuple((float(x), float(y)) for x, y in entered)
            entry = config.TowerSettings(offset_mm=offset_mm, sigma_mm=ENTRY_SIGMA_MM)
            below = SupportTower.entered(case.piece, case.bottoms, entry)
        held = grasped_piece_in(scene, model, below)
        if settings.weigh:
            found = weighed_piece(scene)
            sigma = float(found.sigma_mm[:2].max())
            held = replace(held, com_xy_mm=pair_of(found.com_mm), com_sigma_mm=sigma)
        return make_strategy(held, settings, at)

    return create


def weighed_piece(scene: Scene) -> WeighedPiece:
    """Return the result of weighing the piece of a scene, by the estimator of the bench."""
    turns = np.stack([pose_rotation(Pose(0.0, 0.0, 0.0, rx, ry)) for rx, ry in LEANS])
    rows = zip(*simulate_weighing(scene, turns), strict=True)
    empty, held = (PoseReadings(t_s, turns, wrenches, sigmas) for t_s, wrenches, sigmas in rows)
    lever_mm = scene.grip_height_mm + scene.settings.wrist.height_mm
    return estimate_held_piece(empty, held, lever_mm)


def oracle_factory(pairs: Iterable[tuple[SceneSetup, Scene]]) -> Callable[[Scene, XY], Strategy]:
    """Return the factory of the oracle strategy for scenes and their set-ups."""
    settings = {
        scene.number: OracleSetting(case.piece, case.bottoms[0], case.settings)
        for case, scene in pairs
    }
    return lambda scene, at: OracleStrategy(settings[scene.number], at, scene.seed)


def uninformed_model(case: SceneSetup) -> BatchModel:
    """Return a model without predictions, for the oracle, which reads the signals."""
    points = geometry.face_points(case.piece.face)
    return BatchModel(lambda seen: np.full((len(seen), len(points)), 0.5), points, None)
