"""Choice of the rule of release of a network of ``fused``.

``python -m tests.rule_study NETWORK --trials N`` runs N trials of each piece on each of four
separate bottoms, or of each class of fresh outlines, and counts every rule on the same trials; it
resumes. The trials never release: the strategy moves on after every press, and its belief about the
centre of mass is stored with the truth. They use no bottoms or seeds of the tables.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import (
    FusedSettings,
    PolicySettings,
    SimulationSettings,
    StackSettings,
    load_simulation,
    parse_settings,
)
from touchdown.backend.core import Outcome, program_version, write_atomically
from touchdown.backend.experiments.strategies import uninformed_model
from touchdown.backend.experiments.trials import (
    FRESH,
    FRESH_TRIAL_SEED,
    BatchTrialResult,
    SceneSetup,
    grasped_piece_in,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import (
    FRESH_CLASSES,
    Outline,
    circle,
    load_pieces,
    rectangle,
    square,
)
from touchdown.backend.jobs import JobContext, JobSpec, JobStore, ProcessPool, run_campaign
from touchdown.backend.learning import use_one_thread
from touchdown.backend.learning.fused import InsetDistribution
from touchdown.backend.placement import (
    XY,
    FusedStrategy,
    GraspedPiece,
    PlaceDecision,
    ProbeObservation,
)
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene, release_kick_mm, touched_margins_mm, true_com_xy_mm

# Free bottoms of 30 mm and 30 g, none of the tables.
THRESHOLD_BOTTOMS: Mapping[str, Outline] = {
    "disc 22": circle(22.0),
    "square 17": square(17.0),
    "disc 16": circle(16.0),
    "rectangle 13 x 19": rectangle(13.0, 19.0),
}
THRESHOLD_PIECES = ("mushroom", "barrel", "pot")
THRESHOLD_SEED, CELL_SEEDS = 45_000_000, 10_000
TRIALS_PER_JOB = 8
INSETS_MM = (0.0, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
RISKS = (0.1, 0.07, 0.05, 0.04, 0.03, 0.02, 0.015, 0.01, 0.005)
FIRST_RISKS = (0.0, 0.003, 0.005, 0.01)  # 0: the same after every probe
RULE_SEED = sha256(b"choice of the release rule").hexdigest()  # of fresh outlines
NEVER_MM = 50.0
RULE_PROBES = (8, 12)
ENSEMBLES = ("minimum", "mixture")
Json = dict[str, Any]
Exceeds = Mapping[str, Sequence[float]]


def threshold_jobs(
    bench: SimulationSettings, code: str, weights: Path, trials: int, outlines: str = "convex"
) -> list[JobSpec]:
    """Return the jobs of ``trials`` trials of every piece on every bottom.

    With any outlines the bottoms are fresh ones, ``trials`` of each class, of a seed that serves
    the choice of a rule alone.
    """
    params: Json = {"bench": bench.model_dump(mode="json"), "weights": str(weights.resolve()),
                    "weights_sha256": sha256(weights.read_bytes()).hexdigest()}  # fmt: skip
    if outlines == "any":
        params |= {"bottom": FRESH, "outline_seed": RULE_SEED, "trials": len(FRESH_CLASSES)}
        return [
            JobSpec("fused-trials", {**params, "piece": piece}, seed, (), code)
            for first in range(trials)
            for number, piece in enumerate(THRESHOLD_PIECES)
            for seed in [FRESH_TRIAL_SEED + CELL_SEEDS * number + len(FRESH_CLASSES) * first]
        ]
    return [
        JobSpec(
            "fused-trials",
            {
                **params,
                "piece": piece,
                "bottom": bottom,
                "trials": min(TRIALS_PER_JOB, trials - first),
            },
            THRESHOLD_SEED + CELL_SEEDS * (len(THRESHOLD_BOTTOMS) * number + at) + first,
            (),
            code,
        )
        for first in range(0, trials, TRIALS_PER_JOB)
        for number, piece in enumerate(THRESHOLD_PIECES)
        for at, bottom in enumerate(THRESHOLD_BOTTOMS)
    ]


def fused_trials(spec: JobSpec, _place: JobContext) -> Mapping[str, Any]:
    """Run trials of one piece on one bottom, or on fresh ones, with one network."""
    use_one_thread()
    p = spec.params
    seeds = [spec.seed + k for k in range(p["trials"])]
    if p["bottom"] == FRESH:
        cases = [SceneSetup.of_trial(p, seed) for seed in seeds]
    else:
        bench = parse_settings(SimulationSettings, p["bench"], "job")
        cases = [held_out_setup(p["piece"], p["bottom"], bench)] * len(seeds)
    return {"trials": record_trials(cases, seeds, Path(p["weights"]))}


def held_out_setup(piece: str, bottom: str, bench: SimulationSettings) -> SceneSetup:
    """Return a piece of the catalogue over one of ``THRESHOLD_BOTTOMS``."""
    catalogue = load_pieces()
    face = THRESHOLD_BOTTOMS[bottom]
    below = replace(catalogue.bottom("short"), name="own", face=face, upper=face, lower=face)
    return SceneSetup(catalogue.top(piece), (below,), bench)


def record_trials(cases: Sequence[SceneSetup], seeds: Sequence[int], weights: Path) -> list[Json]:
    """Run one trial per seed; record each press with belief and truth.

    ``exceeds``: probability that the centre of mass lies further inside than each of ``INSETS_MM``,
    by the mixture and by the least confident network.
    """
    pairs = zip(cases, seeds, strict=True)
    scenes = [scene for case, seed in pairs if (scene := start_scene(case, seed)) is not None]
    never = FusedSettings(weights=str(weights), inset_mm=NEVER_MM)
    policy = PolicySettings(max_probes=max(RULE_PROBES))
    settings = StackSettings(strategy="fused", fused=never, policy=policy)
    recorders: list[RecordingFusedStrategy] = []

    def create(scene: Scene, at: XY) -> RecordingFusedStrategy:
        recorders.append(RecordingFusedStrategy(grasped_piece_in(scene, None), settings, at))
        return recorders[-1]

    model = uninformed_model(cases[0])
    results = stack_in_lockstep(scenes, model, settings, EpisodeLimits(), create)
    return [
        _trial_record(scene, end, one.exceeds_by_probe)
        for scene, end, one in zip(scenes, results, recorders, strict=True)
    ]


def inset_at(strategy: FusedStrategy, offset_mm: XY) -> InsetDistribution | None:
    """Return the expected inset of the centre of mass at a displacement; None before a probe."""
    if strategy._last is None:
        return None
    here, com = strategy._offset_mm[-1], strategy._held.com_xy_mm
    point = offset_mm[0] - here[0] + com[0], offset_mm[1] - here[1] + com[1]
    return strategy._inset(strategy._last, np.array([point]), here)


class RecordingFusedStrategy(FusedStrategy):
    """Fused strategy that records the inset probabilities of the centre of mass."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        super().__init__(held, settings, origin_mm)
        self.exceeds_by_probe: list[Exceeds] = []

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Return the decision of the fused strategy and record its belief."""
        found = super().conclude(touched)
        inset = inset_at(self, touched.offset_mm)
        if inset is not None:
            by_rule = {"mixture": inset.exceeds, "minimum": inset.surely_exceeds}
            self.exceeds_by_probe.append(
                {name: [round(float(p(x)[0]), 5) for x in INSETS_MM] for name, p in by_rule.items()}
            )
        return found


def _trial_record(scene: Scene, end: BatchTrialResult, exceeds_by_probe: Sequence[Exceeds]) -> Json:
    # The disturbance of a release moves the centre of mass alone.
    com = np.add(true_com_xy_mm(scene), release_kick_mm(scene, 1))
    upright = [step for step in end.steps if not step.toppled]
    places = np.array([step.true_mm for step in upright]).reshape(-1, 2) + com
    x, y = com.tolist()
    true = touched_margins_mm(scene, (x, y), places)
    steps = [
        {"inset_mm": round(float(inset), 4), "exceeds": exceeds}
        for inset, exceeds in zip(true, exceeds_by_probe[: len(true)], strict=True)
    ]
    return {"seed": end.seed, "outcome": end.outcome.value, "steps": steps}


def threshold_counts(trials: Sequence[Json]) -> list[Json]:
    """Return the outcome counts for every rule: ensemble, most probes, inset and accepted risks."""
    return [
        count_under_threshold(trials, FusedSettings.model_validate(rule), most)
        for most in RULE_PROBES
        for rule in (
            {"ensemble": ensemble, "inset_mm": inset_mm, "risk": risk, "first_risk": first_risk}
            for ensemble in ENSEMBLES
            for inset_mm in INSETS_MM
            for risk in RISKS
            for first_risk in FIRST_RISKS
            if first_risk < risk
        )
    ]


def best_rules(rules: Sequence[Json]) -> list[Json]:
    """Return the rules with the most placed among those with at most as many unsafe trials."""
    best: list[Json] = []
    for rule in sorted(rules, key=lambda rule: (rule["unsafe"], -rule["placed"])):
        if not best or rule["placed"] > best[-1]["placed"]:
            best.append(rule)
    return best


def count_under_threshold(trials: Iterable[Json], rule: FusedSettings, most: int = 8) -> Json:
    """Count the outcomes under one rule with at most ``most`` probes."""
    placed, unsafe, other, probes, at = 0, 0, 0, 0, INSETS_MM.index(rule.inset_mm)
    needed = [1 - rule.accepted_risk(n, most) for n in range(1, most + 1)]
    for trial in trials:
        steps = enumerate(zip(trial["steps"], needed, strict=False), start=1)
        let_go = next(((n, s) for n, (s, p) in steps if s["exceeds"][rule.ensemble][at] >= p), None)
        if let_go is None:
            fell = trial["outcome"] == Outcome.KNOCKED_OVER.value and len(trial["steps"]) < most
            unsafe, other = unsafe + fell, other + (not fell)
        elif let_go[1]["inset_mm"] > 0.0:
            placed, probes = placed + 1, probes + let_go[0]
        else:
            unsafe += 1
    return {
        "ensemble": rule.ensemble,
        "most_probes": most,
        "inset_mm": rule.inset_mm,
        "first_risk": rule.first_risk,
        "risk": rule.risk,
        "placed": placed,
        "unsafe": unsafe,
        "not_released": other,
        "probes": round(probes / placed, 2) if placed else None,
    }


def main(argv: list[str] | None = None) -> int:
    """Run the missing trials, write the counts, and print the best rules."""
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m tests.rule_study")
    parser.add_argument("weights", type=Path, help="network of 'fused'")
    parser.add_argument("--trials", type=int, default=16)
    parser.add_argument("--preset", help="of the bench (default: bench-v1, or that of --bench)")
    parser.add_argument("--bench", type=Path, metavar="FILE", help="settings of the bench (TOML)")
    parser.add_argument("--outlines", choices=("convex", "any"), default="convex")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("output/rules"))
    args = parser.parse_args(argv)
    preset = args.preset or (None if args.bench else "bench-v1")
    bench, code = load_simulation(args.bench, preset), program_version()
    jobs = threshold_jobs(bench, code, args.weights, args.trials, args.outlines)
    (args.out / "jobs").mkdir(parents=True, exist_ok=True)
    store = JobStore(args.out / "jobs")
    for _ in run_campaign(jobs, ProcessPool(KINDS, store, args.workers), store):
        pass
    done = [spec for spec in jobs if store.has(spec.id)]
    rules = threshold_counts([one for spec in done for one in store.result(spec.id)["trials"]])
    write_atomically(args.out / "rules.json", json.dumps(rules, indent=1).encode() + b"\n")
    rows = [rules[0], *(map(str, rule.values()) for rule in best_rules(rules))]
    sys.stdout.write("\n".join(" | ".join(row) for row in rows) + "\n")
    return 0 if len(done) == len(jobs) else 1


KINDS = {"fused-trials": fused_trials}

if __name__ == "__main__":
    sys.exit(main())
