"""Study of the guard: disjoint trials, counts of alarms, and the command that writes both."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

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
from touchdown.backend.config import load_simulation

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
