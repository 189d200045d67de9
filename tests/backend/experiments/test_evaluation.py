"""What exists is asked elsewhere and with other nuisances: same seeds, nothing asked twice."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.config.simulation import SpreadSettings, load_simulation
from touchdown.backend.experiments import DomainShift
from touchdown.backend.experiments.evaluation import press_scores, shift_tables
from touchdown.backend.experiments.nuisances import (
    LATER_NUISANCES,
    NUISANCES,
    band_benches,
    scale_nuisance,
)
from touchdown.backend.experiments.statistics import format_change, iou_change
from touchdown.backend.simulation import conditions, mujoco_available

BENCH = load_simulation(preset="bench-v1")
EVERY = {**NUISANCES, **LATER_NUISANCES}


def test_every_spread_but_that_of_a_jig_is_a_nuisance() -> None:
    keys = {key for found in EVERY.values() for key in found}
    assert {f"spread.{name}" for name in SpreadSettings.model_fields} - keys == {"spread.jig_mm"}


@pytest.mark.parametrize(
    ("name", "preset"), [(name, "bench-v1" if name in NUISANCES else "bench-v2") for name in EVERY]
)
def test_one_nuisance_grows_and_nothing_else(name, preset) -> None:
    bench, found = load_simulation(preset=preset), EVERY[name]
    assert scale_nuisance(bench, found, 1.0) == bench
    before, after = bench.model_dump(), scale_nuisance(bench, found, 3.0).model_dump()
    changed = {
        f"{section}.{name}"
        for section, content in before.items()
        if isinstance(content, dict)
        for name, value in content.items()
        if after[section][name] != value
    } | {f".{name}" for name, value in before.items()
         if isinstance(value, float) and after[name] != value}  # fmt: skip
    assert changed == set(found)
    for key in set(found) - {"face.foundation_range_n_mm3"}:
        section, name = key.split(".")
        new, old = (content[section] if section else content for content in (after, before))
        assert new[name] == pytest.approx(3.0 * old[name])


def test_a_range_keeps_its_middle() -> None:
    bench = load_simulation(preset="bench-v1")
    low, high = scale_nuisance(bench, NUISANCES["foundation"], 0.5).face.foundation_range_n_mm3
    assert low * high == pytest.approx(5.0 * 50.0)
    assert high / low == pytest.approx((50.0 / 5.0) ** 0.5)


def test_a_band_is_a_latin_hypercube_of_the_nuisances_that_a_bench_draws() -> None:
    bench = load_simulation(preset="bench-v2")
    found = band_benches(bench, 16)
    assert found == band_benches(bench, 16)
    for name in EVERY:
        log2 = np.sort([np.log2(factors[name]) for factors, _ in found])
        # One in each sixteenth of the range from a half to two.
        assert np.floor(8.0 * (log2 + 1.0)).tolist() == list(range(16))
    for factors, one in found:
        assert one.spread.com_mm == pytest.approx(0.5 * factors["com"])
        assert one.release_disturbance_mm == pytest.approx(0.5 * factors["release"])
        assert one.mu == bench.mu
    plain, _ = band_benches(load_simulation(preset="bench-v1"), 2)[0]
    assert set(plain) == set(NUISANCES)


def test_without_tilt_no_board_is_tilted() -> None:
    bench = scale_nuisance(load_simulation(preset="bench-v1"), NUISANCES["tilt"], 0.0)
    draws = [conditions.draw_mounting(bench, np.random.default_rng(k)) for k in range(3)]
    assert [draw.tilt_rad for draw in draws] == [(0.0, 0.0)] * 3


def _part(iou: list[float], says: list[bool], margins: list[float], left_out: int = 0) -> dict:
    patch = dict.fromkeys(("iou", "accuracy", "iou_true"), iou)
    score = {"patch": patch, "says": dict.fromkeys("123", says)}
    return {
        "models": {"M": score},
        "margin_mm": [[m, m] for m in margins],
        "slipped": 0.5,
        "rejected": 1,
        "left_out": left_out,
    }


def test_figures_of_presses_join_their_parts() -> None:
    parts = [
        _part([0.2, 0.4], [True, False], [3.0, -2.0]),
        _part([0.6, 0.8], [True, True], [-1.0, 0.1]),
    ]
    found = press_scores(parts, "M")
    assert found["iou"]["value"] == pytest.approx(0.5)
    assert found["iou"]["n"] == 4
    # One place is too close to call; of the three others two were told right.
    assert found["stable_1"]["accuracy"]["value"] == pytest.approx(2 / 3)
    assert found["stable_1"]["too_close"] == 1
    assert found["stable_1"]["unsafe"]["value"] == pytest.approx(0.5)
    assert found["rejected"] == 2


@pytest.mark.parametrize("world", ["elsewhere", "elsewhere-finite-elements"])
def test_a_drop_is_told_in_points(world: str) -> None:
    here, there = (
        {"world": name, "bottom": "short", "model": "M", **press_scores([part], "M")}
        for name, part in (
            ("bench", _part([0.8, 0.8], [True], [3.0])),
            (world, _part([0.65, 0.65], [True], [0.1])),
        )
    )
    presses, changes, trials = shift_tables({"presses": [here, there], "changes": [], "trials": []})
    (row,) = presses.texts()[1:]
    assert row[:4] == ("M short", "80.0 (80.0 to 80.0)", "65.0 (65.0 to 65.0)", "-15.0")
    assert row[5:7] == ("-", "")  # too close to call
    assert len(changes.rows) == len(trials.rows) == 0


@pytest.mark.optional
@pytest.mark.skipif(not mujoco_available(), reason="needs the optional engine")
def test_a_gel_is_a_world_with_the_same_seeds_and_settings_behind_a_strategy() -> None:
    name = "fused:fused.weights=any:fused.ensemble=mixture"
    plan = DomainShift(BENCH, "code", "pot", {"FT": "x"}, strategies=(name,), groups=0, trials=2)
    for there in ("elsewhere", "elsewhere-finite-elements"):
        jobs = replace(plan, there=there).jobs()
        assert [job.params.get("world", "bench") for job in jobs] == ["bench"] * 2 + [there] * 2
        assert [job.seed for job in jobs[:2]] == [job.seed for job in jobs[2:]]
        assert {job.params["strategy"] for job in jobs} == {name}


def test_both_worlds_are_asked_the_same_and_only_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["experiment", "elsewhere", "--pieces", "pot", "--bottoms", "short", "--groups", "2"]
    words += ["--trials", "1", "--strategies", "paper", "--preset", "bench-v1", "--json"]
    words += ["--executor", "serial", "--out", str(tmp_path)]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["missing"], answer["failed"]) == (0, [])
    said = json.loads(Path(answer["file"]).read_text("utf-8"))
    presses = {(c["world"], c["bottom"]): c for c in said["presses"] if c["model"] == "FT+Tac"}
    here, there = presses["bench", "short"], presses["elsewhere", "short"]
    assert here["iou"]["n"] == there["iou"]["n"] == 2
    assert here["iou"]["value"] != there["iou"]["value"]
    assert here["stable_1"]["stable_share"] == there["stable_1"]["stable_share"]
    assert {c["placed"]["n"] for c in said["trials"]} == {1}
    assert {c["strategy"] for c in said["trials"]} == {"paper"}
    iou = {(c["world"], c["model"]): c["iou"]["value"] for c in said["presses"]
           if c["bottom"] == "short"}  # fmt: skip
    change = {(c["what"], c["from"], c["to"]): c["value"] for c in said["changes"]
              if c["bottom"] == "short"}  # fmt: skip
    gain = iou["elsewhere", "FT+Tac"] - iou["elsewhere", "FT"]
    assert change["elsewhere", "FT", "FT+Tac"] == pytest.approx(gain)
    lost = iou["elsewhere", "FT"] - iou["bench", "FT"]
    assert change["drop", "FT", "FT"] == pytest.approx(lost)
    done = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert main(words) == 0
    assert done == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["elsewhere", "--groups", "0", "--trials", "0"], "--groups"),
        (["elsewhere", "--strategies", "fused:fused.unknown=1"], "fused.unknown"),
        (["elsewhere", "--pieces", "pot,barrel"], "--pieces"),
        (["elsewhere", "--bottoms", "sea"], "--bottoms"),
        (["elsewhere", "--strategies", "ceiling"], "fused,zero-wrench,fused-any"),
        (["elsewhere", "--first", "-1"], "--first"),
        (["beyond", "--strategies", "luck"], "fused-certified,fused-uneven,fused-wrench"),
        (["beyond", "--bottoms", "table"], "--bottoms"),
        (["beyond", "--trials", "0"], "--trials"),
        (["beyond", "--strategies", "fused", "--stop-early", "placed"], "--stop-early"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    words: list[str], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    verb, *more = words
    given = ["experiment", verb, "--pieces", "pot", "--out", str(tmp_path), "--json"]
    assert main([*given, *more]) == 2
    assert where in capsys.readouterr().err


def test_changes_are_paired_by_group_and_jobs_that_lost_one_do_not_count() -> None:
    def part(first: list[float], second: list[float], left_out: int = 0) -> dict:
        models = {"A": {"patch": {"iou": first}}, "B": {"patch": {"iou": second}}}
        return {"models": models, "left_out": left_out}

    there = [part([0.2, 0.6], [0.3, 0.8]), part([0.1], [0.9], left_out=1)]
    found = iou_change([(p, p) for p in there], "A", "B")
    assert found["value"] == pytest.approx(0.15)
    assert found["n"] == 2
    # Standard error of 0.1 and 0.2: 0.05.
    assert found["high"] - found["value"] == pytest.approx(1.96 * 0.05, abs=1e-4)
    assert format_change(found) == "+15.0 ± 9.8"


def test_both_worlds_begin_where_they_are_told_to() -> None:
    given = {"FT+Tac": "given", "FT": "too"}
    plan = DomainShift(BENCH, "test", "pot", given, ("short",), ("paper", "fused"), 2, 2, first=40)
    jobs = plan.jobs()
    pressed = [spec for spec in jobs if spec.kind == "static"]
    tried = [spec for spec in jobs if spec.kind == "beyond"]
    assert {spec.seed % 100 for spec in (*pressed, *tried)} == {40}
    assert [spec.inputs for spec in pressed] == [("given", "too")] * 2
    # Strategies read the first given model.
    read = [(spec.params["strategy"], spec.inputs) for spec in tried]
    assert sorted(read) == sorted(2 * [("paper", ("given",)), ("fused", ("given",))])
