"""Reconciliation of a dataset with its files, its journals, or another copy of it.

Runs on every opening, before anything can be recorded. Merging takes the union of the operations.
"""

from __future__ import annotations

import sqlite3
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from itertools import islice, zip_longest
from pathlib import Path

from touchdown.backend.annotations import episode_files, operation_log, review
from touchdown.backend.annotations.backups import list_backups
from touchdown.backend.annotations.consistency import ConsistencyProblem, DatasetParts, leftover
from touchdown.backend.annotations.database import REBUILD, SCHEMA, Database, add_event
from touchdown.backend.annotations.geometry_records import GeometryStore
from touchdown.backend.annotations.run_tracking import check_runs
from touchdown.backend.annotations.values import (
    FIRST_HASH,
    PROGRAM_ACTOR,
    ChainPosition,
    Operation,
    canonical_json,
    first_broken_link,
)
from touchdown.backend.core import Fault, InputError, parse_json, write_atomically

# Newest operations checked on opening: number, and size of their bodies; ``verify`` checks all.
CHECKED_OPERATIONS, CHECKED_CHARACTERS = 500, 2_000_000


def check_labels(parts: DatasetParts, *, whole: bool) -> Iterator[ConsistencyProblem]:
    """Yield problems of operations, journals and heads."""
    with parts.database.reading() as connection:
        catalogue = operation_log.newest_operations(connection)
    broken: set[str] = set()
    chains: dict[str, list[Operation]] = {}
    for site, (seq, _) in catalogue.items():
        after = 0 if whole else _first_checked(parts, site, seq)
        with parts.database.reading() as connection:
            chain = operation_log.read_operations(
                connection, "site = ? AND seq >= ?", (site, after)
            )
        start = (chain[0].seq, chain[0].hash) if after else (0, FIRST_HASH)
        bad = first_broken_link(_counted(parts, chain[1:] if after else chain), start)
        if whole:
            chains[site] = chain
        if bad is not None:
            broken.add(site)
            yield _broken(site, bad, "The chain of label operations is broken")
    missing: list[Operation] = []
    journals = {path.stem for path in parts.journal.folder.glob("*.jsonl")}
    for site in sorted({*catalogue, *journals} - broken):
        newest = catalogue.get(site, (0, FIRST_HASH))
        ahead, findings = _compare_journal(parts, site, newest, chains.get(site))
        missing += ahead
        yield from findings
    if missing:
        missing.sort(key=lambda op: (op.lamport, op.site, op.seq))
        message = (
            f"{len(missing)} label operations of the journal were not in the catalogue: replayed."
        )
        yield ConsistencyProblem("replay", parts.site, message, lambda c: _replay(c, missing))
    wrong = wrong_heads(parts, whole=whole)
    if wrong:
        message = f"{len(wrong)} label heads did not follow from the revisions: rebuilt."
        yield ConsistencyProblem("heads", parts.database.path.name, message, review.rebuild_heads)


def _first_checked(parts: DatasetParts, site: str, newest: int) -> int:
    """Return the number of the operation after which all are checked on opening."""
    least, characters = max(0, newest - CHECKED_OPERATIONS), 0
    sql = "SELECT seq, length(body) FROM op WHERE site = ? AND seq > ? ORDER BY seq DESC"
    with parts.database.reading() as connection:
        # Read one by one: the operation of a pack has the labels of 500 episodes.
        for seq, size in connection.execute(sql, (site, least)):
            characters += size
            if characters > CHECKED_CHARACTERS:
                return int(seq)
    return least


# Tables that follow from the operations.
DERIVED = ("label_rev", "closed", "mark", "opinion", "apart")
# Columns of an episode file that never change.
RECORDED = (
    "series, campaign, plan_item, sha256, bytes, recorded_ns, piece, bottom, geometry, grip_id,"
    " mounting_id, person, mode, quality, accepted, keep_frames"
)


def check_catalogue(parts: DatasetParts) -> list[ConsistencyProblem]:
    """Return a problem if the file is damaged, or differs from operations or newest backup."""
    damage = parts.database.damage()
    if not damage:
        with parts.database.reading() as connection:
            connection.execute("BEGIN")
            try:
                damage = _difference(parts, connection)
            finally:
                connection.execute("ROLLBACK")
    message = f"The catalogue is damaged ({damage}). {REBUILD}"
    target = parts.database.path.name
    return [ConsistencyProblem("catalogue", target, message, lasting=True)] if damage else []


def _difference(parts: DatasetParts, connection: sqlite3.Connection) -> str:
    """Return the first table that does not follow from the operations, "" if all do."""
    with closing(sqlite3.connect(":memory:", isolation_level=None)) as expected:
        expected.executescript(f"{SCHEMA} BEGIN")
        try:
            for operation in _counted(parts, operation_log.read_operations(connection)):
                operation_log.store_operation(expected, operation)
        except (KeyError, TypeError, ValueError, sqlite3.Error) as error:
            return f"an operation: {error}"
        for table in DERIVED:
            sql = f"SELECT * FROM {table} ORDER BY 1, 2"  # noqa: S608
            pairs = zip_longest(expected.execute(sql), connection.execute(sql))
            if any(row != other for row, other in pairs):
                return f"table {table} differs from the operations"
    recorded = f"SELECT uuid, {RECORDED} FROM episode WHERE kind = 'file'"  # noqa: S608
    for backup in list_backups(parts.folder / "backup")[:1]:
        address = f"{backup.path.resolve().as_uri()}?mode=ro&immutable=1"
        with suppress(sqlite3.Error), closing(sqlite3.connect(address, uri=True)) as copy:
            old = {uuid: row for uuid, *row in copy.execute(recorded)}
            for uuid, *row in connection.execute(recorded):
                if old.get(uuid, row) != row:
                    return f"the row of episode {uuid} differs from {backup.path.name}"
    return ""


def wrong_heads(parts: DatasetParts, *, whole: bool) -> list[str]:
    """Return episodes whose head is missing, not a leaf, or (``whole``) differs."""
    rows = parts.database.rows(
        "SELECT DISTINCT r.episode FROM label_rev r LEFT JOIN label_head h USING (episode)"
        " WHERE h.episode IS NULL"
        " UNION SELECT h.episode FROM label_head h LEFT JOIN label_rev r USING (rev_uuid)"
        " WHERE r.rev_uuid IS NULL OR r.episode != h.episode"
        " UNION SELECT h.episode FROM label_rev c JOIN label_head h ON h.episode = c.episode"
        " WHERE c.parent = h.rev_uuid"
    )
    found = {episode for (episode,) in rows}
    if whole:
        with parts.database.reading() as connection:
            heads = connection.execute("SELECT * FROM label_head").fetchall()
            for done, row in enumerate(heads):
                parts.progress("Labels", done, len(heads))
                if review.head_row(connection, row[0]) != row:
                    found.add(row[0])
    return sorted(found)


def _counted(parts: DatasetParts, operations: Sequence[Operation]) -> Iterator[Operation]:
    for done, operation in enumerate(operations):
        parts.progress("Label operations", done, len(operations))
        yield operation


def _compare_journal(
    parts: DatasetParts, site: str, newest: ChainPosition, chain: Sequence[Operation] | None
) -> tuple[list[Operation], list[ConsistencyProblem]]:
    """Return the operations of the journal that the catalogue lacks, and problems of the site.

    All lines are compared with ``chain``; without one the last line is read.
    """
    path = parts.journal.path(site)
    last = _last_position(path)
    if last == newest and chain is None:
        return [], []
    if last is not None and last[0] < newest[0]:
        sql = "SELECT hash FROM op WHERE site = ? AND seq = ?"
        if not last[0] or parts.database.first(sql, (site, last[0])) == (last[1],):
            message = (
                f"{newest[0] - last[0]} label operations were missing in the journal: written."
            )
            catch_up = partial(parts.journal.catch_up, site=site)
            # A crash leaves at most the newest one unwritten.
            is_damage = parts.checked.looks or newest[0] - last[0] > 1
            kind = "journal" if is_damage else "behind"
            return [], [ConsistencyProblem(kind, site, message, catch_up)]
    try:
        operations = list(operation_log.read_journal(path))
        if last == newest:
            if operations != chain:
                raise ValueError(f"{path.name} was changed")
            return [], []
    except (ValueError, OSError) as error:
        return [], [_damaged_journal(parts, site, newest, error)]
    ahead = [operation for operation in operations if operation.seq > newest[0]]
    shared = [operation.hash for operation in operations if operation.seq == newest[0]]
    if newest[0] and shared != [newest[1]]:
        message = "Journal and catalogue have different label operations"
        return [], [_broken(site, newest[0], message)]
    misfit = first_broken_link(ahead, newest)
    if misfit is not None:
        return [], [_broken(site, misfit, "The journal's chain of label operations is broken")]
    return ahead, []


def _damaged_journal(
    parts: DatasetParts, site: str, newest: ChainPosition, error: Exception
) -> ConsistencyProblem:
    """Return the problem; its repair writes the journal again if the catalogue has all of it."""
    path = parts.journal.path(site)

    def write_anew(connection: sqlite3.Connection) -> None:
        episode_files.quarantine_file(parts, path)
        parts.journal.catch_up(connection, site, rewritten=True)

    message = f"The journal of labels is damaged ({error})"
    if max(operation_log.line_numbers(path), default=0) <= newest[0]:
        message += ": rewritten from the catalogue; the damaged file is in quarantine."
        return ConsistencyProblem("journal-damaged", site, message, write_anew)
    message += ", and it has operations that the catalogue lacks: take this file from a copy."
    return ConsistencyProblem("journal-damaged", site, message, lasting=True)


def _last_position(path: Path) -> ChainPosition | None:
    """Return the position of the last complete line: (0, ...) without one, None if unreadable."""
    try:
        line, _ = operation_log.read_last_line(path)
        if not line:
            return 0, FIRST_HASH
        facts = parse_json(line)
        return int(facts["seq"]), str(facts["hash"])
    except FileNotFoundError:
        return 0, FIRST_HASH
    except (ValueError, TypeError, KeyError):
        return None


def _replay(connection: sqlite3.Connection, missing: list[Operation]) -> None:
    touched: set[str] = set()
    for operation in missing:
        touched |= operation_log.store_operation(connection, operation)
    review.refresh_heads(connection, touched)


def _broken(site: str, seq: int, what: str) -> ConsistencyProblem:
    message = (
        f"{what} at number {seq} of site {site}: labels are read-only."
        " Restore a backup, or rebuild the catalogue."
    )
    return ConsistencyProblem("broken-chain", f"{site}/{seq}", message, locks=True)


# Leftovers of a crash, of files that are built again on demand.
LEFTOVERS = (
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
# An unmounted disk causes thousands of repairs, and each new pack brings the rows of 500 episodes.
REPAIRS_PER_TRANSACTION = 100
BUSY_S = 60.0  # a cache changed more recently than this is in use


def check_dataset(parts: DatasetParts, *, whole: bool = False) -> Iterator[ConsistencyProblem]:
    """Yield all problems of a dataset without changing it.

    ``whole`` reads every file and checks every operation. Otherwise the newest operations are
    checked, and the file sizes in folders that are not known to be in order.
    """
    if whole and (damage := check_catalogue(parts)):
        yield from damage
        return
    known: set[str] = set()
    for check in _checks(parts, whole):
        found = [problem for problem in check if not (problem.lasting and problem.target in known)]
        known |= {problem.target for problem in found}
        yield from found


def _checks(parts: DatasetParts, whole: bool) -> Iterator[Iterator[ConsistencyProblem]]:
    # Labels come first, so that an episode with a label in the journal does not get a second one.
    yield check_labels(parts, whole=whole)
    yield episode_files.check_episode_files(parts, whole=whole)
    yield episode_files.check_packs(parts, whole=whole)
    yield check_runs(parts)
    yield _left_overs(parts)
    yield episode_files.check_losses(parts, whole=whole)
    yield _damaged_geometry(parts) if whole else iter(())
    yield open_findings(parts)


def _damaged_geometry(parts: DatasetParts) -> Iterator[ConsistencyProblem]:
    store = GeometryStore(parts.geometry.folder)  # without the cache of earlier reads
    for (pair,) in parts.database.rows("SELECT DISTINCT geometry FROM label_rev"):
        try:
            store.pair(pair)
        except InputError as error:
            name = parts.name(Path(error.where))
            message = f"{name}: {error.what} {error.fix}"
            yield ConsistencyProblem("geometry", name, message, lasting=True)


def reconcile(
    parts: DatasetParts, *, whole: bool = False, again: bool = False
) -> list[ConsistencyProblem]:
    """Repair the problems of a dataset; return those to report. Each is stored as an event.

    ``again`` also returns the problems for a person that were reported before.
    """
    if whole and (damage := check_catalogue(parts)):
        return damage
    reported: list[ConsistencyProblem] = []
    for check in _checks(parts, whole):
        known = {problem.target for problem in reported}
        found = (problem for problem in check if not (problem.lasting and problem.target in known))
        while batch := list(islice(found, REPAIRS_PER_TRANSACTION)):
            reported += _repaired(parts, batch, again)
    with parts.database.reading() as connection:
        sites = list(operation_log.newest_operations(connection))
    for site in sites:
        with parts.database.transaction() as connection:
            parts.journal.catch_up(connection, site)
    return reported


def _repaired(
    parts: DatasetParts, findings: Sequence[ConsistencyProblem], again: bool
) -> list[ConsistencyProblem]:
    reported: list[ConsistencyProblem] = []
    unrepaired = [finding for finding in findings if finding.repair is None]
    with parts.database.transaction() as connection:
        for finding in findings:
            if finding.repair is None:
                continue
            connection.execute("SAVEPOINT one")
            try:
                finding.repair(connection)
                body = {"said": finding.message, "open": finding.stays_listed}
                add_event(connection, PROGRAM_ACTOR, finding.kind, finding.target, body)
                reported.append(replace(finding, repair=None))  # it holds the rows of a pack
            except (InputError, OSError, sqlite3.IntegrityError) as error:
                connection.execute("ROLLBACK TO one")
                message = f"{finding.message} That failed: {error}"
                unrepaired.append(ConsistencyProblem("not-mended", finding.target, message))
            connection.execute("RELEASE one")
    return reported + [f for f in unrepaired if f.lasting or _is_new(parts, f) or f.locks or again]


def _is_new(parts: DatasetParts, finding: ConsistencyProblem) -> bool:
    """Store a problem as an event; return False if it was stored before."""
    body = {"said": finding.message}
    kept = canonical_json(body).decode("utf-8")
    sql = "SELECT 1 FROM event WHERE verb = ? AND target = ? AND body = ? LIMIT 1"
    if parts.database.first(sql, (finding.kind, finding.target, kept)):
        return False
    with parts.database.transaction() as connection:
        add_event(connection, PROGRAM_ACTOR, finding.kind, finding.target, body)
    return True


def open_findings(parts: DatasetParts) -> Iterator[ConsistencyProblem]:
    """Yield the repaired damage that no person has marked as resolved (``resolve_findings``)."""
    rows = parts.database.rows(
        "SELECT e.verb, e.target, max(e.at_ns), json_extract(e.body, '$.said') FROM event e"
        " WHERE e.actor = ? AND e.body LIKE '%\"open\":true%'"
        " AND NOT EXISTS (SELECT 1 FROM event r WHERE r.id > e.id AND r.verb = ?"
        " AND r.target = e.target) GROUP BY e.verb, e.target ORDER BY e.id",
        (PROGRAM_ACTOR, RESOLVED),
    )
    for kind, target, at_ns, said in rows:
        found = datetime.fromtimestamp(at_ns / 1e9, UTC)
        message = (
            f"{found:%Y-%m-%d %H:%M} UTC: {said} 'touchdown dataset verify --resolve' marks this"
            " as resolved."
        )
        yield ConsistencyProblem(kind, target, message, lasting=True)


RESOLVED = "resolved"


def resolve_findings(parts: DatasetParts, person: str, *kinds: str) -> list[ConsistencyProblem]:
    """Take repaired damage (default: of all kinds) off the lists of problems; return it."""
    found = [one for one in open_findings(parts) if not kinds or one.kind in kinds]
    with parts.database.transaction() as connection:
        for one in found:
            add_event(connection, person, RESOLVED, one.target, {"said": one.message})
    return found


def _left_overs(parts: DatasetParts) -> Iterator[ConsistencyProblem]:
    for folder, pattern in LEFTOVERS:
        for path in sorted((parts.folder / folder).glob(pattern)):
            own = path.name.startswith(parts.database.path.name)
            # A training may be building a young cache.
            young = folder == "cache" and time.time() - path.stat().st_mtime < BUSY_S
            if not own and not young:
                yield leftover(parts, path, "was left incomplete")


@dataclass(frozen=True, slots=True)
class MergeReport:
    """Result of a merge: numbers of operations and episodes, and episodes in conflict."""

    operations: int
    episodes: int
    conflicts: tuple[str, ...]


def merge_operations(
    connection: sqlite3.Connection, theirs: Sequence[Operation], where: str
) -> set[str]:
    """Store the operations that are missing here; return the episodes they concern.

    ``where`` names the other dataset in errors. Raises ``InputError`` for a broken chain, or one
    that continues differently in both.
    """
    by_site: dict[str, list[Operation]] = defaultdict(list)
    for operation in theirs:
        by_site[operation.site].append(operation)
    for site, chain in by_site.items():
        bad = first_broken_link(sorted(chain, key=lambda op: op.seq))
        if bad is not None:
            what = f"The chain of labels is broken at operation {bad} of site {site}."
            fix = "Restore that dataset from a backup first."
            raise InputError(what, where, fix)
    touched: set[str] = set()
    for operation in sorted(theirs, key=lambda op: (op.lamport, op.site, op.seq)):
        row = connection.execute(
            "SELECT hash FROM op WHERE site = ? AND seq = ?", (operation.site, operation.seq)
        ).fetchone()
        if row is None:
            touched |= operation_log.store_operation(connection, operation)
        elif row[0] != operation.hash:
            what = f"Both datasets continue one chain differently (operation {operation.seq})."
            fix = "Start from a copy that was opened once where it lies, then label there."
            raise InputError(what, where, fix)
    review.refresh_heads(connection, touched)
    return touched


def copy_files(mine: Path, theirs: Path, paths: Sequence[str]) -> list[str]:
    """Copy missing files (relative names) and geometry; return those that do not exist.

    Each file appears complete or not at all. Raises ``InputError`` for a name outside the folder.
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
    try:
        return folder.resolve() in path.resolve().parents and len(path.name) <= 200
    except (OSError, ValueError):  # a name that is invalid on every system
        return False


def merge_episodes(
    connection: sqlite3.Connection, theirs: Database, mine: Path, missing: Sequence[str]
) -> int:
    """Insert the episodes that are missing here; return their number.

    ``missing``: files that do not exist.
    """
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


def merge_labels(
    connection: sqlite3.Connection, log: Sequence[Operation], where: str, *, episodes: int
) -> MergeReport:
    """Merge the log of another copy into this one; ``episodes``: number of copied episodes."""
    (before,) = connection.execute("SELECT count(*) FROM op").fetchone()
    touched = merge_operations(connection, log, where)
    (after,) = connection.execute("SELECT count(*) FROM op").fetchone()
    rows = connection.execute("SELECT episode FROM label_head WHERE conflict ORDER BY episode")
    conflicts = tuple(episode for (episode,) in rows if episode in touched)
    return MergeReport(after - before, episodes, conflicts)


def copy_fault(error: OSError, folder: Path) -> Fault:
    """Return the fault for files that could not be copied."""
    return Fault(
        code="MERGE-WRITE",
        what=f"A file of the other dataset could not be copied: {error.strerror or error}.",
        consequence="Nothing was merged; files that came are complete, and used the next time.",
        next_step=f"Make room on the disk of {folder} or check both disks, then merge again.",
    )
