"""Undo and redo of label changes, computed from the log: no limit, and they survive a restart.

``LabelStore.undo`` and ``redo`` write the drafts made here as operations of their own.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from touchdown.backend.annotations import operation_log
from touchdown.backend.annotations.review import RevisionNode, leaves_of, read_nodes
from touchdown.backend.annotations.values import NO_LABEL, LabelContent, Operation, uuid7
from touchdown.backend.core import RefusedError

# Verbs of operations by the program, which cannot be undone.
NO_STEPS = ("record", "adopt", "import", "label.opinion")


@dataclass(slots=True)
class UndoStacks:
    """Operations of one person to undo, and undo operations to redo; the latest on top."""

    undo: list[str] = field(default_factory=list)
    redo: list[str] = field(default_factory=list)

    def apply(self, op_uuid: str, verb: str, target: str | None) -> None:
        """Update the stacks with the next operation of the person."""
        if verb in NO_STEPS:
            return
        done = self.redo if verb == "redo" else self.undo
        if verb not in operation_log.REVERSING:
            self.redo.clear()
        elif target in done:
            # After a merge the operations of two sites interleave: it may not be the topmost.
            done.remove(target)
        (self.redo if verb == "undo" else self.undo).append(op_uuid)


def read_undo_stacks(connection: sqlite3.Connection, person: str) -> UndoStacks:
    """Return the stacks of ``person``, computed from the whole log."""
    stacks = UndoStacks()
    rows = connection.execute(
        "SELECT op_uuid, verb, target_op FROM op WHERE actor = ? ORDER BY lamport, site, seq",
        (person,),
    )
    for op_uuid, verb, target in rows:
        stacks.apply(op_uuid, verb, target)
    return stacks


def inverse_draft(
    connection: sqlite3.Connection, operation: Operation
) -> operation_log.OperationDraft:
    """Return the draft that reverts ``operation``.

    Raises ``RefusedError`` with the name of a person who changed one of its episodes since. A
    change that was itself undone does not count.
    """
    draft = operation_log.OperationDraft()
    body: Mapping[str, Any] = operation.body
    by_episode: dict[str, list[str]] = {}
    for rev in body["revs"]:
        by_episode.setdefault(rev["episode"], []).append(rev["rev_uuid"])
    for episode, written in by_episode.items():
        nodes, closed = read_nodes(connection, episode)
        _take_back(connection, draft, _EpisodeHistory(nodes, closed), written)
    for rev_uuid in body["closes"]:
        retired = operation_log.read_revision(connection, rev_uuid)
        draft.add_copy(operation_log.following(retired, retired), rev_uuid)
    # The former head has to be the head again: the leaf of the greatest id wins, and ids rise.
    if body["closes"]:
        _renumber(connection, draft)
    for mark in body.get("marks", ()):
        draft.marks.append(_unmark(connection, operation, mark))
    for step in body.get("apart", ()):
        operation_log.take_back_step(connection, draft, operation, step["episode"])
    return draft


class _EpisodeHistory:
    """Revisions of one episode, and the originals behind its leaves."""

    def __init__(self, nodes: list[RevisionNode], closed: Iterable[str]) -> None:
        self.by_id = {node.rev_uuid: node for node in nodes}
        self.leaves = {self.original(leaf): leaf for leaf in leaves_of(nodes, closed)}

    def original(self, node: RevisionNode) -> str | None:
        """Return the revision that ``node`` restored, or itself; None for the first one."""
        while node.verb in operation_log.REVERSING:
            if node.copy_of is None:
                return None
            node = self.by_id[node.copy_of]
        return node.rev_uuid


def _take_back(
    connection: sqlite3.Connection,
    draft: operation_log.OperationDraft,
    story: _EpisodeHistory,
    written: Iterable[str],
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
        if node.verb in operation_log.REVERSING and node.copy_of == node.parent:
            # It had reopened a closed revision: close it again.
            draft.closes.append(leaf)
            continue
        now = operation_log.read_revision(connection, leaf)
        if node.parent is None:
            content = LabelContent(NO_LABEL, now.source, now.geometry)
            draft.revs.append(operation_log.new_revision(now.episode, leaf, content, "unlabelled"))
        else:
            before = operation_log.read_revision(connection, node.parent)
            draft.add_copy(operation_log.following(now, before), node.parent)


def _renumber(connection: sqlite3.Connection, draft: operation_log.OperationDraft) -> None:
    revs, copies = draft.revs, draft.copies
    sql = "SELECT o.lamport, o.site FROM label_rev r JOIN op o USING (op_uuid) WHERE r.rev_uuid = ?"

    def order(rev: Mapping[str, Any]) -> tuple[int, str, str]:
        source = copies[rev["rev_uuid"]]
        return (*connection.execute(sql, (source,)).fetchone(), source)

    revs.sort(key=order)
    draft.revs, draft.copies = [], {}
    for rev in revs:
        draft.add_copy({**rev, "rev_uuid": uuid7()}, copies[rev["rev_uuid"]])


def _unmark(
    connection: sqlite3.Connection, operation: Operation, mark: Mapping[str, Any]
) -> operation_log.EpisodeMark:
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
    return operation_log.EpisodeMark(
        episode=mark["episode"],
        name=mark["name"],
        present=mark["was"],
        note=mark["was_note"],
        owner=mark["was_owner"],
        was=mark["present"],
        was_note=mark["note"],
        was_owner=owner,
    )
