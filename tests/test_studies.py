"""The studies of the guard and of releases in stages, on few trials."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import mannwhitneyu

from tests.guard_study import (
    CALIBRATION,
    FRESH,
    OWN,
    GuardStudy,
    alarm_after,
    calibration,
    guard_table,
    guard_trials,
    score_of,
)
from tests.release_study import (
    BEFORE,
    DETECTORS,
    STUDY_BOTTOMS,
    OpeningCourse,
    OpeningPlan,
    alarm_scores,
    draw_pads,
    draw_standing,
    main,
    open_in_steps,
    place_with_margin,
    release_on_bench,
    rig_answer,
    rig_jobs,
    roc_of,
)
from touchdown.backend.config import load_simulation
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Tower, judge_tower

CELLS = (("pot", "short"), ("pot", "long"), ("barrel", "short"))


@pytest.fixture
def study():
    return GuardStudy(
        load_simulation(preset="bench-v1"), "0", CELLS, 60, sequences=2, length=30, runs=4, most=8
    )


class Store:
    """Job store with made-up trials: other signals in the second world."""

    def __init__(self, missing=()):
        self._rng, self._missing, self._done = np.random.default_rng(4), missing, {}

    def has(self, source):
        return source not in self._missing

    def add(self, spec):
        unseen = 0.0002 if spec.params["world"] == "bench" else 0.2
        self._done[spec.id] = {
            "trials": [
                {"piece": piece, "bottom": bottom, "seed": spec.seed + k, "outcome": "placed",
                 "probes": 3, "distances": [float(self._rng.lognormal()), unseen]}
                for k, (piece, bottom) in enumerate(spec.params["cells"])
            ]
        }  # fmt: skip

    def result(self, source):
        return self._done[source]


def filled(study, **options):
    store = Store(**options)
    for spec in study.jobs():
        store.add(spec)
    return store


def test_no_trial_is_in_two_sets(study):
    seeds = [spec.seed + k for spec in study.jobs() for k in range(len(spec.params["cells"]))]
    assert len(set(seeds)) == len(seeds) == 3 * 60 + 2 * 30 + 4 * 8
    assert len({spec.id for spec in study.jobs()}) == len(study.jobs())
    assert sum(map(study.effort, study.jobs())) == len(seeds)


def test_alarms_are_counted_here_and_in_the_second_world(study):
    store = filled(study)
    answer = study.answer(store)
    assert json.loads(json.dumps(answer)) == answer
    assert answer["calibration"] == {"pot": 120, "barrel": 60}
    assert answer["own"]["sequences"]["runs"] == 2
    assert answer["own"]["sequences"]["alarms"] == 0
    assert answer["own"]["resampled"]["alarms"] < 0.05 * answer["own"]["resampled"]["sequences"]
    there = answer["elsewhere"]
    assert (there["runs"], there["alarms"]) == (4, 4)
    assert max(there["after"]) <= 4
    assert there["before_alarm"]["placed"] == sum(end - 1 for end in there["after"])
    assert answer["inputs_only"]["elsewhere"]["alarms"] == 0, "the inputs are alike"
    rows = list(guard_table(answer).texts()[1:])
    assert any("4" in row for row in rows)
    (bench,) = calibration(study, store).benches
    known = study.trials(store, CALIBRATION)
    assert sorted(map(score_of, known)) == sorted(s for own in bench.scores.values() for s in own)


def test_a_trial_without_a_decision_has_no_score_but_counts_as_a_trial(study):
    store = filled(study)
    known, other = study.trials(store, CALIBRATION), study.run_jobs()[0]
    strange = store.result(other.id)["trials"]
    first = alarm_after(strange, known)
    aborted = {**strange[0], "distances": None}
    assert alarm_after([aborted, *strange], known) == first + 1


def test_until_all_trials_are_done_nothing_is_counted(study):
    store = filled(study, missing=(study.bench_jobs(CALIBRATION)[1].id,))
    answer = study.answer(store)
    assert answer["calibration"] == {}
    assert answer["elsewhere"]["runs"] == 0
    assert guard_table(answer)


@pytest.mark.parametrize("cell", [("pot", "short"), ("pot", FRESH)])
def test_trials_on_the_bench_have_usual_signals_and_are_repeatable(study, cell):
    spec = study._job("bench", [cell], 7)
    (trial,) = guard_trials(spec, SimpleNamespace())["trials"]
    assert (trial["piece"], trial["bottom"]) == cell
    assert trial == guard_trials(spec, SimpleNamespace())["trials"][0]
    inputs, unseen = trial["distances"]
    assert 0.1 < inputs < 4.0
    assert unseen < 0.001


def test_in_the_second_world_the_marker_fields_are_not_the_typical_ones(study):
    pytest.importorskip("mujoco")
    spec = study._job("elsewhere", [("pot", "short")], 7)
    (trial,) = guard_trials(spec, SimpleNamespace())["trials"]
    assert trial["distances"][1] > 0.05
    assert len(study.bench_jobs(OWN)) == len(CELLS)


BENCH = load_simulation(preset="bench-v1")
PLAN = OpeningPlan(steps=2, hold_s=0.6)


@pytest.mark.parametrize("bottom", STUDY_BOTTOMS)
@pytest.mark.parametrize("margin_mm", [-1.7, -0.2, 2.0])
def test_a_place_has_the_margin_of_the_exact_judge(bottom, margin_mm) -> None:
    catalogue = load_pieces()
    top, below = catalogue.top("pot"), catalogue.bottom(bottom)
    at = place_with_margin(top, below, margin_mm, 0.4)
    exact = judge_tower(Tower((below.body(), top.body(at)))).margins_mm[1]
    assert exact == pytest.approx(margin_mm, abs=0.01)


def test_the_pads_are_half_the_width_beside_the_middle() -> None:
    margins = np.array([-1.5, -0.2, 0.3, 2.0])
    top = load_pieces().top("barrel")
    standing = draw_standing(top, margins, 1.0, np.random.default_rng(3))
    assert (standing.span_mm <= 2.0 * max(top.face.half_extents_mm) + 1e-6).all()
    assert (standing.span_mm > 2.0 * np.maximum(margins, 0.0)).all()
    np.testing.assert_allclose(standing.pads_mm.mean(axis=1), margins)
    apart = 0.5 * (standing.pads_mm[:, 1] - standing.pads_mm[:, 0])
    np.testing.assert_allclose(apart, 0.5 * top.width_mm * np.sin(standing.axis_rad))


def still_course(count: int) -> OpeningCourse:
    t_s = np.arange(0.0, PLAN.end_s + 1e-9, 0.01)
    shape = (count, len(t_s))
    return OpeningCourse(
        t_s,
        np.zeros(shape),
        np.zeros((*shape, 2, 3)),
        np.full((*shape, 2), 1.0),
        np.zeros((*shape, 6)),
    )


def test_scores_of_noise_alone_follow_chi_square() -> None:
    count = 400
    scores = alarm_scores(
        still_course(count), BENCH, PLAN, np.full(count, 10.0), np.random.default_rng(1)
    )
    freedom = dict(zip(DETECTORS, (7, 6, 13, 7, 6, 13), strict=True))
    used = scores.values[:, :, -1] ** 2
    for k, detector in enumerate(DETECTORS):
        assert used[:, k].mean() == pytest.approx(freedom[detector], rel=0.25), detector
    assert scores.t_s[0] > PLAN.starts_s[0] - 0.04
    assert PLAN.starts_s[0] > BEFORE * 0.04


def test_a_visible_turn_raises_the_scores() -> None:
    count = 30
    course = still_course(count)
    turned = course.t_s > PLAN.starts_s[1] + 0.3
    course.strain[:, turned, :, 2] = 0.02
    scores = alarm_scores(course, BENCH, PLAN, np.full(count, 10.0), np.random.default_rng(1))
    late = scores.t_s > PLAN.starts_s[1] + 0.4
    for k, detector in enumerate(DETECTORS):
        seen = scores.values[:, k][:, late].max(axis=1) > 8.0
        assert seen.all() == ("wrench" not in detector)


def test_the_roc_is_that_of_the_rank_test() -> None:
    rng = np.random.default_rng(0)
    stable, turning = rng.normal(0.0, 1.0, 40), rng.normal(1.0, 1.0, 25)
    trials = [{"stable": True, "scores": {"wrench": x}} for x in stable]
    trials += [{"stable": False, "scores": {"wrench": x}} for x in turning]
    found = roc_of(trials, "wrench")
    exact = mannwhitneyu(turning, stable).statistic / (25 * 40)
    assert found["area"] == pytest.approx(exact, abs=1e-4)
    assert (stable > found["threshold"]).sum() <= 2
    assert found["caught"]["value"] == pytest.approx(
        (turning > found["threshold"]).mean(), abs=0.04
    )
    assert roc_of(trials[:40], "wrench")["area"] is None


def test_a_perfect_unloading_leaves_stable_pieces_unmoved() -> None:
    rng = np.random.default_rng(5)
    top = load_pieces().top("pot")
    standing = draw_standing(top, np.array([0.5, 2.0]), 1.0, rng)
    pads = draw_pads(BENCH, standing, top, rng)
    course = open_in_steps(standing, replace(pads, strain=np.zeros_like(pads.strain)), PLAN)
    assert not course.angle_rad.any()
    assert not course.wrench_g[:, :, [0, 2, 3, 4, 5]].any()


def test_the_command_writes_the_roc(tmp_path, capsys) -> None:
    words = ["--pieces", "pot", "--unstable", "3", "--stable", "4"]
    words += ["--weights", "1", "--jaw-steps", "2", "--hold", "0.6"]
    assert main([*words, "--out", str(tmp_path)]) == 0
    answer = json.loads((tmp_path / "release.json").read_text())
    assert len(answer["trials"]["margin_mm"]) == 7
    assert sum(answer["trials"]["stable"]) == 4
    assert {row["detector"] for row in answer["groups"]} == set(DETECTORS)
    assert "Caught %" in capsys.readouterr().out


def test_releases_through_the_rig_are_counted_by_side_of_the_edge() -> None:
    jobs = rig_jobs(["brick"], 2, {"stages": 2}, "code")
    assert [spec.params["stable"] for spec in jobs] == [False, True, False, True]
    assert len({spec.seed for spec in rig_jobs(["brick", "pot"], 40, {}, "code")}) == 160
    rows = [(-1.0, "GAVE_UP"), (2.0, "PLACED"), (-0.2, "FELL"), (0.1, "ABORTED")]
    results = {
        spec.id: {"piece": "brick", "margin_mm": margin, "outcome": outcome}
        for spec, (margin, outcome) in zip(jobs, rows, strict=True)
    }
    store = SimpleNamespace(has=results.__contains__, result=results.__getitem__)
    (group,) = rig_answer(jobs, store)["groups"]
    assert (group["unstable"], group["beyond"], group["stable"], group["fell"]) == (2, 1, 1, 1)
    assert group["unstable_held_again"]["value"] == 0.5
    assert (group["beyond_held_again"]["value"], group["stable_held_again"]["value"]) == (1.0, 0.0)


def test_a_forced_release_runs_through_the_bench() -> None:
    (spec, _) = rig_jobs(
        ["brick"], 1, {"stages": 2, "turn_sigmas": 100.0, "lean_sigmas": 100.0}, "code"
    )
    found = release_on_bench(spec, None)
    assert found["outcome"] == "FELL"
    assert found["margin_mm"] < 0.5
    assert 0.0 < found["hold"] < 100.0
    assert found["lean"] is not None
