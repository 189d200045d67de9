"""The experiments as a campaign: nothing leaks, everything is traced, the numbers repeat."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.bench_description import bench_sha256
from touchdown.backend.config.simulation import SimulationSettings, load_simulation
from touchdown.backend.core import (
    ActionChosen,
    BeliefMap,
    BeliefUpdated,
    Event,
    InputError,
    MarkerField,
    Outcome,
    PlaceAction,
    RunStarted,
    Stability,
    StabilityJudged,
    SupportKind,
    TrialFinished,
    TrialStarted,
    program_version,
)
from touchdown.backend.experiments import document, statics
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.models import (
    adopt_models,
    keep_models,
    load_model,
    shipped_model_folders,
)
from touchdown.backend.experiments.results import DATA, PAGE, write_tables
from touchdown.backend.experiments.run_report import _with_arrows, wrench_svg, write_run_report
from touchdown.backend.experiments.statics import ProbeGroups
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    estimate_rate,
    reliability_curve,
    verdict_changes,
)
from touchdown.backend.experiments.tables import (
    FULL,
    JOB_FUNCTIONS,
    MODELS,
    PIECES,
    QUICK,
    STABILITY,
    TABLE_BOTTOMS,
    TRAINING_BOTTOMS,
    Recipe,
    Scale,
    VerdictSample,
    agreement,
    job_code,
    score_verdicts,
    stacking_cell,
)
from touchdown.backend.experiments.trials import (
    BatchModel,
    SceneSetup,
    balanced_offset,
    start_scene,
)
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.sampling import MAX_LEAN_MM
from touchdown.backend.jobs.execution import SerialExecutor, run_campaign
from touchdown.backend.jobs.job import SPEC_FILE, JobSpec, JobStore, run_job
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.simulation.batch import BatchedTrials, TrialPresses
from touchdown.backend.simulation.gripper import scene_mounting

HARD = SimulationSettings.model_validate({"preset": "hard"})
TABLES = {"table1", "table2", "table3"}
TINY = Scale("tiny", 30, 1, 4, 2, 2, 1, 5, 2, fused=3)


def test_full_has_the_papers_counts() -> None:
    jobs = Recipe(FULL, HARD, "1").jobs()
    kinds = [spec.kind for spec in jobs]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "simulate": 9,
        "train": 12,
        "static": 12,
        "stack": 15,
        "devices": 9,
    }
    collected = [spec.params["episodes"] for spec in jobs if spec.kind == "simulate"]
    assert collected == [2000] * 9
    assert {spec.params["epochs"] for spec in jobs if "epochs" in spec.params} <= {30}
    sample = [spec.params for spec in jobs if spec.params.get("protocol") == "paper"]
    assert [p["mountings"] * p["grips"] * p["probes"] for p in sample] == [400] * 6


def test_inputs_come_before_what_needs_them_and_no_job_twice() -> None:
    seen: set[str] = set()
    for spec in Recipe(FULL, HARD, "1").jobs():
        assert spec.id not in seen
        assert set(spec.inputs) <= seen
        seen.add(spec.id)


def test_another_bench_or_program_is_another_experiment() -> None:
    mixed = SimulationSettings()
    ids = [
        {spec.id for spec in Recipe(FULL, bench, code).jobs()}
        for bench, code in ((HARD, "1"), (mixed, "1"), (HARD, "2"))
    ]
    assert not ids[0] & ids[1]
    assert not ids[0] & ids[2]


def test_no_seed_of_an_evaluation_serves_twice_or_in_training() -> None:
    used: set[int] = set()
    jobs = [s for s in Recipe(FULL, HARD, "1").jobs() if s.kind in ("static", "stack")]
    cells: dict[str, set[int]] = {}
    for spec in jobs:
        p = spec.params
        count = p.get("groups") or p.get("mountings") or 2 * p["trials"]
        seeds = set(range(spec.seed, spec.seed + count))
        # Strategies are compared on the same trials; cells of other pairs share none.
        cell = f"{spec.kind} {spec.params['piece']} {spec.params.get('bottoms')}"
        cell += f"{p.get('bottom')} {p.get('protocol')}"
        if cell in cells:
            assert cells[cell] == seeds
            continue
        cells[cell] = seeds
        assert not used & seeds
        used |= seeds
    assert not {s.seed for s in Recipe(FULL, HARD, "1").jobs() if s.kind == "simulate"} & used


def test_unseen_outlines_are_unlike_those_of_the_training() -> None:
    catalogue = load_pieces()
    line = np.arange(-20, 20, 0.1)
    grid = np.stack(np.meshgrid(line, line), axis=-1)
    for unseen in (*TABLE_BOTTOMS, "hex20", "rect12x28"):
        inside = catalogue.bottom(unseen).face.contains(grid)
        for known in TRAINING_BOTTOMS:
            other = catalogue.bottom(known).face.contains(grid)
            assert (inside & other).sum() / (inside | other).sum() <= 0.90


@pytest.mark.parametrize("stable", [True, False])
def test_a_balanced_sample_is_what_it_says(stable: bool) -> None:
    case = SceneSetup.of(load_pieces(), "mushroom", ("short",), HARD)
    places = np.stack([balanced_offset(case, seed, 0, stable=stable) for seed in range(40)])
    # Both faces are round and the centre of mass is central: the edge is the smaller circle.
    assert ((np.hypot(*places.T) < 10.0) == stable).all()
    assert np.hypot(*places.T).std() > 1.0


@pytest.mark.parametrize("bottoms", [("short",), ("short", "long"), ("short", "rect12x28")])
def test_a_trial_starts_where_the_devices_would_start_it(bottoms: tuple[str, ...]) -> None:
    catalogue = load_pieces()
    case = SceneSetup.of(catalogue, "pot", bottoms, HARD)
    theirs = make_scene(catalogue, SceneChoice("pot", bottoms, 4), HARD)
    mine = start_scene(case, 4)
    assert mine is not None
    assert mine.start_mm == theirs.start_mm
    assert mine.bottoms == theirs.bottoms


def test_two_bottoms_lean_by_up_to_six_millimetres() -> None:
    case = SceneSetup.of(load_pieces(), "pot", ("short", "long"), HARD)
    scenes = [start_scene(case, seed) for seed in range(60)]
    reach = [np.hypot(*scene.bottoms.bodies[1].at_mm) for scene in scenes if scene]
    assert len(reach) >= 55
    assert max(reach) <= MAX_LEAN_MM
    assert 2.0 < np.mean(reach) < 4.0


def test_a_tiny_campaign_gives_traced_tables_that_repeat(tmp_path: Path) -> None:
    recipe = Recipe(TINY, SimulationSettings(), "1", pieces=("pot",))
    answers = []
    for name in ("first", "second"):
        store = JobStore(tmp_path / name / "jobs")
        results = list(run_campaign(recipe.jobs(), SerialExecutor(KINDS, store), store))
        assert [r.error for r in results if r.state == "failed"] == []
        answers.append(write_tables(tmp_path / name, recipe, store)[1])
    assert answers[0] == answers[1]
    assert (tmp_path / "first" / DATA).is_file()
    page = (tmp_path / "first" / PAGE).read_text("utf-8")
    assert "SIMULATED BENCH" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    own = answers[0]["paper_protocol"]
    kept = JobStore(tmp_path / "first" / "jobs")
    for rows in (found[name] for found in (answers[0], own) for name in TABLES & set(found)):
        for cell in (cell for row in rows for cell in row["cells"]):
            assert_traced(cell, kept, recipe)
    assert own["interactions"] == TINY.mountings * TINY.grips * TINY.fused
    assert own["table1"][0]["cells"][0]["n"] == TINY.mountings
    assert "Table 2, paper&#x27;s protocol: stability" in page
    assert answers[0]["sources"]["static"] == job_code("static", "1").partition("+")[2]
    assert f"static {answers[0]['sources']['static']}" in page
    assert answers[0]["table1"][0]["cells"][0]["n"] == TINY.groups
    methods = {row["method"]: row for row in answers[0]["table2"]}
    assert methods["Implicit"]["cells"][0]["accuracy"]["n"] <= TINY.groups
    assert "accuracy" not in methods["5"]["cells"][0]
    kept = keep_models(store, recipe, tmp_path / "kept")
    assert len(kept) == len(MODELS)
    again = adopt_models(JobStore(tmp_path / "other"), tmp_path / "kept")
    assert set(again) == {("pot", name) for name, _, _ in MODELS}


def assert_traced(cell: dict[str, Any], store: JobStore, recipe: Recipe) -> None:
    """From the cell to its run folder: config, bench, program, seed, networks and their data."""

    def spec_of(job: str) -> JobSpec:
        spec = JobSpec.parse((store.folder(job) / SPEC_FILE).read_text("utf-8"))
        assert (spec.id, spec.code.partition("+")[0]) == (job, recipe.code)
        return spec

    spec = spec_of(cell["job"])
    assert (spec.seed, spec.params["piece"]) == (cell["seed"], cell["piece"])
    assert spec.params["bench"] == recipe.bench.model_dump(mode="json")
    assert store.result(spec.id)["bench_sha256"] == bench_sha256(recipe.bench)
    blind = spec.params.get("strategy") == "pick-and-place"
    assert bool(spec.inputs) is not blind
    for training in spec.inputs:
        assert len(store.result(training)["data_sha256"]) == 64
        collected = spec_of(training).inputs
        assert {spec_of(one).params["bottom"] for one in collected} == set(TRAINING_BOTTOMS)
        for one in collected:
            assert sum(1 for _ in store.folder(one).glob("*.mcap")) >= 1


def test_quick_uses_models_that_exist_and_leaves_other_cells_empty(tmp_path: Path) -> None:
    store = JobStore(tmp_path / "jobs")
    models = adopt_models(store, *shipped_model_folders("mixed"))
    assert {("pot", "FT+Tac"), ("barrel", "FT+Tac"), ("mushroom", "FT+Tac")} <= set(models)
    assert adopt_models(store, *shipped_model_folders("mixed")) == models
    assert load_model(models["pot", "FT+Tac"], store).card.piece == "pot"
    with pytest.raises(InputError, match="no such model"):
        load_model("0" * 32, store)
    only = {("pot", "FT+Tac"): models["pot", "FT+Tac"]}
    recipe = Recipe(replace(QUICK, groups=4, trials=2), HARD, "1", only, ("pot",))
    assert {spec.kind for spec in recipe.jobs()} == {"static", "stack"}
    alone = Recipe(STABILITY, HARD, "1", only, ("pot",))
    assert {spec.kind for spec in alone.jobs()} == {"static"}
    assert recipe.static("barrel", "short") is None
    names = {name for name, _, _ in MODELS}
    assert set(recipe.jobs()[1].params["models"]) < names
    assert PIECES == ("mushroom", "barrel", "pot")


@pytest.mark.slow
def test_trials_are_repeated_on_the_devices_with_the_same_model(tmp_path: Path) -> None:
    store = JobStore(tmp_path / "jobs")
    models = adopt_models(store, *shipped_model_folders("mixed"))
    only = {("pot", "FT+Tac"): models["pot", "FT+Tac"]}
    recipe = Recipe(replace(QUICK, trials=1, repeated=1), HARD, "1", only, ("pot",))
    cells = [recipe.stacking("pot", ("short",), "paper"), recipe.devices("pot", ("short",))]
    answers = []
    for cell in cells:
        assert cell is not None
        spec = replace(cell, seed=cell.seed + 2)  # a short trial
        assert run_job(spec, KINDS, store).error == ""
        answers.append(store.result(spec.id)["trials"])
    assert agreement(*answers)["same_outcome"] == 1
    assert [trial["probes"] for (trial,) in answers] == [3, 3]


def test_agreement_is_counted_by_seed() -> None:
    batch = [
        {"seed": 1, "outcome": "placed", "probes": 3},
        {"seed": 2, "outcome": "fell", "probes": 2},
        {"seed": 3, "outcome": "placed", "probes": 2},
    ]
    devices = [
        {"seed": 2, "outcome": "placed", "probes": 4},
        {"seed": 1, "outcome": "placed", "probes": 3},
    ]
    assert agreement(batch, devices) == {
        "trials": 2,
        "same_outcome": 1,
        "placed_batch": 1,
        "placed_devices": 2,
        "probes_apart": 1.0,
    }


def test_models_trained_on_the_frozen_bench_win_over_those_of_the_default_one(
    tmp_path: Path,
) -> None:
    store = JobStore(tmp_path / "jobs")
    general = adopt_models(store, *shipped_model_folders("mixed"))
    own = adopt_models(store, *shipped_model_folders("bench-v1"))
    assert all(own[piece, "FT+Tac"] != general[piece, "FT+Tac"] for piece in PIECES)
    assert set(own) >= {(piece, name) for piece in PIECES for name, _, _ in MODELS}
    card = load_model(own["pot", "FT"], store).card
    assert (card.modality, card.training["keep"]) == ("FT", "last")


def test_an_empty_folder_of_models_is_bad_input(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no models here"):
        adopt_models(JobStore(tmp_path / "jobs"), tmp_path)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"), [(8, 10, 0.490, 0.943), (40, 60, 0.541, 0.773), (0, 60, 0.0, 0.049)]
)
def test_intervals_of_the_papers_counts(k: int, n: int, low: float, high: float) -> None:
    found = estimate_rate(k, n)
    assert (found.low, found.high) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))
    assert estimate_rate(0, 0).value is None


def test_the_interval_of_a_mean_covers_it_as_often_as_promised() -> None:
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(400):
        found = estimate_mean(np.clip(rng.normal(0.5, 0.1, 40), 0, 1).tolist())
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.5 <= found.high
    assert 0.91 <= held / 400 <= 0.98


@pytest.mark.parametrize(
    ("values", "half"),
    # 1.96 s / sqrt(n) with s of n - 1 degrees of freedom: 0.1414 of two, 0.2 of three.
    [((0.4, 0.6), 0.1960), ((0.3, 0.5, 0.7), 0.2263), ((0.5,), 0.5)],
)
def test_the_interval_of_few_values_by_hand(values: tuple[float, ...], half: float) -> None:
    found = estimate_mean(values)
    assert (found.value, found.n) == (pytest.approx(0.5), len(values))
    assert found.low == pytest.approx(0.5 - half, abs=1e-4)
    assert found.high == pytest.approx(0.5 + half, abs=1e-4)


def test_counts_of_a_yes_or_no_answer() -> None:
    said = [True, True, True, False, False, False, False]
    true = [True, True, False, True, False, False, False]
    binary = VerdictCounts.of(said, true)
    assert binary == VerdictCounts(both=2, missed=1, unsafe=1, neither=3)
    found = binary.as_json()
    assert found["accuracy"]["value"] == pytest.approx(5 / 7)
    assert found["balanced"] == pytest.approx(0.5 * (2 / 3 + 3 / 4))
    assert found["base_rate"] == pytest.approx(4 / 7)
    assert binary + binary == VerdictCounts(both=4, missed=2, unsafe=2, neither=6)


def test_cases_too_close_to_call_are_left_out_and_no_support_is_not() -> None:
    margins = [[1.0, 1.0], [0.1, 0.1], [-0.3, -0.3], [None, None], [2.0, -1.0]]
    says = [True, True, True, False, True]
    every, left_out = score_verdicts(says, margins, interface=1)
    assert left_out == 1
    assert every == VerdictCounts(both=1, missed=0, unsafe=2, neither=1)
    top, _ = score_verdicts(says, margins, interface=0)
    assert top == VerdictCounts(both=2, missed=0, unsafe=1, neither=1)


def test_every_trial_counts() -> None:
    trials = [
        {"outcome": "placed", "probes": 3, "margins_mm": [4.0, 1.0]},
        {"outcome": "fell", "probes": 2, "margins_mm": [-0.5, 2.0]},
        {"outcome": "knocked_over", "probes": 1, "margins_mm": None},
        {"outcome": "gave_up", "probes": 8, "margins_mm": None},
        {"outcome": "aborted", "probes": 0, "margins_mm": None},
    ]
    cell = stacking_cell(trials)
    assert (cell["n"], cell["value"], cell["unsafe_releases"]) == (5, 0.2, 2)
    assert cell["probes"] == 3
    # The top interface alone would have called the second one placed.
    assert cell["top_interface"]["value"] == 0.4


def test_honest_probabilities_lie_on_the_diagonal_and_boasting_ones_do_not() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(60_000)
    truth = rng.random(60_000) < p
    honest = reliability_curve(p, truth)
    assert honest["ece"] < 0.01
    assert max(honest["count"]) - min(honest["count"]) <= 1
    boasting = np.where(p > 0.5, 0.5 + 0.5 * p, 0.5 * p)
    # An even number of bins: none lies across the middle, where both errors would cancel.
    assert reliability_curve(boasting, truth, bins=14)["ece"] == pytest.approx(0.125, abs=0.01)


HULL = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.0], [0.0, 2.0]])


def belief() -> BeliefMap:
    log_odds = np.zeros((5, 7))
    log_odds[0, 0], log_odds[4, 6] = -20.0, 20.0
    return BeliefMap(log_odds, np.ones((5, 7), dtype=bool), (-3.0, -2.0), 1.0, 1)


def facts(outcome: Outcome = Outcome.PLACED, probes: int = 2, piece: str = "pot") -> list[Event]:
    told: list[Event] = [
        RunStarted(0.0, "r", piece, "short", "paper", 3, 1, True, "{}"),
        TrialStarted(0.0, 1, 3, (1.0, 2.0)),
    ]
    for n in range(1, probes + 1):
        kind = "release" if n == probes else "shift"
        told += [
            BeliefUpdated(1.0, belief(), n),
            StabilityJudged(
                1.0, Stability(True, 1.0, SupportKind.AREA, HULL, (1.0, 1.0), "belief"), n
            ),
            ActionChosen(1.0, PlaceAction(kind, (0.5, 0.0), None, False, f"reason {n}"), n, 2.0),
        ]
    told.append(TrialFinished(2.0, 1, 3, outcome, "it <stands>", probes, 0, 1.25))
    return told


def page(tmp_path: Path, *runs: list[Event]) -> str:
    path = tmp_path / "report.html"
    write_run_report(path, runs, {"short": np.array([[0.0, 0], [1, 0], [0, 1]])})
    return path.read_text("utf-8")


def test_a_report_names_its_date_program_and_model_and_the_scale_of_its_colours(
    tmp_path: Path,
) -> None:
    model = json.dumps({"model": {"piece": "pot", "weights_sha256": "0123456789abcdef" * 4}})
    network = json.dumps({"method": {"fused": {"weights": ""}}})
    told = facts()
    fused = replace(told[0], strategy="fused", settings=network)
    text = page(tmp_path, [replace(told[0], settings=model), *told[1:]], [fused, *told[1:]])
    assert f"Written on {datetime.now():%Y-%m-%d} at" in text
    assert f"by touchdown {program_version()}." in text
    assert "strategy paper, model of pot 0123456789abcdef, seed 3." in text
    assert "strategy fused, the shipped network, seed 3." in text
    for drawing in re.findall(r"<svg.*?</svg>", text):
        assert [f">{p}</text>" in drawing for p in ("p", "0", "0.5", "1")] == [True] * 4
        document.check_svg(drawing)


def test_forces_of_a_probe_have_axes_with_units() -> None:
    observation = np.zeros((20, 258))
    observation[:, 254] = np.linspace(0.375, 7.5, 20)
    drawing = wrench_svg(SimpleNamespace(observation=observation))  # type: ignore[arg-type]
    for text in ("F (N) over time after contact (s)", "+7.5", "\N{MINUS SIGN}7.5", "Fz", "2"):
        assert f">{text}</text>" in drawing
    force_z = re.findall(r'points="([^"]+)"', drawing)[2].split()
    # 2 s and the largest force lie at the ends of the axes.
    assert force_z[-1] == "202.0,14.0"
    document.check_svg(drawing)


@pytest.mark.promise("D9")
def test_text_from_outside_is_escaped(tmp_path: Path) -> None:
    text = page(tmp_path, facts(piece="<script>alert(1)</script>"))
    assert "<script>" not in text
    assert "it &lt;stands&gt;" in text


def test_the_picture_is_the_belief_with_y_up(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=1))
    data = re.search(r"data:image/png;base64,([A-Za-z0-9+/=]+)", text)
    assert data is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (5, 7, 3)
    brightness = image.astype(int).sum(axis=2)
    assert np.unravel_index(brightness.argmax(), brightness.shape) == (0, 6)
    assert np.unravel_index(brightness.argmin(), brightness.shape) == (4, 0)


def test_the_hull_is_drawn_where_it_is(tmp_path: Path) -> None:
    text = page(tmp_path, facts(probes=1))
    drawn = re.findall(r'<polygon points="([^"]+)"', text)
    corners = [[float(v) for v in pair.split(",")] for pair in drawn[1].split()]
    assert np.array(corners) * [1, -1] == pytest.approx(HULL)


SEEDS = [70, 71, 72, 73]


def test_a_group_without_observations_is_left_out_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="off"))
    whole = statics.probe_groups(case, SEEDS, 2)
    real = BatchedTrials.press

    def deaf(self: BatchedTrials, trials: list[int], commands_mm: np.ndarray) -> TrialPresses:
        felt = real(self, trials, commands_mm)
        return replace(felt, detected=felt.detected & (np.asarray(trials) != 1))

    monkeypatch.setattr(BatchedTrials, "press", deaf)
    monkeypatch.setattr(statics, "ATTEMPTS", 2)
    groups = statics.probe_groups(case, SEEDS, 2)
    assert (groups.left_out, whole.left_out) == (1, 0)
    assert groups.rejected == whole.rejected + 2
    np.testing.assert_array_equal(groups.true_mm, whole.true_mm[[0, 2, 3]])
    np.testing.assert_array_equal(groups.margin_mm, whole.margin_mm[[0, 2, 3]])


@pytest.fixture(scope="module")
def from_a_jig() -> ProbeGroups:
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="bench-v1"))
    return statics.jig_groups(case, range(90, 93), grips=2, probes=3)


def test_a_jig_gives_grippings_of_one_mounting(
    from_a_jig: ProbeGroups, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert from_a_jig.mounting.tolist() == [90, 90, 91, 91, 92, 92]
    assert len(np.unique(from_a_jig.offset_mm)) == from_a_jig.offset_mm.size
    made: list[BatchedTrials] = []
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="bench-v1"))
    monkeypatch.setattr(
        statics, "_press_groups", lambda case, bench, probes, draw: made.append(bench)
    )
    statics.jig_groups(case, range(90, 190), grips=2, probes=3)
    (bench,) = made
    tilts = [scene_mounting(scene).tilt_rad for scene in bench.scenes]
    assert tilts[0::2] == tilts[1::2]
    assert len(set(tilts)) == 100
    grasps = np.array([grip.grasp_offset_mm for grip in bench.grippings])
    assert len(np.unique(grasps)) == grasps.size
    # chi square of 400 normal values
    assert grasps.std() == pytest.approx(case.settings.spread.jig_mm, rel=0.12)


def test_each_press_from_a_jig_is_judged_with_the_others_of_its_gripping(
    from_a_jig: ProbeGroups,
) -> None:
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="bench-v1"))
    exact = np.where(from_a_jig.truth, 0.999, 0.001)
    model = _known_model(case)
    found = statics.score_fused_verdicts(exact, from_a_jig, model, case, judged=3)
    answer = from_a_jig.as_json(case.settings, judged=3)
    assert answer["mounting"] == from_a_jig.mounting.tolist() * 3
    clear = [abs(m[1] or 9.0) > 1.0 for m in answer["margin_mm"]]
    stands = [(m[1] or -9.0) > 0.0 for m in answer["margin_mm"]]
    assert len(stands) == 18
    assert 0 < sum(stands) < 18
    for name in ("says", "even"):
        said = found[name]["1"]
        assert [s for s, sure in zip(said, clear, strict=True) if sure] == [
            s for s, sure in zip(stands, clear, strict=True) if sure
        ]
    again = from_a_jig.rotated(2)
    np.testing.assert_array_equal(again.margin_mm, from_a_jig.margins_mm[:, 2])
    assert len(statics.score_patches(exact, from_a_jig, first=0)["iou"]) == 3


def _known_model(case: SceneSetup) -> BatchModel:
    points = face_points(case.piece.face)
    return BatchModel(lambda seen: np.zeros((len(seen), len(points))), points, 0.35)


def test_copies_of_a_group_on_its_mounting_add_nothing() -> None:
    """The interval is that of the mountings: each group four times on its mounting."""
    rng = np.random.default_rng(8)
    said, stands = rng.random((2, 60)) < 0.5
    margins = [[None, 1.0 if one else -1.0] for one in stands]
    alone = VerdictSample.of(said.tolist(), margins, [str(k) for k in range(60)])
    copies = VerdictSample.of(
        said.tolist() * 4, margins * 4, [str(k) for k in range(60)] * 4
    ).as_json()
    once = alone.as_json()
    assert copies["mountings"] == once["mountings"] == 60
    assert copies["accuracy"]["low"] == pytest.approx(once["accuracy"]["low"], abs=0.01)
    other = rng.random(60) < 0.5
    pairs = list(zip(said.tolist(), other.tolist(), stands.tolist(), strict=True))
    by_four = verdict_changes(pairs * 4, [str(k) for k in range(60)] * 4)
    for name, change in verdict_changes(pairs).items():
        assert by_four[name]["low"] == pytest.approx(change["low"], abs=1e-9)
        assert by_four[name]["high"] == pytest.approx(change["high"], abs=1e-9)
        assert (by_four[name]["n"], by_four[name]["mountings"]) == (240, 60)


def test_the_table_of_job_functions_names_those_that_run() -> None:
    """The id of a job contains a hash of the sources of its function."""
    run = {kind: (f.__module__, f.__qualname__) for kind, f in KINDS.items()}
    module = "touchdown.backend.experiments."
    assert {kind: (module + m, f) for kind, (m, f) in JOB_FUNCTIONS.items()} == run
    codes = {kind: job_code(kind, "1") for kind in KINDS}
    assert all(code.startswith("1+") for code in codes.values())
    assert len(set(codes.values())) > 8


def test_the_tactile_images_show_the_displacements_three_times_enlarged() -> None:
    at_px, by_px = np.full((63, 2), np.nan), np.zeros((63, 2))
    at_px[0], by_px[0] = (110.0, 100.0), (10.0, 0.0)
    field = MarkerField("left", 1, 0.0, at_px, by_px, np.zeros(63, np.uint8), 1.0, 0.0)
    drawn = _with_arrows(np.zeros((240, 320, 3), np.uint8), field).any(axis=2)
    columns = np.flatnonzero(drawn.any(axis=0))
    assert abs(columns.min() - 100) <= 2
    assert abs(columns.max() - 130) <= 2
    assert abs(np.flatnonzero(drawn.any(axis=1)).mean() - 100) <= 1
