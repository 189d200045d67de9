"""The plan of a comparison of strategies: which trials its jobs hold."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats

from touchdown.backend.config.method import FusedSettings, StackSettings
from touchdown.backend.config.simulation import SimulationSettings, load_simulation
from touchdown.backend.core import FloatArray
from touchdown.backend.core.faults import InputError
from touchdown.backend.experiments.comparison import (
    StrategyComparison,
    comparison_report,
    comparison_tables,
    decided_strategies,
    paired_changes,
    placed_of_ceiling,
    stopped_text,
)
from touchdown.backend.experiments.document import report_page
from touchdown.backend.experiments.models import adopt_models, shipped_model_folders
from touchdown.backend.experiments.results import write_comparison
from touchdown.backend.experiments.statistics import (
    SEQUENTIAL_ERROR,
    evidence,
    sequential_decision,
    verdict_changes,
)
from touchdown.backend.experiments.strategies import (
    MODEL_FREE,
    STRATEGIES,
    SURFACE_KINDS,
    TRIAL_WORDS,
    ClosedLoopComparison,
    count_outcomes,
    least_probes,
    method_of,
    released_unsafely,
    run_closed_loop,
    weighed_piece,
)
from touchdown.backend.experiments.tables import BEYOND_FORMAT, QUICK, TOWER, Recipe
from touchdown.backend.experiments.trials import SceneSetup, start_scene
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.jobs.job import SPEC_FILE, JobContext, JobSpec, JobStore, run_job
from touchdown.backend.learning.checkpoint import save_checkpoint
from touchdown.backend.learning.fused.checkpoint import shipped_fused
from touchdown.backend.placement import load_network_of
from touchdown.backend.runs import LEARNED, StackRequest, StrategyChoice
from touchdown.backend.simulation.ground_truth import Scene, true_margin_mm


@pytest.mark.parametrize(("bottom", "trials"), [("long", 5), ("short+long", 23), ("fresh", 12)])
def test_no_two_trials_of_a_cell_have_the_same_seed(bottom: str, trials: int) -> None:
    plan = ClosedLoopComparison(
        load_simulation(preset="bench-v1"), "1", {"pot": "m", "barrel": "m"}, ("pot", "barrel"),
        (bottom,), ("paper",), trials,
    )  # fmt: skip
    cells: dict[str, list[int]] = {"pot": [], "barrel": []}
    for job in plan.jobs():
        cells[job.params["piece"]] += range(job.seed, job.seed + job.params["trials"])
    for seeds in cells.values():
        assert seeds == list(range(seeds[0], seeds[0] + trials))
    assert not set(cells["pot"]) & set(cells["barrel"])


def test_every_fresh_trial_has_an_outline_and_a_mounting_of_its_own(
    bench_v1: SimulationSettings, store: JobStore
) -> None:
    plan = ClosedLoopComparison(
        bench_v1, "1", {}, ("pot", "barrel"), ("fresh",), ("fused", "pick-and-place"), 12
    )
    jobs = plan.jobs()
    assert [job.params["trials"] for job in jobs] == 4 * [10] + 4 * [2]
    assert not any(job.inputs for job in jobs)
    setups = [SceneSetup.of_trial(job.params, job.seed + k) for job in jobs[:4:2] for k in range(3)]
    assert len({setup.bottoms[0].face for setup in setups}) == 6
    other = replace(plan, outline_seed="0123456789").jobs()[0]
    assert SceneSetup.of_trial(other.params, other.seed).bottoms != setups[0].bottoms
    short = replace(plan, pieces=("pot",), strategies=("pick-and-place",), trials=2)
    (job,) = short.jobs()
    assert run_job(job, {"beyond": run_closed_loop}, store).state == "done"
    answer = StrategyComparison(short).answer(store)
    outlines = [line.split()[4] for line in answer["cells"][0]["trials"]]
    assert outlines == ["disc", "rectangle"]
    loops, classes = comparison_tables(answer)
    assert [row[0] for row in loops.rows][1] == "pick-and-place pooled fresh outlines"
    assert [row[1][0].value for row in classes.rows] == ["disc", "rectangle"]


def test_on_uneven_faces_the_trials_in_which_a_good_place_exists_are_counted(
    store: JobStore,
) -> None:
    bench = load_simulation(
        Path(str(files("touchdown.resources"))) / "benches/bench-v2-surfaces.toml"
    )
    plan = ClosedLoopComparison(bench, "1", {}, ("pot",), ("fresh",), ("pick-and-place",), 1)
    (job,) = plan.jobs()
    assert run_job(job, {"beyond": run_closed_loop}, store).state == "done"
    answer = StrategyComparison(plan).answer(store)
    (line,) = answer["cells"][0]["trials"]
    trial = dict(zip(TRIAL_WORDS, line.split(), strict=True))
    scene = start_scene(SceneSetup.of_trial(job.params, job.seed), job.seed)
    assert scene is not None
    assert scene.bottoms.bodies[-1].surface.kind == trial["surface"] in SURFACE_KINDS
    uneven = comparison_tables(answer)[2]
    names = [row[1][0].value for row in uneven.rows]
    assert names == ["fresh outlines", "disc", trial["surface"]]
    places = np.random.default_rng(4).uniform(-4.0, 4.0, (5, 2)).tolist()
    others = [true_margin_mm(scene, (x, y), 0.0) for x, y in places]
    assert 0.0 < max(others) < float(trial["best_mm"]) + 0.5


def test_placed_of_possible() -> None:
    ends = (("placed", "2.5"), ("fell", "1.0"), ("placed", "0.9"), ("gave_up", "-inf"))
    trials = [
        {"outcome": word, "probes": 2, "least_probes": 1, "best_mm": best, "seed": k}
        for k, (word, best) in enumerate(ends)
    ]
    counts = count_outcomes(trials)
    assert (counts["possible"]["value"], counts["there"]["value"]) == (0.5, 0.5)
    del trials[0]["best_mm"]
    assert "possible" not in count_outcomes(trials[:1])


def test_the_placed_are_a_share_of_what_the_ceiling_places() -> None:
    def cell(*outcomes: str) -> list[Json]:
        return [{"seed": k, "outcome": word} for k, word in enumerate(outcomes)]

    trials = {
        ("ceiling", "pot", "fresh"): cell("placed", "placed", "fell", "placed", "placed"),
        ("fused", "pot", "fresh"): cell("placed", "fell", "placed", "placed"),
    }
    (row,) = placed_of_ceiling(trials)
    assert (row["n"], row["value"]) == (4, 1.0)
    assert row["low"] < 1.0 < row["high"]
    assert released_unsafely({"placed": 3, "fell": 1, "knocked_over": 4}).value == 0.25
    assert placed_of_ceiling({k: v for k, v in trials.items() if k[0] == "fused"}) == []


Json = dict[str, Any]


@pytest.fixture(scope="module")
def bench_v1() -> SimulationSettings:
    return load_simulation(preset="bench-v1")


@pytest.fixture
def store(tmp_path: Path) -> JobStore:
    return JobStore(tmp_path)


def test_changes_are_paired_by_seed() -> None:
    def cell(*outcomes: str) -> list[Json]:
        return [{"seed": k, "outcome": word} for k, word in enumerate(outcomes)]

    trials = {
        ("paper", "pot", "short"): cell("fell", "placed", "fell", "gave_up", "placed"),
        ("mine", "pot", "short"): cell("placed", "placed", "fell", "fell"),
    }
    placed, unsafe = paired_changes(trials)
    assert (placed["n"], placed["paper"], placed["own"]) == (4, 0.25, 0.5)
    assert (placed["only_paper"], placed["only_own"]) == (0, 1)
    assert placed["low"] <= placed["change"] == 0.25 <= placed["high"]
    assert (unsafe["change"], unsafe["only_paper"], unsafe["only_own"]) == (0.0, 1, 1)
    same = {**trials, ("mine", "pot", "short"): trials["paper", "pot", "short"]}
    # No trial of five differs: the exact bound, 1 - 0.05 ** (1 / 5).
    alike = paired_changes(same)[0]
    assert (alike["low"], alike["high"]) == pytest.approx((-0.4507, 0.4507), abs=1e-4)
    assert (placed["p"], unsafe["p"], alike["p"]) == (1.0, 1.0, 1.0)


def test_settings_in_a_name_are_compared_with_the_strategy_without_them() -> None:
    def cell(*outcomes: str) -> list[Json]:
        return [{"seed": k, "outcome": word} for k, word in enumerate(outcomes)]

    name = "fused:policy.least_probes=2"
    trials = {
        ("paper", "pot", "short"): cell(*["fell"] * 6),
        ("fused", "pot", "short"): cell(*["fell"] * 6),
        (name, "pot", "short"): cell(*["placed"] * 6),
    }
    rows = [row for row in paired_changes(trials) if row["strategy"] == name]
    assert [row["reference"] for row in rows] == ["fused", "fused"]
    # Six of six discordant pairs in one direction: 2 / 2 ** 6.
    assert [row["p"] for row in rows] == [pytest.approx(0.03125)] * 2
    assert [row["change"] for row in rows] == [1.0, -1.0]
    method = method_of(f"{name}:fused.risk=0.05", StackSettings())
    assert (method.strategy, method.policy.least_probes, method.fused.risk) == ("fused", 2, 0.05)
    assert method_of("fused:weigh=true", StackSettings()).weigh
    for wrong in ("policy.least=2", "weigh=2", "nothing.risk=2", "policy.least_probes=x"):
        with pytest.raises(InputError):
            method_of(f"fused:{wrong}", StackSettings())


def test_a_strategy_is_compared_under_the_names_that_a_stack_run_offers() -> None:
    base = StackSettings()
    assert (*get_args(StrategyChoice), "ceiling") == STRATEGIES
    for name in LEARNED:
        assert method_of(name, base) == StackRequest(strategy=name).method(base)
        assert name in MODEL_FREE
        (spec, *_) = ClosedLoopComparison(
            load_simulation(), "", {}, strategies=(f"{name}:policy.least_probes=2",)
        ).jobs()
        card = load_network_of(method_of(name, base).fused).card
        assert spec.params["fused_sha256"] == card.weights_sha256
    method = method_of("fused-wrench:policy.least_probes=2", base)
    assert (method.policy.max_probes, method.policy.least_probes) == (12, 2)


def test_a_heavy_piece_is_weighed_with_the_noise_of_the_sensor_and_the_grasp() -> None:
    case = SceneSetup.of(load_pieces(), "brick", ("short",), load_simulation())
    scenes = [start_scene(case, seed) for seed in range(60)]
    found = [weighed_piece(scene) for scene in scenes if scene is not None]
    off = np.array([piece.com_mm[:2] for piece in found]) - case.piece.com_xy_mm
    sigma = np.array([piece.sigma_mm[:2] for piece in found])
    assert (np.abs(off) <= 2.0 * sigma).mean(axis=0).min() >= 0.9
    assert np.std(off, axis=0).max() <= 1.0
    masses = [piece.mass_g for piece in found]
    assert np.mean(masses) == pytest.approx(150.0, abs=0.3)


def test_changes_of_verdicts_have_the_interval_of_a_paired_statistic() -> None:
    rng = np.random.default_rng(5)
    truth = rng.random(200) < 0.5
    before, after = (np.where(rng.random(200) < p, truth, ~truth) for p in (0.6, 0.75))
    found = verdict_changes(list(zip(before, after, truth, strict=True)))
    gain = (after == truth).astype(float) - (before == truth)
    sem = stats.sem(gain)
    assert found["accuracy"]["change"] == pytest.approx(gain.mean())
    assert found["accuracy"]["high"] == pytest.approx(gain.mean() + stats.norm.ppf(0.975) * sem)
    halves = [gain[truth].mean(), gain[~truth].mean()]
    assert found["balanced"]["change"] == pytest.approx(np.mean(halves))


def test_towers_have_the_seeds_of_table_3(bench_v1: SimulationSettings) -> None:
    models = {("pot", "FT+Tac"): "m"}
    table = Recipe(QUICK, bench_v1, "1", models, ("pot",)).stacking("pot", TOWER, "paper")
    plan = ClosedLoopComparison(
        bench_v1, "1", {"pot": "m"}, bottoms=("short+long", "long"),
        strategies=("paper", "ceiling"), trials=2,
    )  # fmt: skip
    assert table is not None
    found = {(j.params["bottom"], j.params["strategy"]): j.seed for j in plan.jobs()}
    # The ceiling knows nothing of towers.
    assert found.keys() == {("short+long", "paper"), ("long", "paper"), ("long", "ceiling")}
    assert found["short+long", "paper"] == table.seed


def test_answers_of_another_network_are_other_jobs(
    bench_v1: SimulationSettings, tmp_path: Path
) -> None:
    ships, other = shipped_fused(), tmp_path / "other.safetensors"
    save_checkpoint(other, {**ships.arrays, "mean": ships.arrays["mean"] + 1.0}, ships.card)
    asks = StackSettings(fused=FusedSettings(weights=str(other)))
    plan = ClosedLoopComparison(
        bench_v1, "1", {"pot": "m"}, ("pot",), ("long",), ("paper", "fused"), 2
    )
    paper, fused = plan.jobs()
    _, theirs = replace(plan, method=asks).jobs()
    assert theirs.id != fused.id
    assert fused.params["fused_sha256"] == ships.card.weights_sha256
    assert theirs.params["fused_sha256"] not in paper.params.values()
    assert "fused_sha256" not in paper.params


def test_the_least_probes_on_a_tower_are_those_to_where_all_of_it_holds(
    bench_v1: SimulationSettings,
) -> None:
    case = SceneSetup.of(load_pieces(), "pot", TOWER, bench_v1)
    scenes = [scene for seed in range(6) if (scene := start_scene(case, seed))]
    assert len(scenes) > 3
    around = np.arange(0.0, 2.0 * np.pi, np.pi / 12)
    for scene in scenes:
        longest = 3.0 * (least_probes(scene) - 1)
        # The exact judge, asked all round: within the steps there is a place, one step less none.
        ways = np.arange(longest, longest - 3.0, -0.5)
        assert any(
            true_margin_mm(scene, off(scene, w, a), 0.0) >= 0.2 for a in around for w in ways
        )
        if longest > 3.3:
            near = [true_margin_mm(scene, off(scene, longest - 3.3, a), 0.0) for a in around]
            assert max(near) < 0.2


def off(scene: Scene, way_mm: float, angle: float) -> tuple[float, float]:
    """A place this far from the start of the trial."""
    x, y = scene.start_mm
    return x + way_mm * float(np.cos(angle)), y + way_mm * float(np.sin(angle))


def test_a_tower_from_end_to_end(bench_v1: SimulationSettings, store: JobStore) -> None:
    models = adopt_models(store, *shipped_model_folders("bench-v1"))
    source = {"pot": models["pot", "FT+Tac"]}
    loops = ClosedLoopComparison(bench_v1, "1", source, ("pot",), ("short+long",), ("paper",), 1)
    plan = StrategyComparison(loops)
    for job in plan.jobs():
        assert run_job(job, {"beyond": run_closed_loop}, store).state == "done"
    found = plan.answer(store)
    (loop,) = found["cells"]
    assert loop["placed"]["n"] + loop["left_out"] == 1
    (job,) = loop["jobs"]
    spec = JobSpec.parse((store.folder(job) / SPEC_FILE).read_text("utf-8"))
    assert (spec.id, spec.kind, spec.seed) == (job, "beyond", loop["seed"])
    assert all(len({len(row) for row in t.texts()}) == 1 for t in comparison_tables(found))


def compared(*strategies: str) -> Json:
    counts = {"value": 0.5, "low": 0.1, "high": 0.9, "n": 2}
    cell = {
        "piece": "pot",
        "bottom": "long",
        "placed": counts,
        "unsafe": counts,
        "outcomes": {"placed": 1, "fell": 1},
        "probes": 3.0,
        "excess_probes_median": 1.0,
        "left_out": 0,
    }
    return {
        "format": BEYOND_FORMAT,
        "bench_sha256": "a" * 64,
        "code": "<1>",
        "cells": [{"strategy": name, **cell} for name in strategies],
        "pooled": [],
    }


def test_the_page_shows_every_strategy_and_escapes_what_it_is_told() -> None:
    page = report_page(comparison_report(compared("mine", "<b>")))
    assert page.count("mine pot long") == 1
    assert "<b>" not in page
    assert "&lt;1&gt;" in page
    assert "SIMULATED BENCH" in page


def test_a_comparison_is_written_with_its_page(tmp_path: Path) -> None:
    file = write_comparison(tmp_path, compared("mine"))
    assert json.loads(file.read_bytes()) == compared("mine")
    assert "mine" in (tmp_path / "beyond.html").read_text("utf-8")


@pytest.mark.parametrize(("more", "less"), [(0, 0), (1, 0), (0, 5), (3, 2), (40, 25), (2, 90)])
def test_evidence_is_the_mean_capital_of_the_bettors(more: int, less: int) -> None:
    bets, weights = np.polynomial.legendre.leggauss(60)
    bets = 0.5 * (bets + 1.0)
    capital = (1.0 + bets) ** more * (1.0 - bets) ** less
    assert evidence(more, less) == pytest.approx(float(0.5 * weights @ capital), rel=1e-9)


def evidence_table(n: int) -> FloatArray:
    """Return the evidence of (more, less) below ``n``, from scipy's incomplete beta function."""
    more, less = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    tail = special.betainc(less + 1.0, more + 1.0, 0.5)
    with np.errstate(divide="ignore"):
        logs = np.log(tail) + special.betaln(more + 1.0, less + 1.0)
    return np.asarray(np.exp(logs + (more + less + 1.0) * np.log(2.0)))


def crossed(paths: NDArray[np.bool_], table: FloatArray, level: float) -> NDArray[np.bool_]:
    """Return the pairs (trials, steps) after which the evidence has reached ``level``."""
    more = np.cumsum(paths, axis=1)
    less = np.arange(1, paths.shape[1] + 1) - more
    return np.asarray(np.maximum.accumulate(table[more, less] >= level, axis=1))


def test_evidence_without_a_difference_is_a_martingale_of_mean_one() -> None:
    table = evidence_table(61)
    for n in (1, 7, 60):
        weight = stats.binom.pmf(np.arange(n + 1), n, 0.5)
        values = table[np.arange(n + 1), n - np.arange(n + 1)]
        assert float(weight @ values) == pytest.approx(1.0, rel=1e-9)
    assert evidence(30, 20) == pytest.approx(float(table[30, 20]), rel=1e-9)


def test_looking_after_every_pair_keeps_the_error_and_the_bound_of_ville() -> None:
    table = evidence_table(301)
    pairs = np.random.default_rng(5).random((20_000, 300)) < 0.5
    for level in (2.0, 5.0, 20.0):
        assert crossed(pairs, table, level)[:, -1].mean() <= 1.0 / level
    both = [crossed(own, table, 2.0 / SEQUENTIAL_ERROR)[:, -1] for own in (pairs, ~pairs)]
    assert np.mean(both[0] | both[1]) <= SEQUENTIAL_ERROR


def test_power_is_near_that_of_the_exact_test_and_it_stops_sooner() -> None:
    # The exact test looks once, after all pairs; the sequential one after each.
    n, share = 60, 0.75
    pairs = np.random.default_rng(6).random((4000, n)) < share
    reached = crossed(pairs, evidence_table(n + 1), 2.0 / SEQUENTIAL_ERROR)
    wins = pairs.sum(axis=1)
    p_value = 2.0 * np.minimum(stats.binom.sf(wins - 1, n, 0.5), 0.5)
    exact = np.mean(p_value <= SEQUENTIAL_ERROR)
    assert reached[:, -1].mean() >= exact - 0.10
    decided_after = np.where(reached.any(axis=1), reached.argmax(axis=1) + 1, n)
    assert decided_after.mean() < 0.7 * n


@pytest.mark.parametrize(
    ("more", "less", "comparisons", "found"),
    [(8, 0, 1, "more"), (0, 8, 1, "less"), (7, 0, 1, None), (8, 0, 2, None), (50, 50, 1, None)],
)
def test_paired_trials_decide_a_direction(
    more: int, less: int, comparisons: int, found: str | None
) -> None:
    assert sequential_decision(more, less, comparisons) == found


def test_comparison_stops_when_it_is_decided(tmp_path: Path) -> None:
    plan = ClosedLoopComparison(
        load_simulation(preset="bench-v1"), "1", {"pot": "m"}, ("pot",), ("short",),
        ("paper", "zero-wrench", "paper-calibrated"), 40,
    )  # fmt: skip
    whole, store = StrategyComparison(plan), JobStore(tmp_path)
    word = {"paper": "fell", "zero-wrench": "placed", "paper-calibrated": "fell"}
    ran: dict[str, int] = {}

    def pretend(spec: JobSpec, _: JobContext) -> dict[str, Any]:
        ran[spec.params["strategy"]] = ran.get(spec.params["strategy"], 0) + spec.params["trials"]
        outcome = word[spec.params["strategy"]]
        rows = [{"seed": spec.seed + k, "outcome": outcome} for k in range(spec.params["trials"])]
        return {"trials": rows, "left_out": 0}

    while jobs := whole.next_round(store, "placed"):
        for job in jobs:
            run_job(job, {"beyond": pretend}, store)
    # Ten pairs in one direction decide one comparison; the other one needs all its trials.
    assert ran == {"paper": 40, "zero-wrench": 10, "paper-calibrated": 40}
    decided = decided_strategies(plan.trials_of(store), "placed")
    assert decided == {"zero-wrench": "more", "paper-calibrated": None}
    assert "zero-wrench more, paper-calibrated undecided" in stopped_text(
        {"quantity": "placed", "round": 10, "decided": decided}
    )


def test_a_band_repeats_the_trials_on_benches_around_the_bench(tmp_path: Path) -> None:
    plan = ClosedLoopComparison(
        load_simulation(preset="bench-v2"), "1", {"pot": "m"}, ("pot",), ("short",), ("paper",), 2
    )
    whole, store = StrategyComparison(plan, band=4), JobStore(tmp_path)
    jobs = whole.jobs()
    assert len(jobs) == len({job.id for job in jobs}) == 5
    assert len({job.seed for job in jobs}) == 1
    words = iter(["placed"] * 2 + ["placed", "fell"] * 3 + ["fell"] * 2)

    def pretend(spec: JobSpec, _: JobContext) -> dict[str, Any]:
        rows = [
            {"seed": spec.seed + k, "outcome": next(words), "probes": 3, "least_probes": 1}
            for k in range(2)
        ]
        return {"trials": rows, "left_out": 0}

    for job in jobs:
        run_job(job, {"beyond": pretend}, store)
    found = whole.answer(store)
    assert len({row["bench_sha256"] for row in found["band"]} | {found["bench_sha256"]}) == 5
    band = next(table for table in comparison_tables(found) if "benches around" in table.title)
    _, rows = band.texts()[0], band.texts()[1:]
    assert list(rows[0]) == [
        "paper pooled one bottom", "4", "8", "100.0", "0.0 / 50.0 / 50.0",
        "0.0", "50.0 / 50.0 / 100.0", "0.0", "50.0 / 50.0 / 100.0",
    ]  # fmt: skip
