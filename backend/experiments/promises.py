"""What strategies say before anything is let go: the groups of Table 2, asked of each of them.

After n probes of a group: would the piece be released at the place of the first one, would it
rather stand there than fall, and does the map keep what its probabilities promise? Every strategy,
the ceiling too, gets the same presses.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.config.load import parse
from backend.config.method import StackSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import BeliefMap, ContactPatch, FloatArray
from backend.experiments.beyond import (
    CEILINGS,
    SINGLE,
    knowing,
    network_named,
    no_model,
    traces_of,
)
from backend.experiments.by_seed import group_lines
from backend.experiments.calibration import reliability
from backend.experiments.closed_loop import Model
from backend.experiments.given_models import load_model
from backend.experiments.models import batch_model
from backend.experiments.recipes import CELL_SEEDS, PIECES, STATIC_SEED
from backend.experiments.scenes import Case, probing_scene
from backend.experiments.scoring import FUSED
from backend.experiments.statics import Groups, probe_groups
from backend.experiments.statistics import Binary, mean
from backend.experiments.tables import scored
from backend.jobs.running import Workplace
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore
from backend.learning.device import one_thread
from backend.learning.metrics import LEVEL
from backend.objects.catalogue import load_catalogue
from backend.placement.strategies import begin
from backend.placement.strategy import XY, Held, Reasoner, Touched

CHUNK = 2
"""Groups of a job: even, so that stable and unstable first places alternate as in Table 2."""
PROBES = max(FUSED)
RELIABLE_AFTER = (1, 3)
IOU_AFTER = 3
STEPS = 400
"""Probabilities are counted in so many steps."""
BELIEVES_NOTHING = ("zero-wrench",)
"""Strategies without a belief in cells."""
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Promises:
    """Which strategies to ask, over ``groups`` groups of each piece and bottom."""

    bench: SimulationSettings
    code: str
    models: Mapping[str, str]
    pieces: tuple[str, ...]
    bottoms: tuple[str, ...]
    strategies: tuple[str, ...]
    groups: int
    method: StackSettings = field(default_factory=StackSettings)

    def jobs(self) -> list[JobSpec]:
        """Return all jobs: the first groups of every cell come first."""
        return [
            self._job(piece, bottom, strategy, first)
            for first in range(0, self.groups, CHUNK)
            for piece in self.pieces
            for bottom in self.bottoms
            if bottom in SINGLE
            for strategy in self.strategies
            if strategy != "pick-and-place"
        ]

    def answers(self, store: JobStore) -> dict[tuple[str, str, str], dict[int, Json]]:
        """Return what is finished: by strategy, piece and bottom, then by the first seed."""
        found: dict[tuple[str, str, str], dict[int, Json]] = {}
        for spec in self.jobs():
            p = spec.params
            cell = found.setdefault((p["strategy"], p["piece"], p["bottom"]), {})
            if store.has(spec.id):
                cell[spec.seed] = dict(store.result(spec.id))
        return found

    def table(self, store: JobStore) -> Json:
        """Return the scores of every cell, and pooled by strategy."""
        cells, traces = self.answers(store), traces_of(self.jobs(), store)
        pooled = {
            s: [a for k, v in cells.items() if k[0] == s for a in v.values()] for s, *_ in cells
        }
        return {
            "cells": [
                {
                    "strategy": s,
                    "piece": p,
                    "bottom": b,
                    **scores(list(answers.values())),
                    **traces[s, p, b],
                    "asked": group_lines(answers),
                }
                for (s, p, b), answers in cells.items()
            ],
            "pooled": [{"strategy": s, **scores(answers)} for s, answers in pooled.items()],
        }

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return how long a job takes compared with those of ``Beyond``."""
        return CHUNK * (200 if spec.params["strategy"] in CEILINGS else 3)

    def _job(self, piece: str, bottom: str, strategy: str, first: int) -> JobSpec:
        source = "" if strategy in CEILINGS else self.models[piece]
        params = {
            "bench": self.bench.model_dump(mode="json"),
            "method": self.method.model_dump(mode="json"),
            "piece": piece,
            "bottom": bottom,
            "strategy": strategy,
            "groups": min(CHUNK, self.groups - first),
            **network_named(strategy, self.method),
        }
        cell = 10 * PIECES.index(piece) + SINGLE.index(bottom)
        seed = STATIC_SEED + CELL_SEEDS * cell + first
        return JobSpec("promises", params, seed, (source,) if source else (), self.code)


def promises(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Press some groups of one cell and ask one strategy after each probe."""
    p, catalogue = spec.params, load_catalogue()
    bench = parse(SimulationSettings, p["bench"], "job")
    case = Case.of(catalogue, p["piece"], (p["bottom"],), bench)
    one_thread()
    seeds = [spec.seed + g for g in range(p["groups"])]
    groups = probe_groups(case, seeds, PROBES)
    strategy = p["strategy"]
    settings = StackSettings.model_validate({**p["method"], "strategy": _as_setting(strategy)})
    if strategy in CEILINGS:
        model, start = no_model(case), knowing(case, diameter_known=strategy == CEILINGS[0])
    else:
        model = batch_model(load_model(spec.inputs[0], place.store), case.piece)
        start = None
    begun = _begun(case, settings, model, start)
    asked = Asked(case, believes=strategy not in BELIEVES_NOTHING)
    for g in range(len(groups.observation)):
        asked.group(groups, g, begun(seeds[g], _pair(groups.offset_mm[g, 0])), model)
    margins = [[_finite(m) for m in pair] for pair in groups.margin_mm]
    return {"margin_mm": margins, "left_out": groups.left_out, **asked.as_json()}


class Asked:
    """Collects the answers of one strategy, group by group."""

    def __init__(self, case: Case, *, believes: bool) -> None:
        self._case, self._believes = case, believes
        self._says: dict[str, list[bool]] = {str(n): [] for n in FUSED}
        self._likely: dict[str, list[bool]] = {str(n): [] for n in FUSED}
        self._iou: list[float] = []
        self._counts = {str(n): np.zeros((3, STEPS)) for n in RELIABLE_AFTER}

    def group(self, groups: Groups, g: int, reasoner: Reasoner, model: Model) -> None:
        """Let ``reasoner`` conclude from the probes of group ``g`` and note what it says."""
        first = _pair(groups.offset_mm[g, 0])
        probability = model.predict(groups.observation[g])
        for k in range(PROBES):
            patch = ContactPatch(model.points_mm.copy(), probability[k])
            here = _pair(groups.offset_mm[g, k])
            concluded = reasoner.conclude(Touched(groups.observation[g, k], patch, here))
            n = str(k + 1)
            if n in self._says:
                self._says[n].append(reasoner.stable_at(first))
                self._likely[n].append(reasoner.likely_at(first))
            if self._believes and k + 1 in RELIABLE_AFTER:
                self._note(concluded.map, groups, g, k + 1)

    def _note(self, belief: BeliefMap, groups: Groups, g: int, probes: int) -> None:
        cells = belief.cell_centres_mm()
        offsets = groups.offset_mm[g, :probes]
        under = np.any([self._case.piece.face.contains(cells - o) for o in offsets], axis=0)
        covered = belief.covered & under
        shift = groups.true_mm[g, 0] - groups.offset_mm[g, 0]
        real = self._case.bottoms[0].face.contains(cells[covered] + shift)
        promised = belief.probability[covered]
        step = np.minimum((promised * STEPS).astype(int), STEPS - 1)
        for row, weight in enumerate((np.ones(len(step)), real, promised)):
            self._counts[str(probes)][row] += np.bincount(step, weight, STEPS)
        if probes == IOU_AFTER:
            said = promised > LEVEL
            either = int((said | real).sum())
            self._iou.append(round(int((said & real).sum()) / either, 4) if either else 1.0)

    def as_json(self) -> Json:
        """Return all answers; ``cells`` per n: count, how many supported, sum of promises."""
        verdicts = {"says": self._says, "likely": self._likely}
        if not self._believes:
            return verdicts
        cells = {n: np.round(rows, 4).tolist() for n, rows in self._counts.items()}
        return {**verdicts, "iou": self._iou, "cells": cells}


def scores(answers: Sequence[Json]) -> Json:
    """Return balanced accuracy by n, reliability by n and IoU of some answers."""
    charts = {}
    for n in map(str, RELIABLE_AFTER):
        rows = [np.array(answer["cells"][n]) for answer in answers if "cells" in answer]
        if rows:
            charts[n] = chart_of(np.sum(rows, axis=0))
    iou = [value for answer in answers for value in answer.get("iou", ())]
    return {
        "groups": sum(len(answer["margin_mm"]) for answer in answers),
        "left_out": sum(answer["left_out"] for answer in answers),
        "released": {n: _verdicts(answers, "says", n).as_json() for n in map(str, FUSED)},
        "likely": {n: _verdicts(answers, "likely", n).as_json() for n in map(str, FUSED)},
        "reliability": charts,
        "iou": mean(iou).as_json(),
    }


def _verdicts(answers: Sequence[Json], kind: str, n: str) -> Binary:
    """Count the verdicts after ``n`` probes against every interface."""
    counts = Binary(0, 0, 0, 0)
    for answer in answers:
        counts += scored(answer[kind][n], answer["margin_mm"], interface=1)[0]
    return counts


def chart_of(counts: FloatArray) -> Json:
    """Return the reliability of counted probabilities (3, STEPS); cells of a step count alike."""
    count = counts[0].astype(int)
    some = count > 0
    promised = np.repeat(counts[2][some] / counts[0][some], count[some])
    came = np.repeat(counts[1][some] / counts[0][some], count[some])
    chart = reliability(promised, came)
    return {
        "promised": [round(v, 4) for v in chart.promised],
        "came": [round(v, 4) for v in chart.came],
        "count": list(chart.count),
        "ece": round(chart.ece, 4),
    }


def _begun(
    case: Case, settings: StackSettings, model: Model, start: Callable[..., Reasoner] | None
) -> Callable[[int, XY], Reasoner]:
    if start is not None:
        return lambda seed, at: start(probing_scene(case, seed), at)
    height_mm = case.piece.grip_height_mm
    assert height_mm is not None
    sensor_mm = case.settings.wrist.height_mm
    held = Held(case.piece.com_xy_mm, height_mm, model.base_rate, sensor_mm)
    return lambda seed, at: begin(held, settings, at)


def _as_setting(strategy: str) -> str:
    return "paper" if strategy in CEILINGS else strategy


def _finite(value: float) -> float | None:
    """Return a margin for JSON: None where nothing is beneath."""
    return round(float(value), 4) if np.isfinite(value) else None


def _pair(values: FloatArray | NDArray[np.float64]) -> XY:
    return float(values[0]), float(values[1])
