"""Datasets: recorded data in file, index and journal; single writer."""

from __future__ import annotations

import json
import os
import sqlite3
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.backend.catalogue.conftest import Record, context_for, small_episode
from touchdown.backend.annotations.database import SCHEMA_VERSION, Database
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import OperationJournal, read_journal
from touchdown.backend.annotations.storage import DatasetInUseError, check_local_disk, file_system
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core.faults import FaultError, InputError, RefusedError
from touchdown.backend.episodes import episode_file
from touchdown.backend.episodes.episode_file import read_label


def test_a_recorded_episode_is_in_file_index_and_journal(dataset: Dataset) -> None:
    episode = small_episode()
    context = context_for(dataset)
    entry = dataset.record(episode, Label(1500, -250, 0, 100), source="measured", context=context)
    assert dataset.episodes() == [entry]
    assert (entry.uuid, entry.state, entry.file_state) == (episode.episode_id, "draft", "complete")
    assert entry.quality == episode.quality
    assert (dataset.folder / entry.path).stat().st_size == entry.bytes
    assert np.array_equal(dataset.read(entry.uuid).observation, episode.observation)
    head = dataset.labels.head(entry.uuid)
    assert (head.label, head.source, head.person) == (Label(1500, -250, 0, 100), "measured", "cleo")
    assert head.label.offset_mm.tolist() == [1.5, -0.25]
    (line,) = read_journal(dataset.journal.path(dataset.description.site))
    assert line.verb == "record"
    assert line.hash == dataset.labels.chain_heads()[dataset.description.site]
    message = read_label(dataset.path(entry.uuid))
    assert message is not None
    assert message["grip_id"] == "grip-1"
    assert message["mounting_id"] == "mounting-1"
    assert message["person"] == "cleo"
    assert message["recorded_ns"] == entry.recorded_ns


def test_an_episode_of_a_run_gets_an_id_of_the_dataset(dataset: Dataset) -> None:
    entry = dataset.record(
        small_episode("run-7-probe-2"), Label(), source="commanded", context=context_for(dataset)
    )
    assert entry.state == "unlabelled"
    assert ("recorded_as", "run-7-probe-2") in dataset.read(entry.uuid).metadata


def test_everything_is_there_after_reopening(tmp_path: Path) -> None:
    with Dataset.open(tmp_path) as dataset:
        entry = dataset.record(
            small_episode(), Label(1, 2, 0, 3), source="commanded", context=context_for(dataset)
        )
        site = dataset.description.site
    with Dataset.open(tmp_path, write=False) as again:
        assert again.episodes() == [entry]
        assert again.description.site == site
        with pytest.raises(RefusedError, match="reading only"):
            again.labels.flag("ann", entry.uuid)


@pytest.mark.promise("D11")
def test_a_second_writer_is_refused_by_name(tmp_path: Path) -> None:
    with Dataset.open(tmp_path, person="ann"):
        with pytest.raises(DatasetInUseError, match=rf"ann \(process {os.getpid()} on ") as caught:
            Dataset.open(tmp_path, person="bob")
        assert caught.value.holder is not None
        assert caught.value.holder.person == "ann"
        with Dataset.open(tmp_path, write=False) as reader:
            assert reader.episodes() == []
    with Dataset.open(tmp_path, person="bob"):
        pass


def test_a_copy_of_a_dataset_begins_a_chain_of_its_own(tmp_path: Path) -> None:
    with Dataset.open(tmp_path / "a") as dataset:
        first = dataset.description
    (tmp_path / "a").rename(tmp_path / "b")
    with Dataset.open(tmp_path / "b") as moved:
        assert moved.description.uuid == first.uuid
        assert moved.description.site != first.site


@pytest.mark.parametrize("table", ["op", "label_rev", "event", "review", "opinion"])
def test_append_only_tables_refuse_update_delete_and_replace(
    dataset: Dataset, record: Record, table: str
) -> None:
    entry = record()
    dataset.labels.accept("ann", entry.uuid)
    dataset.labels.approve("bob", entry.uuid)
    dataset.labels.opinion("cleo", entry.uuid, Label(1, 2, 0, 3))
    with dataset.database.transaction() as connection:
        connection.execute("INSERT INTO event VALUES (7, 1, 'ann', 'test', '', '{}')")
    attempts = {
        "update": f"UPDATE {table} SET rowid = rowid",
        "delete": f"DELETE FROM {table}",
        "replace": f"INSERT OR REPLACE INTO {table} SELECT * FROM {table} LIMIT 1",
        "ignore": f"INSERT OR IGNORE INTO {table} SELECT * FROM {table} LIMIT 1",
    }
    before = dataset.database.rows(f"SELECT * FROM {table}")
    assert before
    for sql in attempts.values():
        with (
            pytest.raises(sqlite3.IntegrityError, match="append-only"),
            dataset.database.transaction() as connection,
        ):
            connection.execute(sql)
    assert dataset.database.rows(f"SELECT * FROM {table}") == before


def test_an_operation_cannot_be_replaced_by_another_of_its_number(
    dataset: Dataset, record: Record
) -> None:
    record()
    with (
        pytest.raises(sqlite3.IntegrityError, match="append-only"),
        dataset.database.transaction() as connection,
    ):
        connection.execute(
            "INSERT OR REPLACE INTO op SELECT 'other', site, seq, lamport, at_ns, actor, verb,"
            " target_op, body, prev_hash, hash FROM op"
        )


def test_commits_are_durable_by_the_settings_of_the_file(dataset: Dataset) -> None:
    settings = {name: dataset.database.one(f"PRAGMA {name}")[0] for name in (
        "journal_mode", "synchronous", "foreign_keys", "busy_timeout", "user_version")}  # fmt: skip
    assert settings == {
        "journal_mode": "wal",
        "synchronous": 2,
        "foreign_keys": 1,
        "busy_timeout": 2000,
        "user_version": SCHEMA_VERSION,
    }


def test_a_newer_catalogue_opens_for_reading_with_a_notice(tmp_path: Path) -> None:
    with Dataset.open(tmp_path) as dataset:
        entry = dataset.record(
            small_episode(), Label(1, 2), source="commanded", context=context_for(dataset)
        )
        with dataset.database.transaction() as connection:
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with Dataset.open(tmp_path) as newer:
        assert not newer.writable
        assert any("newer version" in notice for notice in newer.notices)
        assert newer.entry(entry.uuid) == entry


@pytest.mark.parametrize("write", [True, False])
def test_a_catalogue_of_an_unreleased_schema_is_refused(tmp_path: Path, write: bool) -> None:
    with Dataset.open(tmp_path) as dataset, dataset.database.transaction() as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION - 1}")
    with pytest.raises(InputError, match=f"schema {SCHEMA_VERSION - 1}") as caught:
        Dataset.open(tmp_path, write=write)
    assert "rebuild" in caught.value.fix


@pytest.mark.parametrize("content", [b"no database at all" * 100, b""])
def test_a_foreign_catalogue_is_one_input_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "catalog.db").write_bytes(content)
    if not content:
        Database.open(tmp_path / "catalog.db", write=True).close()
        return
    with pytest.raises(InputError, match="cannot be opened"):
        Dataset.open(tmp_path)
    (tmp_path / "catalog.db").unlink()
    other = sqlite3.connect(tmp_path / "catalog.db")
    other.execute("CREATE TABLE mine (a)")
    other.close()
    with pytest.raises(InputError, match="not a catalogue"):
        Dataset.open(tmp_path)
    (tmp_path / "dataset.json").write_text(json.dumps({"uuid": 1}))
    with pytest.raises(InputError, match="description"):
        Dataset.open(tmp_path)


def test_a_damaged_catalogue_is_not_held_open(tmp_path: Path) -> None:
    path = tmp_path / "catalog.db"
    path.write_bytes(b"no database at all" * 100)
    with pytest.raises(InputError, match="cannot be opened") as shown:
        Database.open(path, write=True)
    # As long as the error is shown, it refers to the frames that opened the file.
    assert shown.tb is not None
    assert str(path) not in {file.path for file in psutil.Process().open_files()}


def test_network_file_systems_are_refused(tmp_path: Path) -> None:
    mounts = [("/", "ext4"), (str(tmp_path), "nfs4"), (str(tmp_path / "usb"), "ext4")]
    assert file_system(tmp_path / "x", mounts) == "nfs4"
    with pytest.raises(InputError, match="network file system"):
        check_local_disk(tmp_path / "x", mounts)
    check_local_disk(tmp_path / "usb" / "x", mounts)
    check_local_disk(tmp_path, [])


def test_a_disk_that_refuses_once_is_tried_again_and_twice_is_a_fault(
    dataset: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    context, failures = context_for(dataset), [1]
    original = episode_file.McapWriter.finish

    def failing(writer: episode_file.McapWriter) -> dict[str, int]:
        if failures[0]:
            failures[0] -= 1
            raise OSError(5, "Input/output error")
        return original(writer)

    monkeypatch.setattr(episode_file.McapWriter, "finish", failing)
    kept = dataset.record(small_episode(), Label(1, 2), source="commanded", context=context)
    assert dataset.path(kept.uuid).is_file()
    failures[0] = 2
    lost = small_episode(seed=2)
    with pytest.raises(FaultError, match="EPISODE-WRITE"):
        dataset.record(lost, Label(1, 2), source="commanded", context=context)
    assert [entry.uuid for entry in dataset.episodes()] == [kept.uuid]
    again = dataset.record(lost, Label(1, 2), source="commanded", context=context)
    assert again.uuid == lost.episode_id


def test_filters_pick_what_they_name(dataset: Dataset, record: Record) -> None:
    first, second, third = record(), record(seed=2, accepted=False), record(None)
    dataset.labels.flag("ann", second.uuid)
    dataset.labels.tag("ann", third.uuid, "gold")
    dataset.labels.delete("ann", first.uuid, "test")

    def ids(**wanted: object) -> list[str]:
        return [e.uuid for e in dataset.episodes(EpisodeFilter(**wanted))]  # type: ignore[arg-type]

    assert ids() == [second.uuid, third.uuid] == [entry.uuid for entry in dataset]
    assert ids(deleted=None) == [first.uuid, second.uuid, third.uuid]
    assert ids(deleted=True) == [first.uuid]
    assert ids(accepted=False) == [second.uuid]
    assert ids(flagged=True) == [second.uuid]
    assert ids(states=("unlabelled",)) == [third.uuid]
    assert ids(tag="gold") == [third.uuid]
    assert ids(after=second.uuid) == [third.uuid]
    assert ids(limit=1) == [second.uuid]
    assert ids(piece="barrel") == []
    assert ids(piece="pot", bottom="circle15", campaign="campaign-1") == [second.uuid, third.uuid]


@pytest.mark.parametrize("tail_bytes", [8, 65_536])
def test_a_torn_line_is_cut_off_and_written_again(
    dataset: Dataset, record: Record, monkeypatch: pytest.MonkeyPatch, tail_bytes: int
) -> None:
    monkeypatch.setattr("touchdown.backend.annotations.operation_log.TAIL_BYTES", tail_bytes)
    entry, site = record(), dataset.description.site
    dataset.labels.flag("ann", entry.uuid)
    path = dataset.journal.path(site)
    whole = path.read_bytes()
    for torn in (whole[:-5], whole + b'{"seq": 3', whole.splitlines(keepends=True)[0]):
        path.write_bytes(torn)
        with dataset.database.reading() as connection:
            OperationJournal(path.parent).catch_up(connection, site)
        assert path.read_bytes() == whole
