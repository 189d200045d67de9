"""An older catalogue is brought up to date on a copy; a death in between loses nothing."""

from __future__ import annotations

import os
import signal
import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import pytest

from backend.catalogue import migration, schema
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import Label
from backend.core.faults import InputError
from tests.backend.catalogue.conftest import context_for, small_episode

RELATIONS = ("run", "param", "metric", "artifact", "schema_migration", "checked_folder", "apart")


@pytest.fixture
def older(tmp_path: Path) -> tuple[Path, str]:
    """A dataset of schema 1 with one labelled episode, as its last program left it."""
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        entry = dataset.record(small_episode(), Label(1000, -500, 0, 150), source="commanded",
                               context=context_for(dataset))  # fmt: skip
        dataset.labels.accept("ann", entry.uuid)
    with closing(sqlite3.connect(folder / "catalog.db", isolation_level=None)) as connection:
        for view in ("campaign", "plan_item"):
            connection.execute(f"DROP VIEW {view}")
        for table in RELATIONS:
            connection.execute(f"DROP TABLE {table}")
        connection.execute("PRAGMA user_version = 1")
    return folder, entry.uuid


def shape(path: Path) -> set[tuple[str, str]]:
    with closing(sqlite3.connect(path)) as connection:
        return set(connection.execute("SELECT name, sql FROM sqlite_master").fetchall())


def test_what_was_there_stays_and_the_new_tables_work(
    older: tuple[Path, str], tmp_path: Path
) -> None:
    folder, uuid = older
    with Dataset.open(folder) as dataset:
        assert "brought up" in dataset.notices[-1]
        assert dataset.database.schema_version == schema.SCHEMA_VERSION
        assert dataset.labels.head(uuid).state == "submitted"
        assert dataset.runs.entries() == []
        rows = dataset.database.rows("SELECT from_version, to_version FROM schema_migration")
        assert rows == [(k, k + 1) for k in range(1, schema.SCHEMA_VERSION)]
        assert dataset.database.one("PRAGMA journal_mode") == ("wal",)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
    Dataset.open(tmp_path / "new").close()
    assert shape(folder / "catalog.db") == shape(tmp_path / "new" / "catalog.db")
    (former,) = (folder / "quarantine").glob("catalog-*.db")
    with closing(sqlite3.connect(former)) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (1,)


def test_an_older_catalogue_can_be_read_as_it_is(older: tuple[Path, str]) -> None:
    folder, uuid = older
    with Dataset.open(folder, write=False) as dataset:
        assert dataset.labels.head(uuid).state == "submitted"
        assert dataset.runs.entries() == []
        assert dataset.database.schema_version == 1


def test_it_waits_for_a_reader_to_be_gone(
    older: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, _ = older
    with Dataset.open(folder, write=False) as reader:
        assert reader.counts()
        with pytest.raises(InputError, match="another program reads it"):
            Dataset.open(folder)
        assert reader.counts()
    with Dataset.open(folder) as dataset:
        assert dataset.database.schema_version == schema.SCHEMA_VERSION


def test_a_step_that_fails_leaves_the_old_one(
    older: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, uuid = older
    monkeypatch.setattr(migration, "STEPS", {1: "CREATE TABLE op (x);"})
    with pytest.raises(InputError, match="cannot be opened"):
        Dataset.open(folder)
    monkeypatch.undo()
    with Dataset.open(folder) as dataset:
        assert dataset.labels.head(uuid).state == "submitted"


@pytest.mark.parametrize("name", ["copyfile", "fsync", "replace", "rename_done"])
@pytest.mark.parametrize("before", [True, False])
def test_a_death_on_the_way_loses_nothing(older: tuple[Path, str], name: str, before: bool) -> None:
    folder, uuid = older
    pid = os.fork()
    if not pid:
        die_at(name, before)
        try:
            Dataset.open(folder)
        finally:
            os._exit(1)
    assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL
    with Dataset.open(folder) as dataset:
        assert dataset.labels.head(uuid).state == "submitted"
        assert dataset.labels.head(uuid).label.x_um == 1000
        assert dataset.database.schema_version == schema.SCHEMA_VERSION
    assert not list(folder.glob(".*.tmp*"))


def die_at(name: str, before: bool) -> None:
    owner = {"copyfile": (migration.shutil, "copyfile"), "fsync": (migration, "_sync"),
             "replace": (Path, "replace"), "rename_done": (migration, "sync_folder")}  # fmt: skip
    place, attribute = owner[name]
    original: Callable[..., object] = getattr(place, attribute)

    def call(*args: object, **words: object) -> object:
        if before:
            os.kill(os.getpid(), signal.SIGKILL)
        answer = original(*args, **words)
        os.kill(os.getpid(), signal.SIGKILL)
        return answer

    setattr(place, attribute, call)
