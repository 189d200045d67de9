"""Backups of the catalogue: complete, verified, pruned, and restorable."""

import json
import shutil
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.backend.annotations.conftest import add
from tests.backend.annotations.test_packs_in_datasets import write_pack
from tests.backend.annotations.test_values import tables
from touchdown.backend.annotations import (
    CATALOGUE_FILE,
    Dataset,
    Label,
    backups,
    list_backups,
    operation_log,
    rebuild_dataset,
    restore_backup,
)
from touchdown.backend.annotations.backups import Backup, BackupStore, check_backup, surplus_backups
from touchdown.backend.annotations.storage import DatasetInUseError
from touchdown.backend.core.faults import FaultError, InputError

NOON = datetime(2030, 5, 31, 12, tzinfo=UTC)


class Clock:
    def __init__(self) -> None:
        self.now = NOON

    def __call__(self) -> datetime:
        return self.now


def copies(dataset: Dataset) -> list[Backup]:
    return list_backups(dataset.folder / "backup")


def test_a_copy_has_what_is_still_in_the_wal(dataset, record):
    entry = record()
    dataset.labels.set("ann", entry.uuid, Label(77, 0, 0, 1))
    path = dataset.backups.make("test")
    assert {p.suffix for p in path.parent.iterdir()} == {".db"}
    plain = dataset.folder / "plain.db"
    shutil.copy(dataset.folder / CATALOGUE_FILE, plain)
    assert check_backup(path) == dataset_heads(dataset)
    with sqlite3.connect(path) as connection:
        found = connection.execute("SELECT x_um FROM label_rev WHERE x_um = 77").fetchall()
    connection.close()
    assert found == [(77,)]
    try:
        behind = check_backup(plain) != dataset_heads(dataset)
    except InputError:
        behind = True
    assert behind


def dataset_heads(dataset: Dataset) -> backups.Heads:
    with dataset.database.reading() as connection:
        return operation_log.newest_operations(connection)


def test_hourly_while_labels_change(dataset, record):
    clock = Clock()
    keeper = BackupStore(dataset.database, dataset.folder / "b", clock)
    assert keeper.age is None
    entry = record()
    assert keeper.hourly() is not None
    assert keeper.hourly() is None
    clock.now += timedelta(minutes=59)
    dataset.labels.set("ann", entry.uuid, Label(1, 1, 0, 1))
    assert keeper.hourly() is None
    clock.now += timedelta(minutes=2)
    assert keeper.age == timedelta(minutes=61)
    assert keeper.hourly() is not None
    clock.now += timedelta(hours=3)
    assert keeper.hourly() is None
    again = BackupStore(dataset.database, dataset.folder / "b", clock)
    assert again.age == timedelta(hours=3)
    assert again.if_changed("close") is None


def test_a_commit_makes_the_first_copy_and_closing_the_last(tmp_path):
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        entry = add(dataset, Label(1, 2, 0, 3))
        assert len(copies(dataset)) == 1
        dataset.labels.set("ann", entry.uuid, Label(5, 5, 0, 1))
        assert len(copies(dataset)) == 1
        heads = dataset_heads(dataset)
    newest = list_backups(folder / "backup")[0]
    assert check_backup(newest.path) == heads
    with Dataset.open(folder) as dataset:
        before = copies(dataset)
    assert list_backups(folder / "backup") == before


def test_retention_keeps_hours_days_and_months():
    made = [NOON - timedelta(minutes=30 * n) for n in range(400 * 48)]
    backups = [Backup(Path(f"/b/{m:%Y%m%d%H%M}"), m) for m in made]
    kept = set(made) - {backup.made for backup in surplus_backups(backups)}
    assert NOON in kept
    hours = [m for m in kept if m > NOON - timedelta(hours=24)]
    assert len(hours) == 24
    assert len({m.date() for m in kept if m > NOON - timedelta(days=14)}) == 14
    assert {(m.year, m.month) for m in kept} == {
        (2030, 5), (2030, 4), (2030, 3), (2030, 2), (2030, 1), (2029, 12), (2029, 11),
        (2029, 10), (2029, 9), (2029, 8), (2029, 7), (2029, 6),
    }  # fmt: skip
    assert len(kept) == 24 + 12 + 11
    last_of_april = max(m for m in kept if m.month == 4)
    assert last_of_april == datetime(2030, 4, 30, 23, 30, tzinfo=UTC)


def test_making_one_prunes_the_old(dataset, record):
    record()
    clock, folder = Clock(), dataset.folder / "b"
    keeper = BackupStore(dataset.database, folder, clock)
    for _ in range(4):
        keeper.make("test")
        clock.now += timedelta(minutes=10)
    (left,) = list_backups(folder)
    assert left.made == NOON + timedelta(minutes=30)
    (folder / "catalog-notes.db").write_text("the operator's own")
    keeper.make("test")
    assert (folder / "catalog-notes.db").exists()


@pytest.mark.parametrize("damage", ["cut", "byte", "foreign", "empty"])
def test_a_bad_copy_is_refused(dataset, record, damage):
    record()
    path = dataset.backups.make("test")
    data = bytearray(path.read_bytes())
    if damage == "cut":
        path.write_bytes(data[: len(data) // 2])
    elif damage == "byte":
        data[4096 * 3 : 4096 * 3 + 400] = b"\xff" * 400
        path.write_bytes(data)
    elif damage == "foreign":
        path.unlink()
        with sqlite3.connect(path) as connection:
            connection.execute("CREATE TABLE t (x)")
        connection.close()
    else:
        path.write_bytes(b"")
    before = (dataset.folder / CATALOGUE_FILE).read_bytes()
    dataset.close()
    with pytest.raises(InputError, match="not usable"):
        restore_backup(dataset.folder, path)
    assert len((dataset.folder / CATALOGUE_FILE).read_bytes()) >= len(before)


def test_a_copy_that_is_not_good_does_not_stay(dataset, record, monkeypatch):
    entry = record()
    held = copies(dataset)

    def broken(target: Path) -> None:
        target.write_bytes(b"half")

    monkeypatch.setattr(dataset.database, "copy_to", broken)
    with pytest.raises(FaultError) as error:
        dataset.backups.make("test")
    assert error.value.fault.code == "BACKUP-FAILED"
    assert copies(dataset) == held
    assert [p for p in (dataset.folder / "backup").iterdir() if p.suffix == ".tmp"] == []
    dataset.labels.set("ann", entry.uuid, Label(1, 1, 0, 1))
    dataset.close()
    assert "could not be copied" in dataset.backup_trouble


def test_going_back_to_a_copy_loses_no_label(tmp_path):
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        for seed in range(3):
            add(dataset, Label(seed, 0, 0, 1), seed=seed)
        old = dataset.backups.make("test")
        uuid = dataset.episodes()[0].uuid
        dataset.labels.set("ann", uuid, Label(50, 60, 0, 7))
        dataset.labels.accept("ann", uuid)
        dataset.labels.approve("bea", uuid)
        add(dataset, Label(9, 9, 0, 1), seed=9)
        expected = tables(dataset)
        keep = tmp_path / "keep.db"
        shutil.copy(old, keep)
    aside = restore_backup(folder, keep)
    assert aside is not None
    with Dataset.open(folder) as dataset:
        assert any("4 label operations of the journal" in notice for notice in dataset.notices)
        assert any("adopted" in notice for notice in dataset.notices)
        assert tables(dataset) == expected
        assert dataset.labels.head(uuid).state == "approved"


def test_a_backup_of_another_dataset_is_refused(tmp_path):
    backups = []
    for seed, name in enumerate(("mine", "other")):
        with Dataset.open(tmp_path / name) as dataset:
            add(dataset, Label(seed, 0, 0, 1), seed=seed)
            backups.append(dataset.backups.make("test"))
            expected = tables(dataset)
    with pytest.raises(InputError, match="it is of another dataset"):
        restore_backup(tmp_path / "other", backups[0])
    with Dataset.open(tmp_path / "other") as dataset:
        assert tables(dataset) == expected
    shutil.rmtree(tmp_path / "other" / "labels")
    assert restore_backup(tmp_path / "other", backups[1]) is not None


@pytest.fixture
def busy(tmp_path: Path) -> Path:
    """A dataset with files, a pack, reviews, an undo, tags and a deleted episode; closed."""
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        for seed in range(6):
            label = Label(100 * seed, 0, 0, 1)
            add(dataset, label, seed=seed, source="measured")
        first, second, third, fourth = (e.uuid for e in dataset.episodes()[:4])
        dataset.labels.set("ann", first, Label(1, 1, 0, 1))
        dataset.labels.accept("ann", first)
        dataset.labels.approve("bea", first)
        dataset.labels.set("ann", second, Label(2, 2, 0, 1))
        dataset.labels.undo("ann")
        dataset.labels.tag("ann", third, "gold")
        dataset.labels.flag("bea", third, note="look")
        dataset.labels.delete("ann", fourth, "slipped")
    write_pack(folder / "packs" / "a.mcap")
    Dataset.open(folder).close()
    return folder


def test_a_catalogue_made_anew_equals_the_old_one(busy):
    before = (busy / CATALOGUE_FILE).read_bytes()
    result = rebuild_dataset(busy, replace=False)
    assert result.equal, (result.only_old, result.only_new)
    assert result.rows["episode"] == 10
    assert result.rows["op"] >= 10
    assert not result.replaced
    assert (busy / CATALOGUE_FILE).read_bytes() == before
    assert list(busy.glob(".rebuilt*")) == []


def test_rows_of_files_that_are_gone_are_kept(busy):
    with Dataset.open(busy) as dataset:
        gone = dataset.episodes()[-1]
        (busy / gone.path).unlink()
    result = rebuild_dataset(busy, replace=True)
    assert result.equal, (result.only_old, result.only_new)
    with Dataset.open(busy) as dataset:
        assert [problem.target for problem in dataset.problems] == [gone.uuid]
        assert dataset.entry(gone.uuid).file_state == "missing"


def test_a_difference_is_counted(busy):
    with Dataset.open(busy) as dataset, dataset.database.transaction() as connection:
        connection.execute("UPDATE episode SET bottom = 'square15' WHERE kind = 'file'")
    result = rebuild_dataset(busy, replace=False)
    assert not result.equal
    assert (result.only_old["episode"], result.only_new["episode"]) == (6, 6)
    assert result.only_new["op"] == 0


@pytest.mark.parametrize("loss", ["deleted", "damaged", "chain"])
def test_a_lost_catalogue_comes_back_from_files_and_journal(busy, loss):
    with Dataset.open(busy) as dataset:
        expected = tables(dataset)
        if loss == "chain":
            with dataset.database.transaction() as connection:
                connection.execute("DROP TRIGGER op_no_update")
                connection.execute("UPDATE op SET actor = 'eve' WHERE seq = 2")
    if loss == "deleted":
        (busy / CATALOGUE_FILE).unlink()
    elif loss == "damaged":
        (busy / CATALOGUE_FILE).write_bytes(b"SQLite format 3\x00" + b"\xff" * 9000)
    if loss != "deleted":
        with pytest.raises(InputError, match="--replace"):
            rebuild_dataset(busy, replace=False)
    result = rebuild_dataset(busy, replace=True)
    assert result.replaced
    with Dataset.open(busy) as dataset:
        assert dataset.notices == ()
        assert dataset.labels.frozen == ""
        assert tables(dataset) == expected
    if loss == "damaged":
        assert len(list((busy / "quarantine").glob("catalog-*.db"))) == 1


def test_an_open_dataset_is_not_rebuilt(busy):
    with Dataset.open(busy, person="cleo"):
        for replace in (False, True):
            with pytest.raises(DatasetInUseError, match="cleo"):
                rebuild_dataset(busy, replace=replace)
    assert json.loads((busy / "dataset.json").read_text())["site"]
