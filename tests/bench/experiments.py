"""Figures of the experiments: batch against devices, the worth of a second worker, training."""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tests.backend.experiments.device_loop import run_on_devices
from tests.bench.registry import Figure, figure
from touchdown.backend.bench.assembly import make_scene, shipped_model
from touchdown.backend.config.method import StackSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.events import ActionChosen, TrialFinished
from touchdown.backend.episodes.training_rows import join_rows, load_rows
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.models import batch_model
from touchdown.backend.experiments.tables import FULL, Recipe, Scale, paper_training
from touchdown.backend.experiments.trials import stack_in_lockstep
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.jobs.execution import ProcessPool, run_campaign
from touchdown.backend.jobs.job import JobStore, run_job
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.learning.training import Trainer
from touchdown.backend.runs.requests import SceneChoice, StackRequest
from touchdown.backend.sensing.episode import EpisodeLimits

HARD = SimulationSettings.model_validate({"preset": "hard"})
SEEDS = range(500, 510)


@figure("experiments")
def trials_both_ways() -> list[Figure]:
    """Ten trials of the pot both ways, sensor noise included (drawn differently): stated."""
    catalogue = load_pieces()
    scenes = [make_scene(catalogue, SceneChoice(seed=seed), HARD) for seed in SEEDS]
    model = batch_model(load_checkpoint(shipped_model("pot")), catalogue.top("pot"))
    ends = stack_in_lockstep(scenes, model, StackSettings(), EpisodeLimits())
    apart, same, probes = [], 0, []
    for end in ends:
        facts = run_on_devices(HARD, replace(StackRequest(), seed=end.seed))
        first = next((f for f in facts if isinstance(f, ActionChosen)), None)
        finished = next(f for f in facts if isinstance(f, TrialFinished))
        same += finished.outcome is end.outcome
        probes.append(abs(finished.probes - end.probes))
        if first is not None and end.steps:
            apart.append(np.subtract(first.action.step_mm, end.steps[0].action.step_mm))
    step = float(np.median(np.hypot(*np.array(apart).T)))
    note = f"probes differ by {np.mean(probes):.1f} on average"
    return [
        Figure("batch and devices: same outcome", same, f"of {len(ends)}", "stated", None, note),
        Figure("batch and devices: first step apart, median", step, "mm", "stated", None),
    ]


@figure("experiments")
def second_worker() -> list[Figure]:
    """Mass simulation through jobs: time of one worker over twice that of two."""
    scale = Scale("speed", 1000, 1, 1, 1, probes_per_grip=50)
    jobs = [spec for spec in Recipe(scale, HARD, "bench").jobs() if spec.kind == "simulate"][:8]
    seconds = []
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            store = JobStore(Path(folder))
            began_s = time.perf_counter()
            results = list(run_campaign(jobs, ProcessPool(KINDS, store, workers), store))
            seconds.append(time.perf_counter() - began_s)
            assert all(result.state == "done" for result in results)
    efficiency = seconds[0] / (2.0 * seconds[1])
    note = f"8 x 1,000 episodes: {seconds[0]:.0f} s and {seconds[1]:.0f} s, start-up included"
    return [
        Figure("efficiency of two workers", efficiency, "", ">= 0.85", efficiency >= 0.85, note)
    ]


@figure("experiments")
def training_of_one_piece() -> list[Figure]:
    """6,000 probes of the pot, 30 epochs, on two threads (three epochs are timed)."""
    data = Recipe(FULL, HARD, "bench", pieces=("pot",)).data("pot")
    with tempfile.TemporaryDirectory() as folder:
        store = JobStore(Path(folder))
        for spec in data:
            run_job(spec, KINDS, store)
        rows = join_rows([load_rows(store.folder(spec.id)) for spec in data])
    torch.set_num_threads(2)
    trainer = Trainer(rows, paper_training("FT+Tac", 3))
    began_s = time.perf_counter()
    epochs = len(list(trainer.epochs()))
    seconds = (time.perf_counter() - began_s) * FULL.epochs / epochs
    torch.set_num_threads(1)
    note = f"{epochs} epochs timed, on two threads"
    return [
        Figure("training, 6,000 probes, 30 epochs", seconds, "s", "<= 240", seconds <= 240, note)
    ]
