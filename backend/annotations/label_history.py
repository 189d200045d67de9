"""History of the labels: heads, marks, log entries, undo and redo stacks.

Undo and redo are computed from the log, so they survive a restart and have no limit.
"""

from __future__ import annotations

import json
import math
import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from touchdown.backend.annotations import operation_log, review
from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.operation_log import (
    COLUMNS,
    REVERSING,
    EpisodeMark,
    OperationDraft,
    as_operation,
    new_revision,
    newest_operations,
    read_head,
    read_revision,
    read_revisions,
)
from touchdown.backend.annotations.review import ReviewStatus, RevisionNode, leaves_of, read_nodes
from touchdown.backend.annotations.values import (
    NO_LABEL,
    ControlItemStep,
    LabelContent,
    LabelState,
    Operation,
    Revision,
    uuid7,
)
from touchdown.backend.core import FloatArray, InputError, RefusedError


class LabelReader:
    """Read access to the labels of one dataset."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def head(self, uuid: str) -> Revision:
        """Return the valid revision; raises ``InputError`` if there is no such episode."""
        with self._database.reading() as connection:
            head = read_head(connection, uuid)
        if head is None:
            raise _unknown(uuid)
        return head

    def offsets_mm(self, uuids: Sequence[str]) -> FloatArray:
        """Return the offsets (n, 2) of the valid revisions; NaN without offset."""
        found: dict[str, tuple[float, float]] = {}
        sql = (
            "SELECT h.episode, r.x_um, r.y_um FROM label_head h JOIN label_rev r USING (rev_uuid)"
            " WHERE r.x_um NOTNULL AND h.episode IN (SELECT value FROM json_each(?))"
        )
        for uuid, x_um, y_um in self._database.rows(sql, (json.dumps(list(uuids)),)):
            found[uuid] = x_um / 1e3, y_um / 1e3
        nowhere = (math.nan, math.nan)
        places = [found.get(uuid, nowhere) for uuid in uuids]
        return np.array(places, dtype=np.float64).reshape(-1, 2)

    def history(self, uuid: str) -> list[Revision]:
        """Return all revisions of an episode, oldest first, including branches of a merge.

        An approved revision that a later approved one replaced has the state ``superseded``.
        """
        with self._database.reading() as connection:
            found = read_revisions(connection, uuid)
            nodes, closed = review.read_nodes(connection, uuid)
        head = review.head_of(nodes, closed)
        old = review.superseded_revisions(nodes, head.counting) if head else set[str]()
        return [replace(r, state="superseded") if r.rev_uuid in old else r for r in found]

    def conflicting(self, uuid: str) -> list[Revision]:
        """Return the leaves of an episode, head last; more than one leaf is a conflict."""
        with self._database.reading() as connection:
            leaves = review.leaves_of(*review.read_nodes(connection, uuid))
            return [read_revision(connection, leaf.rev_uuid) for leaf in leaves]

    def marks(self, uuid: str) -> dict[str, str]:
        """Return the marks of an episode (flag, deleted, tags) with their notes."""
        sql = "SELECT name, note FROM mark WHERE episode = ? AND present ORDER BY name"
        return dict(self._database.rows(sql, (uuid,)))

    def control_item_steps(self, person: str, uuid: str) -> list[ControlItemStep]:
        """Return the steps of ``person`` on one control item, oldest first."""
        with self._database.reading() as connection:
            return operation_log.read_steps(connection, person, uuid)

    def last_control_item_steps(self, person: str) -> dict[str, ControlItemStep]:
        """Return the latest step of ``person`` on each control item."""
        with self._database.reading() as connection:
            return operation_log.last_steps(connection, person)

    def counting(self, uuid: str) -> Revision | None:
        """Return the approved revision used for training, or None."""
        sql = "SELECT counting FROM label_head WHERE episode = ? AND NOT conflict AND NOT deleted"
        with self._database.reading() as connection:
            row = connection.execute(sql, (uuid,)).fetchone()
            return read_revision(connection, row[0]) if row and row[0] else None

    def log(self, *, text: str = "", limit: int = 500) -> list[Operation]:
        """Return operations that contain ``text`` (person, verb, content), newest first."""
        rows = self._database.rows(
            f"SELECT {COLUMNS} FROM op WHERE instr(body || ' ' || verb || ' ' || actor, ?) > 0"  # noqa: S608
            " ORDER BY lamport DESC, site DESC, seq DESC LIMIT ?",
            (text, limit),
        )
        return [as_operation(row) for row in rows]

    def people(self) -> list[str]:
        """Return the names of all persons who changed labels."""
        return [name for (name,) in self._database.rows("SELECT DISTINCT actor FROM op ORDER BY 1")]

    def chain_heads(self) -> dict[str, str]:
        """Return the newest hash per site, for backups, manifests and training runs."""
        with self._database.reading() as connection:
            return {site: digest for site, (_, digest) in newest_operations(connection).items()}


def read_review_status(connection: sqlite3.Connection, uuid: str) -> ReviewStatus:
    """Return the review status; raises ``InputError`` if there is no such episode."""
    row = connection.execute(
        "SELECT state, authors, counting, conflict, deleted FROM label_head WHERE episode = ?",
        (uuid,),
    ).fetchone()
    if row is None:
        raise _unknown(uuid)
    state, authors, counting, conflict, deleted = row
    return ReviewStatus(
        state, review.split_names(authors), counting is not None, bool(conflict), bool(deleted)
    )


def _unknown(uuid: str) -> InputError:
    return InputError("There is no such episode.", uuid, "List the episodes of the dataset.")


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
        if verb not in REVERSING:
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


def inverse_draft(connection: sqlite3.Connection, operation: Operation) -> OperationDraft:
    """Return the draft that reverts ``operation``.

    Raises ``RefusedError`` with the name of a person who changed one of its episodes since. A
    change that was itself undone does not count.
    """
    draft = OperationDraft()
    body: Mapping[str, Any] = operation.body
    by_episode: dict[str, list[str]] = {}
    for rev in body["revs"]:
        by_episode.setdefault(rev["episode"], []).append(rev["rev_uuid"])
    for episode, written in by_episode.items():
        nodes, closed = read_nodes(connection, episode)
        _take_back(connection, draft, _EpisodeHistory(nodes, closed), written)
    for rev_uuid in body["closes"]:
        retired = read_revision(connection, rev_uuid)
        draft.add_copy(following(retired, retired), rev_uuid)
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
        while node.verb in REVERSING:
            if node.copy_of is None:
                return None
            node = self.by_id[node.copy_of]
        return node.rev_uuid


def _take_back(
    connection: sqlite3.Connection,
    draft: OperationDraft,
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
        if node.verb in REVERSING and node.copy_of == node.parent:
            # It had reopened a closed revision: close it again.
            draft.closes.append(leaf)
            continue
        now = read_revision(connection, leaf)
        if node.parent is None:
            content = LabelContent(NO_LABEL, now.source, now.geometry)
            draft.revs.append(new_revision(now.episode, leaf, content, "unlabelled"))
        else:
            before = read_revision(connection, node.parent)
            draft.add_copy(following(now, before), node.parent)


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


def _renumber(connection: sqlite3.Connection, draft: OperationDraft) -> None:
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
) -> EpisodeMark:
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
    return EpisodeMark(
        episode=mark["episode"],
        name=mark["name"],
        present=mark["was"],
        note=mark["was_note"],
        owner=mark["was_owner"],
        was=mark["present"],
        was_note=mark["note"],
        was_owner=owner,
    )
