"""A dataset: opening and its checks, recording, append-only tables, refusals."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path

import numpy as np
import psutil
import pytest

from tests.backend.annotations.conftest import (
    add,
    context_for,
    flip_byte,
    small_episode,
    stored_label,
)
from tests.backend.annotations.test_packs_in_datasets import write_pack
from tests.backend.episodes.test_quality import DISTURBED, Recorded, simulated
from touchdown.backend.annotations import consistency, episode_files, operation_log, review
from touchdown.backend.annotations.backups import restore_backup
from touchdown.backend.annotations.database import SCHEMA_VERSION, Database
from touchdown.backend.annotations.dataset import Dataset, check_dataset_quality
from touchdown.backend.annotations.episode_index import SPLIT_TAG
from touchdown.backend.annotations.operation_log import OperationJournal, read_journal
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import reconcile
from touchdown.backend.annotations.storage import DatasetInUseError, check_local_disk, file_system
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core import Episode, FaultError, InputError, RefusedError
from touchdown.backend.episodes import episode_mcap

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


@pytest.mark.parametrize("crash", [False, True])
def test_only_after_a_crash_everything_is_looked_at(folder, looked, crash):
    if crash:
        die_open(folder)
    assert notices(folder) == ()
    assert looked == {"raw"} | ({"raw/a", "raw/b", "raw/c"} if crash else set())


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


CHANGES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "remove": ("missing", lambda folder: first(folder, "b").unlink()),
    "remove folder": ("missing", lambda folder: shutil.rmtree(folder / "raw" / "b")),
    "rename": ("was moved to", lambda folder: move(folder, "b", "other.mcap")),
    "move": ("was moved to", lambda folder: move(folder, "c", "moved.mcap")),
    "add foreign": ("torn", lambda folder: foreign(folder).write_bytes(b"no episode")),
    "add copy": ("second file", add_copy),
    "shorten": ("torn", replace_by_shorter),
    "replace folder": ("missing", replace_folder),
}


def move(folder: Path, series: str, name: str) -> None:
    first(folder, "b").rename(folder / "raw" / series / name)


def foreign(folder: Path) -> Path:
    return folder / "raw" / "b" / "foreign.mcap"


@pytest.mark.parametrize("crash", [False, True], ids=["closed", "killed"])
@pytest.mark.parametrize("name", CHANGES)
def test_whatever_comes_or_goes_is_found(folder, name, crash):
    said, change = CHANGES[name]
    if crash:
        die_open(folder)
    change(folder)
    found = notices(folder)
    assert found
    assert all(said in line for line in found)
    # Damage is listed until it is resolved, all else once.
    with Dataset.open(folder) as dataset:
        for problems in (dataset.problems, reconcile(dataset.parts, whole=True)):
            assert all(problem.lasting for problem in problems)
            assert bool(problems) == (said != "was moved to")


@pytest.mark.parametrize("way", ["crash", "verify", "a week"])
def test_a_file_cut_in_place_is_found(folder, monkeypatch, way):
    path = first(folder, "b")
    os.truncate(path, path.stat().st_size - 100)
    if way == "crash":
        die_open(folder)
    elif way == "verify":
        with Dataset.open(folder) as dataset:
            assert dataset.notices == ()
            assert [f.kind for f in reconcile(dataset.parts, whole=True)] == ["torn"]
        return
    else:
        monkeypatch.setattr(consistency, "WEEK_NS", 0)
    assert "torn" in notices(folder)[0]


def damage_at_random(folder: Path, rng: np.random.Generator) -> tuple[str, Path]:
    """Damage or remove a recording, a journal or the catalogue; return the target, and the file."""
    raw = sorted((folder / "raw").rglob("*.mcap"))
    journals, catalogue = list((folder / "labels").glob("*.jsonl")), folder / "catalog.db"
    among = (raw, journals, [catalogue])[int(rng.integers(3))]
    path = among[int(rng.integers(len(among)))]
    size, kind = path.stat().st_size, rng.integers(3)
    if kind == 0:
        os.truncate(path, int(rng.integers(size)))
    elif kind == 1:
        data = bytearray(path.read_bytes())
        if path == catalogue:  # a sector; the smallest part that a disk loses
            at = 4096 * int(rng.integers(size // 4096))
            data[at : at + 4096] = rng.bytes(4096)
        else:
            data[int(rng.integers(size))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
    else:
        path.unlink()
    return path.name if path == catalogue else path.stem, path


def ignore(what: str, done: int, total: int) -> None:
    pass


def verified(folder):
    """Return the targets of the problems, or the file that cannot be read."""
    try:
        with Dataset.open(folder) as dataset:
            return {problem.target for problem in dataset.verify(ignore)}
    except InputError as error:
        return {Path(error.where).name}


DAMAGES = 100


def test_each_damage_is_found_by_every_verification(folder):
    rng = np.random.default_rng(11)
    keep = folder.with_name("keep")
    shutil.copytree(folder, keep)
    (site,) = (path.stem for path in (folder / "labels").iterdir())
    for number in range(DAMAGES):
        shutil.rmtree(folder)
        shutil.copytree(keep, folder)
        target, path = damage_at_random(folder, rng)
        removed = not path.exists()
        good = (keep / path.relative_to(folder)).read_bytes()
        # Operations that a new catalogue reads from the journal are listed by the site.
        expected = {site if removed and path.name == "catalog.db" else target}
        for _ in range(3):
            assert verified(folder) == expected, (number, path)
        if path.suffix == ".jsonl":
            assert path.read_bytes() == good
        if path.suffix == ".mcap":
            with Dataset.open(folder, write=False) as reader:
                assert [problem.target for problem in reader.problems] == [target]
                assert len(reader.notices) == 1
                findings = check_dataset_quality(reader, always).findings
                assert [f.episodes for f in findings if f.kind == "unreadable"] == [(target,)]
            path.write_bytes(good)
        elif path.name == "catalog.db" and not removed:
            assert rebuild_dataset(folder, replace=True).replaced
        else:
            with Dataset.open(folder, write=False) as reader:
                assert "verify --resolve" in reader.notices[0]
            with Dataset.open(folder) as dataset:
                assert [problem.target for problem in dataset.resolve("ann")] == [*expected]
        with Dataset.open(folder) as dataset:
            assert dataset.verify(ignore) == []
        with Dataset.open(folder) as dataset:
            assert dataset.notices == ()
            assert {entry.file_state for entry in dataset} == {"complete"}
            assert [dataset.labels.head(e.uuid).label.x_um for e in dataset] == [*range(9)]


def test_damaged_geometry_is_found_until_it_is_back(folder):
    for path in sorted((folder / "geometry").iterdir()):
        good = path.read_bytes()
        for bad in (b"[" * 100_000, b""):
            path.write_bytes(bad)
            for _ in range(3):
                assert verified(folder) == {f"geometry/{path.name}"}
        path.write_bytes(good)
    assert verified(folder) == set()


def test_a_changed_word_of_a_row_is_found_until_it_is_mended(folder):
    for table, column in (("episode", "person"), ("label_rev", "note"), ("label_head", "actor")):
        with sqlite3.connect(folder / "catalog.db") as connection:
            connection.execute(f"DROP TRIGGER IF EXISTS {table}_no_update")
            connection.execute(f"UPDATE {table} SET {column} = 'cleo?'")
        for _ in range(3):
            assert verified(folder) == {"catalog.db"}, table
        assert rebuild_dataset(folder, replace=True).replaced
        with Dataset.open(folder) as dataset:
            dataset.resolve("ann")  # heads were written again
        assert verified(folder) == set(), table


def test_a_loss_is_resolved_by_deleting_the_episode(folder):
    first(folder, "b").unlink()
    with Dataset.open(folder) as dataset:
        (problem,) = dataset.problems
        dataset.labels.delete("ann", problem.target, "lost")
        assert dataset.verify(ignore) == []


def test_a_journal_that_is_ahead_and_damaged_is_left_and_listed(folder):
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


def test_a_label_without_a_recording_is_listed_after_a_rebuild(folder):
    lost = first(folder, "b")
    (folder / "catalog.db").unlink()
    lost.write_bytes(lost.read_bytes()[:-100])
    for _ in range(3):
        with Dataset.open(folder) as dataset:
            found = [problem.target for problem in dataset.verify(ignore)]
        assert lost.stem in found


def test_a_folder_that_changed_a_moment_ago_is_looked_at_again(folder, looked, monkeypatch):
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


def test_a_file_put_there_while_the_dataset_is_open_is_found(folder):
    with Dataset.open(folder):
        add_copy(folder)
    assert "second file" in notices(folder)[0]


def test_rows_that_no_folder_accounts_for_are_found(folder):
    with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
        connection.execute(
            "INSERT INTO episode SELECT 'lost', series, campaign, plan_item, kind,"
            " 'raw/a/lost.mcap', chunk_off, chunk_len, crc, sha256, bytes, recorded_ns, piece,"
            " bottom, geometry, grip_id, mounting_id, person, mode, quality, accepted,"
            " keep_frames, state, adopted FROM episode LIMIT 1"
        )
    assert "missing" in notices(folder)[0]


def test_a_restored_catalogue_knows_no_folder(folder, looked):
    with Dataset.open(folder) as dataset:
        backup = dataset.backups.make("test")
    restore_backup(folder, backup)
    looked.clear()
    assert notices(folder) == ()
    assert looked == {"raw", "raw/a", "raw/b", "raw/c"}


def always(_done: int, _count: int) -> bool:
    return True


@pytest.fixture(scope="module")
def rows() -> list[Recorded]:
    return simulated(30)


@pytest.fixture
def filled(dataset: Dataset, rows: list[Recorded]) -> dict[str, str]:
    """Record the probes, each fault once; return the episode of each kind."""
    context, wrong, first = context_for(dataset, "pot", "circle25"), {}, ""
    for row, kind in zip_longest(rows, DISTURBED, fillvalue=""):
        seen = DISTURBED[kind](row) if kind else row
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


def test_each_fault_of_what_is_not_deleted_is_listed(dataset, filled):
    health = check_dataset_quality(dataset, always)
    found = {(finding.kind, finding.episodes) for finding in health.findings}
    assert found >= {(kind, (uuid,)) for kind, uuid in filled.items()}
    assert {episodes for _, episodes in found} == {(uuid,) for uuid in filled.values()}
    assert (health.examined, health.count) == (30, 30)
    early = check_dataset_quality(dataset, lambda done, _: done < 3)
    assert (early.examined, early.count) == (3, 30)
    uuid = next(e.uuid for e in dataset.episodes() if e.uuid not in filled.values())
    flip_byte(dataset.path(uuid), 1 / 3)
    found = check_dataset_quality(dataset, always).findings
    assert [finding.episodes for finding in found if finding.kind == "unreadable"] == [(uuid,)]
    dataset.labels.delete("ann", filled["jerk"], "knocked")
    health = check_dataset_quality(dataset, always)
    assert health.count == 29
    assert "jerk" not in {finding.kind for finding in health.findings}


def test_a_pair_of_a_series_on_both_sides_is_a_finding(dataset, filled):
    last = [entry for entry in dataset.episodes() if entry.mounting_id == f"m-{len(DISTURBED)}"]
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


def test_every_episode_of_a_pack_is_read(tmp_path):
    Dataset.open(tmp_path / "data").close()
    write_pack(tmp_path / "data" / "packs" / "a.mcap", count=5)
    with Dataset.open(tmp_path / "data") as dataset:
        health = check_dataset_quality(dataset, always)
        jerks = {f.episodes: f.text for f in health.findings if f.kind == "jerk"}
        assert len(jerks) == 5  # random numbers: each jumps, by a length of its own
        assert len(set(jerks.values())) > 1


def test_a_recorded_episode_is_in_file_index_and_journal(dataset):
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
    message = stored_label(dataset.path(entry.uuid))
    assert message["grip_id"] == "grip-1"
    assert message["mounting_id"] == "mounting-1"
    assert message["person"] == "cleo"
    assert message["recorded_ns"] == entry.recorded_ns

    # An episode of a run gets an id of the dataset.
    entry = add(dataset, Label(), name="run-7-probe-2")
    assert entry.state == "unlabelled"
    assert ("recorded_as", "run-7-probe-2") in dataset.read(entry.uuid).metadata


def test_everything_is_there_after_reopening(tmp_path):
    with Dataset.open(tmp_path) as dataset:
        entry = add(dataset, Label(1, 2, 0, 3))
        site = dataset.description.site
    with Dataset.open(tmp_path, write=False) as again:
        assert again.episodes() == [entry]
        assert again.description.site == site
        with pytest.raises(RefusedError, match="reading only"):
            again.labels.flag("ann", entry.uuid)


@pytest.mark.promise("D11")
def test_a_second_writer_is_refused_by_name(tmp_path):
    with Dataset.open(tmp_path, person="ann"):
        with pytest.raises(DatasetInUseError, match=rf"ann \(process {os.getpid()} on ") as caught:
            Dataset.open(tmp_path, person="bob")
        assert caught.value.holder.person == "ann"
        with Dataset.open(tmp_path, write=False) as reader:
            assert reader.episodes() == []
    with Dataset.open(tmp_path, person="bob"):
        pass


def test_a_copy_of_a_dataset_begins_a_chain_of_its_own(tmp_path):
    with Dataset.open(tmp_path / "a") as dataset:
        first = dataset.description
    (tmp_path / "a").rename(tmp_path / "b")
    with Dataset.open(tmp_path / "b") as moved:
        assert moved.description.uuid == first.uuid
        assert moved.description.site != first.site


OTHER_OP = """INSERT OR REPLACE INTO op SELECT 'other', site, seq, lamport, at_ns, actor, verb,
    target_op, body, prev_hash, hash FROM op"""


@pytest.mark.parametrize("table", ["op", "label_rev", "event", "opinion"])
def test_append_only_tables_refuse_update_delete_and_replace(dataset, record, table):
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
        "another of its number": OTHER_OP,
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


def test_commits_are_durable_by_the_settings_of_the_file(dataset):
    wanted = {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 2000,
              "user_version": SCHEMA_VERSION}  # fmt: skip
    assert {name: dataset.database.one(f"PRAGMA {name}")[0] for name in wanted} == wanted


def test_a_newer_catalogue_opens_for_reading_with_a_notice(tmp_path):
    with Dataset.open(tmp_path) as dataset:
        entry = add(dataset, Label(1, 2))
        with dataset.database.transaction() as connection:
            connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION + 1}")
    with Dataset.open(tmp_path) as newer:
        assert not newer.writable
        assert any("newer version" in notice for notice in newer.notices)
        assert newer.entry(entry.uuid) == entry


@pytest.mark.parametrize("write", [True, False])
def test_a_catalogue_of_an_unreleased_schema_is_refused(tmp_path, write):
    with Dataset.open(tmp_path) as dataset, dataset.database.transaction() as connection:
        connection.execute(f"PRAGMA user_version = {SCHEMA_VERSION - 1}")
    with pytest.raises(InputError, match=f"schema {SCHEMA_VERSION - 1}") as caught:
        Dataset.open(tmp_path, write=write)
    assert "rebuild" in caught.value.fix


def test_a_foreign_catalogue_is_one_input_error_and_not_held_open(tmp_path):
    path = tmp_path / "catalog.db"
    path.touch()
    Database.open(path, write=True).close()
    path.write_bytes(b"no database at all" * 100)
    with pytest.raises(InputError, match="cannot be opened") as shown:
        Dataset.open(tmp_path)
    # As long as the error is shown, it refers to the frames that opened the file.
    assert shown.tb is not None
    assert str(path) not in {file.path for file in psutil.Process().open_files()}
    path.unlink()
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE mine (a)")
    other.close()
    with pytest.raises(InputError, match="not a catalogue"):
        Dataset.open(tmp_path)
    (tmp_path / "dataset.json").write_text(json.dumps({"uuid": 1}))
    with pytest.raises(InputError, match="description"):
        Dataset.open(tmp_path)


def test_network_file_systems_are_refused(tmp_path):
    mounts = [("/", "ext4"), (str(tmp_path), "nfs4"), (str(tmp_path / "usb"), "ext4")]
    assert file_system(tmp_path / "x", mounts) == "nfs4"
    with pytest.raises(InputError, match="network file system"):
        check_local_disk(tmp_path / "x", mounts)
    check_local_disk(tmp_path / "usb" / "x", mounts)
    check_local_disk(tmp_path, [])


def test_a_disk_that_refuses_once_is_tried_again_and_twice_is_a_fault(dataset, monkeypatch):
    context, failures = context_for(dataset), [1]
    original = episode_mcap.McapWriter.finish

    def failing(writer: episode_mcap.McapWriter) -> dict[str, int]:
        if failures[0]:
            failures[0] -= 1
            raise OSError(5, "Input/output error")
        return original(writer)

    monkeypatch.setattr(episode_mcap.McapWriter, "finish", failing)
    kept = add(dataset, Label(1, 2))
    assert dataset.path(kept.uuid).is_file()
    failures[0] = 2
    lost = small_episode(seed=2)
    with pytest.raises(FaultError, match="EPISODE-WRITE"):
        dataset.record(lost, Label(1, 2), source="commanded", context=context)
    assert [entry.uuid for entry in dataset.episodes()] == [kept.uuid]
    again = dataset.record(lost, Label(1, 2), source="commanded", context=context)
    assert again.uuid == lost.episode_id


def test_filters_pick_what_they_name(dataset, record):
    first, second, third = record(), record(seed=2, accepted=False), record(None)
    dataset.labels.flag("ann", second.uuid)
    dataset.labels.tag("ann", third.uuid, "gold")
    dataset.labels.delete("ann", first.uuid, "test")

    def ids(**wanted: object) -> list[str]:
        return [e.uuid for e in dataset.episodes(EpisodeFilter(**wanted))]

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
def test_a_torn_line_is_cut_off_and_written_again(dataset, record, monkeypatch, tail_bytes):
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
