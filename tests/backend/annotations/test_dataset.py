"""Opening skips unchanged folders and still finds every change."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.annotations.conftest import (
    Record,
    add,
    authors,
    context_for,
    flip_byte,
    small_episode,
)
from tests.backend.annotations.test_packs_in_datasets import write_pack
from tests.backend.annotations.test_values import ACTIONS, FAST, PEOPLE, Step, act, contents
from tests.backend.episodes.test_quality import (
    jumped_marker,
    knocked,
    late_gel,
    never_touched,
    simulated,
    worse,
)
from touchdown.backend.annotations import consistency, episode_files, operation_log, review
from touchdown.backend.annotations.backups import restore_backup
from touchdown.backend.annotations.database import SCHEMA_VERSION, Database
from touchdown.backend.annotations.dataset import Dataset, check_dataset_quality
from touchdown.backend.annotations.episode_index import SPLIT_TAG
from touchdown.backend.annotations.operation_log import OperationJournal, read_journal
from touchdown.backend.annotations.reconciliation import reconcile
from touchdown.backend.annotations.storage import DatasetInUseError, check_local_disk, file_system
from touchdown.backend.annotations.training_set import labelled_episodes
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core.faults import FaultError, InputError, RefusedError
from touchdown.backend.core.values import Episode
from touchdown.backend.episodes import episode_file
from touchdown.backend.episodes.episode_file import read_label
from touchdown.backend.episodes.quality import ExaminedEpisode

SERIES = ("a", "b", "c")
EACH = 3


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A closed dataset of three series that were in order at the last opening."""
    # Nothing here changes within one tick of the clock, so that nobody has to wait.
    monkeypatch.setattr(consistency, "SETTLED_NS", 0)
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        for number in range(EACH * len(SERIES)):
            context = replace(context_for(dataset), series=SERIES[number // EACH])
            label = Label(number, 0, 0, 1)
            add(dataset, label, seed=number, context=context)
    Dataset.open(folder).close()
    return folder


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Folders whose files were read since."""
    seen: set[str] = set()
    original = episode_files._files

    def files(place: Path, name: str) -> object:
        seen.add(name)
        return original(place, name)

    monkeypatch.setattr(episode_files, "_files", files)
    return seen


def first(folder: Path, series: str) -> Path:
    return min((folder / "raw" / series).glob("*.mcap"))


def die_open(folder: Path) -> None:
    """Open for writing in a child and kill it."""
    pid = os.fork()
    if not pid:
        try:
            Dataset.open(folder)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)


def notices(folder: Path) -> tuple[str, ...]:
    with Dataset.open(folder) as dataset:
        return dataset.notices


def test_what_looks_as_it_did_is_not_looked_at(folder: Path, looked: set[str]) -> None:
    assert notices(folder) == ()
    assert looked == {"raw"}


def test_after_a_crash_everything_is_looked_at(folder: Path, looked: set[str]) -> None:
    die_open(folder)
    assert notices(folder) == ()
    assert looked == {"raw", "raw/a", "raw/b", "raw/c"}


def remove(folder: Path) -> None:
    first(folder, "b").unlink()


def remove_folder(folder: Path) -> None:
    shutil.rmtree(folder / "raw" / "b")


def rename(folder: Path) -> None:
    first(folder, "b").rename(folder / "raw" / "b" / "other.mcap")


def move(folder: Path) -> None:
    path = first(folder, "b")
    path.rename(folder / "raw" / "c" / path.name)


def add_foreign(folder: Path) -> None:
    (folder / "raw" / "b" / "foreign.mcap").write_bytes(b"no episode")


def add_copy(folder: Path) -> None:
    shutil.copyfile(first(folder, "b"), folder / "raw" / "a" / "again.mcap")


def replace_by_shorter(folder: Path) -> None:
    path = first(folder, "b")
    content = path.read_bytes()[:-100]
    path.unlink()
    path.write_bytes(content)


def replace_folder(folder: Path) -> None:
    """Put a copy in its place that has the same times, but a file less."""
    place, copy = folder / "raw" / "b", folder / "copy"
    times = place.stat()
    shutil.copytree(place, copy)
    shutil.rmtree(place)
    min(copy.iterdir()).unlink()
    copy.rename(place)
    os.utime(place, ns=(times.st_atime_ns, times.st_mtime_ns))


@pytest.mark.parametrize("crash", [False, True], ids=["closed", "killed"])
@pytest.mark.parametrize(
    ("change", "said"),
    [(remove, "missing"), (remove_folder, "missing"), (rename, "was moved to"),
     (move, "was moved to"), (add_foreign, "torn"), (add_copy, "second file"),
     (replace_by_shorter, "torn"), (replace_folder, "missing")],
    ids=lambda value: getattr(value, "__name__", ""),
)  # fmt: skip
def test_whatever_comes_or_goes_is_found(
    folder: Path, change: Callable[[Path], None], said: str, crash: bool
) -> None:
    if crash:
        die_open(folder)
    change(folder)
    found = notices(folder)
    assert found
    assert all(said in line for line in found)
    # Losses are listed until they are resolved, all else once.
    with Dataset.open(folder) as dataset:
        for problems in (dataset.problems, reconcile(dataset.parts, whole=True)):
            assert all(problem.lasting for problem in problems)
            assert bool(problems) == (said in ("missing", "torn") and change is not add_foreign)


def test_an_episode_that_comes_back_is_found(folder: Path) -> None:
    path = first(folder, "b")
    path.rename(folder / "kept")
    assert len(notices(folder)) == 1
    assert "is missing" in notices(folder)[0]
    (folder / "kept").rename(path)
    assert "is back" in notices(folder)[0]


def cut(folder: Path) -> None:
    path = first(folder, "b")
    os.truncate(path, path.stat().st_size - 100)


def test_a_file_cut_in_place_is_found_after_a_crash(folder: Path) -> None:
    cut(folder)
    die_open(folder)
    assert "torn" in notices(folder)[0]


def test_a_file_cut_in_place_is_found_by_verify_after_a_clean_close(folder: Path) -> None:
    cut(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert [f.kind for f in reconcile(dataset.parts, whole=True)] == ["torn"]


def test_a_file_cut_in_place_is_found_within_a_week(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(folder)
    monkeypatch.setattr(consistency, "WEEK_NS", 0)
    assert "torn" in notices(folder)[0]


def damage_at_random(folder: Path, rng: np.random.Generator) -> tuple[str, Path]:
    """Cut, change or remove one recording or journal; return the target to be named, and it."""
    files = [*sorted((folder / "raw").rglob("*.mcap")), *(folder / "labels").glob("*.jsonl")]
    path = files[int(rng.integers(len(files)))]
    size, kind = path.stat().st_size, rng.integers(3)
    if kind == 0:
        os.truncate(path, int(rng.integers(size)))
    elif kind == 1:
        data = bytearray(path.read_bytes())
        data[int(rng.integers(size))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
    else:
        path.unlink()
    return path.stem, path


def ignore(what: str, done: int, total: int) -> None:
    pass


def test_each_of_200_damages_is_found_by_every_verification(folder: Path) -> None:
    rng = np.random.default_rng(11)
    keep = folder.with_name("keep")
    shutil.copytree(folder, keep)
    for number in range(200):
        shutil.rmtree(folder)
        shutil.copytree(keep, folder)
        target, path = damage_at_random(folder, rng)
        good = (keep / path.relative_to(folder)).read_bytes()
        for repetition in range(3):
            with Dataset.open(folder) as dataset:
                found = [problem.target for problem in dataset.verify(ignore)]
            # A journal is whole again after the first verification, with all its operations.
            resolved = path.suffix == ".jsonl" and repetition
            assert found == ([] if resolved else [target]), (number, repetition, path)
            if path.suffix == ".jsonl":
                assert path.read_bytes() == good
        if path.suffix == ".mcap":
            with Dataset.open(folder, write=False) as reader:
                assert [problem.target for problem in reader.problems] == [target]
                assert len(reader.notices) == 1
                findings = check_dataset_quality(reader, always).findings
                assert [f.episodes for f in findings if f.kind == "unreadable"] == [(target,)]
            path.write_bytes(good)
            with Dataset.open(folder) as dataset:
                assert dataset.verify(ignore) == []
                assert {entry.file_state for entry in dataset} == {"complete"}


def test_a_loss_is_resolved_by_deleting_the_episode(folder: Path) -> None:
    first(folder, "b").unlink()
    with Dataset.open(folder) as dataset:
        (problem,) = dataset.problems
        dataset.labels.delete("ann", problem.target, "lost")
        assert dataset.verify(ignore) == []


def test_a_journal_that_is_ahead_and_damaged_is_left_and_listed(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        backup = shutil.copy(dataset.backups.make("test"), folder.with_name("backup.db"))
        dataset.labels.flag("ann", dataset.episodes()[0].uuid)
    restore_backup(folder, backup)
    journal = next((folder / "labels").glob("*.jsonl"))
    damaged = journal.read_bytes().replace(b'"verb":"record"', b'"verb":"rec', 1)
    journal.write_bytes(damaged)
    for _ in range(3):
        with Dataset.open(folder) as dataset:
            (problem,) = dataset.verify(ignore)
            assert (problem.kind, problem.target) == ("journal-damaged", journal.stem)
            assert "take this file from a copy" in dataset.notices[0]
        assert journal.read_bytes() == damaged


def test_a_label_without_a_recording_is_listed_after_a_rebuild(folder: Path) -> None:
    lost = first(folder, "b")
    (folder / "catalog.db").unlink()
    lost.write_bytes(lost.read_bytes()[:-100])
    for repetition in range(3):
        with Dataset.open(folder) as dataset:
            found = [problem.target for problem in dataset.verify(ignore)]
        assert found == [lost.stem] if repetition else lost.stem in found


def test_a_folder_that_changed_a_moment_ago_is_looked_at_again(
    folder: Path, looked: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Dataset.open(folder) as dataset:
        context = replace(context_for(dataset), series="b")
        add(dataset, Label(1, 1, 0, 1), seed=99, context=context)
    monkeypatch.setattr(consistency, "SETTLED_NS", 3600 * 10**9)
    for _ in range(2):
        looked.clear()
        assert notices(folder) == ()
        assert looked == {"raw", "raw/b"}
    monkeypatch.setattr(consistency, "SETTLED_NS", 0)
    notices(folder)
    looked.clear()
    notices(folder)
    assert looked == {"raw"}


def test_a_file_put_there_while_the_dataset_is_open_is_found(folder: Path) -> None:
    with Dataset.open(folder):
        add_copy(folder)
    assert "second file" in notices(folder)[0]


def test_rows_that_no_folder_accounts_for_are_found(folder: Path) -> None:
    with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
        connection.execute(
            "INSERT INTO episode SELECT 'lost', series, campaign, plan_item, kind,"
            " 'raw/a/lost.mcap', chunk_off, chunk_len, crc, sha256, bytes, recorded_ns, piece,"
            " bottom, geometry, grip_id, mounting_id, person, mode, quality, accepted,"
            " keep_frames, state, adopted FROM episode LIMIT 1"
        )
    assert "missing" in notices(folder)[0]


def test_a_restored_catalogue_knows_no_folder(folder: Path, looked: set[str]) -> None:
    with Dataset.open(folder) as dataset:
        backup = dataset.backups.make("test")
    restore_backup(folder, backup)
    looked.clear()
    assert notices(folder) == ()
    assert looked == {"raw", "raw/a", "raw/b", "raw/c"}


FAULTS: dict[str, Callable[[ExaminedEpisode], ExaminedEpisode]] = {
    "jerk": knocked,
    "no contact": never_touched,
    "saturated markers": jumped_marker,
    "clock skew": late_gel,
    "lost markers": lambda row: worse(row, lost_markers=4),
    "dropped frames": lambda row: worse(row, dropped_frames=5),
    "slip": lambda row: worse(row, slip_mm=0.4),
}


def always(_done: int, _count: int) -> bool:
    return True


@pytest.fixture(scope="module")
def rows() -> list[ExaminedEpisode]:
    return simulated(30)


@pytest.fixture
def filled(dataset: Dataset, rows: list[ExaminedEpisode]) -> dict[str, str]:
    """Record the probes, each fault once; return the episode of each kind."""
    context, wrong, first = context_for(dataset, "pot", "circle25"), {}, ""
    for row, kind in zip(rows, [*FAULTS, *[""] * (len(rows) - len(FAULTS))], strict=True):
        seen = FAULTS[kind](row) if kind else row
        x_um, y_um = np.rint(1e3 * seen.offset_mm).astype(int).tolist()
        episode = Episode(row.uuid, "pot", seen.observation, seen.offset_mm, 0.5, seen.quality)
        entry = dataset.record(
            episode, Label(x_um, y_um, 0, 300), source="commanded",
            context=replace(context, mounting_id=f"m-{len(wrong)}"),
        )  # fmt: skip
        if kind:
            wrong[kind] = entry.uuid
        first = first or entry.uuid
    return wrong


def test_each_fault_is_listed(dataset: Dataset, filled: dict[str, str]) -> None:
    health = check_dataset_quality(dataset, always)
    found = {(finding.kind, finding.episodes) for finding in health.findings}
    assert found >= {(kind, (uuid,)) for kind, uuid in filled.items()}
    assert {episodes for _, episodes in found} == {(uuid,) for uuid in filled.values()}
    assert (health.examined, health.count) == (30, 30)
    early = check_dataset_quality(dataset, lambda done, _: done < 3)
    assert (early.examined, early.count) == (3, 30)


def test_a_damaged_file_is_a_finding(dataset: Dataset, filled: dict[str, str]) -> None:
    uuid = next(e.uuid for e in dataset.episodes() if e.uuid not in filled.values())
    flip_byte(dataset.path(uuid), 1 / 3)
    found = check_dataset_quality(dataset, always).findings
    assert [finding.episodes for finding in found if finding.kind == "unreadable"] == [(uuid,)]


def test_deleted_episodes_are_not_looked_at(dataset: Dataset, filled: dict[str, str]) -> None:
    dataset.labels.delete("ann", filled["jerk"], "knocked")
    health = check_dataset_quality(dataset, always)
    assert health.count == 29
    assert "jerk" not in {finding.kind for finding in health.findings}


def test_a_pair_of_a_series_on_both_sides_is_a_finding(
    dataset: Dataset, filled: dict[str, str]
) -> None:
    last = [entry for entry in dataset.episodes() if entry.mounting_id == f"m-{len(FAULTS)}"]
    with dataset.labels.commit() as connection:
        mark = operation_log.read_mark(
            connection, last[0].uuid, f"{SPLIT_TAG}held_out", present=True
        )
        draft, site = operation_log.OperationDraft(marks=[mark]), dataset.description.site
        _, touched = operation_log.append_operation(connection, site, "ann", "tag", draft)
        review.refresh_heads(connection, touched)
    found = [
        f for f in check_dataset_quality(dataset, always).findings if f.kind == "divided series"
    ]
    assert [set(finding.episodes) for finding in found] == [{entry.uuid for entry in last}]


def test_every_episode_of_a_pack_is_read(tmp_path: Path) -> None:
    Dataset.open(tmp_path / "data").close()
    write_pack(tmp_path / "data" / "packs" / "a.mcap", count=5)
    with Dataset.open(tmp_path / "data") as dataset:
        health = check_dataset_quality(dataset, always)
        jerks = {f.episodes: f.text for f in health.findings if f.kind == "jerk"}
        assert len(jerks) == 5  # random numbers: each jumps, by a length of its own
        assert len(set(jerks.values())) > 1


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
    entry = add(dataset, Label(), name="run-7-probe-2")
    assert entry.state == "unlabelled"
    assert ("recorded_as", "run-7-probe-2") in dataset.read(entry.uuid).metadata


def test_everything_is_there_after_reopening(tmp_path: Path) -> None:
    with Dataset.open(tmp_path) as dataset:
        entry = add(dataset, Label(1, 2, 0, 3))
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
        entry = add(dataset, Label(1, 2))
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
    kept = add(dataset, Label(1, 2))
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


TABLES = ("op", "label_rev", "label_head", "closed", "mark", "review", "episode")
MORE = (*(a for a in ACTIONS if a != "reopen"), "undo", "redo", "resolve")
steps = st.lists(
    st.tuples(
        st.sampled_from(MORE), st.sampled_from(PEOPLE), st.integers(0, 1), st.integers(-3, 3)
    ),
    max_size=8,
)


def tables(dataset: Dataset) -> dict[str, list[tuple[object, ...]]]:
    return {t: sorted(dataset.database.rows(f"SELECT * FROM {t}"), key=str) for t in TABLES}


def play(dataset: Dataset, todo: list[Step], uuids: list[str]) -> None:
    labels = dataset.labels
    for step in todo:
        action, person, index, number = step
        try:
            if action == "undo":
                labels.undo(person)
            elif action == "redo":
                labels.redo(person)
            elif action == "resolve":
                leaves = labels.conflicting(uuids[index])
                labels.resolve(person, uuids[index], leaves[number % len(leaves)].rev_uuid)
            else:
                act(dataset, step, [uuids[index], uuids[1 - index]])
        except RefusedError:
            continue


def begin(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        return [add(dataset, Label(k, -k, 0, 9)).uuid for k in range(2)]


def merged(folder: Path, name: str, first: str, *others: str) -> Dataset:
    """Return a fresh copy of ``first`` into which the others were merged in turn."""
    shutil.copytree(folder / first, folder / name)
    dataset = Dataset.open(folder / name)
    for other in others:
        dataset.merge("zoe", folder / other)
    return dataset


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(a=steps, b=steps, c=steps, between=steps)
def test_union_is_commutative_associative_and_idempotent(
    a: list[Step], b: list[Step], c: list[Step], between: list[Step]
) -> None:
    with tempfile.TemporaryDirectory(dir=FAST) as name:
        folder = Path(name)
        uuids = begin(folder / "base")
        for site, todo in (("a", a), ("b", b), ("c", c)):
            shutil.copytree(folder / "base", folder / site)
            with Dataset.open(folder / site) as dataset:
                play(dataset, todo, uuids)
        # B goes on after it has seen A: its operations refer to those of A.
        with Dataset.open(folder / "b") as dataset:
            dataset.merge("zoe", folder / "a")
            play(dataset, between, uuids)
        with (
            merged(folder, "ab", "a", "b") as ab,
            merged(folder, "ba", "b", "a") as ba,
            merged(folder, "abc", "a", "b", "c") as abc,
            merged(folder, "cba", "c", "b", "a") as cba,
        ):
            assert tables(ab) == tables(ba)
            assert tables(abc) == tables(cba)
            before = tables(abc)
            assert abc.merge("zoe", folder / "b").operations == 0
            assert abc.merge("zoe", folder / "c").operations == 0
            assert tables(abc) == before
        with merged(folder, "bc", "b", "c") as bc:
            bc.merge("zoe", folder / "a")
            assert tables(bc) == before
            with bc.database.transaction() as connection:
                review.rebuild_heads(connection)
            assert tables(bc) == before
        with Dataset.open(folder / "abc") as again:
            assert tables(again) == before


@pytest.fixture
def copies(tmp_path: Path) -> Iterator[tuple[Dataset, Dataset, list[str]]]:
    uuids = begin(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    with Dataset.open(tmp_path / "a") as ours, Dataset.open(tmp_path / "b") as theirs:
        yield ours, theirs, uuids


Copies = tuple[Dataset, Dataset, list[str]]


def test_two_labels_are_a_conflict_until_a_person_resolves_it(copies: Copies) -> None:
    ours, theirs, (uuid, other) = copies
    mine = ours.labels.accept("ann", uuid, Label(100, 0, 0, 50))
    yours = theirs.labels.accept("bob", uuid, Label(900, 0, 0, 50))
    theirs.labels.accept("bob", other, Label(5, 5, 0, 50))
    done = ours.merge("ann", theirs.folder)
    assert (done.operations, done.episodes, done.conflicts) == (2, 0, (uuid,))
    assert ours.queue("conflicts", "ann") == [uuid]
    assert ours.entry(uuid).conflict
    assert ours.labels.head(other).label == Label(5, 5, 0, 50)
    assert {leaf.rev_uuid for leaf in ours.labels.conflicting(uuid)} == {
        mine.rev_uuid,
        yours.rev_uuid,
    }
    with pytest.raises(RefusedError, match="resolve"):
        ours.labels.approve("cleo", uuid)
    with pytest.raises(RefusedError, match="bob changed this label since"):
        ours.labels.undo("ann")
    conflict = contents(ours)
    resolved = ours.labels.resolve("cleo", uuid, mine.rev_uuid)
    assert (resolved.label, resolved.state) == (mine.label, "submitted")
    assert authors(ours, uuid) == ("ann",)
    assert ours.queue("conflicts", "ann") == []
    chosen = contents(ours)
    for _ in range(3):
        ours.labels.undo("cleo")
        assert contents(ours) == conflict
        ours.labels.redo("cleo")
        assert contents(ours) == chosen
    theirs.merge("bob", ours.folder)
    assert contents(theirs) == chosen
    ours.labels.approve("cleo", uuid)


def test_two_reviews_of_one_label_are_a_conflict_that_its_author_cannot_settle(
    copies: Copies,
) -> None:
    ours, theirs, (uuid, _) = copies
    ours.labels.accept("ann", uuid, Label(100, 0, 0, 50))
    theirs.merge("bob", ours.folder)
    approved = ours.labels.approve("bob", uuid)
    theirs.labels.reject("cleo", uuid, "tilt")
    assert ours.merge("bob", theirs.folder).conflicts == (uuid,)
    assert {leaf.state for leaf in ours.labels.conflicting(uuid)} == {"approved", "rejected"}
    assert uuid not in [one.row.episode for one in labelled_episodes(ours.database, "drafts")]
    with pytest.raises(RefusedError, match="ann wrote it"):
        ours.labels.resolve("ann", uuid, approved.rev_uuid)
    assert ours.labels.resolve("dora", uuid, approved.rev_uuid).state == "approved"
    assert [one.row.episode for one in labelled_episodes(ours.database, "approved")] == [uuid]
    ours.labels.undo("dora")
    leaves = {leaf.state: leaf.rev_uuid for leaf in ours.labels.conflicting(uuid)}
    with pytest.raises(RefusedError, match="ann wrote it"):
        ours.labels.resolve("ann", uuid, leaves["approved"])
    assert ours.labels.resolve("ann", uuid, leaves["rejected"]).state == "rejected"


def test_a_merge_that_the_disk_refuses_says_so_and_goes_on_later(
    copies: Copies, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs, (uuid, _) = copies
    theirs.labels.accept("bob", uuid, Label(900, 0, 0, 50))
    new = add(theirs, Label(1, 2), seed=9, source="measured").uuid
    before = tables(ours)

    def refuse(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr("touchdown.backend.annotations.reconciliation.write_atomically", refuse)
        with pytest.raises(FaultError, match="No space left on device") as caught:
            ours.merge("ann", theirs.folder)
    assert caught.value.fault.code == "MERGE-WRITE"
    assert tables(ours) == before
    assert ours.merge("ann", theirs.folder).operations == 2
    assert ours.read(new).episode_id == new


def test_episodes_come_with_their_files(copies: Copies) -> None:
    ours, theirs, _ = copies
    entry = add(
        theirs,
        Label(1, 2),
        seed=9,
        source="measured",
        context=context_for(theirs, "barrel", "hex20"),
    )
    done = ours.merge("ann", theirs.folder)
    assert (done.episodes, done.operations) == (1, 1)
    assert ours.entry(entry.uuid) == entry
    assert ours.read(entry.uuid).episode_id == entry.uuid
    assert ours.patch(entry.uuid).touching.any()
    journal = list(read_journal(ours.journal.path(theirs.description.site)))
    assert [operation.verb for operation in journal] == ["record"]
    assert ours.database.one("SELECT actor, verb FROM event WHERE verb = 'merge'") == (
        "ann",
        "merge",
    )


def test_a_broken_or_foreign_log_changes_nothing(copies: Copies, tmp_path: Path) -> None:
    ours, theirs, (uuid, _) = copies
    theirs.labels.flag("bob", uuid)
    theirs.labels.flag("bob", uuid, False)
    with theirs.database.transaction() as connection:
        connection.execute("DROP TRIGGER op_no_update")
        connection.execute("UPDATE op SET actor = 'eve' WHERE actor = 'bob' AND seq = 1")
    before = tables(ours)
    with pytest.raises(InputError, match="broken at operation 1 of site"):
        ours.merge("ann", theirs.folder)
    begin(tmp_path / "other")
    with pytest.raises(InputError, match="another dataset"):
        ours.merge("ann", tmp_path / "other")
    with pytest.raises(InputError, match="no dataset"):
        ours.merge("ann", tmp_path / "nowhere")
    assert tables(ours) == before


def test_one_chain_continued_in_two_ways_is_refused(copies: Copies) -> None:
    ours, theirs, (uuid, _) = copies
    # A copy that was made to look as if it lay at the same place.
    theirs.labels.site = ours.description.site
    ours.labels.flag("ann", uuid)
    theirs.labels.tag("bob", uuid, "gold")
    with pytest.raises(InputError, match="differently"):
        ours.merge("ann", theirs.folder)
