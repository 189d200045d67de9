"""When learned fusion should let go: its trials on bottoms and seeds of their own, held against any
rule.

No trial ends by a release: after every press the move follows that the strategy chooses, up to the
most probes. What it says of the centre of mass is kept beside the truth, so that all rules are
compared on the same trials. Nothing of the tables is asked: neither their bottoms nor their seeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from backend.config.load import parse
from backend.config.method import FusedSettings, StackSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import Outcome
from backend.experiments.beyond import no_model
from backend.experiments.closed_loop import TrialEnd, held_in, stack_in_lockstep
from backend.experiments.scenes import Case, start_scene
from backend.jobs.running import Workplace
from backend.jobs.spec import JobSpec
from backend.learning.device import one_thread
from backend.objects.catalogue import load_catalogue
from backend.objects.shapes import Outline, circle, inset_mm, rectangle, square
from backend.placement.fused import FusedReasoner
from backend.placement.strategy import XY, Conclusion, Held, Touched
from backend.sensing.episode import EpisodeLimits
from backend.simulation.scene import Scene

BOTTOMS: Mapping[str, Outline] = {
    "disc 22": circle(22.0),
    "square 17": square(17.0),
    "disc 16": circle(16.0),
    "rectangle 13 x 19": rectangle(13.0, 19.0),
}
"""Free ones of 30 mm and 30 g, none of them of the tables."""
WEIGHTS = "fused.safetensors"
PIECES = ("mushroom", "barrel", "pot")
RULE_SEED, CELL_SEEDS = 45_000_000, 10_000
CHUNK = 8
INSETS_MM = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
RISKS = (0.1, 0.07, 0.05, 0.03, 0.02, 0.01)
NEVER_MM = 99.0
Json = dict[str, Any]


def rule_jobs(bench: SimulationSettings, code: str, network: str, trials: int) -> list[JobSpec]:
    """Return the jobs of ``trials`` trials of every piece on every bottom, a few at a time."""
    return [
        JobSpec(
            "fused-trials",
            {
                "bench": bench.model_dump(mode="json"),
                "piece": piece,
                "bottom": bottom,
                "trials": min(CHUNK, trials - first),
            },
            RULE_SEED + CELL_SEEDS * (len(BOTTOMS) * number + at) + first,
            (network,),
            code,
        )
        for first in range(0, trials, CHUNK)
        for number, piece in enumerate(PIECES)
        for at, bottom in enumerate(BOTTOMS)
    ]


def fused_trials(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Run some trials of one piece on one bottom with the network of the input job."""
    one_thread()
    weights = place.store.folder(spec.inputs[0]) / WEIGHTS
    bench = parse(SimulationSettings, spec.params["bench"], "job")
    case = own_case(spec.params["piece"], spec.params["bottom"], bench)
    seeds = [spec.seed + k for k in range(spec.params["trials"])]
    return {"trials": watched_trials(case, seeds, weights)}


def own_case(piece: str, bottom: str, bench: SimulationSettings) -> Case:
    """Return a piece of the catalogue over one of ``BOTTOMS``."""
    catalogue = load_catalogue()
    face = BOTTOMS[bottom]
    below = replace(catalogue.bottom("short"), name="own", face=face, upper=face, lower=face)
    return Case(catalogue.top(piece), (below,), bench)


def watched_trials(case: Case, seeds: Sequence[int], weights: Path) -> list[Json]:
    """Run one trial for each of ``seeds``; each press with what was said and what was true.

    ``exceeds``: how likely the centre of mass lies further in than each of ``INSETS_MM``.
    """
    scenes = [scene for seed in seeds if (scene := start_scene(case, seed)) is not None]
    never = FusedSettings(weights=str(weights), inset_mm=NEVER_MM)
    settings = StackSettings(strategy="fused", fused=never)
    watching: list[Watching] = []

    def begun(scene: Scene, at: XY) -> Watching:
        watching.append(Watching(held_in(scene, None), settings, at))
        return watching[-1]

    ends = stack_in_lockstep(scenes, no_model(case), settings, EpisodeLimits(), begun)
    return [_told(case, end, one.said) for end, one in zip(ends, watching, strict=True)]


class Watching(FusedReasoner):
    """Notes after each press how likely the centre of mass lies how far in the support."""

    def __init__(self, held: Held, settings: StackSettings, origin_mm: XY) -> None:
        super().__init__(held, settings, origin_mm)
        self.said: list[list[float]] = []

    def conclude(self, touched: Touched) -> Conclusion:
        """Conclude as ever, and note."""
        found = super().conclude(touched)
        inset = self.inset_at(touched.offset_mm)
        if inset is not None:
            self.said.append([round(float(inset.exceeds(x)[0]), 5) for x in INSETS_MM])
        return found


def _told(case: Case, end: TrialEnd, said: Sequence[Sequence[float]]) -> Json:
    com = np.asarray(case.piece.com_xy_mm)
    places = np.array([step.true_mm for step in end.steps]).reshape(-1, 2)
    true = inset_mm(case.bottoms[0].face, places + com)
    steps = [
        {"inset_mm": round(float(inset), 4), "exceeds": exceeds}
        for inset, exceeds in zip(true, said, strict=True)
    ]
    return {"seed": end.seed, "outcome": end.outcome.value, "steps": steps}


def rules(trials: Sequence[Json]) -> list[Json]:
    """Return the counts under every rule: ``risk`` and how far inside the centre must lie."""
    return [counted(trials, risk, at) for at in range(len(INSETS_MM)) for risk in RISKS]


def counted(trials: Iterable[Json], risk: float, at: int) -> Json:
    """Count what would have come of the trials under one rule, ``INSETS_MM[at]`` and ``risk``."""
    placed, unsafe, other, probes = 0, 0, 0, 0
    for trial in trials:
        steps = enumerate(trial["steps"], start=1)
        let_go = next(((n, s) for n, s in steps if s["exceeds"][at] >= 1.0 - risk), None)
        if let_go is None:
            fell = trial["outcome"] == Outcome.KNOCKED_OVER.value
            unsafe, other = unsafe + fell, other + (not fell)
        elif let_go[1]["inset_mm"] > 0.0:
            placed, probes = placed + 1, probes + let_go[0]
        else:
            unsafe += 1
    return {
        "risk": risk,
        "inset_mm": INSETS_MM[at],
        "placed": placed,
        "unsafe": unsafe,
        "not_released": other,
        "probes": round(probes / placed, 2) if placed else None,
    }
