"""Results of the oracle: its worlds press as the bench does, its steps follow Bayes' rule."""

from __future__ import annotations

import errno
import os
import shutil
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from tests.rule_study import (
    INSETS_MM,
    RULE_SEED,
    THRESHOLD_BOTTOMS,
    best_rules,
    count_under_threshold,
    held_out_setup,
    record_trials,
    threshold_jobs,
)
from touchdown.backend.cli import simulate
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.method import FusedSettings, StackSettings
from touchdown.backend.config.simulation import SimulationSettings, load_simulation, settings_with
from touchdown.backend.core import CHANNELS, TACTILE_CHANNELS, ContactPatch, InputError, disk_errors
from touchdown.backend.episodes import TrainingRows
from touchdown.backend.experiments import KINDS, oracle
from touchdown.backend.experiments.comparison import comparison_tables
from touchdown.backend.experiments.fusion import (
    PORTIONS,
    WEIGHTS,
    DataPortion,
    FusionRecipe,
    adopt_tuning,
    labelled_sequences,
    margin_field,
    next_places,
    read_sequences,
    ready_sequences,
)
from touchdown.backend.experiments.models import WEIGHTS as MODELS_WEIGHTS
from touchdown.backend.experiments.models import adopt_models, keep_models
from touchdown.backend.experiments.oracle import (
    ENSEMBLE_SIZE,
    FIRST_STEPS,
    NEXT_STEPS,
    SEAT,
    HypothesisEnsemble,
    OracleSetting,
    OracleStrategy,
    assimilate,
    predict_press,
    select_likely,
)
from touchdown.backend.experiments.strategies import (
    TRIALS_PER_JOB,
    ClosedLoopComparison,
    count_outcomes,
    least_probes,
    run_closed_loop,
    uninformed_model,
)
from touchdown.backend.experiments.tables import (
    CELL_SEEDS,
    FULL,
    QUICK,
    STACKING_SEED,
    STATIC_SEED,
    TRAINING_SEED,
    Recipe,
)
from touchdown.backend.experiments.trials import SceneSetup, stack_in_lockstep, start_scene
from touchdown.backend.geometry.families import FRESH_SEED, UNSEEN_BOTTOMS, UNSEEN_PIECES
from touchdown.backend.geometry.outlines import circle, contact_margins_mm, face_points, square
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.regions import ell
from touchdown.backend.geometry.surfaces import Surface
from touchdown.backend.geometry.tower import Body, Tower
from touchdown.backend.jobs import SPEC_FILE
from touchdown.backend.jobs.execution import SerialExecutor, run_campaign
from touchdown.backend.jobs.job import JobStore, run_job
from touchdown.backend.learning.checkpoint import card_path, load_checkpoint
from touchdown.backend.learning.fused.checkpoint import load_fused, shipped_path
from touchdown.backend.learning.fused.features import TICKS, field_components
from touchdown.backend.learning.fused.training import prepare_sequences
from touchdown.backend.placement.strategies import ProbeObservation
from touchdown.backend.sensing.episode import EpisodeLimits
from touchdown.backend.simulation import BatchedTrials, GraspHistory, Scene
from touchdown.backend.simulation.conditions import (
    DAY_SCORES,
    SEAT_SCORES,
    SeedScope,
    scoped_generator,
)
from touchdown.backend.simulation.ground_truth import scene_mounting

SEED = 51


@pytest.fixture(scope="module")
def bench_v1() -> SimulationSettings:
    return load_simulation(preset="bench-v1")


@pytest.fixture(scope="module")
def scene(bench_v1: SimulationSettings) -> Scene:
    found = start_scene(SceneSetup.of(load_pieces(), "pot", ("short",), bench_v1), SEED)
    assert found is not None
    return found


def setting_of(scene: Scene) -> OracleSetting:
    return OracleSetting(scene.piece, load_pieces().bottom("short"), scene.settings)


def true_world(scene: Scene, bench: BatchedTrials, shift_mm: np.ndarray) -> np.ndarray:
    """The scene's own draws as a row of standard normal scores."""
    spread, settings = scene.settings.spread, scene.settings
    gripping, mounting = bench.grippings[0], scene_mounting(scene)
    low, high = settings.face.foundation_range_n_mm3 or (1.0, 1.0)
    share = np.log(mounting.foundation_n_mm3 / low) / np.log(high / low)
    scores = np.linspace(-5.0, 5.0, 20001)
    row = np.zeros(oracle.COLUMNS)
    row[:2] = shift_mm
    row[[oracle.TILT_X, oracle.TILT_Y]] = np.array(mounting.tilt_rad) / spread.tilt_rad
    row[oracle.STIFFNESS] = np.interp(share, oracle._share(scores), scores)
    row[oracle.GEL] = (gripping.gel_factor - 1.0) / spread.gel
    row[oracle.MU_GRIP] = (gripping.mu_grip / settings.mu_grip - 1.0) / spread.mu_grip
    row[oracle.GRIP] = (gripping.grip_force_n - 10.0) / spread.grip_force_n
    row[[oracle.GRASP_X, oracle.GRASP_Z]] = (
        np.array(gripping.grasp_offset_mm) / spread.grasp_offset_mm
    )
    row[oracle.YAW] = gripping.yaw_rad / spread.yaw_rad
    row[[oracle.GAIN_LEFT, oracle.GAIN_RIGHT]] = (np.array(gripping.gain) - 1.0) / spread.gain
    if not spread.com_mm:
        return row
    places = ((SeedScope.MOUNTING, 0), (SeedScope.PROBE, 0, 0, 1))
    streams = [scoped_generator(scene.seed, s, scene.number, *p).spawn(1)[0] for s, *p in places]
    counts = DAY_SCORES, SEAT_SCORES
    return np.r_[row, *(r.standard_normal(n) for r, n in zip(streams, counts, strict=True))]


@pytest.mark.parametrize("preset", ["bench-v1", "bench-v2"])
def test_the_true_world_feels_what_the_bench_felt(scene: Scene, preset: str) -> None:
    scene = replace(scene, settings=load_simulation(preset=preset))
    bench = BatchedTrials([scene])
    at = bench.start_commands_mm()
    pressed = bench.press([0], at)
    row = true_world(scene, bench, pressed.truth.offset_mm[0] - at[0])
    wrong = row.copy()
    wrong[oracle.TILT_X] += 2.0
    both = HypothesisEnsemble(np.stack([row, wrong]), GraspHistory.fresh(2))
    felt = predict_press(setting_of(scene), both, (at[0, 0], at[0, 1]), np.random.default_rng(1))
    # What the tare left is the same at all ticks: growth is compared, in N and N m.
    growth = np.diff(pressed.observation[0, [1, 19], -6:], axis=0)
    mine = np.diff(felt.observation[:, [1, 19], -6:], axis=1)[:, 0]
    # When the contact was noticed is chance, and moves the press force along its ramp.
    apart = np.abs(mine - growth) / [0.05, 0.05, 0.25, 0.005, 0.005, 0.005]
    assert apart[0].max() < 1.0
    assert apart[1].max() > 3.0


@pytest.mark.parametrize("factors", [FIRST_STEPS, NEXT_STEPS])
def test_where_bayes_can_be_worked_out_the_steps_agree(factors: tuple[float, ...]) -> None:
    assert sum(1.0 / f for f in factors) == pytest.approx(1.0, abs=0.01)
    rng = np.random.default_rng(5)
    value = rng.standard_normal((4000, 2))
    matrix, spread = np.array([[2.0, 1.0], [0.0, 0.5]]), np.diag([0.5, 1.0]) ** 2
    seen = np.array([1.5, -1.0])
    for factor in factors:
        value = assimilate(value, value @ matrix.T, seen, spread, factor, rng)
    precision = np.eye(2) + matrix.T @ np.linalg.inv(spread) @ matrix
    mean = np.linalg.solve(precision, matrix.T @ np.linalg.inv(spread) @ seen)
    assert value.mean(axis=0) == pytest.approx(mean, abs=0.05)
    assert np.cov(value.T) == pytest.approx(np.linalg.inv(precision), abs=0.05)


def test_strays_and_failed_presses_do_not_go_on() -> None:
    felt = np.concatenate([np.zeros((36, 3)), np.full((2, 3), 100.0), np.zeros((2, 3))])
    usable = np.arange(40) < 38
    kept = select_likely(felt, usable, np.zeros(3), np.eye(3), np.random.default_rng(2))
    assert len(kept) == 40
    assert set(kept) == set(range(36))


def test_a_probe_tells_where_the_piece_is(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("touchdown.backend.experiments.oracle.ENSEMBLE_SIZE", 40)
    monkeypatch.setattr("touchdown.backend.experiments.oracle.FIRST_STEPS", (20.0, 1.05))
    bench = BatchedTrials([scene])
    at = bench.start_commands_mm()
    here = (float(at[0, 0]), float(at[0, 1]))
    pressed = bench.press([0], at)
    points = face_points(scene.piece.face)
    patch = ContactPatch(points, np.full(len(points), 0.5))
    reasoner = OracleStrategy(setting_of(scene), here, SEED)

    def error_mm() -> float:
        true = reasoner.worlds.value[:, :2] + at[0]
        return float(np.hypot(*(true - pressed.truth.offset_mm[0]).T).mean())

    before = error_mm()
    concluded = reasoner.conclude(ProbeObservation(pressed.observation[0], patch, here))
    assert error_mm() < 0.7 * before
    assert concluded.action.kind != "give_up"


def test_trials_are_those_of_table_3(bench_v1: SimulationSettings) -> None:
    models = {("pot", "FT+Tac"): "m"}
    table = Recipe(QUICK, bench_v1, "1", models, ("pot",)).stacking("pot", ("long",), "paper")
    plan = ClosedLoopComparison(
        bench_v1, "1", {"pot": "m"}, bottoms=("long",), strategies=("paper",), trials=5
    )
    jobs = plan.jobs()
    assert table is not None
    assert [job.seed - table.seed for job in jobs] == [0, TRIALS_PER_JOB, 2 * TRIALS_PER_JOB]
    assert [job.params["trials"] for job in jobs] == [2, 2, 1]


def test_counts_of_a_cell() -> None:
    trials = [
        {"outcome": "placed", "probes": 4, "least_probes": 2},
        {"outcome": "placed", "probes": 3, "least_probes": 3},
        {"outcome": "fell", "probes": 2, "least_probes": 2},
        {"outcome": "gave_up", "probes": 8, "least_probes": 3},
    ]
    cell = count_outcomes(trials)
    assert (cell["placed"]["value"], cell["unsafe"]["value"]) == (0.5, 0.25)
    assert (cell["probes"], cell["excess_probes_median"]) == (3.5, 1.0)
    assert count_outcomes([])["placed"]["value"] is None


def test_the_least_number_of_probes(scene: Scene) -> None:
    # The pot stands wherever its middle is over the disc of 20 mm: 10 mm, less 0.2 to be sure.
    away = float(np.hypot(*scene.start_mm)) - 9.8
    assert least_probes(scene) == 1 + int(np.ceil(away / 3.0))


def test_letting_go_untested_falls_from_every_start(
    bench_v1: SimulationSettings, tmp_path: Path
) -> None:
    plan = ClosedLoopComparison(
        bench_v1, "1", {}, bottoms=("hex20",), strategies=("pick-and-place",), trials=2
    )
    store = JobStore(tmp_path)
    (job,) = plan.jobs()
    assert run_job(job, {"beyond": run_closed_loop}, store).state == "done"
    (cell,) = plan.table(store)["cells"]
    assert cell["unsafe"]["n"] == 2
    assert cell["placed"]["value"] == 0.0
    (sheet,) = comparison_tables(plan.table(store))
    assert [row[0] for row in sheet.rows] == [
        "pick-and-place pot hex20",
        "pick-and-place pooled one bottom",
    ]


@pytest.mark.parametrize("fixed", [True, False])
def test_side_by_side_each_presses_its_own_bottom(
    bench_v1: SimulationSettings, fixed: bool
) -> None:
    piece = load_pieces().top("pot")
    bottoms = [
        Body("bottom", face, face, 20.0, 30.0, 10.0, fixed=fixed)
        for face in (circle(14.0), square(22.0))
    ]
    scenes = [Scene(piece, Tower((b,)), (0.0, 0.0), 3 + k, bench_v1) for k, b in enumerate(bottoms)]
    places = np.array([[5.0, 1.0], [-6.0, 2.0]])
    together = BatchedTrials(scenes).press([0, 1], places)
    for k in range(2):
        alone = BatchedTrials(scenes[k : k + 1]).press([0], places[k : k + 1])
        np.testing.assert_allclose(together.observation[k], alone.observation[0], atol=2e-3)
        np.testing.assert_allclose(together.truth.offset_mm[k], alone.truth.offset_mm[0], atol=1e-4)
    with pytest.raises(ValueError, match="share"):
        BatchedTrials([scenes[0], replace(scenes[1], piece=load_pieces().top("barrel"))])


def test_a_step_knows_only_where_the_press_acted() -> None:
    rng = np.random.default_rng(2)
    last = np.tile([4.0, 0.0], (500, 1))
    acted = np.tile([-6.0, 0.0], (500, 1))
    step = next_places(last, acted, rng) - last
    assert np.hypot(*step.T).max() <= 3.0 + 1e-9
    assert step[:, 0].mean() < -1.5
    assert abs(step[:, 1].mean()) < 0.3


TINY = {
    "short": DataPortion(0, 60, pieces=1, bottoms=2, probes=2, free=False),
    "free": DataPortion(500, 100, pieces=1, bottoms=1, probes=3, free=True),
    "surface": DataPortion(120, 180, pieces=1, bottoms=2, probes=2, free=False, uneven=True),
}


def tiny(bench: SimulationSettings, **others: Any) -> FusionRecipe:
    return FusionRecipe(bench, "test", {"short": 2, "free": 2}, steps=3, portions=TINY, **others)


def test_from_nothing_to_a_network_with_its_card(
    bench_v1: SimulationSettings, tmp_path: Path
) -> None:
    store = JobStore(tmp_path)
    jobs = tiny(bench_v1).jobs()
    for result in run_campaign(jobs, SerialExecutor(KINDS, store), store):
        assert result.state == "done", result.error
    parts = list(read_sequences(store.folder(job.id) for job in jobs[:2]))
    assert [part["wrench"].shape[2:] for part in parts] == 2 * [(8, CHANNELS - TACTILE_CHANNELS)]
    # Two sequences of two presses and one of three, all padded to three.
    data = prepare_sequences(parts, field_components(parts[0]["field"]), mirror=True)
    assert data.probes.shape[:2] == (4 * 3, 3)
    assert data.there[:2].tolist() == 2 * [[True, True, False]]
    assert not data.probes[:2, 2].any()
    assert data.probes[:2, :2].any(dim=2).all()
    # The start of a sequence overlaps its bottom, and steps are those of a trial or anywhere.
    found = load_fused(store.folder(jobs[-1].id) / WEIGHTS)
    assert found.card.bench_sha256.startswith("03b08d28746d9339")
    assert found.card.left_out == (*UNSEEN_PIECES, *UNSEEN_BOTTOMS)
    # The first part of either portion is held out.
    assert found.card.training["sequences"] == 3
    assert found.card.training["held_out_sequences"] == 3
    again = tiny(bench_v1, seed=1)
    assert not {job.seed for job in again.jobs()[:4]} & {job.seed for job in jobs[:4]}
    # It is fine-tuned on labelled probes, of which every fifth gripping is held out.
    network = store.folder(jobs[-1].id) / WEIGHTS
    tuning = adopt_tuning(store, network, labelled_rows("circle15"), 120.0, 0.25)
    (*parts, tuned) = tiny(bench_v1, tuning=tuning).jobs()
    assert [part.id for part in parts] == [job.id for job in jobs[:-1]]
    (result,) = run_campaign([tuned], SerialExecutor(KINDS, store), store)
    assert result.state == "done", result.error
    other = load_fused(store.folder(tuned.id) / WEIGHTS)
    assert other.card.training["pretrained"] == found.card.weights_sha256
    assert other.card.training["labelled_sequences"] == 4
    assert other.card.training["sequences"] == 3 + 9
    assert other.card.training["held_out_sequences"] == 1
    assert other.card.metrics["pretrained_held_out_loss"] != other.card.metrics["held_out_loss"]
    for name in ("mean", "scale", "modes"):
        np.testing.assert_array_equal(other.arrays[name], found.arrays[name])
    moved = np.abs(other.arrays["probe.weight"] - found.arrays["probe.weight"]).max()
    assert 0.0 < moved < 1e-3
    with pytest.raises(InputError, match="is not convex"):
        adopt_tuning(store, network, labelled_rows("ring24"), 120.0, 0.25)


def labelled_rows(bottom: str) -> TrainingRows:
    """Return ten probes of the pot in five grippings, the grippings in turn."""
    rng = np.random.default_rng(4)
    grips = tuple(f"g{k % 5}" for k in range(10))
    pot, offset = load_pieces().top("pot"), rng.uniform(-5, 5, (10, 2))
    seen = rng.normal(size=(10, 20, CHANNELS)).astype(np.float32)
    patch = np.zeros((10, 4), bool)
    return TrainingRows(
        "pot", pot.sha256, seen, offset, patch, 10 * (bottom,), grips, 10 * ("m",), 10 * ({},)
    )


def test_labelled_probes_of_a_gripping_are_a_sequence() -> None:
    rows = labelled_rows("square15")
    found = labelled_sequences(rows, load_pieces(), sensor_mm=100.0)
    assert found["count"].tolist() == 5 * [2]
    np.testing.assert_allclose(found["true_mm"][3], rows.offset_mm[[3, 8]], rtol=1e-6)
    seen = rows.observation[8, TICKS, TACTILE_CHANNELS:]
    np.testing.assert_array_equal(found["wrench"][3, 1, :, :3], seen[:, :3])
    # The sensor of the network is 20 mm higher: the moment about x gains 20 mm of Fy.
    np.testing.assert_allclose(
        found["wrench"][3, 1, :, 3], seen[:, 3] + 0.02 * seen[:, 1], atol=1e-6
    )
    assert np.abs(found["support_mm"][0]).max() == pytest.approx(7.5)


def test_each_job_draws_its_bench_from_the_ranges(bench_v1: SimulationSettings) -> None:
    ranges = {"grasp.shear_n_mm": [2.0, 3.0], "tactile.mm_per_px.1": [0.06, 0.07]}
    jobs = tiny(bench_v1, ranges=ranges).jobs()[:4]
    benches = [SimulationSettings.model_validate(job.params["bench"]) for job in jobs]
    drawn = [bench.grasp.shear_n_mm for bench in benches]
    assert len(set(drawn)) == 4
    assert all(2.0 <= one <= 3.0 for one in drawn)
    assert all(bench.tactile.mm_per_px[0] == bench_v1.tactile.mm_per_px[0] for bench in benches)
    nominal = {"grasp.shear_n_mm": bench_v1.grasp.shear_n_mm,
               "tactile.mm_per_px.1": bench_v1.tactile.mm_per_px[1]}  # fmt: skip
    assert settings_with(benches[0], nominal) == bench_v1
    for key in ("grasp.nothing", "grasp", "tactile.mm_per_px.7", "grasp.shear_n_mm.0"):
        with pytest.raises(InputError, match="no such number"):
            settings_with(bench_v1, {key: 1.0})


def test_the_wide_family_has_its_own_target_and_leaves_old_jobs_alone(
    bench_v1: SimulationSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert all("outlines" not in job.params for job in tiny(bench_v1).jobs())
    store = JobStore(tmp_path)
    recipe = replace(tiny(bench_v1, outlines="any"), counts={"short": 2, "surface": 2})
    jobs = recipe.jobs()
    assert ["surface" in job.params for job in jobs[:4]] == [False, True, False, True]
    for result in run_campaign(jobs, SerialExecutor(KINDS, store), store):
        assert result.state == "done", result.error
    parts = list(read_sequences(store.folder(job.id) for job in jobs[:4]))
    assert [part["margin_mm"].shape for part in parts] == 4 * [(2, 49, 49)]
    card = load_fused(store.folder(jobs[-1].id) / WEIGHTS).card
    assert card.outlines == "any"
    assert "crescents" in card.family
    assert "stepped" in card.family
    # Such a network is trained further on simulated sequences of its kind alone.
    network = store.folder(jobs[-1].id) / WEIGHTS
    tuning = adopt_tuning(store, network, None, 120.0, 0.5, 1e-3)
    longer = replace(recipe, tuning=tuning, batch=4)
    other = replace(tiny(bench_v1), tuning=tuning).jobs()
    executor = SerialExecutor(KINDS, store)
    ends = [
        *run_campaign(longer.jobs()[-1:], executor, store),
        *run_campaign(other, executor, store),
    ]
    assert [end.state for end in ends] == ["done", *4 * ["done"], "failed"]
    assert "Give --outlines any." in str(ends[-1].error)
    facts = load_fused(store.folder(ends[0].id) / WEIGHTS).card.training
    assert (facts["batch"], facts["learning_rate"]) == (4, 1e-3)
    assert facts["pretrained"] == load_fused(network).card.weights_sha256
    with pytest.raises(InputError, match="Only networks for convex outlines"):
        adopt_tuning(store, network, labelled_rows("circle15"), 120.0, 0.25)
    monkeypatch.setattr("touchdown.backend.experiments.fusion.PORTIONS", TINY)
    ready = ready_sequences(store, bench_v1, "any")
    assert {name: len(some) for name, some in ready.items()} == {
        "short": 2,
        "free": 0,
        "surface": 2,
    }
    # No input of the network depends on the truth.
    data = parts[0]
    truths = {
        name: data[name] + 1 for name in ("margin_mm", "true_mm", "support_mm", "true_com_mm")
    }
    modes = field_components(data["field"])
    both = (prepare_sequences([some], modes, mirror=False) for some in (data, {**data, **truths}))
    first, second = (sequences.probes.numpy() for sequences in both)
    np.testing.assert_array_equal(first, second)


def test_finished_data_of_any_version_train_an_ensemble(
    bench_v1: SimulationSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("touchdown.backend.experiments.fusion.PORTIONS", TINY)
    store = JobStore(tmp_path)
    data = replace(tiny(bench_v1), steps=0)
    jobs = [replace(job, code="an earlier one") for job in data.jobs()]
    assert [job.params["free"] for job in jobs] == [False, True, False, True]
    for job in jobs:
        assert run_job(job, KINDS, store).state == "done"
    # A job that was killed leaves its settings alone.
    killed = replace(jobs[0], code="a later one")
    (store.root / "~killed").mkdir()
    (store.root / "~killed" / SPEC_FILE).write_text(killed.canonical(), encoding="utf-8")
    ready = ready_sequences(store, bench_v1, "convex")
    assert ready == {"short": jobs[::2], "free": jobs[1::2], "surface": []}
    assert not any(ready_sequences(store, bench_v1, "any").values())
    recipe = replace(data, steps=2, ready=ready, networks=2, wrench_alone=True)
    training = recipe.jobs()
    assert [job.kind for job in training] == ["fuse", "fuse", "fuse-join"]
    for result in run_campaign(training, SerialExecutor(KINDS, store), store):
        assert result.state == "done", result.error
    found = load_fused(store.folder(training[-1].id) / WEIGHTS)
    assert found.card.hyper.networks == 2
    assert found.card.training["seeds"] == [0, 1000]
    assert found.card.training["wrench_alone"]
    first, second = found.arrays["answer.weight"]
    assert not np.array_equal(first, second)


def test_nodes_of_the_target_are_the_margins_there() -> None:
    mug, outline = load_pieces().top("mug"), ell(20.0, 16.0, 5.0)
    bottom = Body("bottom", outline, outline, 20.0, 0.0, 10.0, fixed=True)
    off = SimulationSettings.model_validate({"preset": "off"})
    field = margin_field(Scene(mug, Tower((bottom,)), (0.0, 0.0), 1, off))
    assert field.shape == (49, 49)
    near = contact_margins_mm(mug.face, mug.com_xy_mm, outline, np.array([[3.0, -1.5]]))
    assert field[23, 26] == pytest.approx(float(near[0]), abs=0.01)
    # On an inclined bottom the centre of mass moves by the tangent times its height.
    bottom = replace(bottom, surface=Surface((0.0, -0.05)))
    moved = margin_field(Scene(mug, Tower((bottom,)), (0.0, 0.0), 1, off))
    assert 0.3 < float(np.abs(moved - field)[field > 0.5].max()) < 0.05 * mug.com_height_mm + 0.2


def test_no_two_parts_share_a_seed_and_none_has_one_of_the_tables(
    bench_v1: SimulationSettings,
) -> None:
    counts = {name: portion.most for name, portion in PORTIONS.items()}
    seeds: list[int] = []
    for seed in (0, 1):
        jobs = FusionRecipe(bench_v1, "test", counts, seed=seed).jobs()[:-1]
        seeds += [job.seed + k for job in jobs for k in range(240)]
    assert len(set(seeds)) == len(seeds)
    highest = max(TRAINING_SEED, STATIC_SEED, STACKING_SEED) + 100 * CELL_SEEDS
    own = [
        job.seed + k
        for job in threshold_jobs(bench_v1, "test", shipped_path(), 64)
        for k in range(8)
    ]
    assert highest < min(seeds) < max(seeds) < min(own)
    assert len(set(own)) == len(own)


def trial(outcome: str, *steps: tuple[float, float]) -> dict[str, Any]:
    said = [
        {
            "inset_mm": inset,
            "exceeds": {"mixture": len(INSETS_MM) * [p], "minimum": len(INSETS_MM) * [0.9 * p]},
        }
        for inset, p in steps
    ]
    return {"outcome": outcome, "steps": said}


def constant(risk: float, ensemble: Literal["mixture", "minimum"] = "mixture") -> FusedSettings:
    """Return the rule of one risk after every probe."""
    return FusedSettings(risk=risk, first_risk=0.0, inset_mm=0.0, ensemble=ensemble)


def test_counted_by_hand() -> None:
    trials = [
        trial("gave_up", (-1.0, 0.5), (0.5, 0.91), (2.0, 0.99)),
        trial("gave_up", (-0.1, 0.95), (2.0, 0.99)),
        trial("knocked_over", (-3.0, 0.1)),
        trial("aborted", (1.0, 0.8)),
    ]
    bold, shy, never = (count_under_threshold(trials, constant(p)) for p in (0.1, 0.02, 0.001))
    assert (bold["placed"], bold["unsafe"], bold["not_released"], bold["probes"]) == (1, 2, 1, 2.0)
    assert (shy["placed"], shy["unsafe"], shy["not_released"], shy["probes"]) == (2, 1, 1, 2.5)
    assert (never["placed"], never["unsafe"], never["not_released"]) == (0, 1, 3)
    once = count_under_threshold(trials, constant(0.1), most=1)
    assert (once["placed"], once["unsafe"], once["not_released"]) == (0, 1, 3)
    least = count_under_threshold(trials, constant(0.11, "minimum"))
    assert (least["placed"], least["unsafe"], least["not_released"]) == (2, 1, 1)
    # 1 %, 3.2 % and 10 % are accepted after the first, second and third probe.
    grown = FusedSettings(risk=0.1, first_risk=0.01, inset_mm=0.0, ensemble="mixture")
    later = count_under_threshold(trials, grown, most=3)
    assert (later["placed"], later["unsafe"], later["probes"]) == (2, 1, 2.5)


def test_the_best_rules_place_more_for_each_further_unsafe_trial() -> None:
    rows = [(3, 60), (0, 20), (1, 50), (0, 30), (2, 45), (1, 40)]
    rules = [{"unsafe": unsafe, "placed": placed} for unsafe, placed in rows]
    kept = [(rule["unsafe"], rule["placed"]) for rule in best_rules(rules)]
    assert kept == [(0, 30), (1, 50), (3, 60)]


def test_a_rule_counts_what_trials_under_it_come_to() -> None:
    """The strategy itself, let go by the rule, on the same seeds."""
    settings = SimulationSettings.model_validate(
        {"preset": "off", "support": {"rocks": False, "slides": False}}
    )
    case, seeds = held_out_setup("pot", "disc 22", settings), range(70, 73)
    rule = StackSettings(strategy="fused", fused=FusedSettings(risk=0.1, inset_mm=0.5))
    found = count_under_threshold(record_trials([case] * 3, seeds, shipped_path()), rule.fused)
    scenes = [scene for seed in seeds if (scene := start_scene(case, seed)) is not None]
    ends = stack_in_lockstep(scenes, uninformed_model(case), rule, EpisodeLimits())
    words = [end.outcome.value for end in ends]
    assert words.count("placed") == found["placed"]
    assert words.count("fell") == found["unsafe"]


def test_rules_for_any_outline_are_counted_on_fresh_ones_of_another_seed(
    bench_v1: SimulationSettings,
) -> None:
    jobs = threshold_jobs(bench_v1, "test", shipped_path(), 2, "any")
    assert [job.params["piece"] for job in jobs] == 2 * ["mushroom", "barrel", "pot"]
    assert len({job.seed + k for job in jobs for k in range(10)}) == 60
    assert {job.params["outline_seed"] for job in jobs} == {RULE_SEED} != {FRESH_SEED}
    settings = SimulationSettings.model_validate(
        {"preset": "off", "support": {"rocks": False, "slides": False}, "release_disturbance_mm": 1}
    )
    params = {**jobs[0].params, "bench": settings.model_dump(mode="json")}
    # A ring, three feet or more, and two bars: the margins are those of the exact judge.
    seeds = [jobs[0].seed + k for k in (4, 6, 7)]
    cases = [SceneSetup.of_trial(params, seed) for seed in seeds]
    rule = StackSettings(
        strategy="fused", fused=FusedSettings(risk=0.5, first_risk=0.0, inset_mm=0.0)
    )
    scenes = [scene for c, s in zip(cases, seeds, strict=True) if (scene := start_scene(c, s))]
    model, limits = uninformed_model(cases[0]), EpisodeLimits()
    ends = stack_in_lockstep(scenes, model, rule, limits)
    recorded = record_trials(cases, seeds, shipped_path())
    for end, trial in zip(ends, recorded, strict=True):
        assert end.verdict is not None
        margin = trial["steps"][end.probes - 1]["inset_mm"]
        assert margin == pytest.approx(end.verdict.margin_mm, abs=0.05)


@pytest.mark.parametrize("name", THRESHOLD_BOTTOMS)
def test_no_bottom_of_the_tables_is_among_them(name: str) -> None:
    catalogue = load_pieces()
    tables = {catalogue.bottom(b).face for b in ("short", "long", "hex20", "rect12x28")}
    assert THRESHOLD_BOTTOMS[name] not in tables


SHIPPED = Path(str(files("touchdown.resources"))) / "models" / "bench-v1"
RECIPE = Recipe(FULL, SimulationSettings(), "1", pieces=("pot",))
NAMES = ("FT", "FT+Tac")


class KilledError(BaseException):
    """What no code catches, as little as SIGKILL: what follows it is left undone."""


@pytest.fixture(scope="module")
def stores(tmp_path_factory: pytest.TempPathFactory) -> list[JobStore]:
    """Two experiments that trained two models each, under the same names."""
    made = []
    for shift in (0, 1):
        store = JobStore(tmp_path_factory.mktemp("jobs"))
        for k, name in enumerate(NAMES):
            spec = RECIPE.training("pot", name)
            given = SHIPPED / f"pot-{NAMES[(k + shift) % 2].lower()}.safetensors"
            with store.writing(spec) as part:
                shutil.copyfile(given, part / MODELS_WEIGHTS)
                shutil.copyfile(card_path(given), card_path(part / MODELS_WEIGHTS))
                store.finish(spec, part, {})
        made.append(store)
    return made


def at_call(monkeypatch: pytest.MonkeyPatch, name: str, ends: int, error: BaseException) -> None:
    """Let the ``ends``-th call of ``os.fsync`` or ``Path.replace`` raise ``error``."""
    owner = os if name == "fsync" else Path
    real, left = getattr(owner, name), iter(range(ends))

    def call(*args: object) -> object:
        if next(left, None) is None:
            raise error
        return real(*args)

    monkeypatch.setattr(owner, name, call)


def refusal(path: Path) -> InputError | None:
    """Return why a model is not loaded, which must name its file; None for one that is whole."""
    try:
        load_checkpoint(path)
    except InputError as error:
        return error if str(path.with_suffix("")) in error.where else pytest.fail(str(error))
    return None


# Each model is two files; each of them is synced, renamed, and then its folder is synced.
POINTS = [("replace", 0), ("replace", 1), ("replace", 2), ("fsync", 1), ("fsync", 2)]


@pytest.mark.parametrize(("name", "at"), POINTS)
def test_killed_at_any_point_each_model_is_whole_or_refused(
    stores: list[JobStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, at: int
) -> None:
    keep_models(stores[0], RECIPE, tmp_path)
    whole = {p.name: load_checkpoint(p).card.weights_sha256 for p in tmp_path.glob("*.safetensors")}
    assert len(whole) == 2
    with monkeypatch.context() as patch:
        at_call(patch, name, at, KilledError())
        with pytest.raises(KilledError):
            keep_models(stores[1], RECIPE, tmp_path)
    told = [refusal(path) for path in sorted(tmp_path.glob("*.safetensors"))]
    assert len([error for error in told if error is not None]) <= 1
    kept = keep_models(stores[1], RECIPE, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        name for path in kept for name in (path.name, card_path(path).name)
    )
    again = {p.name: load_checkpoint(p).card.weights_sha256 for p in kept}
    assert set(again.values()) == set(whole.values())
    assert again != whole


def test_a_full_disk_is_one_clear_error_and_the_next_try_is_whole(
    stores: list[JobStore], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    with monkeypatch.context() as patch:
        at_call(patch, "fsync", 4, full)
        written = disk_errors("It could not be written", tmp_path, "Make room.")
        with pytest.raises(InputError, match="No space left"), written:
            keep_models(stores[0], RECIPE, tmp_path)
    assert not list(tmp_path.glob(".*"))
    keep_models(stores[0], RECIPE, tmp_path)
    assert len(adopt_models(JobStore(tmp_path / "other"), tmp_path)) == 2


def test_the_oracle_counts_on_the_errors_of_bench_v2_that_no_probe_shows() -> None:
    bench = load_simulation(preset="bench-v2")
    scene = start_scene(SceneSetup.of(load_pieces(), "pot", ("short",), bench), SEED)
    assert scene is not None
    exact = {"release_disturbance_mm": 0.0, "spread": bench.spread.model_copy(update={"com_mm": 0})}
    risks = []
    for one in (bench, bench.model_copy(update=exact)):
        oracle = OracleStrategy(replace(setting_of(scene), settings=one), (0.0, 0.0), SEED)
        value = oracle.worlds.value
        assert value.shape == (ENSEMBLE_SIZE, SEAT.stop)
        value[:, :2] = 0.0  # every hypothesis knows the place
        risks.append(oracle._at_risk_mm((0.0, 0.0)))
    # Pot (15 mm) in the middle of a disc of 20 mm: 10 mm without errors; with them about
    # 0.6 mm less on average (the length of a normal pair) and 2.33 standard deviations.
    assert risks[1] == pytest.approx(10.0, abs=0.05)
    assert risks[1] - 3.0 < risks[0] < risks[1] - 1.5


def test_jobs_of_simulate_draw_their_bench_within_the_ranges_but_the_first(
    monkeypatch, tmp_path
) -> None:
    ranges, given = tmp_path / "lab-bench.json", []
    ranges.write_text('{"randomisation": {"grasp.shear_n_mm": [3.0, 5.0]}}', "utf-8")
    monkeypatch.setattr(simulate, "run_jobs", lambda *args: given.extend(args[4]) or 0)
    words = ["simulate", "--bottoms", "circle15,square15", "--episodes", "3000", "--seed", "4"]
    main([*words, "--ranges", str(ranges), "--out", str(tmp_path / "out")])
    own = load_simulation().grasp.shear_n_mm
    for bottom in ("circle15", "square15"):
        jobs = [job.params for job in given if job.params["bottom"] == bottom]
        assert sum(job["probes"] for job in jobs) == 3000
        first, *others = [job["bench"]["grasp"]["shear_n_mm"] for job in jobs]
        assert first == own
        assert len(set(others)) == len(others) == 2
        assert all(3.0 <= one <= 5.0 for one in others)
    assert len({job.params["bench"]["grasp"]["shear_n_mm"] for job in given}) == 5
