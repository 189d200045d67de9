"""The experiments as a campaign: nothing leaks, everything is traced, the numbers repeat."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.models import (
    adopt_models,
    keep_models,
    load_model,
    shipped_model_folders,
)
from touchdown.backend.experiments.results import DATA, PAGE, write_tables
from touchdown.backend.experiments.tables import (
    FULL,
    MODELS,
    PIECES,
    QUICK,
    TABLE_BOTTOMS,
    TRAINING_BOTTOMS,
    Recipe,
    Scale,
    agreement,
)
from touchdown.backend.experiments.trials import SceneSetup, balanced_offset, start_scene
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.sampling import MAX_LEAN_MM
from touchdown.backend.jobs.execution import SerialExecutor, run_campaign
from touchdown.backend.jobs.job import SPEC_FILE, JobSpec, JobStore, run_job
from touchdown.backend.runs.requests import SceneChoice

HARD = SimulationSettings.model_validate({"preset": "hard"})
TINY = Scale("tiny", 30, 1, 4, 2, 5, 2, fused=3, pictured=40)


def test_full_has_the_papers_counts() -> None:
    jobs = Recipe(FULL, HARD, "1").jobs()
    kinds = [spec.kind for spec in jobs]
    assert {kind: kinds.count(kind) for kind in kinds} == {
        "simulate": 9,
        "train": 12,
        "twins": 1,
        "static": 6,
        "stack": 15,
        "devices": 9,
    }
    collected = [spec.params["episodes"] for spec in jobs if spec.kind == "simulate"]
    assert collected == [2000] * 9
    assert {spec.params["epochs"] for spec in jobs if "epochs" in spec.params} <= {30}


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
        count = spec.params.get("groups") or 2 * spec.params["trials"]
        seeds = set(range(spec.seed, spec.seed + count))
        # Strategies are compared on the same trials; cells of other pairs share none.
        cell = f"{spec.kind} {spec.params['piece']} {spec.params.get('bottoms')}"
        cell += str(spec.params.get("bottom"))
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
    for name in ("table1", "table2", "table3"):
        for row in answers[0][name]:
            for cell in row["cells"]:
                assert_traced(cell, JobStore(tmp_path / "first" / "jobs"), recipe)
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
        assert (spec.id, spec.code) == (job, recipe.code)
        return spec

    spec = spec_of(cell["job"])
    assert (spec.seed, spec.params["piece"]) == (cell["seed"], cell["piece"])
    assert spec.params["bench"] == recipe.bench.model_dump(mode="json")
    assert store.result(spec.id)["bench_sha256"] == recipe.bench_id()
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
    assert {spec.kind for spec in recipe.jobs()} == {"twins", "static", "stack"}
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
    assert [trial["probes"] for (trial,) in answers] == [2, 2]


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
