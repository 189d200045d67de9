"""Evaluation of existing models and strategies on another bench or in the second world.

There are two kinds of jobs: groups of presses, and whole trials. Seeds and draws are the same on
every bench. ``NUISANCES`` lists the quantities that differ between mountings, grippings and probes;
``scale_nuisance`` scales one of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.backend.config import SimulationSettings, StackSettings, bench_sha256
from touchdown.backend.experiments.models import batch_model, load_model
from touchdown.backend.experiments.statics import probe_groups, score_fused_verdicts, score_patches
from touchdown.backend.experiments.strategies import least_probes, network_params
from touchdown.backend.experiments.tables import CELL_SEEDS, PIECES, TABLE_BOTTOMS, job_code
from touchdown.backend.experiments.trials import SceneSetup, stack_in_lockstep, start_scene
from touchdown.backend.jobs import JobContext, JobSpec
from touchdown.backend.learning import use_one_thread
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials
from touchdown.backend.simulation.second_world import SecondWorldTrials

FACTORS = (0.0, 0.5, 1.0, 2.0, 3.0)
FOUNDATION = "face.foundation_range_n_mm3"


@dataclass(frozen=True, slots=True)
class Nuisance:
    """A nuisance of the bench. ``keys``: settings scaled together; ``limit``: bound of draws."""

    name: str
    title: str
    keys: tuple[str, ...]
    limit: str = ""


# Quantities that differ between mountings, grippings or probes.
NUISANCES = (
    Nuisance("tilt", "Tilt of the board", ("spread.tilt_rad",), "0.02 rad"),
    Nuisance("grasp-offset", "Grasp offset", ("spread.grasp_offset_mm",), "2 mm"),
    Nuisance("yaw", "Rotation in the hand", ("spread.yaw_rad",)),
    Nuisance("foundation", "Range of the contact stiffness", (FOUNDATION,)),
    Nuisance("gel", "Gel stiffness", ("spread.gel",), "0.7 to 1.3"),
    Nuisance("hysteresis", "Gel hysteresis", ("grasp.hysteresis_share",)),
    Nuisance("grip-friction", "Friction in the grip", ("spread.mu_grip",), "0.35 to 1.1"),
    Nuisance("grip-force", "Grip force", ("spread.grip_force_n",), "4 to 15 N"),
    Nuisance("face-friction", "Friction of the faces", ("spread.mu",), "0.2 to 0.6"),
    Nuisance("label-error", "Error of the arm", ("spread.label_error_mm",), "0.3 mm"),
    Nuisance("print-offset", "Place of the bottom", ("spread.print_offset_mm",), "0.5 mm"),
    Nuisance("gain", "Tactile gain", ("spread.gain",), "0.8 to 1.2"),
    Nuisance("tactile-bias", "Tactile reference error", ("tactile.bias_px",), "1 px"),
    Nuisance("tactile-drift", "Tactile drift", ("tactile.drift_px_sqrt_s",)),
    Nuisance("tactile-noise", "Tactile white noise", ("tactile.white_px",)),
    Nuisance("lost", "Lost markers and frames", ("tactile.lost_share", "tactile.drop_share")),
    Nuisance("wrist-offset", "Wrist offset after tare", ("wrist.offset_n", "wrist.offset_nm")),
    Nuisance("wrist-noise", "Wrist white noise", ("wrist.white_n", "wrist.white_nm")),
    Nuisance("wrist-drift", "Wrist drift", ("wrist.drift_n_sqrt_min", "wrist.drift_nm_sqrt_min")),
)

# Those that bench-v1 does not draw.
LATER_NUISANCES = (
    Nuisance("reseat", "Re-seating in the grasp", ("spread.reseat_mm", "spread.pitch_rad")),
    Nuisance("flatness", "Faces out of flat", ("spread.face_tilt_rad", "spread.face_crown_rad")),
    Nuisance("com", "Centre of mass", ("spread.com_mm",), "2 mm"),
    Nuisance("pad-area", "Gripped area", ("spread.pad_area",), "factor 1.65"),
    Nuisance("wrist-yaw", "Yaw of the wrist sensor", ("spread.wrist_yaw_rad",)),
    Nuisance("wrist-lever", "Place of the wrist sensor", ("spread.wrist_lever_mm",)),
    Nuisance("cable", "Cable pull", ("spread.cable_n_mm",)),
    Nuisance("creep", "Gel creep", ("grasp.creep_share",)),
    Nuisance("release", "Disturbance at release", (".release_disturbance_mm",)),
)


def scale_nuisance(
    settings: SimulationSettings, nuisance: Nuisance, factor: float
) -> SimulationSettings:
    """Return the bench with one nuisance scaled by ``factor``.

    A log-uniform range keeps its middle. An absent range stays absent.
    """
    if factor == 1.0:
        return settings
    content = settings.model_dump(mode="json")
    for key in nuisance.keys:
        section, name = key.split(".")
        values = content[section] if section else content
        values[name] = _times(values.get(name, 0.0), factor)
    return SimulationSettings.model_validate(content)


BAND_SEED, BAND_FACTOR = 994, 2.0  # magnitudes from half to twice those of the bench


def band_benches(
    bench: SimulationSettings, count: int
) -> list[tuple[dict[str, float], SimulationSettings]]:
    """Return ``count`` benches around ``bench``, each with its factor of every nuisance by name.

    Factors are log-uniform from 1 / ``BAND_FACTOR`` to ``BAND_FACTOR``, a Latin hypercube over the
    nuisances that the bench draws; the same ones for the same ``count``.
    """
    # Imported here: scipy is slow to load.
    from scipy.stats.qmc import LatinHypercube

    content = bench.model_dump(mode="json")

    def drawn(key: str) -> bool:
        section, name = key.split(".")
        return bool((content[section] if section else content).get(name))

    chosen = [n for n in (*NUISANCES, *LATER_NUISANCES) if any(map(drawn, n.keys))]
    cube = LatinHypercube(len(chosen), seed=BAND_SEED).random(count)
    found = []
    for factors in (BAND_FACTOR ** (2.0 * cube - 1.0)).tolist():
        one = bench
        for nuisance, factor in zip(chosen, factors, strict=True):
            one = scale_nuisance(one, nuisance, factor)
        by_name = {n.name: f for n, f in zip(chosen, factors, strict=True)}
        found.append((by_name, one))
    return found


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (int, float)):
        return factor * value
    if value is None:
        return None
    low, high = np.log(value)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * factor
    return [float(np.exp(middle - half)), float(np.exp(middle + half))]


WORLDS: dict[str, type[BatchedTrials]] = {"bench": BatchedTrials, "elsewhere": SecondWorldTrials}
PRESSES_SEED, TRIALS_SEED = 5_000_000, 6_000_000
GROUPS_PER_JOB, PROBES, TRIALS_PER_JOB = 10, 3, 2
EVALUATED_STRATEGIES = (
    "paper",
    "paper-calibrated",
    "fused",
    "zero-wrench",
)  # the last two use no model of a piece
Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class EvaluationBench:
    """Bench of an evaluation: a ``world`` (a name of ``WORLDS``) and settings.

    ``first``: number of the first group or trial in each cell.
    """

    world: str
    bench: SimulationSettings
    first: int = 0


def press_jobs(
    place: EvaluationBench, pair: tuple[str, str], models: Mapping[str, str], groups: int, code: str
) -> list[JobSpec]:
    """Return the jobs of ``groups`` groups of a (piece, bottom); ``models``: source by name."""
    return [
        JobSpec(
            "asked-presses",
            _bench_params(place, pair)
            | {"models": dict(models), "groups": min(GROUPS_PER_JOB, groups - k)},
            PRESSES_SEED + _cell(pair) + place.first + k,
            tuple(sorted(set(models.values()))),
            job_code("asked-presses", code),
        )
        for k in range(0, groups, GROUPS_PER_JOB)
    ]


def trial_jobs(
    place: EvaluationBench, pair: tuple[str, str], strategy: tuple[str, str], trials: int, code: str
) -> list[JobSpec]:
    """Return the jobs of ``trials`` trials; ``strategy``: its name, and the source of its model."""
    params = {"strategy": strategy[0], **network_params(strategy[0], StackSettings())}
    return [
        JobSpec(
            "asked-trials",
            _bench_params(place, pair) | params | {"trials": min(TRIALS_PER_JOB, trials - k)},
            TRIALS_SEED + _cell(pair) + place.first + k,
            (strategy[1],),
            job_code("asked-trials", code),
        )
        for k in range(0, trials, TRIALS_PER_JOB)
    ]


def job_effort(spec: JobSpec) -> int:
    """Return the relative duration of a job."""
    p = spec.params
    slow = 4 if p["world"] == "elsewhere" else 1
    return slow * (int(p["groups"]) * PROBES if "groups" in p else 5 * int(p["trials"]))


def evaluate_presses(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Press groups of probes over one bottom and score every model on the same probes."""
    p = spec.params
    case = SceneSetup.of_job(p, p["bottom"])
    use_one_thread()
    seeds = [spec.seed + g for g in range(p["groups"])]
    groups = probe_groups(case, seeds, PROBES, WORLDS[p["world"]])
    models: Json = {}
    for name, source in sorted(p["models"].items()):
        model = batch_model(load_model(source, place.store), case.piece)
        probability = groups.predictions(model)
        fused = score_fused_verdicts(probability, groups, model, case)
        models[name] = {**score_patches(probability, groups), "says": fused["says"]}
    return {**groups.as_json(case.settings), "models": models}


def evaluate_trials(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run trials of one strategy; every trial counts."""
    p = spec.params
    case = SceneSetup.of_job(p, p["bottom"])
    use_one_thread()
    scenes = [scene for k in range(p["trials"]) if (scene := start_scene(case, spec.seed + k))]
    model = batch_model(load_model(spec.inputs[0], place.store), case.piece)
    method = StackSettings.model_validate({"strategy": p["strategy"]})
    world = WORLDS[p["world"]]
    results = stack_in_lockstep(scenes, model, method, EpisodeLimits(), world=world)
    return {
        "bench_sha256": bench_sha256(case.settings),
        "trials": [
            {**end.as_json(), "least_probes": least_probes(scene)}
            for scene, end in zip(scenes, results, strict=True)
        ],
    }


def _bench_params(place: EvaluationBench, pair: tuple[str, str]) -> Json:
    return {
        "world": place.world,
        "bench": place.bench.model_dump(mode="json"),
        "piece": pair[0],
        "bottom": pair[1],
    }


def _cell(pair: tuple[str, str]) -> int:
    return CELL_SEEDS * (10 * PIECES.index(pair[0]) + TABLE_BOTTOMS.index(pair[1]))
