"""SQLite file of one dataset: tables and one locked connection.

Transactions are explicit.
"""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

from touchdown.backend.annotations.values import canonical_json
from touchdown.backend.core import Fault, FaultError, InputError, RefusedError, SharedLock

APPLICATION_ID = 0x546F7563
SCHEMA_VERSION = 4


def _guards(table: str, key: str) -> str:
    stop = f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END;\n"
    known = f"EXISTS (SELECT 1 FROM {table} WHERE {key})"  # noqa: S608 - names of this module
    return (
        f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} {stop}"
        f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} {stop}"
        f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} WHEN {known} {stop}"
    )


# Append-only tables, with the condition for equal rows.
KEYS = {
    "op": "op_uuid = NEW.op_uuid OR (site = NEW.site AND seq = NEW.seq)",
    "label_rev": "rev_uuid = NEW.rev_uuid",
    "opinion": "op_uuid = NEW.op_uuid AND episode = NEW.episode",
    "event": "id = NEW.id",
    "apart": "op_uuid = NEW.op_uuid AND episode = NEW.episode",
}
TABLES = files("touchdown.resources").joinpath("catalogue.sql").read_text(encoding="utf-8")
SCHEMA = TABLES + "".join(_guards(table, key) for table, key in KEYS.items())

CATALOGUE_FILE = "catalog.db"
REBUILD = "'touchdown dataset rebuild --replace' rebuilds it from files and journal."
BUSY_MS = 2000  # longest wait for a lock held by another program
LEAST_ROOM = 1_000_000
Row = tuple[Any, ...]
Values = Sequence[object] | dict[str, object]


class Database:
    """Connection to one catalogue. Thread-safe: each call holds the lock while it runs.

    Commits are durable when ``transaction`` ends (WAL, synchronous FULL).
    """

    def __init__(self, connection: sqlite3.Connection, path: Path, *, writable: bool) -> None:
        self._connection = connection
        self.path: Path = path
        self.writable: bool = writable
        self._lock = SharedLock()

    @classmethod
    def open(cls, path: Path, *, write: bool) -> Database:
        """Open the catalogue ``path``; create it if ``write`` is set.

        A catalogue of a newer version opens for reading only (``writable`` is False). Raises
        ``InputError`` if the file is missing, is not a catalogue or has an older schema.
        """
        if not write and not path.is_file():
            raise InputError("There is no catalogue.", str(path), "Name the folder of a dataset.")
        mode = "rwc" if write else _read_mode(path)
        connection: sqlite3.Connection | None = None
        try:
            connection = _connect(path, mode)
            found = _examine(connection, path)
            if found == 0 and not write:
                raise InputError("The catalogue is empty.", str(path), REBUILD)
            if found == 0:
                _create(connection)
        except (sqlite3.Error, InputError) as error:
            if connection is not None:
                connection.close()
            if isinstance(error, InputError):
                raise
            raise _open_error(path, error) from error
        writable = write and found <= SCHEMA_VERSION
        if not writable:
            connection.execute("PRAGMA query_only = ON")
        return cls(connection, path, writable=writable)

    @property
    def schema_version(self) -> int:
        """Schema number of the file."""
        return int(self.one("PRAGMA user_version")[0])

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """Run one atomic transaction, durable at the end.

        Raises ``FaultError`` if the disk fails, ``RefusedError`` if the catalogue is open for
        reading only.
        """
        if not self.writable:
            raise RefusedError("read-only", "The dataset is open for reading only.")
        with self._lock:
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException as error:
                if self._connection.in_transaction:
                    self._connection.execute("ROLLBACK")
                if isinstance(error, sqlite3.OperationalError):
                    raise FaultError(_not_saved(error)) from error
                raise

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Run several queries on one consistent state."""
        with self._lock:
            yield self._connection

    def rows(self, sql: str, values: Values = ()) -> list[Row]:
        """Return all rows of a query."""
        with self._lock:
            return self._connection.execute(sql, values).fetchall()

    def first(self, sql: str, values: Values = ()) -> Row | None:
        """Return the first row, or None."""
        with self._lock:
            row: Row | None = self._connection.execute(sql, values).fetchone()
            return row

    def one(self, sql: str, values: Values = ()) -> Row:
        """Return the first row; raises ``LookupError`` if there is none."""
        row = self.first(sql, values)
        if row is None:
            raise LookupError(f"no row: {sql}")
        return row

    def damage(self) -> str:
        """Return the first damage of the file that SQLite finds, "" if there is none."""
        (verdict,) = self.one("PRAGMA integrity_check(1)")
        return "" if verdict == "ok" else " ".join(str(verdict).split())

    def copy_to(self, target: Path) -> None:
        """Write a consistent copy to ``target``, including the WAL."""
        with closing(sqlite3.connect(target)) as copy, self._lock:
            self._connection.backup(copy)

    def close(self) -> None:
        """Close the connection. A second call has no effect."""
        with self._lock:
            self._connection.close()


@contextmanager
def catalogue_errors(path: Path) -> Iterator[None]:
    """Raise ``InputError`` if the catalogue ``path`` turns out to be unreadable."""
    try:
        yield
    except (sqlite3.Error, json.JSONDecodeError) as error:
        raise _open_error(path, error) from error


def add_event(
    connection: sqlite3.Connection, actor: str, verb: str, target: str, body: object = None
) -> None:
    """Append an event that is not a label operation to the audit; ``body`` is stored as JSON."""
    text = canonical_json({} if body is None else body).decode("utf-8")
    connection.execute(
        "INSERT INTO event (at_ns, actor, verb, target, body) VALUES (?, ?, ?, ?, ?)",
        (time.time_ns(), actor, verb, target, text),
    )


def _connect(path: Path, mode: str) -> sqlite3.Connection:
    # One connection for all threads; Database's lock serialises them.
    connection = sqlite3.connect(
        f"{path.resolve().as_uri()}?mode={mode}",
        uri=True,
        isolation_level=None,
        check_same_thread=False,
        cached_statements=256,
    )
    try:
        connection.execute(f"PRAGMA busy_timeout = {BUSY_MS}")
        connection.execute("PRAGMA foreign_keys = ON")
        connection.execute("PRAGMA synchronous = FULL")
    except sqlite3.Error:  # first access: the file may not be a catalogue
        connection.close()
        raise
    return connection


def _read_mode(path: Path) -> str:
    if os.access(path.parent, os.W_OK):
        return "ro"
    wal = path.with_name(f"{path.name}-wal")
    if wal.is_file() and wal.stat().st_size:
        what = "The catalogue was not closed, and its folder cannot be written."
        fix = "Copy the dataset to a disk that can be written, and open it there."
        raise InputError(what, str(path), fix)
    # A read-only folder: open it without the files that writers need.
    return "ro&immutable=1"


def _examine(connection: sqlite3.Connection, path: Path) -> int:
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    ours = connection.execute("PRAGMA application_id").fetchone()[0] == APPLICATION_ID
    empty = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    if not ours and not (empty and version == 0):
        fix = "Name the folder of a dataset."
        raise InputError("The file is not a catalogue of Touchdown.", str(path), fix)
    if 0 < version < SCHEMA_VERSION:
        what, fix = f"The catalogue is of schema {version}, before the first release.", REBUILD
        raise InputError(what, str(path), fix)
    return version


def _create(connection: sqlite3.Connection) -> None:
    # SQLite allows this outside a transaction only.
    connection.execute("PRAGMA journal_mode = WAL")
    connection.executescript(
        f"BEGIN IMMEDIATE;\n{SCHEMA}"
        f"PRAGMA application_id = {APPLICATION_ID};\n"
        f"PRAGMA user_version = {SCHEMA_VERSION};\nCOMMIT;"
    )


def _open_error(path: Path, error: Exception) -> InputError:
    why = "The catalogue cannot be opened"
    fix = f"Check the folder. {REBUILD}"
    if shutil.disk_usage(path.parent).free < LEAST_ROOM:
        why += ", as its disk is full"
        fix = "Make room on it, then try again."
    return InputError(f"{why}: {error}.", str(path), fix)


def _not_saved(error: sqlite3.OperationalError) -> Fault:
    code = "CATALOGUE-WRITE"
    what = f"The catalogue could not be written: {error}."
    step = "Make room on the disk or check it"
    if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
        code = "CATALOGUE-BUSY"
        what = f"Another program has held the catalogue for {1e-3 * BUSY_MS:.0f} s."
        step = "Close the program that has the catalogue open"
    elif error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_FULL:
        code = "DISK-FULL"
        what = "The disk is full: the catalogue could not be written."
        step = "Make room on this disk"
    consequence = "The last action is not saved; nothing that was saved before is touched."
    return Fault(code, what, consequence, f"{step}, then do the action again.")
