"""``touchdown dataset merge``: two copies become one, and what is wrong is one bad input."""

import json
import shutil
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.cli.command_line import main


@pytest.fixture
def copies(tmp_path: Path) -> tuple[Path, Path, str]:
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    with Dataset.open(ours) as dataset:
        entry = dataset.record(
            small_episode(), Label(1, 2, 0, 3), source="commanded", context=context_for(dataset)
        )
    shutil.copytree(ours, theirs)
    return ours, theirs, entry.uuid


def label(folder: Path, person: str, uuid: str, x_um: int) -> None:
    with Dataset.open(folder) as dataset:
        dataset.labels.accept(person, uuid, Label(x_um, 0, 0, 50))


def test_merge_brings_labels_and_tells_conflicts(
    copies: tuple[Path, Path, str], capsys: pytest.CaptureFixture[str]
) -> None:
    ours, theirs, uuid = copies
    label(theirs, "bob", uuid, 500)
    words = ["dataset", "merge", str(theirs), "--dataset", str(ours), "--person", "ann", "--json"]
    assert main(words) == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["operations"], answer["episodes"], answer["conflicts"]) == (1, 0, [])
    with Dataset.open(ours) as dataset:
        dataset.labels.reject("ann", uuid, "tilt")
    with Dataset.open(theirs) as dataset:
        dataset.labels.undo("bob")
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["conflicts"] == [uuid]
    assert main(["dataset", "--dataset", str(ours), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["conflicts"] == 1
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out)["operations"] == 0


@pytest.mark.parametrize("other", ["", "nowhere"])
def test_merge_without_a_copy_is_bad_input(
    copies: tuple[Path, Path, str], other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["dataset", "merge", *([other] if other else []), "--dataset", str(copies[0])]
    assert main(words) == 2
    assert "fix:" in capsys.readouterr().err
