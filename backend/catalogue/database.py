"""The SQLite file of one dataset: one connection, one lock, explicit transactions."""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from backend.catalogue.chain import canonical
from backend.catalogue.schema import APPLICATION_ID, SCHEMA_VERSION, statements
from backend.core.doing import SharedLock
from backend.core.faults import Fault, FaultError, InputError, RefusedError

NAME = "catalog.db"
BUSY_MS = 2000
"""Another program may hold the catalogue for so long."""
LEAST_ROOM = 1_000_000
Row = tuple[Any, ...]


class Database:
    """Rows of one catalogue, shared by threads: every call takes the lock for its own length.

    Commits are durable when ``transaction`` ends (WAL, synchronous FULL).
    """

    def __init__(self, connection: sqlite3.Connection, path: Path, *, writable: bool) -> None:
        self._connection, self.path, self.writable = connection, path, writable
        self._lock = SharedLock()

    @classmethod
    def open(cls, path: Path, *, write: bool) -> Database:
        """Open or (to write) make the catalogue ``path``.

        A catalogue of a newer program opens for reading only (``writable`` is False). Raises
        ``InputError`` for a file that is no catalogue, is of an older schema, or is not there.
        """
        if not write and not path.is_file():
            raise InputError("There is no catalogue.", str(path), "Name the folder of a dataset.")
        mode = "rwc" if write else _looking(path)
        connection: sqlite3.Connection | None = None
        try:
            connection = _connect(path, mode)
            found = _examine(connection, path)
            if write and found == 0:
                _create(connection)
        except (sqlite3.Error, InputError) as error:
            if connection is not None:
                connection.close()
            if isinstance(error, InputError):
                raise
            raise _unopened(path, error) from error
        writable = write and found <= SCHEMA_VERSION
        if not writable:
            connection.execute("PRAGMA query_only = ON")
        return cls(connection, path, writable=writable)

    @property
    def schema_version(self) -> int:
        """Number of the schema of the file."""
        return int(self.one("PRAGMA user_version")[0])

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All or nothing, durable at the end; raises ``FaultError`` if the disk refuses.

        Raises ``RefusedError`` where the catalogue was opened for reading only.
        """
        if not self.writable:
            raise RefusedError("read-only", "The dataset is open for reading only.")
        with self._lock:
            try:
                self._connection.execute("BEGIN IMMEDIATE")
                yield self._connection
                self._connection.execute("COMMIT")
            except BaseException as error:
                self._roll_back()
                if isinstance(error, sqlite3.OperationalError):
                    raise FaultError(_not_saved(error)) from error
                raise

    def _roll_back(self) -> None:
        if self._connection.in_transaction:
            self._connection.execute("ROLLBACK")

    @contextmanager
    def reading(self) -> Iterator[sqlite3.Connection]:
        """Several queries that see one state."""
        with self._lock:
            yield self._connection

    def rows(self, sql: str, values: Sequence[object] = ()) -> list[Row]:
        """Return all rows of a query."""
        with self._lock:
            return self._connection.execute(sql, values).fetchall()

    def first(self, sql: str, values: Sequence[object] = ()) -> Row | None:
        """Return the first row, or None."""
        with self._lock:
            row: Row | None = self._connection.execute(sql, values).fetchone()
            return row

    def one(self, sql: str, values: Sequence[object] = ()) -> Row:
        """Return the first row; raises ``LookupError`` if there is none."""
        row = self.first(sql, values)
        if row is None:
            raise LookupError(f"no row: {sql}")
        return row

    def copy_to(self, target: Path) -> None:
        """Write a consistent copy to ``target``, with what is still in the WAL."""
        copy = sqlite3.connect(target)
        try:
            with self._lock:
                self._connection.backup(copy)
        finally:
            copy.close()

    def close(self) -> None:
        """Close the connection; closing twice does no harm."""
        with self._lock:
            self._connection.close()


def add_event(
    connection: sqlite3.Connection, actor: str, verb: str, target: str, body: object = None
) -> None:
    """Append to the audit what is no operation on labels; ``body`` is kept as JSON."""
    text = canonical({} if body is None else body).decode("utf-8")
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
    except sqlite3.Error:  # The first look at the file: it may be no catalogue at all.
        connection.close()
        raise
    return connection


def _looking(path: Path) -> str:
    """Return how SQLite may look at a catalogue: beside a WAL it makes files, if it can."""
    if os.access(path.parent, os.W_OK):
        return "ro"
    wal = path.with_name(f"{path.name}-wal")
    if wal.is_file() and wal.stat().st_size:
        raise InputError(
            "The catalogue was not closed, and its folder cannot be written.",
            str(path),
            "Copy the dataset to a disk that can be written, and open it there.",
        )
    # Nobody can write it: it may be read without the files that writers would need.
    return "ro&immutable=1"


def _examine(connection: sqlite3.Connection, path: Path) -> int:
    """Return the schema number (0: an empty file)."""
    version = int(connection.execute("PRAGMA user_version").fetchone()[0])
    ours = connection.execute("PRAGMA application_id").fetchone()[0] == APPLICATION_ID
    empty = connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0] == 0
    if not ours and not (empty and version == 0):
        raise InputError(
            "The file is not a catalogue of Touchdown.", str(path), "Name the folder of a dataset."
        )
    if 0 < version < SCHEMA_VERSION:
        raise InputError(
            f"The catalogue is of schema {version}, before the first release.",
            str(path),
            "'touchdown dataset rebuild --replace' makes it anew from files and journal.",
        )
    return version


def _create(connection: sqlite3.Connection) -> None:
    # Set outside the transaction, where alone SQLite allows it.
    connection.execute("PRAGMA journal_mode = WAL")
    script = (
        f"BEGIN IMMEDIATE;\n{statements()}"
        f"PRAGMA application_id = {APPLICATION_ID};\n"
        f"PRAGMA user_version = {SCHEMA_VERSION};\nCOMMIT;"
    )
    connection.executescript(script)


def _unopened(path: Path, error: sqlite3.Error) -> InputError:
    """Return why a catalogue does not open; SQLite needs some room even to read."""
    if shutil.disk_usage(path.parent).free < LEAST_ROOM:
        return InputError(
            f"The catalogue cannot be opened, as its disk is full: {error}.",
            str(path),
            "Make room on it, then try again.",
        )
    return InputError(
        f"The catalogue cannot be opened: {error}.",
        str(path),
        "Check the folder; 'touchdown dataset rebuild' makes it anew from files and journal.",
    )


def _not_saved(error: sqlite3.OperationalError) -> Fault:
    if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
        return Fault(
            code="CATALOGUE-BUSY",
            what=f"Another program has held the catalogue for {1e-3 * BUSY_MS:.0f} s.",
            consequence="The last action is not saved; nothing that was saved before is touched.",
            next_step="Close the program that has the catalogue open, then do the action again.",
        )
    if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_FULL:
        return Fault(
            code="DISK-FULL",
            what="The disk is full: the catalogue could not be written.",
            consequence="The last action is not saved; nothing that was saved before is touched.",
            next_step="Make room on this disk, then do the action again.",
        )
    return Fault(
        code="CATALOGUE-WRITE",
        what=f"The catalogue could not be written: {error}.",
        consequence="The last action is not saved; nothing that was saved before is touched.",
        next_step="Make room on the disk or check it, then do the action again.",
    )
