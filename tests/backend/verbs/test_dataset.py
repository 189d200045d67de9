"""``touchdown dataset`` and ``doctor --dataset``: what they say, and their exit codes."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.backups import list_backups
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.cli.command_line import main


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        context = context_for(dataset)
        for seed in range(3):
            dataset.record(small_episode(seed=seed), Label(seed, 0, 0, 1), source="commanded",
                           context=context)  # fmt: skip
    return folder


@pytest.fixture
def say(capfd: pytest.CaptureFixture[str]) -> Any:
    def call(*words: str) -> tuple[int, dict[str, Any]]:
        capfd.readouterr()
        code = main([*words, "--json"])
        out, err = capfd.readouterr()
        answer: dict[str, Any] = json.loads(out or err)
        return code, answer

    return call


def first_file(folder: Path) -> Path:
    return sorted((folder / "raw").rglob("*.mcap"))[0]


def test_status_counts_by_pair_and_state(folder: Path, say: Any) -> None:
    code, answer = say("dataset", "--dataset", str(folder))
    assert code == 0
    assert answer["episodes"] == 3
    assert answer["pairs"] == [
        {"piece": "pot", "bottom": "circle15", "state": "draft", "episodes": 3}
    ]
    assert answer["backup_age_h"] == 0.0
    (campaign,) = answer["campaigns"]
    assert (campaign["uuid"], campaign["episodes"], campaign["done"]) == ("campaign-1", 3, 1)


def test_the_usual_dataset_is_that_of_the_data_folder(
    folder: Path, say: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TOUCHDOWN_DATA", str(folder.parent))
    folder.rename(folder.parent / "dataset")
    assert say("dataset")[1]["episodes"] == 3
    assert say("doctor", "--dataset")[0] == 0


def test_doctor_reports_and_changes_nothing(folder: Path, say: Any) -> None:
    assert say("doctor", "--dataset", str(folder)) == (
        0, say("doctor", "--dataset", str(folder))[1],
    )  # fmt: skip
    path = first_file(folder)
    path.write_bytes(path.read_bytes()[:-50])
    for _ in range(2):
        code, answer = say("doctor", "--dataset", str(folder))
        assert code == 1
        assert [f["kind"] for f in answer["findings"]] == ["torn"]
    assert path.exists()


def test_verify_reads_every_byte_and_notes_damage(folder: Path, say: Any) -> None:
    assert say("dataset", "verify", "--dataset", str(folder))[0] == 0
    path = first_file(folder)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    code, answer = say("dataset", "verify", "--dataset", str(folder))
    assert code == 1
    assert [f["kind"] for f in answer["findings"]] == ["damaged"]
    assert say("dataset", "--dataset", str(folder))[1]["files"] == {"complete": 2, "damaged": 1}


def test_verify_looks_only_while_another_program_writes(folder: Path, say: Any) -> None:
    path = first_file(folder)
    with Dataset.open(folder, person="ann") as dataset:
        code, answer = say("dataset", "verify", "--dataset", str(folder))
        assert (code, answer["findings"], answer["noted"]) == (0, [], False)
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 4
        path.write_bytes(data)
        code, answer = say("dataset", "verify", "--dataset", str(folder))
        assert (code, [f["kind"] for f in answer["findings"]]) == (1, ["damaged"])
        assert {e.file_state for e in dataset.episodes()} == {"complete"}
        dataset.labels.set("ann", dataset.episodes()[1].uuid, Label(9, 9, 0, 1))


def test_back_up_and_restore(folder: Path, say: Any) -> None:
    code, answer = say("dataset", "backup", "--dataset", str(folder))
    assert code == 0
    copy = Path(answer["backup"])
    assert copy == list_backups(folder / "backup")[0].path
    kept = copy.read_bytes()
    with Dataset.open(folder) as dataset:
        uuid = dataset.episodes()[0].uuid
        dataset.labels.set("ann", uuid, Label(77, 0, 0, 1))
    keep = folder.parent / "keep.db"
    keep.write_bytes(kept)
    code, answer = say("dataset", "restore", str(keep), "--dataset", str(folder))
    assert code == 0
    assert any("replayed" in notice for notice in answer["notices"])
    with Dataset.open(folder) as dataset:
        assert dataset.labels.head(uuid).label.x_um == 77


def test_rebuild_compares_and_replaces(folder: Path, say: Any) -> None:
    code, answer = say("dataset", "rebuild", "--dataset", str(folder))
    assert (code, answer["equal"], answer["replaced"]) == (0, True, False)
    assert answer["rows"]["episode"] == 3
    (folder / "catalog.db").write_bytes(b"gone")
    code, answer = say("dataset", "rebuild", "--dataset", str(folder))
    assert code == 2
    assert "--replace" in answer["error"]["fix"]
    code, answer = say("dataset", "rebuild", "--replace", "--dataset", str(folder))
    assert (code, answer["replaced"]) == (0, True)
    assert say("dataset", "--dataset", str(folder))[1]["episodes"] == 3


@pytest.mark.parametrize(
    "words",
    [["dataset", "restore"], ["dataset", "verify", "x.db"], ["dataset", "burn"],
     ["dataset", "restore", "none.db"]],
)  # fmt: skip
def test_bad_words_are_refused(folder: Path, say: Any, words: list[str]) -> None:
    code, answer = say(*words, "--dataset", str(folder))
    assert code == 2
    assert answer["error"]["fix"]


def test_no_dataset_says_so(tmp_path: Path, say: Any) -> None:
    for words in (["dataset"], ["dataset", "verify"], ["dataset", "rebuild"],
                  ["doctor", "--dataset", str(tmp_path)]):  # fmt: skip
        extra = [] if words[0] == "doctor" else ["--dataset", str(tmp_path)]
        code, answer = say(*words, *extra)
        assert code == 2, words
        assert str(tmp_path) in answer["error"]["where"]
