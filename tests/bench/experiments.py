"""Figures of the experiments: stacking results, batch against devices, cost of the full tables.

Stacking: 60 seeds (3 pieces, 2 bottoms, 10 each), started unstable.
"""

import hashlib
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.interpolate import make_interp_spline

from tests.backend.bench.brisk import brisk_session
from tests.backend.simulation.one_press import CASES, RMS_LIMIT_PX, press_both_ways
from tests.backend.simulation.release_cases import (
    SETS,
    SHAPES,
    SURFACES,
    ask_about_shape,
    ask_about_surface,
    ask_both,
)
from tests.bench.figures import Figure, at_least, at_most, failures, figure, stated
from touchdown.backend.config import (
    ProbeSettings,
    SimulationSettings,
    StackSettings,
    TrainingSettings,
    load_simulation,
)
from touchdown.backend.core import (
    FINGERS,
    ActionChosen,
    Event,
    FloatArray,
    MarkerField,
    Outcome,
    Recording,
    TrialFinished,
)
from touchdown.backend.episodes import PackedEpisode, patch_hex, write_packs
from touchdown.backend.episodes.training_rows import TrainingRows, join_rows, load_rows
from touchdown.backend.experiments import KINDS, PIECES, Recipe, adopt_models
from touchdown.backend.experiments.models import batch_model
from touchdown.backend.experiments.tables import FULL, Scale, agreement, paper_training
from touchdown.backend.experiments.trials import (
    BatchTrialResult,
    SceneSetup,
    refused_presses,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import Piece, Tower, draw_offset, face_points, load_pieces
from touchdown.backend.identification import Recordings
from touchdown.backend.identification.recordings import PressRecording
from touchdown.backend.jobs.execution import ProcessPool, run_campaign
from touchdown.backend.jobs.job import JobSpec, JobStore, run_job
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.learning.training import (
    Trainer,
    computes_bfloat16,
    new_model,
    use_one_thread,
)
from touchdown.backend.learning.training_process import TrainingEpoch
from touchdown.backend.runs.requests import StackRequest, StrategyChoice
from touchdown.backend.sensing import EpisodeLimits, synchronise
from touchdown.backend.sensing.episode import judge_quality
from touchdown.backend.sensing.slip import press_slip_mm
from touchdown.backend.simulation import (
    RESIDUAL_LIMIT,
    BatchedTrials,
    Scene,
    begin_probes,
    conditions,
    mujoco_available,
    wrist_wrench,
)
from touchdown.backend.simulation.mechanics import advance_probes
from touchdown.backend.simulation.release_mujoco import PAIR_BAND_MM, TOWER_BAND_MM
from touchdown.backend.simulation.second_world import FiniteGelTrials

BACKEND = Path(__file__).resolve().parents[2] / "backend"
FIRST_SEED = 100  # sixty seeds, ten per cell
STACKING_PIECES, STACKING_BOTTOMS, TRIALS = ("pot", "mushroom", "barrel"), ("short", "long"), 10
UNSAFE = (Outcome.FELL, Outcome.KNOCKED_OVER)


def _sixty(preset: str, strategy: StrategyChoice) -> tuple[list[TrialFinished], list[float]]:
    """Return how each trial ended, and the decision latencies in ms; two processes share them."""
    cells = list(enumerate(product(STACKING_PIECES, STACKING_BOTTOMS)))
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        parts = list(pool.map(partial(_cell, preset, strategy), cells))
    return [end for ends, _ in parts for end in ends], [ms for _, own_ms in parts for ms in own_ms]


def _cell(
    preset: str, strategy: StrategyChoice, cell: tuple[int, tuple[str, str]]
) -> tuple[list[TrialFinished], list[float]]:
    """Return the same for one piece and bottom.

    Free moves are fast, and half of the images are left out: neither changes the course of a trial.
    """
    facts: list[Event] = []
    session = brisk_session(preset)
    session.events.subscribe(facts.append)
    number, (piece, bottom) = cell
    seed = FIRST_SEED + TRIALS * number
    try:
        session.run(StackRequest(piece, (bottom,), seed, trials=TRIALS, strategy=strategy))
    finally:
        session.close()
    ends = [fact for fact in facts if isinstance(fact, TrialFinished)]
    return ends, [fact.latency_ms for fact in facts if isinstance(fact, ActionChosen)]


def _counts(ends: list[TrialFinished]) -> tuple[int, int, str]:
    placed = sum(end.outcome is Outcome.PLACED for end in ends)
    unsafe = sum(end.outcome in UNSAFE for end in ends)
    probes = float(np.mean([end.probes for end in ends]))
    return placed, unsafe, f"{len(ends)} trials, {probes:.2f} probes on average"


@figure("stacking")
def paper_on_the_default_bench() -> list[Figure]:
    """Placed, unsafe releases and decision latency on mixed noise."""
    ends, latencies_ms = _sixty("mixed", "paper")
    placed, unsafe, note = _counts(ends)
    p50, p99 = (float(value) for value in np.percentile(latencies_ms, [50, 99]))
    decided = f"{len(latencies_ms)} decisions, median {p50:.1f}, max {max(latencies_ms):.1f} ms"
    return [
        at_least("placed, paper strategy", placed, "of 60", 50, note),
        at_most("released unsafely, paper strategy", unsafe, "of 60", 3, note),
        at_most("decision latency p99, headless", p99, "ms", 7, decided),
    ]


@figure("stacking", long=True)
def paper_with_release_disturbance() -> list[Figure]:
    """The same with 0.5 mm of disturbance at release (no target: stated beside the other)."""
    placed, unsafe, note = _counts(_sixty("realistic", "paper")[0])
    note = f"{unsafe} released unsafely; {note}"
    return [stated("placed, preset realistic", placed, "of 60", note)]


@figure("stacking")
def pick_and_place() -> list[Figure]:
    """Without touch nothing stands, since every start is unstable."""
    placed, _, note = _counts(_sixty("mixed", "pick-and-place")[0])
    return [failures("placed, pick-and-place", placed, "of 60", note)]


@figure("agreement")
def batch_against_devices() -> list[Figure]:
    """Marker rms over whole presses, noise off, equal mechanical draws."""
    rms_px = []
    for case in CASES:
        with pytest.MonkeyPatch.context() as patch:
            rms_px.append(press_both_ways(*case, patch).rms_px)
    worst_px, note = max(rms_px), f"worst of {len(rms_px)} presses; best {min(rms_px):.3f}"
    ok = worst_px <= RMS_LIMIT_PX
    target = f"<= {RMS_LIMIT_PX}"
    return [Figure("batch against devices, marker rms", worst_px, "px", target, ok, note)]


@figure("agreement")
def judge_against_engine() -> list[Figure]:
    """Random stacks on which exact judge and physics engine disagree, and how far from the edge."""
    if not mujoco_available():
        note = "needs the extra 'mujoco'"
        return [Figure("judge against MuJoCo", None, "", "0", None, note)]
    figures = []
    for name in SETS:
        asked = list(ask_both(name))
        unlike = [o for o in asked if o.unlike]
        beyond = sum(o.beyond for o in asked)
        band_mm = TOWER_BAND_MM if name == "three bodies" else PAIR_BAND_MM
        note = f"{len(asked)} cases, {len(unlike)} disagree"
        if unlike:
            far_mm = max(abs(o.verdict.margin_mm) for o in unlike)
            note += f", up to {far_mm:.3f} mm from the edge"
        text = f"judge against MuJoCo, {name}: beyond {band_mm} mm"
        figures.append(failures(text, beyond, "cases", note))
    for name in SHAPES:
        asked = list(ask_about_shape(name, SHAPE_CASES))
        unlike = sum(o.unlike for o in asked)
        note = f"{len(asked)} cases, {sum(o.fallen for o in asked)} fall"
        figures.append(
            failures(f"judge against MuJoCo, {name}: beyond 0.5 mm", unlike, "cases", note)
        )
    return figures


@figure("agreement", long=True)
def judge_against_engine_on_surfaces() -> list[Figure]:
    """Placements on tilted, stepped and domed faces on which judge and engine disagree."""
    if not mujoco_available():
        note = "needs the extra 'mujoco'"
        return [Figure("judge against MuJoCo, faces that are not flat", None, "", "0", None, note)]
    figures = []
    for kind in SURFACES:
        asked = list(ask_about_surface(kind, SURFACE_CASES))
        unlike = [o for o in asked if o.unlike]
        note = f"{len(asked)} cases on ten outlines, {sum(o.fallen for o in asked)} fall"
        if unlike:
            far_mm = max(abs(o.verdict.margin_mm) for o in unlike)
            note += f"; {len(unlike)} disagree, up to {far_mm:.3f} mm from the edge"
        text = f"judge against MuJoCo, {kind} faces: beyond {PAIR_BAND_MM} mm"
        figures.append(failures(text, sum(o.beyond for o in asked), "cases", note))
    return figures


SHAPE_CASES = 60
SURFACE_CASES = 200  # twenty on each outline
TOWERS = (("short", "long"), ("short", "hex20"), ("short", "rect12x28"))
# Four rounds of five trials for each piece and tower: 180 trials, each with its own mounting.
TOWER_SEED, TOWER_ROUNDS, TOWER_TRIALS = 4_700_000, 4, 5


@figure("towers", long=True)
def towers_on_batch_and_devices() -> list[Figure]:
    """Trials on two bottoms by the batch, and with devices, images and tracker.

    ``TOUCHDOWN_ROUNDS`` lowers the number of rounds. Finished jobs are kept in ``output`` for as
    long as no source of the backend changes.
    """
    rounds = int(os.environ.get("TOUCHDOWN_ROUNDS", TOWER_ROUNDS))
    code = hashlib.sha256(b"".join(p.read_bytes() for p in sorted(BACKEND.rglob("*.py"))))
    store = JobStore(BACKEND.parent / "output" / f"towers-{code.hexdigest()[:16]}")
    models = adopt_models(store, BACKEND.parent / "resources" / "models")
    bench = load_simulation(preset="bench-v1").model_dump(mode="json")
    pairs: list[tuple[JobSpec, JobSpec]] = []
    for k, piece, tower in product(range(rounds), PIECES, TOWERS):
        seed = TOWER_SEED + 1000 * (10 * PIECES.index(piece) + TOWERS.index(tower)) + 100 * k
        params = {"piece": piece, "bottoms": list(tower), "strategy": "paper", "bench": bench}
        needs = (models[piece, "FT+Tac"],)
        kinds = ("stack", "devices")
        batch, devices = (
            JobSpec(kind, params | {"trials": TOWER_TRIALS}, seed, needs, "bench") for kind in kinds
        )
        pairs.append((batch, devices))
    jobs = [spec for pair in pairs for spec in pair]
    for result in run_campaign(jobs, ProcessPool(KINDS, store, WORKERS), store):
        assert result.state == "done", result.error
    both = [[list(store.result(spec.id)["trials"]) for spec in pair] for pair in pairs]
    batch_trials, device_trials = ([t for pair in both for t in pair[k]] for k in (0, 1))
    found = agreement(batch_trials, device_trials)
    untouched = sum("no contact" in trial["reason"] for trial in batch_trials)
    note = f"{found['same_outcome']} of {found['trials']} trials; placed by the batch "
    note += f"{found['placed_batch']}, on the devices {found['placed_devices']}"
    unlike = [
        f"{piece[0]['seed']} {piece[0]['outcome']} and {piece[1]['outcome']}"
        for piece in zip(batch_trials, device_trials, strict=True)
        if piece[0]["outcome"] != piece[1]["outcome"]
    ]
    if unlike:
        note += f"; {', '.join(unlike)}"
    alike = 100.0 * found["same_outcome"] / found["trials"]
    return [
        at_least("towers, batch and devices end alike", alike, "%", 95, note),
        failures("towers, trials of the batch without contact", untouched, "trials"),
    ]


class OtherNoise(BatchedTrials):
    """The same trials with other noise of the sensors."""

    def _sensor_rng(self, trial: int) -> np.random.Generator:
        return np.random.default_rng(super()._sensor_rng(trial).integers(2**63))


@figure("towers", long=True)
def towers_under_other_noise() -> list[Figure]:
    """Trials on two bottoms by the batch with two draws of sensor noise, all else equal.

    So many end alike without any difference of the method; ``TOUCHDOWN_ROUNDS`` as above.
    """
    use_one_thread()
    rounds = int(os.environ.get("TOUCHDOWN_ROUNDS", TOWER_ROUNDS))
    bench = load_simulation(preset="bench-v1")
    ends: list[tuple[BatchTrialResult, ...]] = []
    for k, piece, tower in product(range(rounds), PIECES, TOWERS):
        seed = TOWER_SEED + 1000 * (10 * PIECES.index(piece) + TOWERS.index(tower)) + 100 * k
        case = SceneSetup.of(load_pieces(), piece, tower, bench)
        scenes = [scene for n in range(TOWER_TRIALS) if (scene := start_scene(case, seed + n))]
        weights = BACKEND.parent / "resources" / "models" / f"{piece}.safetensors"
        model = batch_model(load_checkpoint(weights), case.piece)
        ends += zip(
            *(
                stack_in_lockstep(scenes, model, StackSettings(), EpisodeLimits(), world=world)
                for world in (BatchedTrials, OtherNoise)
            ),
            strict=True,
        )
    same = sum(a.outcome == b.outcome for a, b in ends)
    note = f"{same} of {len(ends)} trials"
    return [stated("towers, batch and batch end alike", 100.0 * same / len(ends), "%", note)]


PRESSES, REFERENCE = 40, (1.0 / 3.0, 1)


def pressed_centres(piece: Piece, bottom: Piece, pitch_mm: float, subcells: int) -> FloatArray:
    """Return the centres of pressure (n, 2) of random presses on bench-v1, rigid bottoms."""
    settings, rng = load_simulation(preset="bench-v1"), np.random.default_rng(PRESSES)
    draws = [
        (
            conditions.draw_mounting(settings, rng),
            conditions.draw_gripping(settings, 10.0, rng),
            conditions.draw_probe(settings, rng),
        )
        for _ in range(PRESSES)
    ]
    drawn = conditions.conditions_from_draws(settings, ProbeSettings(), 30.0, piece.width_mm, draws)
    offsets = draw_offset(rng, piece.face, bottom.face, PRESSES)
    points = face_points(piece.face, pitch_mm)
    state = begin_probes(points, bottom.face, offsets, drawn, None, pitch_mm, subcells)
    for tick in range(1, 21):
        command = np.tile([0.0, 0.0, -1.5 * min(1.0, tick / 15)], (PRESSES, 1))
        state, solved = advance_probes(state, command, 0.1)
    assert (state.residual <= RESIDUAL_LIMIT).all()
    return solved.cop_mm


@figure("lattice", long=True)
def centre_of_pressure_on_the_lattice() -> list[Figure]:
    """Centres of pressure on 1 mm cells against cells of 1/3 mm, and the cost of merged cells.

    Three pieces on four bottoms, positions uniform over the overlaps of the data collection.
    """
    catalogue = load_pieces()
    errors_mm: dict[int, list[float]] = {1: [], 3: []}
    spent_s = dict.fromkeys(errors_mm, 0.0)
    for name, below in product(PIECES, ("short", "long", "hex20", "rect12x28")):
        pair = catalogue.top(name), catalogue.bottom(below)
        fine = pressed_centres(*pair, *REFERENCE)
        for subcells, errors in errors_mm.items():
            began_s = time.process_time()
            found = pressed_centres(*pair, 1.0 / subcells, subcells)
            spent_s[subcells] += time.process_time() - began_s
            errors += np.hypot(*(found - fine).T).tolist()
    whole, merged = (float(np.percentile(errors_mm[k], 95)) for k in (1, 3))
    note = f"{len(errors_mm[3])} presses, worst {max(errors_mm[3]):.2f} mm"
    times = f"{spent_s[1]:.2f} and {spent_s[3]:.2f} s of the processor"
    return [
        stated("centre of pressure, whole cells, p95", whole, "mm"),
        at_most("centre of pressure, cells weighted by ninths, p95", merged, "mm", 0.15, note),
        at_most("time, weighted over whole cells", spent_s[3] / spent_s[1], "", 1.5, times),
    ]


HARD = SimulationSettings.model_validate({"preset": "hard"})


@figure("experiments", long=True)
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
    took = f"{seconds[0]:.0f} s and {seconds[1]:.0f} s, start-up included"
    note = f"{len(jobs)} x 1,000 episodes: {took}"
    return [at_least("efficiency of two workers", efficiency, "", 0.85, note)]


@figure("experiments")
def training_of_one_piece() -> list[Figure]:
    """6,000 probes of the pot, 30 epochs, on two threads (two epochs are timed)."""
    data = Recipe(FULL, HARD, "bench", pieces=("pot",)).data("pot")
    with tempfile.TemporaryDirectory() as folder:
        store = JobStore(Path(folder))
        for spec in data:
            run_job(spec, KINDS, store)
        rows = join_rows([load_rows(store.folder(spec.id)) for spec in data])
    torch.set_num_threads(2)
    trainer = Trainer(rows, paper_training("FT+Tac", 2))
    began_s = time.perf_counter()
    epochs = len(list(trainer.epochs()))
    seconds = (time.perf_counter() - began_s) * FULL.epochs / epochs
    torch.set_num_threads(1)
    note = f"{epochs} epochs timed, on two threads"
    return [at_most("training, 6,000 probes, 30 epochs", seconds, "s", 240, note)]


class PlainLoop:
    """The network of the paper in the usual loop: TensorDataset, DataLoader, torch.optim.Adam."""

    def __init__(self, rows: TrainingRows, trainer: Trainer) -> None:
        self.inputs = torch.from_numpy(np.asarray(rows.inputs(np.arange(len(rows))), np.float32))
        self.targets = torch.from_numpy(rows.patch.astype(np.float32))
        self.split, self.batch = trainer.split, TrainingSettings().batch
        self.model = new_model(trainer.model.shape, trainer.settings.seed)
        self.model.load_state_dict(trainer.model.state_dict())
        self.optimiser = torch.optim.Adam(self.model.parameters())  # rate 1e-3
        train = torch.utils.data.TensorDataset(self.inputs[self.split.train],
                                               self.targets[self.split.train])  # fmt: skip
        self.loader = torch.utils.data.DataLoader(train, self.batch, shuffle=True)
        self.criterion = torch.nn.BCEWithLogitsLoss()
        torch.manual_seed(trainer.settings.seed)

    def epoch(self) -> float:
        """Train one epoch; return the loss on the held-out side."""
        self.model.train()
        for observation, target in self.loader:
            self.optimiser.zero_grad()
            self.criterion(self.model(observation), target).backward()
            self.optimiser.step()
        self.model.eval()
        with torch.no_grad():
            logits = self.model(self.inputs[self.split.held_out])
        return float(self.criterion(logits, self.targets[self.split.held_out]))


PLAIN_EPOCHS, OWN_EPOCHS, PROBES_A_BOTTOM = 12, 4, 1000


@figure("peers")
def training_of_others() -> list[Figure]:
    """Training on 3,000 probes of the pot beside the plain loop: processor time, one thread.

    The target holds for the time until the lowest held-out loss of the plain loop, which is also
    stopped there, with the usual batch and rate. The own training has its usual schedule, Muon, and
    a rate and a batch that suit it.
    """
    scale = Scale("peers", PROBES_A_BOTTOM, 1, 1, 1, probes_per_grip=50)
    with tempfile.TemporaryDirectory() as folder:
        store, parts = JobStore(Path(folder)), []
        for spec in Recipe(scale, HARD, "bench", pieces=("pot",)).data("pot"):
            run_job(spec, KINDS, store)
            parts.append(load_rows(store.folder(spec.id)))
        rows = join_rows(parts)
    torch.set_num_threads(1)
    precisions = ["float32"] + ["bfloat16"] * computes_bfloat16(torch.device("cpu"))
    trainers = [
        Trainer(rows, TrainingSettings.model_validate(
            {"optimiser": "Muon", "learning_rate": 1.2e-2, "batch": 128, "epochs": OWN_EPOCHS,
             "precision": one, "divide_series": True}
        ))
        for one in precisions
    ]  # fmt: skip
    plain = PlainLoop(rows, trainers[0])
    epochs: dict[str, Callable[[], float]] = {"plain": plain.epoch}
    for one, trainer in zip(precisions, trainers, strict=True):
        epochs[one] = partial(_next_loss, trainer.epochs())
    losses: dict[str, list[float]] = {name: [] for name in epochs}
    spent_s: dict[str, list[float]] = {name: [] for name in epochs}
    for number in range(PLAIN_EPOCHS):
        for name, epoch in epochs.items():
            if name == "plain" or number < OWN_EPOCHS:
                begun_s = time.process_time()
                losses[name].append(epoch())
                spent_s[name].append(time.process_time() - begun_s)
    aim, last = min(losses["plain"]), int(np.argmin(losses["plain"])) + 1
    whole_s, figures = sum(spent_s["plain"][:last]), list[Figure]()
    for one in precisions:
        ratio = np.median(spent_s[one]) / np.median(spent_s["plain"])
        name = f"training / plain PyTorch loop, time an epoch, {one}"
        figures.append(stated(name, float(ratio), ""))
        name = f"training / plain PyTorch loop, time to its lowest held-out loss, {one}"
        needed = next((k for k, loss in enumerate(losses[one], 1) if loss <= aim), 0)
        note = f"{needed} of {OWN_EPOCHS} epochs beside {last} of {PLAIN_EPOCHS}; "
        note += f"lowest {min(losses[one]):.4f} and {aim:.4f} nats"
        if needed:
            figures.append(at_most(name, sum(spent_s[one][:needed]) / whole_s, "", 0.5, note))
        else:
            figures.append(Figure(name, "not reached", "", "<= 0.5", False, note))
    return figures


def _next_loss(epochs: Iterator[TrainingEpoch]) -> float:
    return next(epochs).validation_loss


PART = Scale("part", FULL.probes, epochs=2, groups=20, trials=5, repeated=2)
# factor from the measured part of a job kind to the full tables
TIMES = {
    "train": FULL.epochs / PART.epochs,
    "static": FULL.groups / PART.groups,
    "stack": FULL.trials / PART.trials,
    "devices": FULL.repeated / PART.repeated,
}
WORKERS, LIMIT_H = 2, 2.0


@figure("experiments", long=True)
def tables_in_full() -> list[Figure]:
    """Processor time of the parts, scaled; fixed costs are scaled with them, which is too much."""
    use_one_thread()
    spent_s: dict[str, float] = defaultdict(float)
    recipe = Recipe(PART, load_simulation(preset="bench-v1"), "bench", pieces=("mushroom",))
    with tempfile.TemporaryDirectory() as folder:
        store = JobStore(Path(folder))
        for spec in recipe.jobs():
            began_s = time.process_time()
            result = run_job(spec, KINDS, store)
            assert result.state == "done", result.error
            spent_s[spec.kind] += time.process_time() - began_s
    whole_h = {
        kind: len(PIECES) * seconds * TIMES.get(kind, 1.0) / 3600.0
        for kind, seconds in spent_s.items()
    }
    total_h = sum(whole_h.values())
    note = ", ".join(f"{kind} {hours:.2f}" for kind, hours in whole_h.items())
    shared_h, name = total_h / WORKERS, "full tables, two workers that share it evenly"
    return [
        stated("full tables, processor time", total_h, "h", f"{note} h"),
        at_most(name, shared_h, "h", LIMIT_H, "from parts"),
    ]


# Presses of the second world as a laboratory records them: all, per gripping, grippings a mounting
GEL_ELSEWHERE = (45, 5, 3)
LABELS_SEED = 33_000
AIR_S, HELD_S = 0.5, 0.3  # before and after a press; delayed frames still cover the last tick


class RecordedTrials(FiniteGelTrials):
    """Trials of several grippings a mounting, whose presses are kept in ``records``."""

    def __init__(self, scenes: list[Scene], probe: ProbeSettings, grips: list[int]) -> None:
        super().__init__(scenes, probe)
        gel = self._gel
        BatchedTrials.__init__(self, scenes, probe, grips)
        self._gel, self.records = gel, list[tuple[Any, Any]]()

    def _shown(self, record: Any, conditions: Any) -> Any:
        self.records.append((super()._shown(record, conditions), conditions))
        return self.records[-1][0]


def recorded_elsewhere(settings: SimulationSettings, seed: int) -> Recordings:
    """Return recordings of the plan ``gel`` in the second world with the finite-element gel."""
    count, per_grip, per_mounting = GEL_ELSEWHERE
    probe, library = ProbeSettings(ramp_fraction=0.4), load_pieces()
    piece, bottom = library.top("pot"), library.bottom("square15")
    grips = list(range(count // per_grip))
    scenes = [Scene(piece, Tower((bottom.body(),)), (0.0, 0.0), seed + g // per_mounting, settings)
              for g in grips]  # fmt: skip
    world, rng = RecordedTrials(scenes, probe, grips), np.random.default_rng([22, seed])
    presses = []
    for _ in range(per_grip):
        at = draw_offset(rng, piece.face, bottom.face, len(grips))
        world.press(grips, at)
        for g, (record, drawn) in enumerate(world.records[-len(grips) :]):
            signals = native_signals(record, drawn, scenes[g], at[g], rng)
            # As on a bench: by all frames. A ramp of 0.8 s has 3 or 4 ticks in its middle, too few.
            end_s = record.onset_s + probe.duration_s
            slip_mm = press_slip_mm(signals, record.onset_s, end_s)
            ticks = synchronise(signals, record.onset_s)
            if judge_quality(ticks, slip_mm, EpisodeLimits()).accepted:
                presses.append(PressRecording(
                    f"{len(presses)}", f"g{g}", f"m{g // per_mounting}", "pot", "square15", "gel",
                    True, at[g], 0.15, record.onset_s, probe, signals))  # fmt: skip
    return Recordings(tuple(presses), None, (f"second world {seed}",))


def label_elsewhere(
    settings: SimulationSettings, count: int, folder: Path, bottoms: Sequence[str]
) -> None:
    """Write ``count`` labelled probes of the second world as packs, as ``collect`` draws them.

    Five probes a gripping, three grippings a mounting, on each of the ``bottoms`` in turn. A label
    is the commanded displacement.
    """
    _, per_grip, per_mounting = GEL_ELSEWHERE
    library, limits = load_pieces(), EpisodeLimits()
    piece = library.top("pot")
    points, rows = face_points(piece.face), list[PackedEpisode]()
    for number, name in enumerate(bottoms):
        bottom, grips = library.bottom(name), list(range(-(-count // per_grip // len(bottoms))))
        scenes = [Scene(piece, Tower((bottom.body(),)), (0.0, 0.0),
                        LABELS_SEED + 100 * number + g // per_mounting, settings)
                  for g in grips]  # fmt: skip
        world, rng = RecordedTrials(scenes, ProbeSettings(), grips), np.random.default_rng(
            [LABELS_SEED, number])  # fmt: skip
        for probe in range(per_grip):
            at = draw_offset(rng, piece.face, bottom.face, len(grips))
            press = world.press(grips, at)
            patch = bottom.face.contains(points + at[:, None, :])
            for g, reasons in enumerate(refused_presses(press, limits)):
                x_um, y_um = np.rint(1e3 * at[g]).astype(int).tolist()
                rows += [] if reasons else [PackedEpisode(press.observation[g], {
                    "episode": f"{name}-{g}-{probe}", "x_um": x_um, "y_um": y_um, "sigma_um": 150,
                    "source": "commanded", "piece": piece.name, "bottom": name,
                    "patch": patch_hex(patch[g]), "points": len(points), "person": "judge",
                    "grip_id": f"{name}-g{g}", "mounting_id": f"{name}-m{g // per_mounting}",
                    "geometry": piece.sha256, "seed": LABELS_SEED})]  # fmt: skip
    rows.sort(key=lambda row: str(row.label["grip_id"]))
    folder.mkdir(exist_ok=True)
    write_packs(folder, "labels", iter(rows[:count]), {"simulated": "true"})


def native_signals(record: Any, now: Any, scene: Scene, at_mm: Any, rng: Any) -> Recording:
    """Return the signals of one press with the sensor errors of its bench."""
    wrist, tactile = scene.settings.wrist, scene.settings.tactile
    start_s, end_s = record.t_s[0] - AIR_S, record.t_s[-1] + HELD_S
    pose_t_s = np.r_[start_s, record.t_s, end_s]
    path = make_interp_spline(
        pose_t_s, np.vstack([record.air, record.values, record.values[-1]]), 1
    )
    t_s = np.arange(start_s, end_s, 1.0 / wrist.rate_hz)
    white = np.repeat([wrist.white_n, wrist.white_nm], 3)
    walk = np.repeat([wrist.drift_n_sqrt_min, wrist.drift_nm_sqrt_min], 3)
    drift = walk * np.cumsum(rng.standard_normal((len(t_s), 6)), axis=0) / np.sqrt(
        60.0 * wrist.rate_hz)  # fmt: skip
    wrench = wrist_wrench(path(t_s)[:, :6], wrist.height_mm, wrist.yaw_rad) + now.ft_offset[0]
    wrench += white * rng.standard_normal(wrench.shape) + drift
    fall = ProbeSettings().approach_mm_s * AIR_S
    height = np.r_[record.height_mm[0] + fall, record.height_mm, record.height_mm[-1]]
    height = height + scene.grip_height_mm + now.grasp_offset_mm[0, 1]
    give = path(pose_t_s)[:, :2] / now.robot_n_mm[0, :2]
    fields = []
    for k, finger in enumerate(FINGERS):
        at_s = np.arange(start_s + rng.uniform(0.0, 0.04), end_s, 1.0 / tactile.rate_hz)
        at_s = at_s + rng.uniform(-tactile.jitter_s, tactile.jitter_s, len(at_s))
        shown = slice(6 + 126 * k, 132 + 126 * k)
        moved = (path(at_s)[:, shown] - record.air[shown]).reshape(-1, 63, 2) * now.gain[0, k]
        steps = rng.standard_normal((len(at_s), 1, 2)) / np.sqrt(tactile.rate_hz)
        moved += now.bias_px[0, k] + tactile.drift_px_sqrt_s * np.cumsum(steps, axis=0)
        moved += tactile.white_px * rng.standard_normal(moved.shape)
        fields += [MarkerField(finger, n, t, one, one, np.zeros(63, np.uint8), 1.0)
                   for n, (t, one) in enumerate(zip(at_s.tolist(), moved, strict=True))
                   if start_s < t < end_s]  # fmt: skip
    fields.sort(key=lambda field: field.t_s)
    pose = np.column_stack([at_mm + give, height])
    return Recording(t_s, wrench, tuple(fields), (), pose_t_s, pose, np.zeros(6))
