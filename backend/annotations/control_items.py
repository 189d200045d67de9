"""Control items: approved labels of other people, mixed into the queue as unlabelled episodes."""

from __future__ import annotations

import sqlite3
from bisect import bisect_right
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from hashlib import blake2b
from typing import Any

from touchdown.backend.annotations import operation_log, review, values
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import LabelEditor, LabelStore
from touchdown.backend.annotations.operation_log import OperationDraft
from touchdown.backend.annotations.review import BY_PROGRAM, ReviewStatus, RevisionNode
from touchdown.backend.core import InputError

CONTROL_ITEM_EVERY = 20
BLOCK = CONTROL_ITEM_EVERY - 1


@dataclass(frozen=True, slots=True)
class ControlItemView:
    """Presentation of a control item: the label as recorded, and its position in the queue.

    ``beside``: the episode of the queue before it, "" if it comes first.
    """

    recorded: values.Revision
    beside: str


# Queue with control items, and their views by episode.
Mixed = tuple[list[str], dict[str, ControlItemView]]


def with_control_items(
    dataset: Dataset, person: str, order: Sequence[str], entries: Container[str], seed: int = 0
) -> Mixed:  # fmt: skip
    """Return the queue of ``person`` with control items, unfinished ones included."""
    waiting = dataset.queue("gold", person, seed=seed)
    steps = dataset.labels.last_control_item_steps(person)
    begun = {uuid: steps[uuid] for uuid in waiting if uuid in steps and uuid in entries}
    found = mix_control_items(order, waiting, begun)
    places = preceding(found, set(order)) | {uuid: step.beside for uuid, step in begun.items()}
    return found, {
        uuid: ControlItemView(dataset.labels.history(uuid)[0], beside)
        for uuid, beside in places.items()
    }


def mix_control_items(
    order: Sequence[str],
    items: Sequence[str],
    begun: Mapping[str, values.ControlItemStep] | None = None,
) -> list[str]:
    """Return ``order`` with one of ``items`` inserted per block of 19 episodes.

    Positions derive from the ids, so the same queue gives the same mix. Control items in ``begun``
    keep their former position, or move to the end if they were skipped. The skipped part of
    ``order`` starts where the rising ids fall.
    """
    known, there = begun or {}, set(order)
    places = defaultdict[int, list[str]](list)
    falls = (k for k in range(1, len(order)) if order[k] < order[k - 1])
    skipped = next(falls, len(order))
    for uuid in sorted(set(known) - there):
        step = known[uuid]
        low, high = (skipped, len(order)) if step.skipped else (0, skipped)
        places[bisect_right(order, step.beside, low, high)].append(uuid)
    fresh = [uuid for uuid in items if uuid not in there and uuid not in known]
    for uuid, block in zip(fresh, range(len(known), len(order) // BLOCK), strict=False):
        die = blake2b(uuid.encode(), digest_size=2).digest()[0] % CONTROL_ITEM_EVERY
        places[block * BLOCK + die].append(uuid)
    found = list[str]()
    for k in range(len(order) + 1):
        found += [*places[k], *order[k : k + 1]]
    return found


def preceding(order: Sequence[str], ordinary: set[str]) -> dict[str, str]:
    """Return the ordinary episode before each control item, "" if there is none."""
    found, before = dict[str, str](), ""
    for uuid in order:
        if uuid in ordinary:
            before = uuid
        else:
            found[uuid] = before
    return found


class ControlItemLabels(LabelEditor):
    """Labels of the control items of one annotation session; ``of`` also serves other episodes.

    A decision about a control item is stored as an opinion, not as a label; a rejected or deleted
    control item gives one without offset. Not thread-safe: a session saves one label after the
    other.
    """

    def __init__(self, book: LabelStore) -> None:
        self._book = book
        self._person = ""
        self._shown: Mapping[str, ControlItemView] = {}

    def begin(self, person: str, views: Mapping[str, ControlItemView]) -> None:
        """Set the control items in the queue of ``person``."""
        self._person, self._shown = person, dict(views)

    def hides(self, uuid: str) -> bool:
        """Return True if an episode is a control item of the session."""
        return uuid in self._shown

    def of(self, uuid: str) -> LabelStore | ControlItemLabels:
        """Return the object that reads and changes the label of an episode.

        Both objects have the same methods for it. Undo and redo are those of ``LabelStore``.
        """
        return self if self.hides(uuid) else self._book

    def entry(self, entry: values.EpisodeEntry) -> values.EpisodeEntry:
        """Return the entry as the page shows it."""
        if not self.hides(entry.uuid):
            return entry
        now = self._now(entry.uuid)
        return replace(entry, state=now.version.state, conflict=False, deleted=bool(now.deleted))

    def log(self, *, text: str = "", limit: int = 500) -> list[values.Operation]:
        """Return the log, newest first, without others' operations on control items."""
        return [op for op in self._book.log(text=text, limit=limit) if not self._tells(op)]

    def _tells(self, operation: values.Operation) -> bool:
        if operation.verb in BY_PROGRAM or operation.actor == self._person:
            return False
        episodes = operation.episodes
        return bool(episodes) and all(self.hides(uuid) for uuid in episodes)

    def _now(self, uuid: str) -> values.ControlItemStep:
        """Return the entry as the person sees it."""
        return self._steps(uuid)[-1]

    def head(self, uuid: str) -> values.Revision:
        """Return the label as the person sees it."""
        return self.history(uuid)[-1]

    def history(self, uuid: str) -> list[values.Revision]:
        """Return the revisions as the person sees them, oldest first."""
        versions = {step.version.rev_uuid: step.version for step in reversed(self._steps(uuid))}
        return list(reversed(versions.values()))

    def restore_revision(self, person: str, uuid: str, rev_uuid: str) -> values.Revision:
        """Write an old revision again as a draft."""
        for old in self.history(uuid):
            if old.rev_uuid == rev_uuid:
                return self.set(person, uuid, old.label, source=old.source, verdict=old.verdict)
        raise InputError("The revision is of another episode.", rev_uuid, "Look at its history")

    def skip(self, person: str, uuid: str) -> None:
        """Move an episode to the end of its queue."""
        review.check_open(self._review_status(uuid))
        if not self._now(uuid).skipped:
            self._mark(person, "skip", uuid, skipped=True)

    def delete(self, person: str, uuid: str, reason: str) -> None:
        """Hide an episode, with a reason."""
        if self._now(uuid).deleted != reason:
            self._mark(person, "delete", uuid, deleted=reason)

    def _steps(self, uuid: str) -> list[values.ControlItemStep]:
        """Return the revisions of an episode as the person saw them, recording first."""
        shown = self._shown[uuid]
        begun = values.ControlItemStep(shown.recorded, beside=shown.beside)
        return [begun, *self._book.control_item_steps(self._person, uuid)]

    def _head_and_status(
        self, connection: sqlite3.Connection, uuid: str
    ) -> tuple[values.Revision, ReviewStatus]:
        return self.head(uuid), self._review_status(uuid)

    def _review_status(self, uuid: str) -> ReviewStatus:
        steps = self._steps(uuid)
        head, nodes = steps[-1].version, [_node(steps[0], "record")]
        for step in steps:
            if step.version.rev_uuid not in {node.rev_uuid for node in nodes}:
                nodes.append(_node(step, "label.set"))
        authors = review.authors_of(nodes, head.rev_uuid)
        return ReviewStatus(head.state, authors, False, False, bool(steps[-1].deleted))

    @contextmanager
    def edit(
        self, person: str, verb: str, context: values.AnswerContext | None = None
    ) -> Iterator[tuple[sqlite3.Connection, OperationDraft, str]]:
        """Store the changes of a draft as steps on control items, not as labels and reviews."""
        with self._book.edit(person, verb, context) as (connection, draft, name):
            yield connection, draft, name
            for rev in draft.revs:
                now = self._now(rev["episode"])
                names = ("rev_uuid", "parent", "source", "state", "reason", "verdict")
                label = values.Label(rev["x_um"], rev["y_um"], rev["theta_mdeg"], rev["sigma_um"])
                version = replace(now.version, label=label, **{name: rev[name] for name in names})
                operation_log.add_step(draft, replace(now, version=version, copy_of=None))
            draft.revs, draft.reviews = [], []

    def _mark(self, person: str, verb: str, uuid: str, **what: Any) -> None:
        self._book.record_control_item_step(person, verb, replace(self._now(uuid), **what))


def _node(step: values.ControlItemStep, verb: str) -> RevisionNode:
    r = step.version
    return RevisionNode(
        r.rev_uuid, r.parent, step.copy_of, r.state, r.geometry, 0, "", verb, r.person
    )
