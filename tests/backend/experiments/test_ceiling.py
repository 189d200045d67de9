"""The ceiling knows the bench: its worlds press as the bench does, its steps are Bayes' where that
can be worked out by hand, and its trials are those of Table 3.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.config.simulation import SimulationSettings, load_simulation
from touchdown.backend.core.values import ContactPatch
from touchdown.backend.experiments import oracle
from touchdown.backend.experiments.comparison import comparison_tables
from touchdown.backend.experiments.oracle import (
    FIRST_STEPS,
    NEXT_STEPS,
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
)
from touchdown.backend.experiments.tables import QUICK, Recipe
from touchdown.backend.experiments.trials import SceneSetup, start_scene
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.jobs.job import JobStore, run_job
from touchdown.backend.placement.strategies import ProbeObservation
from touchdown.backend.simulation.batch import BatchedTrials
from touchdown.backend.simulation.gripper import scene_mounting
from touchdown.backend.simulation.mechanics import GraspHistory
from touchdown.backend.simulation.scene import Scene

SEED = 51


@pytest.fixture(scope="module")
def bench_v1() -> SimulationSettings:
    return load_simulation(preset="bench-v1")


@pytest.fixture(scope="module")
def scene(bench_v1: SimulationSettings) -> Scene:
    found = start_scene(SceneSetup.of(load_pieces(), "pot", ("short",), bench_v1), SEED)
    assert found is not None
    return found


def setting_of(scene: Scene, *, known: bool = True) -> OracleSetting:
    return OracleSetting(scene.piece, load_pieces().bottom("short"), scene.settings, known)


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
    return row


def test_the_true_world_feels_what_the_bench_felt(scene: Scene) -> None:
    bench = BatchedTrials([scene])
    at = bench.start_commands_mm()
    pressed = bench.press([0], at)
    row = true_world(scene, bench, pressed.true_mm[0] - at[0])
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


def test_a_round_bottom_of_the_right_size_is_the_known_one(scene: Scene) -> None:
    value = np.zeros((1, oracle.COLUMNS))
    value[0, :2] = 5.0, 2.0  # the middle of the diameters that may be is that of Short: 20 mm
    one = HypothesisEnsemble(value, GraspHistory.fresh(1))
    known, unknown = (
        predict_press(setting_of(scene, known=known), one, (0.0, 0.0), np.random.default_rng(4))
        for known in (True, False)
    )
    assert np.array_equal(known.observation, unknown.observation)
    assert known.usable.all()


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
        return float(np.hypot(*(true - pressed.true_mm[0]).T).mean())

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
    (sheet,) = comparison_tables({**plan.table(store), "gaps": []})
    assert [row[0] for row in sheet.rows] == [
        "pick-and-place pot hex20",
        "pick-and-place pooled one bottom",
    ]


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["--strategies", "luck"], "--strategies"),
        (["--bottoms", "table"], "--bottoms"),
        (["--trials", "0"], "--trials"),
    ],
)
def test_bad_words_are_refused(
    words: list[str], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path), "--pieces", "pot"]
    assert main(["experiment", "beyond", *out, *words, "--json"]) == 2
    assert where in json.loads(capsys.readouterr().err)["error"]["where"]
