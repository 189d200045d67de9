"""Problems found by the consistency check of a dataset, each with its repair."""

from __future__ import annotations

import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.operation_log import OperationJournal

# A folder that changed later than this may change again within one tick of its time stamp.
SETTLED_NS = 2_500_000_000
WEEK_NS = 7 * 24 * 3600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class FolderState:
    """How a folder looked, how many rows belong to it, and when its files were looked at (UTC)."""

    stamp: str
    rows: int
    at_ns: int


@dataclass(slots=True)
class CheckedFolders:
    """What is known of the folders below ``raw``, by name relative to the dataset."""

    looks: dict[str, FolderState] = field(default_factory=dict)

    @classmethod
    def take(cls, database: Database) -> CheckedFolders:
        """Return what the last close left, and leave nothing behind."""
        rows = database.rows("SELECT path, stamp, rows, at_ns FROM checked_folder")
        if rows:
            with database.transaction() as connection:
                connection.execute("DELETE FROM checked_folder")
        return cls({path: FolderState(*look) for path, *look in rows})

    def keep(self, database: Database) -> None:
        """Leave it for the next start; folders that changed since then do not match any more."""
        if self.looks:
            rows = [(name, k.stamp, k.rows, k.at_ns) for name, k in self.looks.items()]
            with database.transaction() as connection:
                connection.executemany(
                    "INSERT OR REPLACE INTO checked_folder VALUES (?, ?, ?, ?)", rows
                )

    def unchanged(self, dataset: Path) -> dict[str, int]:
        """Return the folders that look as they did, with their numbers of rows."""
        now_ns = time.time_ns()
        return {
            name: look.rows
            for name, look in self.looks.items()
            if abs(now_ns - look.at_ns) < WEEK_NS and stamp_of(dataset / name) == look.stamp
        }

    def remember(self, name: str, stamp: str, rows: int, at_ns: int) -> None:
        """Note that a folder was in order; ``stamp`` and ``at_ns`` from before it was read."""
        if stamp and at_ns - int(stamp.split(":")[-1]) > SETTLED_NS:
            self.looks[name] = FolderState(stamp, rows, at_ns)

    def forget(self, names: set[str]) -> None:
        """Drop what is known of ``names``."""
        for name in names:
            self.looks.pop(name, None)


def stamp_of(folder: Path) -> str:
    """Return what changes whenever a file of ``folder`` comes or goes; "" if there is none.

    The later of its two times stands last. The inode tells a folder from a copy put in its place.
    """
    try:
        found = folder.stat()
    except OSError:
        return ""
    times = sorted((found.st_mtime_ns, found.st_ctime_ns))
    return f"{found.st_ino}:{times[0]}:{times[1]}"


QUARANTINE = "quarantine"
FULL_LINES = 5  # more findings of one kind than this are told in one sentence


@dataclass(frozen=True, slots=True)
class DatasetParts:
    """The parts of a dataset that a check needs; ``site``: the chain it writes.

    ``checked``: folders that a start need not look at again, brought up to date by a check.
    """

    folder: Path
    database: Database
    journal: OperationJournal
    geometry: GeometryStore
    site: str
    checked: CheckedFolders = field(default_factory=CheckedFolders)

    @property
    def quarantine(self) -> Path:
        """Folder of what a crash or damage left."""
        return self.folder / QUARANTINE

    def name(self, path: Path) -> str:
        """Return ``path`` relative to the dataset."""
        return path.relative_to(self.folder).as_posix()


Repair = Callable[[sqlite3.Connection], None]


@dataclass(frozen=True, slots=True)
class ConsistencyProblem:
    """One thing out of order.

    ``kind`` becomes the verb of an event, ``target`` its subject; ``said`` is a sentence for
    people. ``mend`` is None where only a person can decide: such a finding is told once, unless it
    ``locks`` the labels, which is told at every start.
    """

    kind: str
    target: str
    said: str
    mend: Repair | None = None
    locks: bool = False


def problem_lines(findings: Iterable[ConsistencyProblem]) -> tuple[str, ...]:
    """Return one line per finding, or per kind of which there are many."""
    listed = list(findings)
    counts = Counter(finding.kind for finding in listed)
    lines = [f.said for f in listed if counts[f.kind] <= FULL_LINES]
    for kind, count in counts.items():
        if count > FULL_LINES:
            first = next(f for f in listed if f.kind == kind)
            lines.append(f"{kind.replace('-', ' ')}, {count} times; the first: {first.said}")
    return tuple(lines)
