"""Rebuild of the index from episode files, packs and journals."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from touchdown.backend.annotations.backups import BackupStore, put_in_place
from touchdown.backend.annotations.consistency import DatasetParts, problem_lines
from touchdown.backend.annotations.database import CATALOGUE_FILE, Database
from touchdown.backend.annotations.dataset import Dataset, read_description
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.operation_log import OperationJournal
from touchdown.backend.annotations.reconciliation import reconcile, resolve_findings
from touchdown.backend.annotations.storage import NotWritableError, WriterLock
from touchdown.backend.annotations.values import PROGRAM_ACTOR
from touchdown.backend.core import InputError

REBUILT = ".rebuilt.db"
# Tables that derive from files and journal, with the columns to compare.
COMPARED = {
    "op": "*",
    "label_rev": "*",
    "closed": "*",
    "mark": "*",
    "opinion": "*",
    "apart": "*",
    "label_head": "*",
    "series": "uuid, started_ns, person, campaign, mode, bench",
    "episode": "uuid, series, campaign, plan_item, kind, path, chunk_off, chunk_len, sha256, bytes,"
    " recorded_ns, piece, bottom, geometry, grip_id, mounting_id, person, mode, quality, accepted,"
    " keep_frames, state",
}
CARRIED = ("event", "score", "suggestion")
UNUSABLE = "state IN ('missing', 'quarantined', 'damaged')"


@dataclass(frozen=True, slots=True)
class RebuildReport:
    """Comparison of the new catalogue with the old one: differing rows per table.

    ``old_readable`` is False if there was nothing to compare with. ``notices``: problems found
    while the new catalogue was built.
    """

    rows: dict[str, int]
    only_old: dict[str, int]
    only_new: dict[str, int]
    old_readable: bool
    replaced: bool
    notices: tuple[str, ...]

    @property
    def equal(self) -> bool:
        """True if both have the same content."""
        return self.old_readable and not any((*self.only_old.values(), *self.only_new.values()))


def rebuild_dataset(folder: Path, *, replace: bool, person: str = "") -> RebuildReport:
    """Build a new catalogue beside the old one and compare them.

    ``replace`` puts the new catalogue in place and moves the old one to the quarantine. The dataset
    must not be open. Raises ``InputError`` if the old catalogue cannot be read and ``replace`` is
    not set, or if the folder cannot be written.
    """
    readable = _settle(folder, person)
    if not readable and not replace:
        what = "The catalogue cannot be read, so there is nothing to compare with."
        fix = "Say --replace to put the new one in its place; the old one is kept in quarantine."
        raise InputError(what, str(folder / CATALOGUE_FILE), fix)
    with closing(WriterLock.take(folder, person)):
        path = folder / REBUILT
        _delete(path)
        try:
            notices = _make(folder, path, carry=readable, back_up=replace)
            result = _compare(folder, path, notices, readable, replace)
            if replace:
                put_in_place(folder, path)
        finally:
            _delete(path)
    return result


def _settle(folder: Path, person: str) -> bool:
    """Reconcile the old catalogue with the journal; return False if it cannot be read."""
    read_description(folder)
    try:
        with Dataset.open(folder, create=False, person=person) as dataset:
            return not dataset.labels.frozen and not dataset.database.damage()
    except NotWritableError:
        raise
    except InputError:
        return False


def _make(folder: Path, path: Path, *, carry: bool, back_up: bool) -> tuple[str, ...]:
    site = read_description(folder).site
    with closing(Database.open(path, write=True)) as database:
        journal, geometry = OperationJournal(folder / "labels"), GeometryStore(folder / "geometry")
        if carry:
            _carry_over(database, folder / CATALOGUE_FILE)
        parts = DatasetParts(folder, database, journal, geometry, site)
        found = reconcile(parts)
        resolve_findings(parts, PROGRAM_ACTOR, "replay")
        if back_up:
            BackupStore(database, folder / "backup").make("rebuild", prune=False)
    return problem_lines(finding for finding in found if finding.kind not in ("adopt", "replay"))


def _carry_over(database: Database, old: Path) -> None:
    with closing(sqlite3.connect(f"{old.resolve().as_uri()}?mode=ro", uri=True)) as source:
        for table in CARRIED:
            _copy(source, database, table, f"SELECT * FROM {table}")  # noqa: S608
        _copy(source, database, "episode", f"SELECT * FROM episode WHERE {UNUSABLE}")  # noqa: S608
        gone = f"SELECT series FROM episode WHERE {UNUSABLE}"  # noqa: S608
        sql = f"SELECT * FROM series WHERE uuid IN ({gone})"  # noqa: S608
        _copy(source, database, "series", sql)


def _copy(source: sqlite3.Connection, target: Database, table: str, sql: str) -> None:
    rows = source.execute(sql).fetchall()
    if rows:
        marks = ", ".join("?" * len(rows[0]))
        with target.transaction() as connection:
            connection.executemany(f"INSERT INTO {table} VALUES ({marks})", rows)  # noqa: S608


def _compare(
    folder: Path, path: Path, notices: Sequence[str], readable: bool, replaced: bool
) -> RebuildReport:
    rows, only_old, only_new = {}, {}, {}
    with closing(sqlite3.connect(path.resolve().as_uri(), uri=True)) as connection:
        if readable:
            address = f"{(folder / CATALOGUE_FILE).resolve().as_uri()}?mode=ro"
            connection.execute("ATTACH DATABASE ? AS old", (address,))
        for table, columns in COMPARED.items():
            (rows[table],) = connection.execute(f"SELECT count(*) FROM {table}").fetchone()  # noqa: S608
            if readable:
                new, old = (f"SELECT {columns} FROM {db}.{table}" for db in ("main", "old"))  # noqa: S608
                only_new[table] = len(connection.execute(f"{new} EXCEPT {old}").fetchall())
                only_old[table] = len(connection.execute(f"{old} EXCEPT {new}").fetchall())
    return RebuildReport(rows, only_old, only_new, readable, replaced, tuple(notices))


def _delete(path: Path) -> None:
    for suffix in ("", "-wal", "-shm", "-journal"):
        path.with_name(f"{path.name}{suffix}").unlink(missing_ok=True)
