"""What a look at a dataset found out of order, and what mends it."""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from backend.catalogue.checked_folders import CheckedFolders
from backend.catalogue.database import Database
from backend.catalogue.geometry import GeometryStore
from backend.catalogue.journal import Journal

QUARANTINE = "quarantine"
FULL_LINES = 5
"""More findings of one kind than this are told in one sentence."""


@dataclass(frozen=True, slots=True)
class Store:
    """The parts of a dataset that a check needs; ``site``: the chain it writes.

    ``checked``: folders that a start need not look at again, brought up to date by a check.
    """

    folder: Path
    database: Database
    journal: Journal
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


Mend = Callable[[sqlite3.Connection], None]


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing out of order.

    ``kind`` becomes the verb of an event, ``target`` its subject; ``said`` is a sentence for
    people. ``mend`` is None where only a person can decide: such a finding is told once, unless it
    ``locks`` the labels, which is told at every start.
    """

    kind: str
    target: str
    said: str
    mend: Mend | None = None
    locks: bool = False


def sentences(findings: Iterable[Finding]) -> tuple[str, ...]:
    """Return one line per finding, or per kind of which there are many."""
    listed = list(findings)
    counts = Counter(finding.kind for finding in listed)
    lines = [f.said for f in listed if counts[f.kind] <= FULL_LINES]
    for kind, count in counts.items():
        if count > FULL_LINES:
            first = next(f for f in listed if f.kind == kind)
            lines.append(f"{kind.replace('-', ' ')}, {count} times; the first: {first.said}")
    return tuple(lines)
