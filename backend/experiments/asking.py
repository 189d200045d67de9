"""Models and strategies that exist, asked on a bench that they were not made for.

Two kinds of jobs: groups of presses, and whole trials. The bench is any settings of the simulated
one, or the second world with them; seeds and draws are the same in both.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from backend.config.bench_facts import bench_sha256
from backend.config.load import parse
from backend.config.method import StackSettings
from backend.config.simulation import SimulationSettings
from backend.experiments.beyond import least_probes, network_named
from backend.experiments.closed_loop import stack_in_lockstep
from backend.experiments.given_models import load_model
from backend.experiments.models import batch_model
from backend.experiments.recipes import BOTTOMS, CELL_SEEDS, PIECES
from backend.experiments.scenes import Case, start_scene
from backend.experiments.scoring import fused_verdicts, patch_scores
from backend.experiments.statics import probe_groups
from backend.jobs.running import Workplace
from backend.jobs.spec import JobSpec
from backend.learning.device import one_thread
from backend.objects.catalogue import load_catalogue
from backend.sensing.episode import EpisodeLimits
from backend.simulation.elsewhere.bench import Elsewhere
from backend.simulation.lockstep import Lockstep

WORLDS: dict[str, type[Lockstep]] = {"bench": Lockstep, "elsewhere": Elsewhere}
PRESSES_SEED, TRIALS_SEED = 5_000_000, 6_000_000
GROUPS_A_JOB, PROBES, TRIALS_A_JOB = 10, 3, 2
STRATEGIES = ("paper", "fused", "zero-wrench")
"""What can be asked; the last two read no model of a piece."""
SLIPPED_MM = 0.02
"""A pad that moved by more than this in one press has slipped."""
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Place:
    """Where something is asked: a ``world`` (a name of ``WORLDS``) with the settings of a bench.

    ``first``: number of the first group or trial in each cell.
    """

    world: str
    bench: SimulationSettings
    first: int = 0


def presses_jobs(
    place: Place, pair: tuple[str, str], models: Mapping[str, str], groups: int, code: str
) -> list[JobSpec]:
    """Return the jobs of ``groups`` groups of a (piece, bottom); ``models``: name to its job."""
    return [
        JobSpec(
            "asked-presses",
            {
                **_asked(place, pair),
                "models": dict(models),
                "groups": min(GROUPS_A_JOB, groups - k),
            },
            PRESSES_SEED + _cell(pair) + place.first + k,
            tuple(sorted(set(models.values()))),
            code,
        )
        for k in range(0, groups, GROUPS_A_JOB)
    ]


def trials_jobs(
    place: Place, pair: tuple[str, str], strategy: tuple[str, str], trials: int, code: str
) -> list[JobSpec]:
    """Return the jobs of ``trials`` trials; ``strategy``: its name, and the job of its model."""
    network = network_named(strategy[0], StackSettings())
    return [
        JobSpec(
            "asked-trials",
            {
                **_asked(place, pair),
                "strategy": strategy[0],
                "trials": min(TRIALS_A_JOB, trials - k),
                **network,
            },
            TRIALS_SEED + _cell(pair) + place.first + k,
            (strategy[1],),
            code,
        )
        for k in range(0, trials, TRIALS_A_JOB)
    ]


def effort(spec: JobSpec) -> int:
    """Return how long a job takes compared with others, for the time that is left."""
    p = spec.params
    slow = 4 if p["world"] == "elsewhere" else 1
    return slow * (int(p["groups"]) * PROBES if "groups" in p else 5 * int(p["trials"]))


def presses(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Press groups of probes over one bottom and score every model on the same probes."""
    p, case = spec.params, _case(spec)
    one_thread()
    seeds = [spec.seed + g for g in range(p["groups"])]
    groups = probe_groups(case, seeds, PROBES, WORLDS[p["world"]])
    models: Json = {}
    for name, source in sorted(p["models"].items()):
        model = batch_model(load_model(source, place.store), case.piece)
        g, n = groups.observation.shape[:2]
        flat = groups.observation.reshape(g * n, *groups.observation.shape[2:])
        probability = model.predict(flat).reshape(g, n, -1)
        fused = fused_verdicts(probability, groups, model, case)
        models[name] = {**patch_scores(probability, groups), "says": fused["says"]}
    return {
        "bench_sha256": bench_sha256(case.settings),
        "margin_mm": [[round(float(m), 4) for m in pair] for pair in groups.margin_mm],
        "slipped": float((groups.slip_mm > SLIPPED_MM).mean()),
        "rejected": groups.rejected,
        "left_out": groups.left_out,
        "models": models,
    }


def trials(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Run some trials of one strategy; every trial counts, whatever its outcome."""
    p, case = spec.params, _case(spec)
    one_thread()
    scenes = [scene for k in range(p["trials"]) if (scene := start_scene(case, spec.seed + k))]
    model = batch_model(load_model(spec.inputs[0], place.store), case.piece)
    method = StackSettings.model_validate({"strategy": p["strategy"]})
    world = WORLDS[p["world"]]
    ends = stack_in_lockstep(scenes, model, method, EpisodeLimits(), world=world)
    return {
        "bench_sha256": bench_sha256(case.settings),
        "trials": [
            {**end.as_json(), "least_probes": least_probes(scene)}
            for scene, end in zip(scenes, ends, strict=True)
        ],
    }


def _asked(place: Place, pair: tuple[str, str]) -> Json:
    return {
        "world": place.world,
        "bench": place.bench.model_dump(mode="json"),
        "piece": pair[0],
        "bottom": pair[1],
    }


def _case(spec: JobSpec) -> Case:
    p = spec.params
    bench = parse(SimulationSettings, p["bench"], "job")
    return Case.of(load_catalogue(), p["piece"], (p["bottom"],), bench)


def _cell(pair: tuple[str, str]) -> int:
    return CELL_SEEDS * (10 * PIECES.index(pair[0]) + BOTTOMS.index(pair[1]))
