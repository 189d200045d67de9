"""``touchdown collect``: a dataset from the command line, gone on with, and bad input refused."""

from __future__ import annotations

import json

import pytest

from tests.backend.brisk import RATE_HZ
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.cli.collect import coverage_text
from touchdown.backend.cli.command_line import main
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry.outlines import circle


@pytest.mark.slow
def test_a_campaign_is_collected_and_resumed(tmp_path, capsys) -> None:
    bench = tmp_path / "bench.toml"
    bench.write_text(f'preset = "quiet"\n[tactile]\nrate_hz = {RATE_HZ}\n', "utf-8")
    words = ["--dataset", str(tmp_path / "ds"), "--runs", str(tmp_path / "runs")]
    words += ["--bench", str(bench)]
    given = ["--count", "2", "--probes-per-grip", "2", "--person", "ann"]
    assert main(["collect", *given, *words, "--json", "--inject", "force_torque:stop@14"]) == 1
    first = json.loads(capsys.readouterr().out)
    assert first["ending"] == "failed"
    assert first["faults"]
    assert (first["collected"], first["count"], first["simulated"]) == (1, 2, True)
    assert main(["collect", "--resume", "--person", "bob", *words]) == 0
    second = capsys.readouterr().out
    for said in (first["campaign"], "2 of 2 probes are done.", "no findings"):
        assert said in second
    with Dataset.open(tmp_path / "ds", write=False) as dataset:
        assert [entry.person for entry in dataset.episodes()] == ["ann", "bob"]
    assert (tmp_path / "runs").is_dir()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "0"], "at least one probe"),
        (["--within", "-1"], "range is not positive"),
        (["--seed", "-2"], "seed -2 is negative"),
        (["--piece", "cup"], "no piece 'cup'"),
        (["--probes-per-grip", "0"], "--probes-per-grip must be at least 1"),
        (["--preset", "calm"], "no preset 'calm'"),
        (["--hand-over", "--json"], "With --json the prompt"),
    ],
)
def test_bad_input_is_one_clear_error(words, said, tmp_path, capsys) -> None:
    where = ["--dataset", str(tmp_path / "ds"), "--runs", str(tmp_path / "runs")]
    assert main(["collect", *words, *where]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert err.count("\n") <= 3


def test_resume_needs_a_campaign(tmp_path, capsys) -> None:
    where = ["--dataset", str(tmp_path / "ds")]
    assert main(["collect", "--resume", *where]) == 2
    assert "no dataset" in capsys.readouterr().err
    Dataset.open(tmp_path / "ds").close()
    assert main(["collect", "--resume", *where]) == 2
    assert "has no campaign" in capsys.readouterr().err


def test_coverage_is_drawn_with_y_up() -> None:
    seen = count_coverage([(0.0, 2.0)] * 3 + [(2.0, 0.0)] * 12, circle(8.0), circle(8.0))
    head, *rows = coverage_text(seen).splitlines()
    assert head.startswith("Covered 2 of ")
    upper = next(k for k, row in enumerate(rows) if "3" in row)
    lower = next(k for k, row in enumerate(rows) if "+" in row)
    assert lower == upper + 1
    assert rows[lower].index("+") > rows[upper].index("3")
