"""Folders of episode files that were found in order, and how they looked then.

Adding, removing or renaming a file changes its folder, so that a folder that looks as it did needs
no second look at a start. What this cannot see is a file whose size is changed in place: that is
left to ``verify``, to reading it, and to the whole look that a start takes once a week.

The catalogue holds this only from a clean close to the next start: after a crash, a restore or a
rebuild every file is looked at.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

from backend.catalogue.database import Database

SETTLED_NS = 2_500_000_000
"""A folder that changed later than this may change again within one tick of its time stamp."""
WEEK_NS = 7 * 24 * 3600 * 1_000_000_000


@dataclass(frozen=True, slots=True)
class Look:
    """How a folder looked, how many rows belong to it, and when its files were looked at (UTC)."""

    stamp: str
    rows: int
    at_ns: int


@dataclass(slots=True)
class CheckedFolders:
    """What is known of the folders below ``raw``, by name relative to the dataset."""

    looks: dict[str, Look] = field(default_factory=dict)

    @classmethod
    def take(cls, database: Database) -> CheckedFolders:
        """Return what the last close left, and leave nothing behind."""
        rows = database.rows("SELECT path, stamp, rows, at_ns FROM checked_folder")
        if rows:
            with database.transaction() as connection:
                connection.execute("DELETE FROM checked_folder")
        return cls({path: Look(*look) for path, *look in rows})

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
            self.looks[name] = Look(stamp, rows, at_ns)

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
