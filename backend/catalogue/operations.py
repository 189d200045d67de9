"""The log of operations: appended to, hashed, and turned into the tables that derive from it.

Storing is the same for an operation made here, merged from another dataset or replayed from the
journal, so that equal sets of operations give equal catalogues whatever the order of arrival.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypedDict

from backend.catalogue.chain import FIRST, canonical, link
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import Content, Label, LabelState, Operation, Revision

COLUMNS = "op_uuid, site, seq, lamport, at_ns, actor, verb, target_op, body, prev_hash, hash"
REVERSING = ("undo", "redo")


class Mark(TypedDict):
    """A word put on an episode or taken off, and what was there before.

    ``owner``: the operation whose mark it is, None for the one that writes it; an undo gives it
    back to the one before ("" if there was none).
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
class Draft:
    """What one action is about to write. ``copies``: whose content a revision writes again.

    ``apart``: steps on gold, which are in no label.
    """

    revs: list[dict[str, Any]] = field(default_factory=list)
    closes: list[str] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)
    copies: dict[str, str] = field(default_factory=dict)
    reviews: list[Mapping[str, object]] = field(default_factory=list)
    opinions: list[Mapping[str, object]] = field(default_factory=list)
    apart: list[Mapping[str, object]] = field(default_factory=list)
    extra: dict[str, object] = field(default_factory=dict)

    def add_copy(self, revision: dict[str, Any], source: str) -> None:
        """Write ``revision``, whose content is that of the revision ``source``."""
        self.revs.append(revision)
        self.copies[revision["rev_uuid"]] = source

    def body(self) -> dict[str, object]:
        """Return the body of the operation; empty optional parts are left out."""
        body: dict[str, object] = {"closes": list(self.closes), "revs": list(self.revs)}
        for name in ("marks", "copies", "reviews", "opinions", "apart"):
            if getattr(self, name):
                body[name] = getattr(self, name)
        return body | self.extra


def new_revision(
    episode: str,
    parent: str | None,
    content: Content,
    state: LabelState,
    reason: str | None = None,
) -> dict[str, Any]:
    """Return the columns of a new revision as they stand in the body of its operation."""
    label = content.label
    return {
        "rev_uuid": uuid7(),
        "episode": episode,
        "parent": parent,
        "x_um": label.x_um,
        "y_um": label.y_um,
        "theta_mdeg": label.theta_mdeg,
        "sigma_um": label.sigma_um,
        "source": content.source,
        "state": state,
        "reason": reason,
        "verdict": content.verdict,
        "geometry": content.geometry,
        "note": content.note,
    }


def append(
    connection: sqlite3.Connection,
    site: str,
    actor: str,
    verb: str,
    draft: Draft,
    target_op: str | None = None,
) -> tuple[Operation, set[str]]:
    """Make the next operation of ``site`` and store it, within the caller's transaction.

    Returns it and the episodes whose heads to refresh.
    """
    last = connection.execute(
        "SELECT seq, hash FROM op WHERE site = ? ORDER BY seq DESC LIMIT 1", (site,)
    ).fetchone()
    seq, previous = last if last else (0, FIRST)
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
    operation = Operation(**content, hash=link(unsigned))
    return operation, store(connection, operation)


def store(connection: sqlite3.Connection, operation: Operation) -> set[str]:
    """Insert ``operation`` and what it says; return the episodes whose heads to refresh.

    What it refers to must be there: store in the order of (lamport, site, seq). Raises
    ``sqlite3.IntegrityError`` if it is there already, or its site has another of that number.
    """
    connection.execute(
        f"INSERT INTO op ({COLUMNS}) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",  # noqa: S608
        (
            operation.op_uuid,
            operation.site,
            operation.seq,
            operation.lamport,
            operation.at_ns,
            operation.actor,
            operation.verb,
            operation.target_op,
            canonical(operation.body).decode("utf-8"),
            operation.prev_hash,
            operation.hash,
        ),
    )
    _store_body(connection, operation)
    return _touched(connection, operation)


def _touched(connection: sqlite3.Connection, operation: Operation) -> set[str]:
    body: Mapping[str, Any] = operation.body
    named = {part["episode"] for part in (*body["revs"], *body.get("marks", ()))}
    return named.union(*(_episode_of(connection, closed) for closed in body["closes"]))


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
    for review in body.get("reviews", ()):
        seen, blind = body.get("seen_ms"), body.get("blind")
        who = (operation.op_uuid, review["rev_uuid"], operation.actor)
        what = (review["decision"], review["reason"], seen, blind)
        connection.execute("INSERT INTO review VALUES (?, ?, ?, ?, ?, ?, ?)", (*who, *what))
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


def _episode_of(connection: sqlite3.Connection, rev_uuid: str) -> set[str]:
    row = connection.execute("SELECT episode FROM label_rev WHERE rev_uuid = ?", (rev_uuid,))
    return {episode for (episode,) in row}


def _store_mark(
    connection: sqlite3.Connection, operation: Operation, mark: Mapping[str, Any]
) -> None:
    # The mark of the greatest (lamport, site) stays, so that the order of arrival does not matter.
    connection.execute(
        "INSERT INTO mark VALUES (?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT DO UPDATE SET"
        " present = excluded.present, note = excluded.note, op_uuid = excluded.op_uuid,"
        " lamport = excluded.lamport, site = excluded.site, owner = excluded.owner"
        " WHERE (excluded.lamport, excluded.site) > (mark.lamport, mark.site)",
        (
            mark["episode"],
            mark["name"],
            int(mark["present"]),
            mark["note"],
            operation.op_uuid,
            operation.lamport,
            operation.site,
            operation.op_uuid if mark["owner"] is None else mark["owner"],
        ),
    )


def mark_of(
    connection: sqlite3.Connection, episode: str, name: str, *, present: bool, note: str = ""
) -> Mark:
    """Return the mark for the body of an operation, with what was there before."""
    row = connection.execute(
        "SELECT present, note, owner FROM mark WHERE episode = ? AND name = ?", (episode, name)
    ).fetchone()
    was, was_note, was_owner = row or (0, "", "")
    return Mark(
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
    """Return operations in (lamport, site, seq) order; ``where`` is a constant SQL condition."""
    condition = f"WHERE {where}" if where else ""
    rows = connection.execute(
        f"SELECT {COLUMNS} FROM op {condition} ORDER BY lamport, site, seq",  # noqa: S608
        tuple(values),
    )
    return [as_operation(row) for row in rows]


def as_operation(row: tuple[Any, ...]) -> Operation:
    """Return the operation of a row of ``COLUMNS``."""
    op_uuid, site, seq, lamport, at_ns, actor, verb, target, body, previous, digest = row
    content = json.loads(body)
    return Operation(
        op_uuid, site, seq, lamport, at_ns, actor, verb, target, content, previous, digest
    )


REVISION = (
    "r.rev_uuid, r.op_uuid, r.episode, r.parent, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um,"
    " r.source, r.state, r.reason, r.verdict, r.geometry, r.note, o.actor, o.at_ns"
)
"""Columns of ``as_revision``, from ``label_rev r JOIN op o USING (op_uuid)``."""


def as_revision(row: tuple[Any, ...]) -> Revision:
    """Return the revision of a row of ``REVISION``."""
    rev_uuid, op_uuid, episode, parent, *label, source, state = row[:10]
    reason, verdict, geometry, note, person, at_ns = row[10:]
    return Revision(
        rev_uuid, op_uuid, episode, parent, Label(*label), source, state, reason, verdict, geometry,
        note, person, at_ns,
    )  # fmt: skip


def read_revision(connection: sqlite3.Connection, rev_uuid: str) -> Revision:
    """Return one revision as written."""
    row = connection.execute(
        f"SELECT {REVISION} FROM label_rev r JOIN op o USING (op_uuid)"  # noqa: S608
        " WHERE r.rev_uuid = ?",
        (rev_uuid,),
    ).fetchone()
    return as_revision(row)


def newest_of(connection: sqlite3.Connection) -> dict[str, tuple[int, str]]:
    """Return number and hash of the newest operation per site."""
    # From site to site by the index: GROUP BY would pass over every operation.
    rows = connection.execute(
        "WITH RECURSIVE s(site) AS (SELECT min(site) FROM op UNION ALL"
        " SELECT (SELECT min(op.site) FROM op WHERE op.site > s.site) FROM s"
        " WHERE s.site IS NOT NULL)"
        " SELECT op.site, op.seq, op.hash FROM s JOIN op ON op.site = s.site"
        " AND op.seq = (SELECT max(o.seq) FROM op o WHERE o.site = s.site) ORDER BY op.site"
    )
    return {site: (seq, digest) for site, seq, digest in rows}
