"""Job kinds of the experiments, each a pure function of its spec.

Imports torch and the simulated bench with its devices.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np

from touchdown.backend import config, learning
from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
from touchdown.backend.core import Event, TrialFinished
from touchdown.backend.episodes import TrainingRows, join_rows, load_rows
from touchdown.backend.experiments.collection import batch_plan, run_job, split_jobs, total_redraws
from touchdown.backend.experiments.models import WEIGHTS, batch_model, load_model
from touchdown.backend.experiments.run_report import FILM_FILE, belief_film
from touchdown.backend.experiments.statics import (
    ProbeGroups,
    jig_groups,
    join_groups,
    probe_groups,
    score_fused_verdicts,
    score_patches,
)
from touchdown.backend.experiments.tables import JOB_FUNCTIONS, OWN_MODEL, PAPER_PROTOCOL
from touchdown.backend.experiments.trials import (
    WORLDS,
    SceneSetup,
    pick_and_place_in_lockstep,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import face_points, load_pieces
from touchdown.backend.jobs import JobContext, JobFunctions, JobSpec
from touchdown.backend.runs import RecordingOptions, StackRequest
from touchdown.backend.sensing import EpisodeLimits
from touchdown.backend.simulation import Scene

GROUPS_PER_BATCH = 50
FILMS_PER_CELL = 2  # number of trials per stacking cell stored as pictures


def simulate_collection(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Collect labelled probes of one piece over one outline, as packs in the job's folder."""
    p, catalogue = spec.params, load_pieces()
    piece, bottom = catalogue.top(p["piece"]), catalogue.bottom(p["bottom"])
    settings = _bench(p)
    plan = batch_plan(
        piece, bottom, settings, p["episodes"], spec.seed, p["probes_per_grip"],
        p["grips_per_mounting"],
    )  # fmt: skip
    jobs = split_jobs(plan, {"geometry": piece.sha256}, place.folder)
    redraws = total_redraws([run_job(job) for job in jobs])
    return {
        "bench_sha256": config.bench_sha256(settings),
        "episodes": plan.episodes,
        "rejected": redraws.drawn_again,
        "unsolved": redraws.unsolved,
    }


def train_model(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Train one model on the probes of the input jobs."""
    learning.use_one_thread()
    settings = config.parse_settings(config.TrainingSettings, spec.params["training"], "job")
    rows = join_rows([load_rows(place.store.folder(i)) for i in sorted(spec.inputs)])
    head = spec.params["head"]
    if head == "stability":
        rows = stability_rows(rows)
    data = learning.fingerprint(rows)
    device = learning.select_device(spec.params["device"])
    trainer = learning.Trainer(rows, settings, device)
    losses = [(report.train_loss, report.validation_loss) for report in trainer.epochs()]
    card = learning.make_card(rows, trainer, data).model_copy(update={"answers": head})
    card = learning.save_checkpoint(place.folder / WEIGHTS, trainer.best_model().arrays(), card)
    return {
        "weights_sha256": card.weights_sha256,
        "data_sha256": data,
        "episodes": len(rows),
        "device": learning.device_name(device),
        "losses": [[round(a, 5), round(b, 5)] for a, b in losses],
    }


def stability_rows(rows: TrainingRows) -> TrainingRows:
    """Return rows with one target: 1 if the centre of mass is above the true patch.

    A network trained on them is the *Implicit* baseline of the paper.
    """
    piece = load_pieces().top(rows.piece)
    points = face_points(piece.face) - np.asarray(piece.com_xy_mm)
    return replace(rows, patch=learning.stable_flags(rows.patch, points)[:, None])


def evaluate_static(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Press groups of probes over one bottom and score every model on the same probes."""
    p = spec.params
    case = SceneSetup.of_job(p, p["bottom"])
    learning.use_one_thread()
    judged = 1
    if p.get("protocol") == PAPER_PROTOCOL:
        seeds, size = range(spec.seed, spec.seed + p["mountings"]), GROUPS_PER_BATCH // p["grips"]
        parts = [jig_groups(case, some, p["grips"], p["probes"]) for some in _chunks(seeds, size)]
        judged = p["probes"]
    else:
        seeds = range(spec.seed, spec.seed + p["groups"])
        chunks = _chunks(seeds, GROUPS_PER_BATCH)
        world = WORLDS[p.get("world", "bench")]
        parts = [probe_groups(case, list(some), p["probes"], world) for some in chunks]
    groups, fused = join_groups(parts), p.get("fused", [OWN_MODEL])
    models = {
        name: _scores(load_model(source, place.store), case, groups, judged, name in fused)
        for name, source in sorted(p["models"].items())
    }
    return {**groups.as_json(case.settings, judged), "models": models}


def _chunks(seeds: range, size: int) -> list[range]:
    return [seeds[k : k + size] for k in range(0, len(seeds), size)]


def _scores(
    checkpoint: learning.Checkpoint, case: SceneSetup, groups: ProbeGroups, judged: int, fuses: bool
) -> dict[str, Any]:
    """Return the scores of one model; ``fuses``: with the verdicts of Table 2."""
    model = batch_model(checkpoint, case.piece)
    probability = groups.predictions(model)
    about: dict[str, Any] = {"weights_sha256": checkpoint.card.weights_sha256}
    if checkpoint.card.answers == "stability":
        stable = (probability[:, :judged, 0] > learning.CONTACT_LEVEL).T.ravel()
        return {**about, "says": {"1": stable.tolist()}}
    # The first probe of a balanced sample is not a random one.
    about["patch"] = score_patches(probability, groups, first=int(judged == 1))
    if fuses:
        about |= score_fused_verdicts(probability, groups, model, case, judged)
    return about


def run_stacking(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run the trials of one cell; every trial counts."""
    p = spec.params
    case = SceneSetup.of_job(p, *p["bottoms"])
    learning.use_one_thread()
    scenes, left_out = _counted(case, spec)
    settings, limits = config.StackSettings(), EpisodeLimits()
    answer: dict[str, Any] = {
        "bench_sha256": config.bench_sha256(case.settings),
        "left_out": left_out,
    }
    if p["strategy"] == "pick-and-place":
        results = pick_and_place_in_lockstep(scenes, settings)
    else:
        (source,) = spec.inputs
        checkpoint = load_model(source, place.store)
        answer["weights_sha256"] = checkpoint.card.weights_sha256
        results = stack_in_lockstep(scenes, batch_model(checkpoint, case.piece), settings, limits)
        outline = case.bottoms[-1].face.path()
        films = [belief_film(end, outline) for end in results[:FILMS_PER_CELL]]
        (place.folder / FILM_FILE).write_text(json.dumps(films), encoding="utf-8")
    return {**answer, "trials": [end.as_json() for end in results]}


def _counted(case: SceneSetup, spec: JobSpec) -> tuple[list[Scene], int]:
    """Return the first scenes with a stable place, and the number of scenes without one before the
    last.
    """
    scenes: list[Scene] = []
    left_out = 0
    while len(scenes) < spec.params["trials"]:
        scene = start_scene(case, spec.seed + len(scenes) + left_out)
        if scene is None:
            left_out += 1
        else:
            scenes.append(scene)
    return scenes, left_out


def run_on_devices(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Run trials of a cell on the stepped bench: devices, rendered images, tracker, interlock.

    The seeds are those of ``run_stacking``: towers without a stable place are left out here, too.
    """
    p = spec.params
    (source,) = spec.inputs
    request = StackRequest(
        piece=p["piece"],
        bottoms=tuple(p["bottoms"]),
        seed=spec.seed,
        trials=p["trials"],
        model=str(place.store.folder(source) / WEIGHTS),
    )
    results: list[Event] = []
    # A fault ends a run, so each trial is a run of its own.
    for scene in _counted(SceneSetup.of_job(p, *p["bottoms"]), spec)[0]:
        choice, keep = SimulatedBenchChoice(given=_bench(p)), RecordingOptions(None)
        with simulated_session(choice, keep=keep) as session:
            session.events.subscribe(results.append)
            session.run(replace(request, seed=scene.seed, trials=1))
    return {
        "bench_sha256": config.bench_sha256(_bench(p)),
        "trials": [
            {"seed": e.seed, "outcome": e.outcome.value, "reason": e.reason, "probes": e.probes}
            for e in results
            if isinstance(e, TrialFinished)
        ],
    }


def _bench(params: Mapping[str, Any]) -> config.SimulationSettings:
    return config.parse_settings(config.SimulationSettings, params["bench"], "job")


KINDS: JobFunctions = {
    kind: getattr(import_module(f"{__package__}.{module}"), function)
    for kind, (module, function) in JOB_FUNCTIONS.items()
}
