"""An older catalogue becomes one of the present schema: on a copy, which then takes its place.

A death at any instruction leaves either the old catalogue or the new one. The old one is kept in
the quarantine.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import time
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from backend.catalogue.schema import SCHEMA_VERSION, STEPS
from backend.core.faults import InputError
from backend.core.files import sync_folder
from backend.core.program import program

QUARANTINE = "quarantine"
STAMP = "%Y%m%dT%H%M%S%fZ"


def migrate(path: Path) -> Path:
    """Bring the closed catalogue ``path`` to the present schema; return where the old one is kept.

    Raises ``InputError`` if another program reads it, ``sqlite3.Error`` if it is damaged.
    """
    part = path.with_name(f".{path.name}.migrated.tmp")
    part.unlink(missing_ok=True)
    with closing(sqlite3.connect(path, isolation_level=None)) as old:
        _settle(old, path)
        with closing(sqlite3.connect(part, isolation_level=None)) as new:
            old.backup(new)
            _bring_up(new)
    kept = path.parent / QUARANTINE / f"{path.stem}-{datetime.now(UTC).strftime(STAMP)}.db"
    kept.parent.mkdir(exist_ok=True)
    shutil.copyfile(path, kept)
    for file in (part, kept):
        _sync(file)
    sync_folder(kept.parent)
    part.replace(path)
    sync_folder(path.parent)
    return kept


def _settle(old: sqlite3.Connection, path: Path) -> None:
    """Leave no write-ahead log behind: it would be played into the new catalogue.

    Only the last connection can do that, so that nobody reads what is about to be replaced.
    """
    try:
        (mode,) = old.execute("PRAGMA journal_mode = DELETE").fetchone()
    except sqlite3.OperationalError:
        mode = "busy"
    if mode != "delete":
        raise InputError(
            "The catalogue is of an older version, and another program reads it.",
            str(path),
            "Close the other program, then open the dataset again.",
        )


def _bring_up(new: sqlite3.Connection) -> None:
    (found,) = new.execute("PRAGMA user_version").fetchone()
    for version in range(found, SCHEMA_VERSION):
        new.executescript(
            f"BEGIN IMMEDIATE;\n{STEPS[version]}PRAGMA user_version = {version + 1};\nCOMMIT;"
        )
        row = (version, version + 1, time.time_ns(), program())
        new.execute("INSERT INTO schema_migration VALUES (?, ?, ?, ?)", row)
    (verdict,) = new.execute("PRAGMA integrity_check").fetchone()
    if verdict != "ok":
        raise sqlite3.DatabaseError(verdict)
    new.execute("PRAGMA journal_mode = WAL")


def _sync(file: Path) -> None:
    with file.open("rb+") as opened:
        os.fsync(opened.fileno())
