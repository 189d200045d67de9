"""Review state of a label: valid revision, stage, permitted actions.

The valid revision (head) of an episode is a pure function of the set of operations.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from touchdown.backend.annotations.operation_log import REVERSING
from touchdown.backend.annotations.values import DELETED, FLAG, PROGRAM_ACTOR, SKIPPED, LabelState
from touchdown.backend.core import InputError, RefusedError

# Stage of an episode in the workflow; each has exactly one.
Stage = Literal["unlabelled", "review", "approved", "rejected", "conflicts", "deleted"]

BY_PROGRAM = ("record", "adopt")  # verbs whose revisions have no author


@dataclass(frozen=True, slots=True)
class RevisionNode:
    """Fields of a revision that determine heads.

    ``copy_of``: the revision whose content an undo, redo or resolve repeated.
    """

    rev_uuid: str
    parent: str | None
    copy_of: str | None
    state: LabelState
    geometry: str
    lamport: int
    site: str
    verb: str
    actor: str

    @property
    def order(self) -> tuple[int, str, str]:
        """Sort key among the leaves."""
        return self.lamport, self.site, self.rev_uuid

    @property
    def is_copy(self) -> bool:
        """True if the content repeats another revision."""
        return self.verb in REVERSING or self.copy_of is not None


@dataclass(frozen=True, slots=True)
class LabelHead:
    """Head of one episode and derived values.

    ``counting``: the revision used for training, that is the latest approved one up to the head
    with the geometry of the head; None for a rejected head. ``authors``: persons who wrote the
    content.
    """

    node: RevisionNode
    leaves: tuple[str, ...]
    counting: str | None
    authors: tuple[str, ...]


def leaves_of(nodes: Sequence[RevisionNode], closed: Iterable[str]) -> list[RevisionNode]:
    """Return the leaves of one episode, the head last."""
    inner = {node.parent for node in nodes} | set(closed)
    return sorted((n for n in nodes if n.rev_uuid not in inner), key=lambda n: n.order)


def head_of(nodes: Sequence[RevisionNode], closed: Iterable[str]) -> LabelHead | None:
    """Return the head of one episode from its revisions, in any order."""
    leaves = leaves_of(nodes, closed)
    if not leaves:
        return None
    by_id = {node.rev_uuid: node for node in nodes}
    head = leaves[-1]
    approved = (
        node.rev_uuid
        for node in _ancestry(head, by_id)
        if node.state == "approved" and node.geometry == head.geometry
    )
    counting = None if head.state == "rejected" else next(approved, None)
    ids = tuple(leaf.rev_uuid for leaf in leaves)
    return LabelHead(head, ids, counting, _authors(head, by_id))


def authors_of(nodes: Sequence[RevisionNode], rev_uuid: str) -> tuple[str, ...]:
    """Return the authors of the content of the revision ``rev_uuid``."""
    by_id = {node.rev_uuid: node for node in nodes}
    return _authors(by_id[rev_uuid], by_id)


def _ancestry(head: RevisionNode, by_id: Mapping[str, RevisionNode]) -> Iterator[RevisionNode]:
    """Yield ``head`` and its predecessors: the revision that each copies, else its parent."""
    node: RevisionNode | None = head
    while node is not None:
        yield node
        node = by_id.get((node.copy_of if node.is_copy else node.parent) or "")


def _authors(head: RevisionNode, by_id: Mapping[str, RevisionNode]) -> tuple[str, ...]:
    """Return the authors of the content since its last approval (reviewers are not authors)."""
    found: set[str] = set()
    for node in _ancestry(head, by_id):
        if node.verb in BY_PROGRAM or (node.state == "approved" and found):
            break
        if not node.is_copy and node.state in ("draft", "submitted"):
            found.add(node.actor)
    return tuple(sorted(found))


def superseded_revisions(nodes: Sequence[RevisionNode], counting: str | None) -> set[str]:
    """Return the approved revisions before the counting one."""
    by_id = {node.rev_uuid: node for node in nodes}
    chain = () if counting is None else _ancestry(by_id[counting], by_id)
    return {node.rev_uuid for node in chain if node.state == "approved"} - {counting or ""}


def stage_of(state: LabelState, *, conflict: bool, deleted: bool) -> Stage:
    """Return the stage of an episode."""
    if deleted:
        return "deleted"
    if conflict:
        return "conflicts"
    stages: dict[str, Stage] = {"submitted": "review", "approved": "approved"}
    return "rejected" if state == "rejected" else stages.get(state, "unlabelled")


def join_names(names: Iterable[str]) -> str:
    """Return names in one text, each between line breaks, for an exact search in SQL."""
    return "".join(f"\n{name}" for name in names) + "\n"


def split_names(text: str) -> tuple[str, ...]:
    """Return the names of a text made by ``join_names``."""
    return tuple(name for name in text.split("\n") if name)


NODES = """
SELECT r.rev_uuid, r.parent, r.copy_of, r.state, r.geometry, o.lamport, o.site, o.verb, o.actor
FROM label_rev r JOIN op o USING (op_uuid) WHERE r.episode = ?
"""
CLOSED = """
SELECT c.rev_uuid FROM closed c JOIN label_rev r USING (rev_uuid) WHERE r.episode = ?
"""


def read_nodes(
    connection: sqlite3.Connection, episode: str
) -> tuple[list[RevisionNode], list[str]]:
    """Return the revisions of one episode and the closed ones among them."""
    nodes = [RevisionNode(*row) for row in connection.execute(NODES, (episode,))]
    closed = [rev for (rev,) in connection.execute(CLOSED, (episode,))] if nodes else []
    return nodes, closed


def head_row(connection: sqlite3.Connection, episode: str) -> tuple[object, ...] | None:
    """Return the row of ``label_head`` that follows from the revisions, None without revisions."""
    head = head_of(*read_nodes(connection, episode))
    if head is None:
        return None
    sql = "SELECT name FROM mark WHERE episode = ? AND present"
    names = {name for (name,) in connection.execute(sql, (episode,))}
    conflict, deleted = len(head.leaves) > 1, DELETED in names
    stage = stage_of(head.node.state, conflict=conflict, deleted=deleted)
    return (
        episode, head.node.rev_uuid, conflict, stage, head.node.state, head.counting,
        join_names(head.authors), head.node.actor, FLAG in names, SKIPPED in names, deleted,
    )  # fmt: skip


def refresh_heads(connection: sqlite3.Connection, episodes: Iterable[str]) -> None:
    """Recompute the derived rows of ``episodes`` within the caller's transaction."""
    rows = (head_row(connection, episode) for episode in sorted(set(episodes)))
    connection.executemany(
        "INSERT OR REPLACE INTO label_head VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
        filter(None, rows),
    )


def rebuild_heads(connection: sqlite3.Connection) -> None:
    """Recompute all heads from the revisions."""
    connection.execute("DELETE FROM label_head")
    episodes = connection.execute("SELECT DISTINCT episode FROM label_rev").fetchall()
    refresh_heads(connection, (episode for (episode,) in episodes))


Action = Literal["set", "accept", "approve", "reject"]

# in the order of the keys 1 to 9; the last one takes a free text
REJECT_REASONS = (
    "slip in grasp",
    "tilt",
    "wrong piece",
    "no contact",
    "edge of range",
    "sensor fault",
    "markers lost",
    "disturbed",
    "other",
)

MAX_NAME = 80


@dataclass(frozen=True, slots=True)
class ReviewStatus:
    """State of one episode that determines the permitted actions.

    ``approved_before``: an approved revision exists before the head.
    """

    state: LabelState
    authors: tuple[str, ...]
    approved_before: bool
    conflict: bool
    deleted: bool


def check_person(person: str) -> str:
    """Return the name without surrounding spaces; raises ``InputError`` for an invalid name."""
    name = person.strip()
    if not name or len(name) > MAX_NAME or not name.isprintable() or name == PROGRAM_ACTOR:
        fix = f"Give a name of 1 to {MAX_NAME} printable characters other than '{PROGRAM_ACTOR}'."
        raise InputError("This is not the name of a person.", repr(person), fix)
    return name


def state_after(
    action: Action, status: ReviewStatus, person: str, *, four_eyes: bool = True
) -> LabelState:
    """Return the state after ``action``; raises ``RefusedError`` with the reason."""
    check_open(status)
    if action == "set":
        _check_own_work(status, person)
        return "draft"
    if action == "accept":
        if status.state != "draft":
            raise RefusedError(f"is {status.state}", _NO_DRAFT[status.state])
        return "submitted"
    return _review(action, status, person, four_eyes)


def check_open(status: ReviewStatus) -> None:
    """Raise ``RefusedError`` if the episode is deleted or in conflict."""
    if status.deleted:
        raise RefusedError("deleted", "The episode is deleted: restore it first.")
    if status.conflict:
        raise RefusedError("conflict", "It has two labels since a merge: resolve that first.")


def check_other_author(authors: Sequence[str], person: str) -> None:
    """Raise ``RefusedError`` if ``person`` is one of the authors."""
    if person in authors:
        raise RefusedError("four eyes", f"{person} wrote it: another person has to review it.")


def _check_own_work(status: ReviewStatus, person: str) -> None:
    if status.state == "submitted":
        raise RefusedError(
            "waits for review",
            "It waits for review: undo the submission, or let the reviewer reject it.",
        )
    own = not status.authors or person in status.authors
    if status.state in ("draft", "rejected") and not own:
        names = " and ".join(status.authors)
        raise RefusedError("another's work", f"The labels are by {names}: take them over first.")


def _review(action: Action, status: ReviewStatus, person: str, four_eyes: bool) -> LabelState:
    state = status.state
    if action == "reject" and state in ("unlabelled", "draft"):
        # The labeller rejects the episode itself; nothing was submitted for review.
        return "rejected"
    if state != "submitted" and not (state == "draft" and status.approved_before):
        raise RefusedError(f"is {state}", _NOT_SUBMITTED[state])
    if four_eyes:
        check_other_author(status.authors, person)
    return "approved" if action == "approve" else "rejected"


_NO_DRAFT = {
    "unlabelled": "There is no offset yet: set one.",
    "submitted": "It waits for review already.",
    "approved": "It is approved already.",
    "rejected": "It was rejected: change it first.",
}
_NOT_SUBMITTED = {
    "unlabelled": "There is no label to review.",
    "draft": "It is a draft: its author has to accept it first.",
    "approved": "It is approved: change the label, or delete the episode with a reason.",
    "rejected": "It is rejected already: its author has to change it.",
}
