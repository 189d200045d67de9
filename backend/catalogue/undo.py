"""Undo and redo, recomputed from the log: they survive restarts and have no limit.

Undoing an operation writes new revisions with the former content; it never removes any. A redo is
the undo of an undo.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from backend.catalogue.heads import Node, leaves_of, read_nodes
from backend.catalogue.operations import Draft, Mark, new_revision, read_revision
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import NO_LABEL, Content, Operation, Revision
from backend.core.faults import RefusedError

NO_STEPS = ("record", "adopt", "import")
"""Verbs that are no action of a person, so that no undo takes them back."""


@dataclass(slots=True)
class Stacks:
    """Operations of one person that can be undone, and undos that can be redone; last on top."""

    undo: list[str] = field(default_factory=list)
    redo: list[str] = field(default_factory=list)

    def apply(self, op_uuid: str, verb: str, target: str | None) -> None:
        """Take note of the next operation of the person."""
        if verb in NO_STEPS:
            return
        if verb == "undo":
            self._move(target, self.undo)
            self.redo.append(op_uuid)
        elif verb == "redo":
            self._move(target, self.redo)
            self.undo.append(op_uuid)
        else:
            self.undo.append(op_uuid)
            self.redo.clear()

    @staticmethod
    def _move(target: str | None, stack: list[str]) -> None:
        # After a merge the operations of two sites interleave: it need not be the topmost.
        if target in stack:
            stack.remove(str(target))


def read_stacks(connection: sqlite3.Connection, person: str) -> Stacks:
    """Return the stacks of ``person`` from the whole log."""
    stacks = Stacks()
    rows = connection.execute(
        "SELECT op_uuid, verb, target_op FROM op WHERE actor = ? ORDER BY lamport, site, seq",
        (person,),
    )
    for op_uuid, verb, target in rows:
        stacks.apply(op_uuid, verb, target)
    return stacks


def inverse(connection: sqlite3.Connection, operation: Operation) -> Draft:
    """Return what takes ``operation`` back.

    Raises ``RefusedError``, naming who, if anybody changed one of its episodes since.
    """
    draft = Draft()
    body: Mapping[str, Any] = operation.body
    by_episode: dict[str, list[str]] = {}
    for rev in body["revs"]:
        by_episode.setdefault(rev["episode"], []).append(rev["rev_uuid"])
    for episode, written in by_episode.items():
        nodes, closed = read_nodes(connection, episode)
        _refuse_later_change(nodes, closed, set(written))
        _take_back(connection, draft, written, {node.rev_uuid: node for node in nodes}, closed)
    for rev_uuid in body["closes"]:
        _reopen(connection, draft, rev_uuid)
    # Of several leaves the one that led before has to lead again: ids decide, and they rise.
    _renumber(connection, draft)
    for mark in body.get("marks", ()):
        draft.marks.append(_unmark(connection, operation, mark))
    return draft


def _refuse_later_change(nodes: list[Node], closed: Iterable[str], written: set[str]) -> None:
    if {leaf.rev_uuid for leaf in leaves_of(nodes, closed)} == written:
        return
    latest = max((n for n in nodes if n.rev_uuid not in written), key=lambda n: n.order)
    later = [n for n in nodes if n.parent in written]
    who = (later or [latest])[-1].actor
    raise RefusedError("changed since", f"{who} changed this label since: undo would lose that.")


def _take_back(
    connection: sqlite3.Connection,
    draft: Draft,
    written: Iterable[str],
    by_id: Mapping[str, Node],
    closed: Iterable[str],
) -> None:
    was_closed = set(closed)
    for rev_uuid in written:
        node = by_id[rev_uuid]
        if node.parent in was_closed:
            # It had reopened a retired revision: retire it again.
            draft.closes.append(rev_uuid)
            continue
        now = read_revision(connection, rev_uuid)
        before = None if node.parent is None else read_revision(connection, node.parent)
        draft.revs.append(_copy(now, before))


def _reopen(connection: sqlite3.Connection, draft: Draft, rev_uuid: str) -> None:
    now = read_revision(connection, rev_uuid)
    copy = _copy(now, now)
    draft.revs.append(copy)
    draft.repeats.append(str(copy["rev_uuid"]))


def _copy(parent: Revision, before: Revision | None) -> dict[str, Any]:
    if before is None:
        content = Content(NO_LABEL, parent.source, parent.geometry)
        return new_revision(parent.episode, parent.rev_uuid, content, "unlabelled")
    content = Content.of(before)
    return new_revision(parent.episode, parent.rev_uuid, content, before.state, before.reason)


def _renumber(connection: sqlite3.Connection, draft: Draft) -> None:
    """Give the ids of ``draft.revs`` anew in the order in which what they copy stood."""
    if not draft.repeats:
        return
    repeats = set(draft.repeats)
    placed = []
    for rev in draft.revs:
        source = str(rev["parent"])
        if rev["rev_uuid"] not in repeats:
            source = _parent_of(connection, source) or source
        placed.append((_order(connection, source), rev))
    placed.sort(key=lambda pair: pair[0])
    draft.revs, draft.repeats = [], []
    for _, rev in placed:
        renewed = {**rev, "rev_uuid": uuid7()}
        draft.revs.append(renewed)
        if rev["rev_uuid"] in repeats:
            draft.repeats.append(renewed["rev_uuid"])


def _order(connection: sqlite3.Connection, rev_uuid: str) -> tuple[int, str, str]:
    row = connection.execute(
        "SELECT o.lamport, o.site, r.rev_uuid FROM label_rev r JOIN op o USING (op_uuid)"
        " WHERE r.rev_uuid = ?",
        (rev_uuid,),
    ).fetchone()
    return int(row[0]), str(row[1]), str(row[2])


def _parent_of(connection: sqlite3.Connection, rev_uuid: str) -> str | None:
    row = connection.execute(
        "SELECT parent FROM label_rev WHERE rev_uuid = ?", (rev_uuid,)
    ).fetchone()
    return row[0] if row else None


def _unmark(connection: sqlite3.Connection, operation: Operation, mark: Mapping[str, Any]) -> Mark:
    where = (mark["episode"], mark["name"])
    row = connection.execute(
        "SELECT m.op_uuid, o.actor FROM mark m JOIN op o USING (op_uuid)"
        " WHERE m.episode = ? AND m.name = ?",
        where,
    ).fetchone()
    if row is None or row[0] != operation.op_uuid:
        who = "someone" if row is None else row[1]
        raise RefusedError("changed since", f"{who} changed this mark since: undo would lose that.")
    return Mark(
        episode=mark["episode"],
        name=mark["name"],
        present=mark["was"],
        note=mark["was_note"],
        was=mark["present"],
        was_note=mark["note"],
    )
