"""Domain randomisation: each mounting a bench of its own, the same again from its seed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.config.simulation import SimulationSettings, load_simulation
from touchdown.backend.experiments.domain_shift import (
    LAW_FACTORS,
    NUISANCE_FACTORS,
    DomainShift,
    RandomisedTraining,
    randomise_bench,
)
from touchdown.backend.experiments.evaluation import FOUNDATION, NUISANCES
from touchdown.backend.experiments.statistics import format_change, iou_change

BENCH = load_simulation(preset="bench-v1")
SEEDS = range(24)


@pytest.fixture(scope="module")
def drawn() -> list[SimulationSettings]:
    """Return the benches of 24 mountings."""
    return [randomise_bench(BENCH, seed) for seed in SEEDS]


def value(bench: SimulationSettings, key: str) -> np.ndarray:
    section, name = key.split(".")
    return np.atleast_1d(getattr(getattr(bench, section) if section else bench, name))


def test_a_mounting_is_the_same_bench_again_from_its_seed_and_no_other() -> None:
    before = BENCH.model_dump()
    assert randomise_bench(BENCH, 7) == randomise_bench(BENCH, 7)
    assert randomise_bench(BENCH, 7) != randomise_bench(BENCH, 8)
    assert BENCH.model_dump() == before


@pytest.mark.parametrize("key", [key for key in LAW_FACTORS if key != FOUNDATION])
def test_laws_fill_their_range_and_pairs_stay_pairs(
    key: str, drawn: list[SimulationSettings]
) -> None:
    factors = np.array([value(bench, key) / value(BENCH, key) for bench in drawn])
    low, high = LAW_FACTORS[key]
    # Hysteresis is a size and a law at once.
    wide = NUISANCE_FACTORS if key == "grasp.hysteresis_share" else (1.0, 1.0)
    assert factors.min() >= low * wide[0]
    assert factors.max() <= high * wide[1]
    assert np.ptp(np.log(factors), axis=1) == pytest.approx(np.zeros(len(factors)))
    # 24 uniform draws miss a third of their range, at either end, once in 8,000 times.
    share = np.log(factors[:, 0] / low) / np.log(high / low)
    assert share.min() < 1 / 3
    assert share.max() > 2 / 3


def test_every_nuisance_has_a_size_of_its_own(drawn: list[SimulationSettings]) -> None:
    keys = [n.keys[0] for n in NUISANCES if n.keys[0] not in {FOUNDATION, *LAW_FACTORS}]
    sizes = np.array([float(value(drawn[3], key)[0] / value(BENCH, key)[0]) for key in keys])
    assert ((sizes >= NUISANCE_FACTORS[0]) & (sizes <= NUISANCE_FACTORS[1])).all()
    assert len(set(sizes.round(9))) == len(keys)


def test_the_contact_is_softer_or_harder_as_a_whole(drawn: list[SimulationSettings]) -> None:
    ranges = np.log([bench.face.foundation_range_n_mm3 for bench in drawn])
    middle, half = ranges.mean(axis=1), 0.5 * np.ptp(ranges, axis=1)
    ours = np.log(BENCH.face.foundation_range_n_mm3)
    assert np.exp(middle - ours.mean()).min() < 1.0 < 3.0 < np.exp(middle - ours.mean()).max()
    shares = half / (0.5 * np.ptp(ours))
    assert ((shares >= NUISANCE_FACTORS[0]) & (shares <= NUISANCE_FACTORS[1])).all()


def test_a_collection_is_one_job_a_mounting_and_as_large_as_the_paper_s() -> None:
    wide = RandomisedTraining(BENCH, "test", "pot", "randomised")
    plain = replace(wide, collected="mountings")
    jobs, same = wide.data(), plain.data()
    assert len({spec.id for spec in (*jobs, *same)}) == 240
    assert sum(spec.params["episodes"] for spec in jobs) == 6000
    assert len({spec.seed for spec in jobs}) == 120
    assert [spec.seed for spec in jobs] == [spec.seed for spec in same]
    assert {str(spec.params["bench"]) for spec in same} == {str(BENCH.model_dump(mode="json"))}
    assert len({str(spec.params["bench"]) for spec in jobs}) == 120
    assert wide.training().inputs == tuple(spec.id for spec in jobs)


def test_changes_are_paired_by_group_and_jobs_that_lost_one_do_not_count() -> None:
    def part(first: list[float], second: list[float], left_out: int = 0) -> dict:
        return {"models": {"A": {"iou": first}, "B": {"iou": second}}, "left_out": left_out}

    there = [part([0.2, 0.6], [0.3, 0.8]), part([0.1], [0.9], left_out=1)]
    found = iou_change([(p, p) for p in there], "A", "B")
    assert found["value"] == pytest.approx(0.15)
    assert found["n"] == 2
    # Standard error of 0.1 and 0.2: 0.05.
    assert found["high"] - found["value"] == pytest.approx(1.96 * 0.05, abs=1e-4)
    assert format_change(found) == "+15.0 ± 9.8"


def test_both_worlds_begin_where_they_are_told_to_and_wait_for_the_training() -> None:
    own = RandomisedTraining(BENCH, "test", "pot", "randomised", probes=60)
    given = {"FT+Tac": "given", "FT": "too"}
    plan = DomainShift(
        BENCH, "test", "pot", given, ("short",), ("paper", "fused"), 2, 2, (own,), first=40
    )
    jobs = plan.jobs()
    assert [spec.kind for spec in jobs[:7]] == ["simulate"] * 6 + ["train"]
    pressed = [spec for spec in jobs[7:] if spec.kind == "asked-presses"]
    tried = [spec for spec in jobs[7:] if spec.kind == "asked-trials"]
    assert {spec.seed % 100 for spec in (*pressed, *tried)} == {40}
    assert all(own.training().id in spec.inputs for spec in pressed)
    # Strategies read the first given model and the trained one; fusion reads none of a piece.
    read = [(spec.params["strategy"], spec.inputs) for spec in tried]
    assert len(pressed) == 2
    assert sorted(read) == sorted(
        2 * [("paper", ("given",)), ("paper", (own.training().id,)), ("fused", ("given",))]
    )


@pytest.mark.parametrize(
    ("words", "where"),
    [(["--train", "everything"], "--train"), (["--first", "-1"], "--first")],
)
def test_what_cannot_be_trained_or_numbered_is_refused(
    words: list[str], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["experiment", "elsewhere", "--pieces", "pot", "--out", str(tmp_path)]
    assert main([*given, *words]) == 2
    assert where in capsys.readouterr().err
