"""Bring the work of another copy of a dataset into this one: the union of the operations.

Commutative, associative, idempotent: heads are a function of the set. Two labels of one episode
are a conflict for a person to resolve; nothing is chosen silently.
"""

from __future__ import annotations

import sqlite3
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from backend.catalogue import heads, operations
from backend.catalogue.chain import first_break
from backend.catalogue.database import Database, add_event
from backend.catalogue.values import Operation
from backend.core.faults import Fault, InputError
from backend.core.files import write_atomically


@dataclass(frozen=True, slots=True)
class Merged:
    """What a merge brought: numbers of operations and episodes, and the episodes in conflict."""

    operations: int
    episodes: int
    conflicts: tuple[str, ...]


def union(connection: sqlite3.Connection, theirs: Sequence[Operation], where: str) -> set[str]:
    """Store the operations that are new here; return the episodes they touch.

    ``where`` names their dataset. Raises ``InputError`` for a broken chain, or one that goes on
    differently in both.
    """
    _check_chains(theirs, where)
    touched: set[str] = set()
    for operation in sorted(theirs, key=lambda op: (op.lamport, op.site, op.seq)):
        row = connection.execute(
            "SELECT hash FROM op WHERE site = ? AND seq = ?", (operation.site, operation.seq)
        ).fetchone()
        if row is None:
            touched |= operations.store(connection, operation)
        elif row[0] != operation.hash:
            raise InputError(
                f"Both datasets continue one chain differently (operation {operation.seq}).",
                where,
                "Start from a copy that was opened once where it lies, then label there.",
            )
    heads.refresh(connection, touched)
    return touched


def copy_files(mine: Path, theirs: Path, paths: Sequence[str]) -> list[str]:
    """Copy files (relative names) that are not here yet, geometry included; return those missing.

    A file appears complete or not at all. Raises ``InputError`` for a name that leaves the folder.
    """
    missing = []
    names = [*(f"geometry/{path.name}" for path in (theirs / "geometry").glob("*.json")), *paths]
    for name in names:
        source, target = theirs / name, mine / name
        if not (_is_inside(mine, target) and _is_inside(theirs, source)):
            raise InputError("A file lies outside its dataset.", name, "Do not merge this dataset.")
        if target.exists():
            continue
        if not source.is_file():
            missing.append(name)
            continue
        write_atomically(target, source.read_bytes())
    return missing


def _is_inside(folder: Path, path: Path) -> bool:
    """Whether ``path`` names something below ``folder``, links followed."""
    try:
        return folder.resolve() in path.resolve().parents and len(path.name) <= 200
    except (OSError, ValueError):
        # A name that no system takes.
        return False


def take_rows(
    connection: sqlite3.Connection, theirs: Database, mine: Path, missing: Sequence[str]
) -> int:
    """Enter their episodes that are not here yet; return how many. ``missing``: without a file."""
    columns = [row[1] for row in theirs.rows("PRAGMA table_info(episode)")]
    names, marks = ", ".join(columns), ", ".join("?" * len(columns))
    state, path = columns.index("state"), columns.index("path")
    count = 0
    for row in theirs.rows(f"SELECT {names} FROM episode"):  # noqa: S608
        values = list(row)
        if values[path] in missing:
            values[state] = "missing"
        elif (mine / values[path]).is_file():
            values[state] = "complete" if values[state] == "missing" else values[state]
        sql = f"INSERT OR IGNORE INTO episode ({names}) VALUES ({marks})"  # noqa: S608
        count += connection.execute(sql, values).rowcount
    for row in theirs.rows("SELECT * FROM series"):
        connection.execute("INSERT OR IGNORE INTO series VALUES (?, ?, ?, ?, ?, ?)", row)
    return count


def take_labels(
    connection: sqlite3.Connection, log: Sequence[Operation], where: str, *, episodes: int
) -> Merged:
    """Unite their log with this one; ``episodes``: how many came along."""
    (before,) = connection.execute("SELECT count(*) FROM op").fetchone()
    touched = union(connection, log, where)
    (after,) = connection.execute("SELECT count(*) FROM op").fetchone()
    rows = connection.execute("SELECT episode FROM label_head WHERE conflict ORDER BY episode")
    conflicts = tuple(episode for (episode,) in rows if episode in touched)
    return Merged(after - before, episodes, conflicts)


def note(connection: sqlite3.Connection, person: str, where: Path, done: Merged) -> None:
    """Keep the merge in the audit."""
    body = {"operations": done.operations, "episodes": done.episodes}
    add_event(connection, person, "merge", str(where), body | {"conflicts": len(done.conflicts)})


def not_copied(error: OSError, folder: Path) -> Fault:
    """Return the fault of files that could not be copied."""
    return Fault(
        code="MERGE-WRITE",
        what=f"A file of the other dataset could not be copied: {error.strerror or error}.",
        consequence="Nothing was merged; files that came are complete, and used the next time.",
        next_step=f"Make room on the disk of {folder} or check both disks, then merge again.",
    )


def _check_chains(theirs: Sequence[Operation], where: str) -> None:
    by_site: dict[str, list[Operation]] = defaultdict(list)
    for operation in theirs:
        by_site[operation.site].append(operation)
    for site, chain in by_site.items():
        bad = first_break(sorted(chain, key=lambda op: op.seq))
        if bad is not None:
            raise InputError(
                f"The chain of labels is broken at operation {bad} of site {site}.",
                where,
                "Restore that dataset from a backup first.",
            )
