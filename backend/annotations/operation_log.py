"""Append-only log of label operations, in the database and as JSON lines.

The JSON lines are in ``labels/<site>.jsonl``. All other label tables derive from the log. Work on
control items is stored apart from labels.
"""

from __future__ import annotations

import os
import sqlite3
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, TypedDict

from touchdown.backend.annotations.values import (
    FIRST_HASH,
    NO_LABEL,
    ControlItemStep,
    Label,
    LabelContent,
    LabelState,
    Operation,
    Revision,
    canonical_json,
    operation_hash,
    uuid7,
)
from touchdown.backend.core import append_line, parse_json

FIELDS = tuple(field.name for field in fields(Operation))
COLUMNS = ", ".join(FIELDS)  # of the table ``op``
REVERSING = ("undo", "redo")


class EpisodeMark(TypedDict):
    """A mark set on or removed from an episode, with the previous state.

    ``owner``: the operation that owns the mark, None for the one that writes it. An undo returns it
    to the previous owner ("" if there was none).
    """

    episode: str
    name: str
    present: bool
    note: str
    owner: str | None
    was: bool
    was_note: str
    was_owner: str


@dataclass(slots=True)
class OperationDraft:
    """Content of an operation before it is written.

    ``copies``: source revision of each revision that repeats another one. ``apart``: steps on
    control items, which are in no label.
    """

    revs: list[dict[str, Any]] = field(default_factory=list)
    closes: list[str] = field(default_factory=list)
    marks: list[EpisodeMark] = field(default_factory=list)
    copies: dict[str, str] = field(default_factory=dict)
    reviews: list[Mapping[str, object]] = field(default_factory=list)
    opinions: list[Mapping[str, object]] = field(default_factory=list)
    apart: list[Mapping[str, object]] = field(default_factory=list)
    extra: dict[str, object] = field(default_factory=dict)

    def add_copy(self, revision: dict[str, Any], source: str) -> None:
        """Add ``revision``, which repeats the content of the revision ``source``."""
        self.revs.append(revision)
        self.copies[revision["rev_uuid"]] = source

    def body(self) -> dict[str, object]:
        """Return the body of the operation without empty optional parts."""
        body: dict[str, object] = {"closes": list(self.closes), "revs": list(self.revs)}
        for name in ("marks", "copies", "reviews", "opinions", "apart"):
            if getattr(self, name):
                body[name] = getattr(self, name)
        return body | self.extra


def new_revision(
    episode: str,
    parent: str | None,
    content: LabelContent,
    state: LabelState,
    reason: str | None = None,
) -> dict[str, Any]:
    """Return the columns of a new revision, as written to the body of its operation."""
    columns: dict[str, Any] = asdict(content)
    columns |= columns.pop("label")
    place = {"rev_uuid": uuid7(), "episode": episode, "parent": parent}
    return place | columns | {"state": state, "reason": reason}


def following(
    parent: Revision, source: Revision, state: LabelState | None = None
) -> dict[str, Any]:
    """Return the columns of a revision after ``parent`` with the content of ``source``.

    ``state`` None: state and reason are also those of ``source``.
    """
    content, reason = LabelContent.of(source), source.reason
    if state not in (None, "rejected"):
        reason = None
    return new_revision(parent.episode, parent.rev_uuid, content, state or source.state, reason)


def append_operation(
    connection: sqlite3.Connection,
    site: str,
    actor: str,
    verb: str,
    draft: OperationDraft,
    target_op: str | None = None,
) -> tuple[Operation, set[str]]:
    """Create and store the next operation of ``site`` within the caller's transaction.

    Returns it and the episodes whose heads have to be refreshed.
    """
    last = connection.execute(
        "SELECT seq, hash FROM op WHERE site = ? ORDER BY seq DESC LIMIT 1", (site,)
    ).fetchone()
    seq, previous = last if last else (0, FIRST_HASH)
    (clock,) = connection.execute("SELECT max(lamport) FROM op").fetchone()
    content: dict[str, Any] = {
        "op_uuid": uuid7(),
        "site": site,
        "seq": seq + 1,
        "lamport": 1 + (clock or 0),
        "at_ns": time.time_ns(),
        "actor": actor,
        "verb": verb,
        "target_op": target_op,
        "body": draft.body(),
        "prev_hash": previous,
    }
    unsigned = Operation(**content, hash="")
    operation = Operation(**content, hash=operation_hash(unsigned))
    return operation, store_operation(connection, operation)


def store_operation(connection: sqlite3.Connection, operation: Operation) -> set[str]:
    """Insert ``operation`` and its content; return the episodes whose heads to refresh.

    Operations have to be stored in the order of (lamport, site, seq). Raises
    ``sqlite3.IntegrityError`` if it exists already, or if its site has another one of that number.
    """
    row = {name: getattr(operation, name) for name in FIELDS}
    row["body"] = canonical_json(operation.body).decode("utf-8")
    values = ", ".join(f":{name}" for name in FIELDS)
    connection.execute(f"INSERT INTO op ({COLUMNS}) VALUES ({values})", row)  # noqa: S608
    _store_body(connection, operation)
    body: Mapping[str, Any] = operation.body
    named = {part["episode"] for part in (*body["revs"], *body.get("marks", ()))}
    for closed in body["closes"]:
        found = connection.execute("SELECT episode FROM label_rev WHERE rev_uuid = ?", (closed,))
        named.update(episode for (episode,) in found)
    return named


def _store_body(connection: sqlite3.Connection, operation: Operation) -> None:
    body: Mapping[str, Any] = operation.body
    copies = body.get("copies", {})
    for rev in body["revs"]:
        copy_of = copies.get(rev["rev_uuid"])
        values = {**rev, "op_uuid": operation.op_uuid, "copy_of": copy_of}
        connection.execute(_INSERT_REVISION, values)
    for closed in body["closes"]:
        connection.execute("INSERT INTO closed VALUES (?, ?)", (closed, operation.op_uuid))
    for mark in body.get("marks", ()):
        _store_mark(connection, operation, mark)
    for opinion in body.get("opinions", ()):
        connection.execute(
            "INSERT INTO opinion VALUES (:op_uuid, :episode, :x_um, :y_um, :theta_mdeg, :sigma_um,"
            " :verdict)",
            {**opinion, "op_uuid": operation.op_uuid},
        )
    for step in body.get("apart", ()):
        connection.execute(_INSERT_APART, {**step, "op_uuid": operation.op_uuid})


_INSERT_REVISION = """
INSERT INTO label_rev (rev_uuid, op_uuid, episode, parent, x_um, y_um, theta_mdeg, sigma_um,
    source, state, reason, verdict, geometry, note, copy_of)
VALUES (:rev_uuid, :op_uuid, :episode, :parent, :x_um, :y_um, :theta_mdeg, :sigma_um,
    :source, :state, :reason, :verdict, :geometry, :note, :copy_of)
"""
_INSERT_APART = """
INSERT INTO apart VALUES (:op_uuid, :episode, :rev_uuid, :parent, :x_um, :y_um, :theta_mdeg,
    :sigma_um, :source, :state, :reason, :verdict, :geometry, :note, :copy_of, :deleted, :skipped,
    :shown_ns, :beside)
"""


def _store_mark(
    connection: sqlite3.Connection, operation: Operation, mark: Mapping[str, Any]
) -> None:
    # The mark of the greatest (lamport, site) wins, so the order of arrival does not matter.
    own = {name: getattr(operation, name) for name in ("op_uuid", "lamport", "site")}
    owner = operation.op_uuid if mark["owner"] is None else mark["owner"]
    connection.execute(
        "INSERT INTO mark VALUES (:episode, :name, :present, :note, :op_uuid, :lamport, :site,"
        " :owner) ON CONFLICT DO UPDATE SET"
        " present = excluded.present, note = excluded.note, op_uuid = excluded.op_uuid,"
        " lamport = excluded.lamport, site = excluded.site, owner = excluded.owner"
        " WHERE (excluded.lamport, excluded.site) > (mark.lamport, mark.site)",
        {**mark, **own, "owner": owner},
    )


def read_mark(
    connection: sqlite3.Connection, episode: str, name: str, *, present: bool, note: str = ""
) -> EpisodeMark:
    """Return a mark for the body of an operation, with the previous state."""
    row = connection.execute(
        "SELECT present, note, owner FROM mark WHERE episode = ? AND name = ?", (episode, name)
    ).fetchone()
    was, was_note, was_owner = row or (0, "", "")
    return EpisodeMark(
        episode=episode,
        name=name,
        present=present,
        note=note,
        owner=None,
        was=bool(was),
        was_note=was_note,
        was_owner=was_owner,
    )


def read_operations(
    connection: sqlite3.Connection, where: str = "", values: Iterable[object] = ()
) -> list[Operation]:
    """Return operations ordered by (lamport, site, seq); ``where`` is a constant SQL condition."""
    condition = f"WHERE {where}" if where else ""
    rows = connection.execute(
        f"SELECT {COLUMNS} FROM op {condition} ORDER BY lamport, site, seq",  # noqa: S608
        tuple(values),
    )
    return [as_operation(row) for row in rows]


def as_operation(row: tuple[Any, ...]) -> Operation:
    """Return the operation of a row of ``COLUMNS``."""
    values = dict(zip(FIELDS, row, strict=True))
    return Operation(**values | {"body": parse_json(values["body"])})


# Columns of ``as_revision``, from ``label_rev r JOIN op o USING (op_uuid)``.
REVISION = (
    "r.rev_uuid, r.op_uuid, r.episode, r.parent, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um,"
    " r.source, r.state, r.reason, r.verdict, r.geometry, r.note, o.actor, o.at_ns"
)
_REVISIONS = f"SELECT {REVISION} FROM label_rev r JOIN op o USING (op_uuid)"  # noqa: S608


def as_revision(row: tuple[Any, ...]) -> Revision:
    """Return the revision of a row of ``REVISION``."""
    values = (*row[:4], Label(*row[4:8]), *row[8:])
    return Revision(*values)


def read_revisions(connection: sqlite3.Connection, episode: str) -> list[Revision]:
    """Return all revisions of an episode, oldest first."""
    sql = f"{_REVISIONS} WHERE r.episode = ? ORDER BY o.lamport, o.site, r.rev_uuid"
    return [as_revision(row) for row in connection.execute(sql, (episode,))]


def read_revision(connection: sqlite3.Connection, rev_uuid: str) -> Revision:
    """Return one revision."""
    return as_revision(
        connection.execute(f"{_REVISIONS} WHERE r.rev_uuid = ?", (rev_uuid,)).fetchone()
    )


def read_head(connection: sqlite3.Connection, episode: str) -> Revision | None:
    """Return the valid revision of an episode, or None."""
    sql = "SELECT rev_uuid FROM label_head WHERE episode = ?"
    row = connection.execute(f"{_REVISIONS} WHERE r.rev_uuid = ({sql})", (episode,)).fetchone()
    return row and as_revision(row)


def newest_operations(connection: sqlite3.Connection) -> dict[str, tuple[int, str]]:
    """Return number and hash of the newest operation per site."""
    # Skip scan over the index; GROUP BY would read every operation.
    rows = connection.execute(
        "WITH RECURSIVE s(site) AS (SELECT min(site) FROM op UNION ALL"
        " SELECT (SELECT min(op.site) FROM op WHERE op.site > s.site) FROM s"
        " WHERE s.site IS NOT NULL)"
        " SELECT op.site, op.seq, op.hash FROM s JOIN op ON op.site = s.site"
        " AND op.seq = (SELECT max(o.seq) FROM op o WHERE o.site = s.site) ORDER BY op.site"
    )
    return {site: (seq, digest) for site, seq, digest in rows}


TAIL_BYTES = 65_536
LINES_PER_WRITE = 100  # the operation of a pack has the revisions of 500 episodes


class OperationJournal:
    """Journals of one dataset, one file per site."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._written: dict[str, int] = {}

    def path(self, site: str) -> Path:
        """Return the journal of ``site``."""
        return self.folder / f"{site}.jsonl"

    def catch_up(
        self, connection: sqlite3.Connection, site: str, *, rewritten: bool = False
    ) -> int:
        """Append the operations that the journal of ``site`` lacks; return their number.

        An incomplete last line is removed first. ``rewritten``: the file was moved away. Raises
        ``OSError`` if the disk fails.
        """
        path = self.path(site)
        last = None if rewritten else self._written.get(site)
        if last is None:
            last = _cut_torn_line(path)
        # Unknown until written, so that the next call looks again after a failure.
        self._written.pop(site, None)
        first, where = last, "site = ? AND seq > ? AND seq <= ?"
        while missing := read_operations(connection, where, (site, last, last + LINES_PER_WRITE)):
            # not ``asdict``, which copies the body of a bulk operation
            rows = ({name: getattr(operation, name) for name in FIELDS} for operation in missing)
            append_line(path, b"\n".join(map(canonical_json, rows)))
            last = missing[-1].seq
        self._written[site] = last
        return last - first


def read_journal(path: Path) -> Iterator[Operation]:
    """Yield the operations of a journal, without an incomplete last line.

    Raises ``ValueError`` with the line number for any other damage.
    """
    for number, line in enumerate(path.read_bytes().splitlines(keepends=True), start=1):
        if not line.endswith(b"\n"):
            return
        try:
            yield Operation(**parse_json(line))
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path.name}, line {number}: {error}") from error


def line_numbers(path: Path) -> Iterator[int]:
    """Yield the sequence number of each readable line of a journal."""
    for line in path.read_bytes().splitlines():
        with suppress(ValueError, TypeError, KeyError):
            yield int(parse_json(line)["seq"])


def _cut_torn_line(path: Path) -> int:
    """Remove an incomplete last line; return the last sequence number (0 if none)."""
    if not path.exists():
        return 0
    line, end = read_last_line(path)
    if end < path.stat().st_size:
        os.truncate(path, end)
    try:
        return int(parse_json(line)["seq"]) if line else 0
    except (ValueError, TypeError, KeyError):
        last = 0
        with suppress(ValueError):
            for operation in read_journal(path):
                last = operation.seq
        return last


def read_last_line(path: Path) -> tuple[bytes, int]:
    """Return the last complete line of a file (b"" if there is none) and the offset of its end."""
    size, length = path.stat().st_size, TAIL_BYTES
    with path.open("rb") as file:
        while True:
            start = max(0, size - length)
            file.seek(start)
            tail = file.read()
            if not start or tail.count(b"\n") >= 2:
                end = tail.rfind(b"\n") + 1
                return tail[tail.rfind(b"\n", 0, max(end - 1, 0)) + 1 : end], start + end
            length *= 4


_STEPS = (
    f"SELECT {REVISION}, r.copy_of, r.deleted, r.skipped, r.beside"  # noqa: S608
    " FROM apart r JOIN op o USING (op_uuid) WHERE o.actor = ?"
)
_IN_ORDER = " ORDER BY o.lamport, o.site, o.seq"


def read_steps(connection: sqlite3.Connection, person: str, uuid: str) -> list[ControlItemStep]:
    """Return the steps of ``person`` on one control item, oldest first."""
    rows = connection.execute(f"{_STEPS} AND r.episode = ?{_IN_ORDER}", (person, uuid))
    return list(_steps(rows))


def last_steps(connection: sqlite3.Connection, person: str) -> dict[str, ControlItemStep]:
    """Return the latest step of ``person`` on each control item."""
    rows = connection.execute(_STEPS + _IN_ORDER, (person,))
    return {step.version.episode: step for step in _steps(rows)}


def _steps(rows: sqlite3.Cursor) -> Iterator[ControlItemStep]:
    for row in rows:
        copy_of, deleted, skipped, beside = row[16:]
        yield ControlItemStep(as_revision(row[:16]), copy_of, deleted, bool(skipped), beside)


def add_step(draft: OperationDraft, step: ControlItemStep) -> None:
    """Add a step on a control item; a decision is also stored as an opinion."""
    r = step.version
    content = new_revision(r.episode, r.parent, LabelContent.of(r), r.state, r.reason)
    draft.apart.append({
        **content, "rev_uuid": r.rev_uuid, "copy_of": step.copy_of, "deleted": step.deleted,
        "skipped": step.skipped, "shown_ns": 0, "beside": step.beside,
    })  # fmt: skip
    if step.answer is not None:
        draft.opinions.append({"episode": r.episode, "verdict": r.verdict} | asdict(step.answer))


def take_back_step(
    connection: sqlite3.Connection, draft: OperationDraft, operation: Operation, uuid: str
) -> None:
    """Add the step that reverts ``operation``; its opinion is added or removed as well."""
    steps = read_steps(connection, operation.actor, uuid)
    at = [step.version.op_uuid for step in steps].index(operation.op_uuid)
    done, now = steps[at], steps[-1]
    recorded = replace(
        done, version=read_revisions(connection, uuid)[0], copy_of=None, deleted="", skipped=False
    )
    before = steps[at - 1] if at else recorded
    if done.version.rev_uuid == before.version.rev_uuid:
        step = replace(now, deleted=before.deleted, skipped=before.skipped)
    else:
        old = before.version
        version = replace(old, rev_uuid=uuid7(), parent=now.version.rev_uuid)
        step = replace(now, version=version, copy_of=old.rev_uuid)
    add_step(draft, step)
    if step.answer is not None:
        seen_ms, blind = connection.execute(
            "SELECT json_extract(body, '$.seen_ms'), json_extract(body, '$.blind') FROM op"
            " WHERE op_uuid = ?",
            (before.version.op_uuid,),
        ).fetchone()
        draft.extra |= {} if seen_ms is None else {"seen_ms": seen_ms, "blind": bool(blind)}
    elif now.answer is not None:
        draft.opinions.append({"episode": uuid, "verdict": None} | asdict(NO_LABEL))
