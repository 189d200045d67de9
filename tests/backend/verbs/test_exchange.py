"""``touchdown export`` and ``import``: what they say, and their exit codes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.backend.exchange.conftest import fill
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.cli.command_line import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with Dataset.open(tmp_path / "data", person="cleo") as dataset:
        fill(dataset, frames=False)
    return tmp_path / "data"


@pytest.fixture
def say(capfd: pytest.CaptureFixture[str]) -> Any:
    def call(*words: object) -> tuple[int, dict[str, Any]]:
        capfd.readouterr()
        code = main([*(str(word) for word in words), "--json"])
        out, err = capfd.readouterr()
        answer: dict[str, Any] = json.loads(out or err)
        return code, answer

    return call


def test_out_and_in_again(folder: Path, say: Any, tmp_path: Path) -> None:
    out, back = tmp_path / "out", tmp_path / "back"
    code, answer = say("export", "robomimic", "--dataset", folder, "--out", out)
    assert (code, answer["episodes"]) == (0, 4)
    words = ("import", "robomimic", out, "--dataset", back, "--person", "dora")
    code, answer = say(*words, "--check")
    assert (code, answer["found"], answer["written"]) == (0, 4, 0)
    code, answer = say(*words)
    assert (code, answer["written"]) == (0, 4)
    code, answer = say(*words)
    assert (code, answer["here"], answer["written"]) == (0, 4, 0)
    with Dataset.open(back) as dataset:
        assert {dataset.labels.head(e.uuid).person for e in dataset.episodes()} == {"dora"}


def test_labels_go_out_and_come_in(folder: Path, say: Any, tmp_path: Path) -> None:
    for kind in ("csv", "coco"):
        out = tmp_path / kind
        assert say("export", kind, "--dataset", folder, "--out", out)[0] == 0
        code, answer = say("import", kind, out, "--dataset", folder, "--person", "ann")
        assert (code, answer["changed"], answer["unchanged"]) == (0, 0, 4)
    assert say("export", "jsonl", "--dataset", folder, "--out", tmp_path / "log")[0] == 0
    words = ("import", "jsonl", tmp_path / "log", "--dataset", folder, "--person", "ann")
    assert say(*words)[1]["operations"] == 0


def test_an_edited_table_without_its_manifest(folder: Path, say: Any, tmp_path: Path) -> None:
    say("export", "csv", "--dataset", folder, "--out", tmp_path / "csv")
    table = tmp_path / "csv" / "episodes.csv"
    table.write_text(table.read_text().replace(",-2.501,", ",-2.600,"))
    words = ("--dataset", folder, "--person", "ann")
    code, answer = say("import", "csv", tmp_path / "csv", *words)
    assert code == 2
    assert "missing or cut short" in str(answer) or "changed since" in str(answer)
    code, answer = say("import", "csv", table, *words)
    assert (code, answer["changed"]) == (0, 1)
    assert Path(answer["backup"]).parent == folder / "backup"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("export", "csv", "--out", "{tmp}/o", "--states", "perfect"), "--states"),
        (("export", "csv", "--out", "{tmp}/o", "--held-out", "1"), "--held-out"),
        (("export", "csv", "--out", "{tmp}/o", "--piece", "barrel"), "barrel"),
        (("export", "csv", "--out", "{tmp}/o", "--video", "all"), "--video"),
        (("export", "gif", "--out", "{tmp}/o"), "export"),
        (("import", "csv", "{tmp}/none.csv", "--person", "ann"), "none.csv"),
        (("import", "csv", "{tmp}"), "--person"),
        (("import", "lerobot", "{tmp}", "--person", "ann"), "{tmp}"),
    ],
)
def test_bad_wishes_are_refused(
    words: tuple[str, ...], why: str, folder: Path, say: Any, tmp_path: Path
) -> None:
    called = [word.format(tmp=tmp_path) for word in words]
    code, answer = say(*called, "--dataset", folder)
    assert code == 2
    assert why.format(tmp=tmp_path) in answer["error"]["where"]
    assert answer["error"]["fix"]
