"""What exists is asked elsewhere and with other nuisances: same seeds, nothing asked twice."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.config.simulation import SpreadSettings, load_simulation
from touchdown.backend.experiments.document import report_page
from touchdown.backend.experiments.domain_shift import format_drop, format_interval, press_scores
from touchdown.backend.experiments.evaluation import FACTORS, NUISANCES, scale_nuisance
from touchdown.backend.experiments.job_kinds import KINDS
from touchdown.backend.experiments.models import adopt_models, shipped_model_folders
from touchdown.backend.experiments.sensitivity import (
    NuisanceSensitivity,
    sensitivity_report,
    sensitivity_table,
)
from touchdown.backend.jobs.execution import SerialExecutor, run_campaign
from touchdown.backend.jobs.job import JobStore
from touchdown.backend.learning.checkpoint import load_card
from touchdown.backend.simulation import conditions
from touchdown.backend.simulation.release_mujoco import mujoco_available

BY_NAME = {found.name: found for found in NUISANCES}


def test_every_spread_but_that_of_a_jig_is_a_nuisance() -> None:
    keys = {key for found in NUISANCES for key in found.keys}
    assert {f"spread.{name}" for name in SpreadSettings.model_fields} - keys == {"spread.jig_mm"}


@pytest.mark.parametrize("found", NUISANCES, ids=lambda found: found.name)
def test_one_nuisance_grows_and_nothing_else(found) -> None:
    bench = load_simulation(preset="bench-v1")
    assert scale_nuisance(bench, found, 1.0) == bench
    before, after = bench.model_dump(), scale_nuisance(bench, found, 3.0).model_dump()
    changed = {
        f"{section}.{name}"
        for section, content in before.items()
        if isinstance(content, dict)
        for name, value in content.items()
        if after[section][name] != value
    }
    assert changed == set(found.keys)
    for key in set(found.keys) - {"face.foundation_range_n_mm3"}:
        section, name = key.split(".")
        assert after[section][name] == pytest.approx(3.0 * before[section][name])


def test_a_range_keeps_its_middle() -> None:
    bench = load_simulation(preset="bench-v1")
    low, high = scale_nuisance(bench, BY_NAME["foundation"], 0.5).face.foundation_range_n_mm3
    assert low * high == pytest.approx(5.0 * 50.0)
    assert high / low == pytest.approx((50.0 / 5.0) ** 0.5)


def test_without_tilt_no_board_is_tilted() -> None:
    bench = scale_nuisance(load_simulation(preset="bench-v1"), BY_NAME["tilt"], 0.0)
    draws = [conditions.draw_mounting(bench, np.random.default_rng(k)) for k in range(3)]
    assert [draw.tilt_rad for draw in draws] == [(0.0, 0.0)] * 3


def _part(iou: list[float], says: list[bool], margins: list[float], left_out: int = 0) -> dict:
    score = {"iou": iou, "accuracy": iou, "iou_true": iou, "says": dict.fromkeys("123", says)}
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


def test_a_drop_is_told_in_points() -> None:
    here, there = ({"value": v, "low": v - 0.1, "high": v + 0.1} for v in (0.8, 0.65))
    assert format_drop(here, there) == "-15.0"
    assert format_interval(here) == "80.0 (70 to 90)"
    assert format_drop(here, {"value": None}) == ""


def test_sensitivity_is_asked_once_for_the_bench_itself(tmp_path: Path) -> None:
    store, bench = JobStore(tmp_path), load_simulation(preset="quiet")
    source = adopt_models(store, *shipped_model_folders("quiet"))["pot", "FT+Tac"]
    asked = (BY_NAME["tilt"], BY_NAME["gain"])
    plan = NuisanceSensitivity(bench, "test", "pot", source, ("short",), groups=4, nuisances=asked)
    jobs = plan.jobs()
    assert len(jobs) == 1 + 2 * (len(FACTORS) - 1)
    # The bench itself comes first, then the ends of the range.
    assert all(job.seed == jobs[0].seed for job in jobs)
    some = jobs[:3]
    assert {r.state for r in run_campaign(some, SerialExecutor(KINDS, store), store)} == {"done"}
    answer = plan.answer(store)
    tilt, gain = answer["nuisances"]
    assert [row["factor"] for row in tilt["at"]] == [0.0, 1.0]
    assert tilt["at"][1] == gain["at"][1]
    assert tilt["at"][1]["iou_change"]["value"] == 0.0
    shift = tilt["at"][0]["iou_change"]["value"]
    assert shift == pytest.approx(tilt["at"][0]["iou"]["value"] - tilt["at"][1]["iou"]["value"])
    assert shift != 0.0
    assert tilt["at"][0]["iou_change_on"] == {"short": tilt["at"][0]["iou_change"]}
    page = report_page(sensitivity_report(answer))
    assert page.count("<svg") == 2
    assert sensitivity_table(answer).texts()[1][1] in page


@pytest.mark.optional
@pytest.mark.skipif(not mujoco_available(), reason="needs the optional engine")
def test_both_worlds_are_asked_the_same_and_only_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["experiment", "elsewhere", "--pieces", "pot", "--bottoms", "short", "--groups", "2"]
    words += ["--trials", "1", "--strategies", "paper", "--preset", "quiet", "--json"]
    words += ["--executor", "serial", "--out", str(tmp_path), "--train", "randomised"]
    words += ["--probes", "10", "--epochs", "1", "--keep-models", str(tmp_path)]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["missing"], answer["failed"]) == (0, [])
    card = load_card(tmp_path / "randomised" / "pot-ft+tac.safetensors")
    assert (card.data["mountings"], card.training["epochs"]) == (3, 1)
    said = json.loads(Path(answer["file"]).read_text("utf-8"))
    presses = {(c["world"], c["bottom"]): c for c in said["presses"] if c["model"] == "FT+Tac"}
    here, there = presses["bench", "short"], presses["elsewhere", "short"]
    assert here["iou"]["n"] == there["iou"]["n"] == 2
    assert here["iou"]["value"] != there["iou"]["value"]
    assert here["stable_1"]["stable_share"] == there["stable_1"]["stable_share"]
    assert {c["placed"]["n"] for c in said["trials"]} == {1}
    own = "FT+Tac randomised"
    assert {c["strategy"] for c in said["trials"]} == {"paper", f"paper, {own}"}
    iou = {(c["world"], c["model"]): c["iou"]["value"] for c in said["presses"]
           if c["bottom"] == "short"}  # fmt: skip
    change = {(c["what"], c["from"], c["to"]): c["value"] for c in said["changes"]
              if c["bottom"] == "short"}  # fmt: skip
    gain = iou["elsewhere", own] - iou["elsewhere", "FT+Tac"]
    assert change["elsewhere", "FT+Tac", own] == pytest.approx(gain)
    lost = iou["elsewhere", own] - iou["bench", own]
    assert change["drop", own, own] == pytest.approx(lost)
    done = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert main(words) == 0
    assert done == {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["--groups", "0"], "--groups"),
        (["--pieces", "pot,barrel"], "--pieces"),
        (["--bottoms", "sea"], "--bottoms"),
        (["--strategies", "ceiling"], "--strategies"),
    ],
)
def test_what_cannot_be_asked_is_refused(
    words: list[str], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["experiment", "sensitivity", "--pieces", "pot", "--out", str(tmp_path), "--json"]
    assert main([*given, *words]) == 2
    assert where in json.loads(capsys.readouterr().err)["error"]["where"]
