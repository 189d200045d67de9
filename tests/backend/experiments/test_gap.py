"""The share of the way to the ceiling: its interval where that is known, files as its source."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.core.faults import InputError
from touchdown.backend.experiments.comparison import (
    merged_oracle_shares,
    oracle_shares,
    quantity_label,
)
from touchdown.backend.experiments.strategies import (
    group_lines,
    parse_trials,
    parse_verdicts,
    trial_lines,
)
from touchdown.backend.experiments.tables import BEYOND_FORMAT

Json = dict[str, Any]


def cell(placed: int, of: int, *, word: str = "gave_up") -> list[Json]:
    ends = ["placed"] * placed + [word] * (of - placed)
    return [{"seed": k, "outcome": e, "probes": 3, "least_probes": 2} for k, e in enumerate(ends)]


def stored(**strategies: list[Json]) -> Json:
    """The content of a beyond.json with some trials of pot on Long, and no groups."""
    counts = {"value": 0.5, "low": 0.1, "high": 0.9, "n": 2}
    cells = [
        {
            "strategy": name.replace("_", "-"), "piece": "pot", "bottom": "long",
            "placed": counts, "unsafe": counts, "outcomes": {"placed": 1}, "probes": 3.0,
            "excess_probes_median": 1.0, "left_out": 0, "trials": trial_lines(trials),
        }
        for name, trials in strategies.items()
    ]  # fmt: skip
    return {
        "format": BEYOND_FORMAT, "bench_sha256": "a" * 64, "code": "1", "models": {},
        "cells": cells, "pooled": [], "gaps": [],
    }  # fmt: skip


def test_between_nothing_and_everything_the_share_is_the_rate_itself() -> None:
    names = {"paper": cell(0, 80), "mine": cell(60, 80), "ceiling": cell(80, 80)}
    row, unsafe = oracle_shares(
        {(name, "pot", "long"): trials for name, trials in names.items()}, {}
    )
    half = 1.96 * (0.75 * 0.25 / 80) ** 0.5
    assert row["share"] == 0.75
    assert (row["share_low"], row["share_high"]) == pytest.approx(
        (0.75 - half, 0.75 + half), abs=0.02
    )
    # Nobody let go of anything that fell: there is no way to go.
    assert unsafe["share"] is None


def test_one_who_knows_less_of_the_bottom_is_a_ceiling_too() -> None:
    names = {"paper": cell(2, 10), "mine": cell(5, 10), "ceiling-diameter": cell(7, 10)}
    of_pot = {(name, "pot", "long"): trials for name, trials in names.items()}
    (row, _) = oracle_shares(of_pot, {})
    assert (row["to"], row["share"]) == ("ceiling-diameter", pytest.approx(0.6))
    rows = oracle_shares({**of_pot, ("ceiling", "pot", "long"): cell(8, 10)}, {})
    # None of the two stands among those that are on their way.
    placed = [(r["strategy"], quantity_label(r), r["share"]) for r in rows if r["what"] == "placed"]
    assert placed == [
        ("mine", "placed", pytest.approx(0.5)),
        ("mine", "placed, to ceiling-diameter", pytest.approx(0.6)),
    ]


def test_a_way_that_may_not_exist_has_no_interval() -> None:
    names = {"paper": cell(9, 10), "mine": cell(10, 10), "ceiling": cell(10, 10)}
    row, _ = oracle_shares({(name, "pot", "long"): trials for name, trials in names.items()}, {})
    # Without the one seed that tells them apart, as in a third of all draws, there is no way.
    assert (row["share"], row["share_low"], row["share_high"]) == (1.0, None, None)


def test_lines_hold_what_the_shares_are_made_of() -> None:
    said = {
        "margin_mm": [[3.5, 1.25], [-2.0, -2.0], [None, None]],
        "left_out": 0,
        "likely": {"1": [True, False, False], "2": [True, True, False],
                   "3": [True, False, True], "5": [True, False, False]},
        "says": {"1": [False] * 3, "2": [False, True, False],
                 "3": [True, False, False], "5": [True, False, False]},
    }  # fmt: skip
    (line,) = group_lines({600: said})
    assert line == "600 1.25:1111:0011 -2:0100:0100 -:0010:0000"
    found = {"cells": [{"strategy": "mine", "piece": "pot", "bottom": "long", "asked": [line]}]}
    back = parse_verdicts({"statics": found})["mine", "pot", "long"][600]
    assert back["margin_mm"] == [[1.25, 1.25], [-2.0, -2.0], [None, None]]
    assert (back["likely"], back["says"]) == (said["likely"], said["says"])
    trials = cell(1, 2, word="knocked_over")
    assert parse_trials(stored(mine=trials))["mine", "pot", "long"] == trials


def test_one_command_prints_the_shares_over_several_files(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / "ceiling.json", tmp_path / "others.json"]
    files[0].write_text(json.dumps(stored(ceiling=cell(6, 6))))
    files[1].write_text(json.dumps(stored(paper=cell(2, 4, word="fell"), mine=cell(3, 4))))
    out = ["--out", str(tmp_path / "out"), "--beyond", *map(str, files)]
    assert main(["experiment", "gap", *out, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["gaps"]
    assert [(r["what"], r["n"], r["share"]) for r in rows] == [
        ("placed", 4, 0.5),
        ("unsafe", 4, 1.0),
    ]
    # What it leaves can be shown with tables, like any other comparison.
    kept = json.loads((tmp_path / "out" / "gap.json").read_text("utf-8"))
    assert (kept["format"], kept["gaps"]) == (BEYOND_FORMAT, rows)
    assert (
        "| mine | placed | 4 | 50.0 | 75.0 | 100.0 | 50.0" in (tmp_path / "out/gap.md").read_text()
    )
    assert main(["experiment", "gap", *out, str(files[1]), "--json"]) == 2
    assert "mine pot long" in json.loads(capsys.readouterr().err)["error"]["what"]
    assert main(["experiment", "gap", *out[:2], "--beyond", str(files[1]), "--json"]) == 2
    assert "ceiling" in json.loads(capsys.readouterr().err)["error"]["what"]


def test_other_benches_are_refused() -> None:
    other = {**stored(ceiling=cell(1, 1)), "bench_sha256": "b" * 64}
    with pytest.raises(InputError, match="different benches"):
        merged_oracle_shares([("one", stored(paper=cell(1, 1))), ("other", other)])
