"""Which revision of an episode holds: a pure function of the set of operations.

Leaves are revisions without children that no operation closed; the head is the leaf with the
greatest (lamport, site, rev_uuid); more than one leaf is a conflict. So a merge is a set union.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from backend.catalogue.operations import REVERSING
from backend.catalogue.values import DELETED, FLAG, SKIPPED, LabelState

Stage = Literal["unlabelled", "review", "approved", "rejected", "conflicts", "deleted"]
"""Where an episode stands in the work: each is in exactly one."""

BY_PROGRAM = ("record", "adopt")
"""Verbs whose revisions nobody is the author of."""


@dataclass(frozen=True, slots=True)
class Node:
    """What of a revision decides about heads.

    ``copy_of``: the revision whose content an undo, redo or resolve wrote again.
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
        """Its place among the leaves."""
        return self.lamport, self.site, self.rev_uuid

    @property
    def is_copy(self) -> bool:
        """Whether its content was written before."""
        return self.verb in REVERSING or self.copy_of is not None


@dataclass(frozen=True, slots=True)
class Head:
    """The head of one episode and what follows from it.

    ``counting``: the revision that training uses, the latest approved one before the head with the
    geometry of the head; None for a rejected head. ``authors``: who made the content.
    """

    node: Node
    leaves: tuple[str, ...]
    counting: str | None
    authors: tuple[str, ...]


def leaves_of(nodes: Sequence[Node], closed: Iterable[str]) -> list[Node]:
    """Return the leaves of one episode, the head last."""
    inner = {node.parent for node in nodes} | set(closed)
    return sorted((n for n in nodes if n.rev_uuid not in inner), key=lambda n: n.order)


def head_of(nodes: Sequence[Node], closed: Iterable[str]) -> Head | None:
    """Return the head of one episode from all its revisions, in any order."""
    leaves = leaves_of(nodes, closed)
    if not leaves:
        return None
    by_id = {node.rev_uuid: node for node in nodes}
    head = leaves[-1]
    counting = None if head.state == "rejected" else _counting(head, by_id)
    ids = tuple(leaf.rev_uuid for leaf in leaves)
    return Head(head, ids, counting, _authors(head, by_id))


def authors_of(nodes: Sequence[Node], rev_uuid: str) -> tuple[str, ...]:
    """Return who wrote what the revision ``rev_uuid`` says."""
    by_id = {node.rev_uuid: node for node in nodes}
    return _authors(by_id[rev_uuid], by_id)


def _before(node: Node, by_id: Mapping[str, Node]) -> Node | None:
    """Return what ``node`` goes back to: what it copies, else its parent."""
    key = node.copy_of if node.is_copy else node.parent
    return None if key is None else by_id.get(key)


def _counting(head: Node, by_id: Mapping[str, Node]) -> str | None:
    node: Node | None = head
    while node is not None:
        if node.state == "approved" and node.geometry == head.geometry:
            return node.rev_uuid
        node = _before(node, by_id)
    return None


def _authors(head: Node, by_id: Mapping[str, Node]) -> tuple[str, ...]:
    """Return who wrote the content since it was last approved (reviewing is not writing)."""
    found: set[str] = set()
    node: Node | None = head
    while node is not None and node.verb not in BY_PROGRAM:
        if node.state == "approved" and found:
            break
        if not node.is_copy and node.state in ("draft", "submitted"):
            found.add(node.actor)
        node = _before(node, by_id)
    return tuple(sorted(found))


def superseded(nodes: Sequence[Node], counting: str | None) -> set[str]:
    """Return the approved revisions behind the one that counts."""
    by_id = {node.rev_uuid: node for node in nodes}
    node = None if counting is None else _before(by_id[counting], by_id)
    found = set()
    while node is not None:
        if node.state == "approved":
            found.add(node.rev_uuid)
        node = _before(node, by_id)
    return found


def stage_of(state: LabelState, *, conflict: bool, deleted: bool) -> Stage:
    """Return where an episode stands."""
    if deleted:
        return "deleted"
    if conflict:
        return "conflicts"
    stages: dict[str, Stage] = {"submitted": "review", "approved": "approved"}
    return "rejected" if state == "rejected" else stages.get(state, "unlabelled")


def as_text(names: Iterable[str]) -> str:
    """Return names so that SQL finds a whole one: each between line breaks."""
    return "".join(f"\n{name}" for name in names) + "\n"


def as_names(text: str) -> tuple[str, ...]:
    """Return the names of ``as_text``."""
    return tuple(name for name in text.split("\n") if name)


NODES = """
SELECT r.rev_uuid, r.parent, r.copy_of, r.state, r.geometry, o.lamport, o.site, o.verb, o.actor
FROM label_rev r JOIN op o USING (op_uuid) WHERE r.episode = ?
"""
CLOSED = """
SELECT c.rev_uuid FROM closed c JOIN label_rev r USING (rev_uuid) WHERE r.episode = ?
"""


def read_nodes(connection: sqlite3.Connection, episode: str) -> tuple[list[Node], list[str]]:
    """Return the revisions of one episode and those that were closed."""
    nodes = [Node(*row) for row in connection.execute(NODES, (episode,))]
    closed = [rev for (rev,) in connection.execute(CLOSED, (episode,))] if nodes else []
    return nodes, closed


def refresh(connection: sqlite3.Connection, episodes: Iterable[str]) -> None:
    """Write the derived rows of ``episodes`` anew, within the caller's transaction."""
    for episode in sorted(set(episodes)):
        head = head_of(*read_nodes(connection, episode))
        if head is None:
            continue
        marks = connection.execute(
            "SELECT name FROM mark WHERE episode = ? AND present", (episode,)
        ).fetchall()
        names = {name for (name,) in marks}
        conflict, deleted = len(head.leaves) > 1, DELETED in names
        row = (
            episode,
            head.node.rev_uuid,
            int(conflict),
            stage_of(head.node.state, conflict=conflict, deleted=deleted),
            head.node.state,
            head.counting,
            as_text(head.authors),
            head.node.actor,
            int(FLAG in names),
            int(SKIPPED in names),
            int(deleted),
        )
        connection.execute(
            "INSERT OR REPLACE INTO label_head VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row
        )


def rebuild(connection: sqlite3.Connection) -> None:
    """Make all heads anew from the revisions."""
    connection.execute("DELETE FROM label_head")
    episodes = connection.execute("SELECT DISTINCT episode FROM label_rev").fetchall()
    refresh(connection, (episode for (episode,) in episodes))
