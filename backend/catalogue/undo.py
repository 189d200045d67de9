"""Undo and redo, recomputed from the log: they survive restarts and have no limit.

Undoing an operation writes new revisions with the former content; it never removes any. A redo is
the undo of an undo.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from backend.catalogue import apart
from backend.catalogue.heads import Node, leaves_of, read_nodes
from backend.catalogue.operations import (
    REVERSING,
    Draft,
    Mark,
    new_revision,
    read_revision,
)
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import NO_LABEL, Content, Operation, Revision
from backend.core.faults import RefusedError

NO_STEPS = ("record", "adopt", "import", "label.opinion")
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

    Raises ``RefusedError``, naming who, if anybody changed one of its episodes since. A change
    that was itself undone is none.
    """
    draft = Draft()
    body: Mapping[str, Any] = operation.body
    by_episode: dict[str, list[str]] = {}
    for rev in body["revs"]:
        by_episode.setdefault(rev["episode"], []).append(rev["rev_uuid"])
    for episode, written in by_episode.items():
        nodes, closed = read_nodes(connection, episode)
        _take_back(connection, draft, _Story(nodes, closed), written)
    for rev_uuid in body["closes"]:
        retired = read_revision(connection, rev_uuid)
        draft.add_copy(_following(retired, retired), rev_uuid)
    # Of several leaves the one that led before has to lead again: ids decide, and they rise.
    if body["closes"]:
        _renumber(connection, draft)
    for mark in body.get("marks", ()):
        draft.marks.append(_unmark(connection, operation, mark))
    for step in body.get("apart", ()):
        apart.take_back(connection, draft, operation, step["episode"])
    return draft


class _Story:
    """The revisions of one episode, and what its leaves stand for."""

    def __init__(self, nodes: list[Node], closed: Iterable[str]) -> None:
        self.by_id = {node.rev_uuid: node for node in nodes}
        self.leaves = {self.original(leaf): leaf for leaf in leaves_of(nodes, closed)}

    def original(self, node: Node) -> str | None:
        """Return the revision that ``node`` brought back, or itself; None for the very start."""
        while node.verb in REVERSING:
            if node.copy_of is None:
                return None
            node = self.by_id[node.copy_of]
        return node.rev_uuid


def _take_back(
    connection: sqlite3.Connection, draft: Draft, story: _Story, written: Iterable[str]
) -> None:
    expected = {story.original(story.by_id[rev]): story.by_id[rev] for rev in written}
    others = [leaf for key, leaf in story.leaves.items() if key not in expected]
    if others or len(story.leaves) != len(expected):
        who = (others or list(story.leaves.values()))[-1].actor
        raise RefusedError(
            "changed since", f"{who} changed this label since: undo would lose that."
        )
    for key, node in expected.items():
        leaf = story.leaves[key].rev_uuid
        if node.verb in REVERSING and node.copy_of == node.parent:
            # It had reopened a retired revision: retire that again.
            draft.closes.append(leaf)
            continue
        now = read_revision(connection, leaf)
        if node.parent is None:
            content = Content(NO_LABEL, now.source, now.geometry)
            draft.revs.append(new_revision(now.episode, leaf, content, "unlabelled"))
        else:
            before = read_revision(connection, node.parent)
            draft.add_copy(_following(now, before), node.parent)


def _following(parent: Revision, said: Revision) -> dict[str, Any]:
    content = Content.of(said)
    return new_revision(parent.episode, parent.rev_uuid, content, said.state, said.reason)


def _renumber(connection: sqlite3.Connection, draft: Draft) -> None:
    """Give the copies of ``draft`` new ids, rising in the order of what they copy."""
    revs, copies = draft.revs, draft.copies
    revs.sort(key=lambda rev: _order(connection, copies[rev["rev_uuid"]]))
    draft.revs, draft.copies = [], {}
    for rev in revs:
        draft.add_copy({**rev, "rev_uuid": uuid7()}, copies[rev["rev_uuid"]])


def _order(connection: sqlite3.Connection, rev_uuid: str) -> tuple[int, str, str]:
    row = connection.execute(
        "SELECT o.lamport, o.site, r.rev_uuid FROM label_rev r JOIN op o USING (op_uuid)"
        " WHERE r.rev_uuid = ?",
        (rev_uuid,),
    ).fetchone()
    return int(row[0]), str(row[1]), str(row[2])


def _unmark(connection: sqlite3.Connection, operation: Operation, mark: Mapping[str, Any]) -> Mark:
    owner = operation.op_uuid if mark["owner"] is None else mark["owner"]
    now = connection.execute(
        "SELECT m.owner, o.actor FROM mark m JOIN op o USING (op_uuid)"
        " WHERE m.episode = ? AND m.name = ?",
        (mark["episode"], mark["name"]),
    ).fetchone()
    if now[0] != owner:
        raise RefusedError(
            "changed since", f"{now[1]} changed this mark since: undo would lose that."
        )
    return Mark(
        episode=mark["episode"],
        name=mark["name"],
        present=mark["was"],
        note=mark["was_note"],
        owner=mark["was_owner"],
        was=mark["present"],
        was_note=mark["note"],
        was_owner=owner,
    )
