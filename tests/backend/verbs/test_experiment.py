"""The verb ``experiment``: bad words are refused before any work; what is done is done once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from touchdown.backend.cli.command_line import main
from touchdown.backend.experiments import tables


@pytest.mark.parametrize(
    ("words", "where"),
    [
        (["--workers", "0"], "--workers"),
        (["--pieces", "teapot"], "--pieces"),
        (["--pieces", ""], "--pieces"),
        (["--full", "--models", "."], "--models"),
        (["--executor", "dask"], "--cluster"),
        (["--shard", "2/2"], "--shard"),
        (["--preset", "loud"], "--preset"),
        (["--bench", "nowhere.toml"], "nowhere.toml"),
        (["--full", "--quick"], "touchdown experiment"),
    ],
)
def test_bad_words_are_refused(
    words: list[str], where: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["experiment", "tables", *out, *words, "--json"]) == 2
    assert where in json.loads(capsys.readouterr().err)["error"]["where"]


def test_a_file_in_the_way_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").write_text("in the way")
    assert main(["experiment", "tables", "--out", str(tmp_path / "out")]) == 2
    assert "cannot be made" in capsys.readouterr().err


def test_two_shards_make_one_experiment(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    small = replace(tables.QUICK, groups=4, trials=2)
    monkeypatch.setitem(tables.SCALES, "quick", small)
    words = ["experiment", "tables", "--pieces", "pot", "--executor", "serial", "--json"]
    words += ["--preset", "quiet"]  # bottoms that stand still cost the least
    words += ["--out", str(tmp_path)]
    missing = []
    for shard in ("0/2", "1/2"):
        assert main([*words, "--shard", shard]) == 0
        missing.append(json.loads(capsys.readouterr().out)["missing"])
    assert missing[0] > 0
    assert missing[1] == 0
    folders = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "jobs").iterdir()}
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["failed"] == []
    assert Path(answer["page"]).is_file()
    assert folders == {p.name: p.stat().st_mtime_ns for p in (tmp_path / "jobs").iterdir()}
    assert answer["tables"]["table3"][1]["cells"][0]["n"] == 2
