"""What a start does before anything can be recorded: bring files, rows and labels together.

Safe to run at any time and any number of times. Nothing that holds data is deleted; what cannot be
decided without a person is told and left.
"""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from backend.catalogue.chain import canonical
from backend.catalogue.database import add_event
from backend.catalogue.findings import Finding, Store
from backend.catalogue.operations import newest_of
from backend.catalogue.packs import check_packs
from backend.catalogue.raw_files import check_files
from backend.catalogue.replay import check_labels
from backend.catalogue.run_check import check_runs
from backend.catalogue.run_rows import follow
from backend.catalogue.values import PROGRAM
from backend.core.faults import InputError

LEFT_OVERS = (
    ("cache", "*.tmp"),
    ("cache", ".*.part"),
    ("exports", "*.tmp"),
    ("backup", ".*.tmp*"),
    ("geometry", ".*.part"),
    (".", ".*.tmp"),
    (".", ".*.part"),
    ("runs/*", ".*.part"),
    (".", ".rebuilt.db*"),
)
"""What a crash may leave of files that are made again anyway."""
TOGETHER = 500
"""Findings mended in one transaction: a disk that is not mounted makes thousands."""
BUSY_S = 60.0
"""A cache that changed this recently is not a left-over."""


def examine(where: Store, *, whole: bool = False) -> Iterator[Finding]:
    """Yield everything out of order, changing nothing.

    ``whole`` reads every file and checks every operation; else the newest operations are looked
    at, and the sizes of files in folders that are not known to be in order.
    """
    yield from check_labels(where, whole=whole)
    yield from check_files(where, whole=whole)
    yield from check_packs(where, whole=whole)
    yield from check_runs(where)
    yield from _left_overs(where)


def reconcile(where: Store, *, whole: bool = False) -> list[Finding]:
    """Mend what ``examine`` finds; returns what there is to say, each also kept as an event."""
    told: list[Finding] = []
    # Labels come first: an episode whose label is in the journal must not get a second one.
    for check in (
        check_labels(where, whole=whole),
        check_files(where, whole=whole),
        check_packs(where, whole=whole),
        check_runs(where),
        _left_overs(where),
    ):
        found = list(check)
        for start in range(0, len(found), TOGETHER):
            told += _mended(where, found[start : start + TOGETHER])
    follow(where.folder, where.database)
    with where.database.reading() as connection:
        sites = list(newest_of(connection))
    for site in sites:
        with where.database.transaction() as connection:
            where.journal.catch_up(connection, site)
    return told


def _mended(where: Store, findings: Sequence[Finding]) -> list[Finding]:
    """Mend in one transaction; return what to say: all but what was said before."""
    told: list[Finding] = []
    untold = [finding for finding in findings if finding.mend is None]
    with where.database.transaction() as connection:
        for finding in findings:
            if finding.mend is None:
                continue
            connection.execute("SAVEPOINT one")
            try:
                finding.mend(connection)
                body = {"said": finding.said}
                add_event(connection, PROGRAM, finding.kind, finding.target, body)
                told.append(finding)
            except (InputError, OSError, sqlite3.IntegrityError) as error:
                connection.execute("ROLLBACK TO one")
                said = f"{finding.said} That failed: {error}"
                untold.append(Finding("not-mended", finding.target, said))
            connection.execute("RELEASE one")
    return told + [f for f in untold if _tell_once(where, f) or f.locks]


def _tell_once(where: Store, finding: Finding) -> bool:
    """Keep a finding as an event; False if the same was kept before."""
    body = {"said": finding.said}
    kept = canonical(body).decode("utf-8")
    sql = "SELECT 1 FROM event WHERE verb = ? AND target = ? AND body = ? LIMIT 1"
    if where.database.first(sql, (finding.kind, finding.target, kept)):
        return False
    with where.database.transaction() as connection:
        add_event(connection, PROGRAM, finding.kind, finding.target, body)
    return True


def _left_overs(where: Store) -> Iterator[Finding]:
    for folder, pattern in LEFT_OVERS:
        for path in sorted((where.folder / folder).glob(pattern)):
            if not _in_use(where, path):
                said = f"{where.name(path)} was left half-made: deleted."
                yield Finding("left-over", where.name(path), said, partial(_remove, path))


def _in_use(where: Store, path: Path) -> bool:
    """Whether we work on it, or it is a cache that a training beside us may be building."""
    if path.name.startswith(where.database.path.name):
        return True
    return path.parent.name == "cache" and time.time() - path.stat().st_mtime < BUSY_S


def _remove(path: Path, _: sqlite3.Connection) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
