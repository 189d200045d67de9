"""Problems found by the consistency check of a dataset, each with its repair."""

from __future__ import annotations

import shutil
import sqlite3
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.operation_log import OperationJournal

# A folder that changed within one tick of its time stamp may change again unnoticed.
SETTLED_NS = 2_500_000_000
WEEK_NS = 7 * 24 * 3600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class FolderState:
    """State of a folder, number of its rows, and time of its last check (UTC)."""

    stamp: str
    rows: int
    at_ns: int


@dataclass(slots=True)
class CheckedFolders:
    """Folders below ``raw`` that were found in order, by name relative to the dataset."""

    looks: dict[str, FolderState] = field(default_factory=dict)

    @classmethod
    def take(cls, database: Database) -> CheckedFolders:
        """Return the state saved by the last ``keep`` and delete it."""
        rows = database.rows("SELECT path, stamp, rows, at_ns FROM checked_folder")
        if rows:
            with database.transaction() as connection:
                connection.execute("DELETE FROM checked_folder")
        return cls({path: FolderState(*look) for path, *look in rows})

    def keep(self, database: Database) -> None:
        """Save the state for the next opening. Folders that change later no longer match."""
        if self.looks:
            rows = [(name, k.stamp, k.rows, k.at_ns) for name, k in self.looks.items()]
            with database.transaction() as connection:
                connection.executemany(
                    "INSERT OR REPLACE INTO checked_folder VALUES (?, ?, ?, ?)", rows
                )

    def unchanged(self, dataset: Path) -> dict[str, int]:
        """Return the unchanged folders with their numbers of rows."""
        now_ns = time.time_ns()
        return {
            name: look.rows
            for name, look in self.looks.items()
            if abs(now_ns - look.at_ns) < WEEK_NS and stamp_of(dataset / name) == look.stamp
        }

    def remember(self, name: str, stamp: str, rows: int, at_ns: int) -> None:
        """Record a folder as checked; ``stamp`` and ``at_ns`` were taken before reading it."""
        if stamp and at_ns - int(stamp.split(":")[-1]) > SETTLED_NS:
            self.looks[name] = FolderState(stamp, rows, at_ns)


def stamp_of(folder: Path) -> str:
    """Return a stamp that changes when a file of ``folder`` comes or goes; "" if it is missing.

    The later of its two times comes last. The inode distinguishes the folder from a copy.
    """
    try:
        found = folder.stat()
    except OSError:
        return ""
    times = sorted((found.st_mtime_ns, found.st_ctime_ns))
    return f"{found.st_ino}:{times[0]}:{times[1]}"


QUARANTINE = "quarantine"
FULL_LINES = 5  # above this number, findings of one kind are summarised


CheckProgress = Callable[[str, int, int], None]


def no_progress(what: str, done: int, total: int) -> None:
    """Ignore the progress of a check."""


@dataclass(frozen=True, slots=True)
class DatasetParts:
    """Parts of a dataset that checks and repairs use; ``site``: hash chain of this copy.

    ``checked``: folders that need no check at the next opening; a check updates it. ``progress``
    receives what is checked, and numbers of checked and of all.
    """

    folder: Path
    database: Database
    journal: OperationJournal
    geometry: GeometryStore
    site: str
    checked: CheckedFolders = field(default_factory=CheckedFolders)
    progress: CheckProgress = no_progress

    @property
    def quarantine(self) -> Path:
        """Folder of files that a crash left behind or that are damaged."""
        return self.folder / QUARANTINE

    def name(self, path: Path) -> str:
        """Return ``path`` relative to the dataset."""
        return path.relative_to(self.folder).as_posix()


Repair = Callable[[sqlite3.Connection], object]


@dataclass(frozen=True, slots=True)
class ConsistencyProblem:
    """One problem found by a check.

    ``kind`` becomes the verb of an event, ``target`` its subject; ``message`` is a sentence for
    users. ``repair`` is None if a person has to decide: such a problem is reported once. A problem
    that is ``lasting``, or that ``locks`` the labels, is reported at every opening.
    """

    kind: str
    target: str
    message: str
    repair: Repair | None = None
    locks: bool = False
    lasting: bool = False

    @property
    def is_damage(self) -> bool:
        """True if data were lost or damaged, False for ordinary work after a crash or a copy."""
        return self.kind not in (
            "adopt", "back", "behind", "interrupted", "left-over", "moved", "unfinished",
        )  # fmt: skip

    @property
    def stays_listed(self) -> bool:
        """True if its repair leaves no row that tells of it, so that its event does."""
        return self.kind in ("double", "heads", "journal", "journal-damaged", "replay") or (
            self.kind == "torn" and self.target.endswith(".mcap")
        )


def leftover(parts: DatasetParts, path: Path, why: str) -> ConsistencyProblem:
    """Return the problem of a file or folder that a crash left behind; its repair deletes it."""

    def repair(_: sqlite3.Connection) -> None:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)

    name = parts.name(path)
    return ConsistencyProblem("left-over", name, f"{name} {why}: deleted.", repair)


def problem_lines(findings: Iterable[ConsistencyProblem]) -> tuple[str, ...]:
    """Return one line per problem, or per kind with many problems."""
    listed = list(findings)
    counts = Counter(finding.kind for finding in listed)
    lines = [f.message for f in listed if counts[f.kind] <= FULL_LINES]
    for kind, count in counts.items():
        if count > FULL_LINES:
            first = next(f for f in listed if f.kind == kind)
            lines.append(f"{kind.replace('-', ' ')}, {count} times; the first: {first.message}")
    return tuple(lines)
