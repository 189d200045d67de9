"""Runs: files first and rows second; nothing is lost, whatever process has the dataset open."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import signal
import sqlite3
from pathlib import Path

import pytest

from touchdown.backend.annotations.backups import list_backups, restore_backup
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.run_tracking import METRICS_FILE, RUNS_FOLDER, ActiveRun
from touchdown.backend.core.faults import InputError

SETTINGS = {"modality": "FT+Tac", "epochs": 2, "out": "pot.safetensors"}


def begin(dataset: Dataset, **changes: object) -> ActiveRun:
    return dataset.runs.begin("train", seed=7, settings=SETTINGS | changes, manifest="m" * 64)


def test_a_run_is_told_while_it_goes_on_and_after(dataset: Dataset, tmp_path: Path) -> None:
    live = begin(dataset)
    assert dataset.runs.entry(live.uuid).state == "running"
    live.metric("loss", 1, 0.5)
    live.end_epoch()
    assert [(m.name, m.step, m.value) for m in dataset.runs.metrics(live.uuid)] == [
        ("loss", 1, 0.5)
    ]
    live.metric("loss", 2, 0.25)
    live.metric("iou", 2, math.nan)
    model = tmp_path / "pot.safetensors"
    model.write_bytes(b"weights")
    live.artifact("model", model)
    live.finish()
    entry = dataset.runs.entry(live.uuid)
    assert (entry.state, entry.kind, entry.seed, entry.manifest) == (
        "finished", "train", 7, "m" * 64,
    )  # fmt: skip
    assert entry.params == SETTINGS
    assert entry.ended_ns is not None
    assert entry.ended_ns >= entry.started_ns
    (made,) = entry.artifacts
    assert (made.path, made.bytes) == (str(model.resolve()), 7)
    assert made.sha256 == hashlib.sha256(b"weights").hexdigest()
    assert [m.value for m in dataset.runs.metrics(live.uuid, "loss")] == [0.5, 0.25]
    assert math.isnan(dataset.runs.metrics(live.uuid, "iou")[0].value)


def test_runs_are_listed_by_kind_the_newest_first(dataset: Dataset) -> None:
    with begin(dataset) as first:
        first.finish()
    with dataset.runs.begin("evaluate", seed=0, settings={}) as other:
        other.finish()
    with begin(dataset) as second:
        second.finish()
    assert [e.uuid for e in dataset.runs.entries()] == [second.uuid, other.uuid, first.uuid]
    assert [e.uuid for e in dataset.runs.entries("train")] == [second.uuid, first.uuid]
    with pytest.raises(InputError, match="no such run"):
        dataset.runs.entry("elsewhere")


def test_what_did_not_end_by_itself_failed_or_was_cancelled(dataset: Dataset) -> None:
    with pytest.raises(ValueError, match="too hot"), begin(dataset) as failed:
        raise ValueError("too hot")
    with pytest.raises(KeyboardInterrupt), begin(dataset) as stopped:
        raise KeyboardInterrupt
    states = {e.uuid: (e.state, e.reason) for e in dataset.runs.entries()}
    assert states == {failed.uuid: ("failed", "too hot"), stopped.uuid: ("cancelled", "")}


def test_a_run_needs_no_right_to_write_the_catalogue(dataset: Dataset) -> None:
    with Dataset.open(dataset.folder, write=False) as reader:
        live = begin(reader)
        assert reader.runs.entries() == []
    live.metric("loss", 1, 0.5)
    assert [e.state for e in dataset.runs.entries()] == ["running"]
    live.finish()
    assert [e.state for e in dataset.runs.entries()] == ["finished"]
    with Dataset.open(dataset.folder, write=False) as reader:
        assert [e.uuid for e in reader.runs.entries()] == [live.uuid]
        assert len(reader.runs.metrics(live.uuid)) == 1


def die_running(folder: Path, lines: int) -> str:
    """Begin a run in a child, write ``lines`` values and half a line, and kill it."""
    out, into = os.pipe()
    pid = os.fork()
    if not pid:
        with Dataset.open(folder, write=False) as dataset:
            live = begin(dataset)
        for step in range(lines):
            live.metric("loss", step, float(step))
        live._metrics.write('{"name": "lo')
        live._metrics.flush()
        os.write(into, live.uuid.encode())
        os.kill(os.getpid(), signal.SIGKILL)
    os.close(into)
    uuid = os.read(out, 100).decode()
    os.close(out)
    os.waitpid(pid, 0)
    return uuid


def test_a_killed_run_is_interrupted_at_the_next_start(tmp_path: Path) -> None:
    Dataset.open(tmp_path / "data").close()
    uuid = die_running(tmp_path / "data", 3)
    with Dataset.open(tmp_path / "data", write=False) as reader:
        assert [f.kind for f in check_dataset(reader.parts)] == ["interrupted"]
    with Dataset.open(tmp_path / "data") as dataset:
        assert "--resume" in dataset.notices[0]
        entry = dataset.runs.entry(uuid)
        assert entry.state == "interrupted"
        assert entry.ended_ns is not None
        assert [m.value for m in dataset.runs.metrics(uuid)] == [0.0, 1.0, 2.0]
    with Dataset.open(tmp_path / "data") as dataset:
        assert dataset.notices == ()
        assert list(check_dataset(dataset.parts, whole=True)) == []


def test_a_run_that_lives_is_left_alone(dataset: Dataset) -> None:
    live = begin(dataset)
    assert list(check_dataset(dataset.parts)) == []
    live.finish()


def test_a_folder_without_a_run_is_deleted_and_a_row_without_folder_is_kept(
    dataset: Dataset,
) -> None:
    live = begin(dataset)
    dataset.runs.entries()
    live.finish()
    shutil.rmtree(dataset.folder / RUNS_FOLDER / live.uuid)
    (dataset.folder / RUNS_FOLDER / "begun").mkdir()
    dataset.close()
    with Dataset.open(dataset.folder) as again:
        assert len(again.notices) == 2
        assert again.runs.entry(live.uuid).state == "interrupted"
        assert not (again.folder / RUNS_FOLDER / "begun").exists()


def test_an_unreadable_run_is_told_once_and_harms_nothing(dataset: Dataset) -> None:
    live = begin(dataset)
    live.finish()
    (dataset.folder / RUNS_FOLDER / live.uuid / "run.json").write_text("{")
    dataset.close()
    with Dataset.open(dataset.folder) as again:
        assert "cannot be read" in again.notices[0]
    with Dataset.open(dataset.folder) as again:
        assert again.notices == ()


def test_metrics_that_were_cut_are_read_anew(dataset: Dataset) -> None:
    live = begin(dataset)
    for step in range(5):
        live.metric("loss", step, 1.0)
    assert len(dataset.runs.metrics(live.uuid)) == 5
    live.finish()
    path = dataset.folder / RUNS_FOLDER / live.uuid / METRICS_FILE
    path.write_bytes(path.read_bytes().splitlines(keepends=True)[0])
    assert len(dataset.runs.metrics(live.uuid)) == 1


def test_runs_come_back_after_a_rebuild_and_after_a_restore(dataset: Dataset) -> None:
    backup = dataset.backups.make("test")
    live = begin(dataset)
    live.metric("loss", 1, 0.5)
    live.finish()
    dataset.runs.entries()
    dataset.close()
    assert rebuild_dataset(dataset.folder, replace=True).equal
    with Dataset.open(dataset.folder) as again:
        assert len(again.runs.metrics(live.uuid)) == 1
    assert list_backups(dataset.folder / "backup")
    restore_backup(dataset.folder, backup)
    with Dataset.open(dataset.folder) as again:
        assert len(again.runs.metrics(live.uuid)) == 1
        assert again.runs.entry(live.uuid).params == SETTINGS


def test_the_chain_of_labels_is_written_into_the_run(dataset: Dataset, record) -> None:  # type: ignore[no-untyped-def]
    record()
    live = begin(dataset)
    live.finish()
    newest = dataset.database.one("SELECT hash FROM op ORDER BY seq DESC LIMIT 1")[0]
    assert newest in json.dumps(dict(dataset.runs.entry(live.uuid).chain))


def test_a_param_is_never_without_its_run(dataset: Dataset) -> None:
    with (
        pytest.raises(sqlite3.IntegrityError),
        dataset.database.transaction() as connection,
    ):
        connection.execute("INSERT INTO param VALUES ('none', 'k', '1')")
