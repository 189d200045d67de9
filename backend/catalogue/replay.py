"""Journals, chains and heads against the catalogue: what is missing on either side.

The catalogue is ahead after a crash between commit and journal; the journal is ahead after a backup
was restored. A chain that does not fit is never repaired: the labels are then read-only.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterable, Iterator
from pathlib import Path

from backend.catalogue import heads
from backend.catalogue.chain import FIRST, link
from backend.catalogue.findings import Finding, Store
from backend.catalogue.journal import read_journal, tail_of
from backend.catalogue.operations import newest_of, read_operations, store
from backend.catalogue.values import Operation

TAIL = 500
"""At a start the newest operations of a chain are checked, by ``verify`` all of them."""

Place = tuple[int, str]
"""Number and hash of an operation."""


def check_labels(where: Store, *, whole: bool) -> Iterator[Finding]:
    """Yield what is out of order with operations, journals and heads."""
    with where.database.reading() as connection:
        catalogue = newest_of(connection)
    broken: set[str] = set()
    for site, (seq, _) in catalogue.items():
        bad = _bad_link(where, site, 0 if whole else max(0, seq - TAIL))
        if bad is not None:
            broken.add(site)
            yield _broken(site, bad, "The chain of label operations is broken")
    missing: list[Operation] = []
    for site in sorted({*catalogue, *_journalled(where)} - broken):
        ahead, findings = _against_journal(where, site, catalogue.get(site, (0, FIRST)))
        missing += ahead
        yield from findings
    if missing:
        missing.sort(key=lambda op: (op.lamport, op.site, op.seq))
        said = (
            f"{len(missing)} label operations of the journal were not in the catalogue: replayed."
        )
        yield Finding("replay", where.site, said, lambda connection: _replay(connection, missing))
    wrong = wrong_heads(where, whole=whole)
    if wrong:
        said = f"{len(wrong)} label heads did not follow from the revisions: made anew."
        yield Finding("heads", str(len(wrong)), said, heads.rebuild)


def wrong_heads(where: Store, *, whole: bool) -> list[str]:
    """Return episodes whose head is absent, not a leaf, or (``whole``) not what the rule says."""
    rows = where.database.rows(
        "SELECT DISTINCT r.episode FROM label_rev r LEFT JOIN label_head h USING (episode)"
        " WHERE h.episode IS NULL"
        " UNION SELECT h.episode FROM label_head h LEFT JOIN label_rev r USING (rev_uuid)"
        " WHERE r.rev_uuid IS NULL OR r.episode != h.episode"
        " UNION SELECT h.episode FROM label_rev c JOIN label_head h ON h.episode = c.episode"
        " WHERE c.parent = h.rev_uuid"
    )
    found = {episode for (episode,) in rows}
    if whole:
        found |= set(_disobedient(where))
    return sorted(found)


def _disobedient(where: Store) -> Iterator[str]:
    with where.database.reading() as connection:
        rows = connection.execute("SELECT episode, rev_uuid, conflict FROM label_head").fetchall()
        for episode, rev_uuid, conflict in rows:
            head = heads.head_of(*heads.read_nodes(connection, episode))
            found = head and (head.node.rev_uuid, int(len(head.leaves) > 1))
            if found != (rev_uuid, conflict):
                yield episode


def _journalled(where: Store) -> set[str]:
    return {path.stem for path in where.journal.folder.glob("*.jsonl")}


def _bad_link(where: Store, site: str, after: int) -> int | None:
    """Return the number of the first operation after ``after`` that does not fit, or None."""
    with where.database.reading() as connection:
        operations = read_operations(connection, "site = ? AND seq >= ?", (site, after))
    if after:
        start = (operations[0].seq, operations[0].hash)
        return first_misfit(operations[1:], start)
    return first_misfit(operations, (0, FIRST))


def first_misfit(operations: Iterable[Operation], start: Place) -> int | None:
    """Return the first number that does not continue the chain of one site from ``start``."""
    seq, digest = start
    for operation in operations:
        fits = (operation.seq, operation.prev_hash) == (seq + 1, digest)
        if not fits or _link(operation) != operation.hash:
            return seq + 1
        seq, digest = operation.seq, operation.hash
    return None


def _link(operation: Operation) -> str:
    try:
        return link(operation)
    except (TypeError, ValueError):
        return ""


def _against_journal(
    where: Store, site: str, newest: Place
) -> tuple[list[Operation], list[Finding]]:
    """Return operations only the journal has, and what else there is to say of one site."""
    path = where.journal.path(site)
    last = _last_line(path)
    if last == newest:
        return [], []
    if last is not None and last[0] < newest[0] and _is_known(where, site, last):
        return [], [_behind(where, site, newest[0] - last[0])]
    try:
        operations = list(read_journal(path))
    except (ValueError, OSError) as error:
        return [], [Finding("journal-damaged", site, f"The journal is damaged: {error}.")]
    ahead = [operation for operation in operations if operation.seq > newest[0]]
    shared = [operation for operation in operations if operation.seq == newest[0]]
    if newest[0] and [operation.hash for operation in shared] != [newest[1]]:
        said = "Journal and catalogue have different label operations"
        return [], [_broken(site, newest[0], said)]
    misfit = first_misfit(ahead, newest)
    if misfit is not None:
        return [], [_broken(site, misfit, "The journal's chain of label operations is broken")]
    return ahead, []


def _is_known(where: Store, site: str, place: Place) -> bool:
    if not place[0]:
        return True
    found = where.database.first("SELECT hash FROM op WHERE site = ? AND seq = ?", (site, place[0]))
    return found == (place[1],)


def _last_line(path: Path) -> Place | None:
    """Return the place of the last whole line; (0, ...) without any, None if it is unreadable."""
    try:
        _, content = tail_of(path)
    except FileNotFoundError:
        return 0, FIRST
    end = content.rfind(b"\n") + 1
    line = content[content.rfind(b"\n", 0, max(end - 1, 0)) + 1 : end]
    if not line:
        return 0, FIRST
    try:
        facts = json.loads(line)
        return int(facts["seq"]), str(facts["hash"])
    except (ValueError, TypeError, KeyError):
        return None


def _behind(where: Store, site: str, count: int) -> Finding:
    def mend(connection: sqlite3.Connection) -> None:
        where.journal.catch_up(connection, site)

    said = f"{count} label operations were missing in the journal: written."
    return Finding("journal", site, said, mend)


def _replay(connection: sqlite3.Connection, missing: list[Operation]) -> None:
    touched: set[str] = set()
    for operation in missing:
        touched |= store(connection, operation)
    heads.refresh(connection, touched)


def _broken(site: str, seq: int, what: str) -> Finding:
    said = (
        f"{what} at number {seq} of site {site}: labels are read-only."
        " Restore a backup, or rebuild the catalogue."
    )
    return Finding("broken-chain", f"{site}/{seq}", said, locks=True)
