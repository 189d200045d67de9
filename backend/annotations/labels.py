"""Labels of a dataset: read, edit one by one or in bulk. Each change is one operation.

A bulk change is previewed first, then applied as one operation.
"""

from __future__ import annotations

import json
import math
import sqlite3
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, replace

import numpy as np

from touchdown.backend.annotations import operation_log, review
from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.operation_log import (
    COLUMNS,
    OperationDraft,
    OperationJournal,
    as_operation,
    following,
    new_revision,
    newest_operations,
    read_head,
    read_mark,
    read_revision,
    read_revisions,
)
from touchdown.backend.annotations.review import REJECT_REASONS, Action, ReviewStatus, check_person
from touchdown.backend.annotations.undo import UndoStacks, inverse_draft, read_undo_stacks
from touchdown.backend.annotations.values import (
    DELETED,
    FLAG,
    GEOMETRY_CHANGED,
    SKIPPED,
    AnswerContext,
    ControlItemStep,
    Label,
    LabelContent,
    LabelState,
    Operation,
    Revision,
    Source,
    Verdict,
)
from touchdown.backend.core import FloatArray, InputError, RefusedError, SharedLock


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


@dataclass(frozen=True, slots=True)
class ShiftOrigin:
    """Correct the origin of the bottom: add this vector to every offset."""

    dx_um: int
    dy_um: int


@dataclass(frozen=True, slots=True)
class CarryCorrection(ShiftOrigin):
    """Correct drafts measured by the arm by this vector, and accept them as of ``source``."""

    sigma_um: int
    source: Source


@dataclass(frozen=True, slots=True)
class RotateFrame:
    """Correct the axes of the bottom: rotate every offset (and rotation) counter-clockwise."""

    angle_mdeg: int


@dataclass(frozen=True, slots=True)
class MoveGeometry:
    """Correct a dimension: labels of the pair ``old`` refer to the pair ``new``."""

    old: str
    new: str


@dataclass(frozen=True, slots=True)
class SetState:
    """Accept, approve or reject (with a ``reason``) labels without changing them."""

    action: Action
    reason: str = ""


ARM_SOURCES = "commanded", "measured"
ARM_UM = 70  # standard uncertainty of the difference of two positions of the arm
BulkChange = ShiftOrigin | RotateFrame | MoveGeometry | SetState


@dataclass(frozen=True, slots=True)
class BulkChangeRow:
    """One label before and after a bulk change."""

    before: Revision
    after: LabelContent
    state: LabelState

    @property
    def episode(self) -> str:
        """Id of the episode."""
        return self.before.episode


@dataclass(frozen=True, slots=True)
class BulkPreview:
    """Effect of a bulk change: ``rows`` to change, ``refused`` pairs (episode, reason).

    It stores the heads it was computed from; applying it is refused once one of them has changed.
    """

    change: BulkChange
    rows: tuple[BulkChangeRow, ...]
    refused: tuple[tuple[str, str], ...]


def _set_state(
    head: Revision, status: ReviewStatus, change: SetState, person: str, four_eyes: bool
) -> BulkChangeRow:
    if change.action == "reject" and not change.reason.strip():
        raise InputError("A rejection needs a reason.", "reason", "Say why in a few words.")
    state = review.state_after(change.action, status, person, four_eyes=four_eyes)
    return BulkChangeRow(head, LabelContent.of(head), state)


def _corrected(head: Revision, change: ShiftOrigin | RotateFrame | MoveGeometry) -> BulkChangeRow:
    content = LabelContent.of(head)
    if isinstance(change, MoveGeometry):
        if head.geometry != change.old:
            raise RefusedError("other geometry", "It belongs to another geometry.")
        # Rejected labels stay rejected when a dimension is corrected.
        keeps = head.state in ("unlabelled", "rejected")
        return BulkChangeRow(
            head, replace(content, geometry=change.new), head.state if keeps else "draft"
        )
    if not head.label.is_set:
        raise RefusedError("is unlabelled", "It has no offset.")
    if head.state == "rejected":
        raise RefusedError("is rejected", "It is rejected.")
    label = _moved(head.label, change)
    if isinstance(change, CarryCorrection):
        if head.source not in ARM_SOURCES or head.state != "draft":
            raise RefusedError("has a label", "A person or a model labelled it.")
        label = replace(label, sigma_um=change.sigma_um)
        return BulkChangeRow(head, replace(content, label=label, source=change.source), "submitted")
    return BulkChangeRow(head, replace(content, label=label), "draft")


def _moved(label: Label, change: ShiftOrigin | RotateFrame) -> Label:
    x_um, y_um = label.x_um or 0, label.y_um or 0
    if isinstance(change, ShiftOrigin):
        return replace(label, x_um=x_um + change.dx_um, y_um=y_um + change.dy_um)
    angle = math.radians(change.angle_mdeg / 1e3)
    c, s = math.cos(angle), math.sin(angle)
    theta = None if label.theta_mdeg is None else label.theta_mdeg + change.angle_mdeg
    return replace(
        label, x_um=round(c * x_um - s * y_um), y_um=round(s * x_um + c * y_um), theta_mdeg=theta
    )


class LabelEditor(ABC):
    """Changes of single labels; a subclass reads and stores them.

    ``four_eyes``: nobody may review their own work.
    """

    four_eyes: bool = True

    @abstractmethod
    def head(self, uuid: str) -> Revision:
        """Return the valid revision of an episode."""

    @abstractmethod
    def edit(
        self, person: str, verb: str, context: AnswerContext | None = None
    ) -> AbstractContextManager[tuple[sqlite3.Connection, OperationDraft, str]]:
        """Collect a draft and store it as one operation; an empty draft writes nothing."""

    @abstractmethod
    def _head_and_status(
        self, connection: sqlite3.Connection, uuid: str
    ) -> tuple[Revision, ReviewStatus]: ...

    def set(
        self,
        person: str,
        uuid: str,
        label: Label,
        *,
        source: Source | None = None,
        verdict: Verdict | None = None,
        note: str | None = None,
    ) -> Revision:
        """Write a draft; writes nothing if nothing changed.

        ``source`` None: ``human`` if the offset changed, else unchanged. ``verdict`` and ``note``
        None: unchanged. A draft or rejected label of another person has to be taken over first.
        """
        with self.edit(person, "label.set") as (connection, draft, name):
            head, status = self._head_and_status(connection, uuid)
            state = review.state_after("set", status, name)
            wanted = _edited(head, label, source, verdict, note)
            if wanted != head or head.state not in ("draft", state):
                draft.revs.append(following(head, wanted, state))
        return self.head(uuid)

    def accept(
        self,
        person: str,
        uuid: str,
        label: Label | None = None,
        *,
        source: Source | None = None,
        verdict: Verdict | None = None,
        context: AnswerContext | None = None,
    ) -> Revision:
        """Submit a draft for review; a differing ``label`` is set in the same operation."""
        with self.edit(person, "label.accept_next", context) as (connection, draft, name):
            head, status = self._head_and_status(connection, uuid)
            wanted = _edited(head, label or head.label, source, verdict, None)
            if wanted.label != head.label:
                edited = review.state_after("set", status, name)
                status = replace(status, state=edited)
            state = review.state_after("accept", status, name)
            draft.revs.append(following(head, wanted, state))
        return self.head(uuid)

    def take_over(self, person: str, uuid: str) -> Revision:
        """Turn a draft or rejected label of another person into a draft of ``person``."""
        with self.edit(person, "label.take_over") as (connection, draft, name):
            head, status = self._head_and_status(connection, uuid)
            review.check_open(status)
            if head.state not in ("draft", "rejected") or name in status.authors:
                raise RefusedError("nothing to take over", "This is no draft of another person.")
            draft.revs.append(following(head, head, "draft"))
        return self.head(uuid)

    def reject(
        self, person: str, uuid: str, reason: str, *, context: AnswerContext | None = None
    ) -> Revision:
        """Reject a label with a reason; it returns to its author."""
        if not reason.strip():
            fix = f"For instance: {', '.join(REJECT_REASONS)}."
            raise InputError("A rejection needs a reason.", uuid, fix)
        return self._review(person, uuid, "reject", reason.strip(), context)

    def _review(
        self,
        person: str,
        uuid: str,
        action: Action,
        reason: str | None,
        context: AnswerContext | None,
    ) -> Revision:
        with self.edit(person, action, context) as (connection, draft, name):
            head, status = self._head_and_status(connection, uuid)
            state = review.state_after(action, status, name, four_eyes=self.four_eyes)
            draft.revs.append(following(head, replace(head, reason=reason), state))
            done = {"rev_uuid": head.rev_uuid, "decision": state, "reason": reason}
            draft.reviews.append(done)
        return self.head(uuid)


class LabelStore(LabelReader, LabelEditor):
    """Labels of one dataset. ``site``: hash chain that new operations continue.

    ``frozen``: reason why labels are read-only, set if the hash chain is broken; "" if they can be
    changed.
    """

    def __init__(self, database: Database, journal: OperationJournal, site: str) -> None:
        super().__init__(database)
        self._journal = journal
        self.site: str = site
        self._lock = SharedLock()
        self._stacks: dict[str, UndoStacks] = {}
        self.frozen = ""
        self.journal_trouble: str = ""
        self.after_commit: Callable[[], None] = lambda: None
        self.before_bulk: Callable[[], None] = lambda: None

    def approve(self, person: str, uuid: str, *, context: AnswerContext | None = None) -> Revision:
        """Approve a submitted label (or a changed one that was approved before)."""
        return self._review(person, uuid, "approve", None, context)

    def resolve(self, person: str, uuid: str, rev_uuid: str) -> Revision:
        """End a conflict: the leaf ``rev_uuid`` becomes valid, the others are closed.

        With ``four_eyes``, a person cannot prefer an approval of their own work to another review.
        """
        with self.edit(person, "resolve") as (connection, draft, name):
            nodes, closed = review.read_nodes(connection, uuid)
            ids = [leaf.rev_uuid for leaf in review.leaves_of(nodes, closed)]
            if len(ids) < 2 or rev_uuid not in ids:
                raise RefusedError("no conflict", "There is no conflict that this would resolve.")
            winner = read_revision(connection, rev_uuid)
            if self.four_eyes and winner.state == "approved":
                review.check_other_author(review.authors_of(nodes, rev_uuid), name)
            draft.add_copy(following(winner, winner, winner.state), winner.rev_uuid)
            draft.closes += [other for other in ids if other != rev_uuid]
        return self.head(uuid)

    def opinion(
        self,
        person: str,
        uuid: str,
        label: Label,
        *,
        verdict: Verdict | None = None,
        context: AnswerContext | None = None,
    ) -> None:
        """Store an answer of ``person`` for agreement figures; no label changes.

        The latest answer counts. An opinion cannot be undone.
        """
        with self.edit(person, "label.opinion", context) as (connection, draft, _):
            read_review_status(connection, uuid)
            draft.opinions.append({"episode": uuid, "verdict": verdict} | asdict(label))

    def record_control_item_step(self, person: str, verb: str, step: ControlItemStep) -> None:
        """Store a step on a control item; it can be undone but changes no label."""
        with self.edit(person, verb) as (connection, draft, _):
            read_review_status(connection, step.version.episode)
            operation_log.add_step(draft, step)

    def restore_revision(self, person: str, uuid: str, rev_uuid: str) -> Revision:
        """Write an old revision again as a draft with its original source."""
        with self._database.reading() as connection:
            old = read_revision(connection, rev_uuid)
        if old.episode != uuid:
            raise InputError("The revision is of another episode.", rev_uuid, "Look at its history")
        return self.set(
            person, uuid, old.label, source=old.source, verdict=old.verdict, note=old.note
        )

    def preview(self, person: str, uuids: Iterable[str], change: BulkChange) -> BulkPreview:
        """Return the effect of ``change`` on these episodes; nothing is written."""
        name = check_person(person)
        if isinstance(change, SetState) and change.action == "set":
            raise InputError("A state cannot be 'set'.", "action", "Use accept, approve or reject.")
        rows, refused = [], []
        with self._database.reading() as connection:
            for uuid in dict.fromkeys(uuids):
                try:
                    head, status = self._head_and_status(connection, uuid)
                    review.check_open(status)
                    if isinstance(change, SetState):
                        rows.append(_set_state(head, status, change, name, self.four_eyes))
                    else:
                        rows.append(_corrected(head, change))
                except RefusedError as error:
                    refused.append((uuid, error.detail))
        return BulkPreview(change, tuple(rows), tuple(refused))

    def bulk(self, person: str, wanted: BulkPreview) -> int:
        """Apply a previewed change as one operation; return the number of changed labels.

        Raises ``RefusedError`` and changes nothing if one of the labels changed since.
        """
        self.before_bulk()
        change = wanted.change
        with self.edit(person, "bulk") as (connection, draft, name):
            changed = []
            for row in wanted.rows:
                head, status = self._head_and_status(connection, row.episode)
                if head.rev_uuid != row.before.rev_uuid or status.conflict or status.deleted:
                    changed.append(head)
                elif isinstance(change, SetState):
                    review.state_after(change.action, status, name, four_eyes=self.four_eyes)
            if changed:
                raise RefusedError(
                    "changed since the preview",
                    f"{len(changed)} of {len(wanted.rows)} labels changed since the preview, the"
                    f" first by {changed[0].person}: look at it again.",
                )
            for row in wanted.rows:
                before, reason = row.before.rev_uuid, row.before.reason
                if isinstance(change, SetState) and change.action in ("approve", "reject"):
                    reason = change.reason or None
                    done = {"rev_uuid": before, "decision": row.state, "reason": reason}
                    draft.reviews.append(done)
                elif row.state != "rejected":
                    reason = None
                draft.revs.append(new_revision(row.episode, before, row.after, row.state, reason))
                if isinstance(change, MoveGeometry):
                    mark = read_mark(connection, row.episode, GEOMETRY_CHANGED, present=True)
                    draft.marks.append(mark)
        return len(wanted.rows)

    def skip(self, person: str, uuid: str) -> None:
        """Move an episode to the end of its queue."""
        self._mark(person, "skip", uuid, SKIPPED)

    def flag(self, person: str, uuid: str, present: bool = True, note: str = "") -> None:
        """Set or remove the flag."""
        self._mark(person, "flag", uuid, FLAG, present=present, note=note)

    def tag(self, person: str, uuid: str, name: str, present: bool = True) -> None:
        """Set or remove a tag (any word that the catalogue does not use itself)."""
        if not name.strip() or name in (FLAG, SKIPPED, DELETED):
            raise InputError("This cannot be a tag.", repr(name), "Choose another word.")
        self._mark(person, "tag", uuid, name.strip(), present=present)

    def delete(self, person: str, uuid: str, reason: str) -> None:
        """Hide an episode, with a reason; its file and history are kept."""
        if not reason.strip():
            raise InputError("A deletion needs a reason.", uuid, "Say why in a few words.")
        self._mark(person, "delete", uuid, DELETED, note=reason.strip())

    def restore(self, person: str, uuid: str, reason: str = "") -> None:
        """Restore a deleted episode."""
        self._mark(person, "restore", uuid, DELETED, present=False, note=reason.strip())

    def _mark(self, person: str, verb: str, uuid: str, name: str, *,
              present: bool = True, note: str = "") -> None:  # fmt: skip
        with self.edit(person, verb) as (connection, draft, _):
            status = read_review_status(connection, uuid)
            if status.deleted and name != DELETED:
                review.check_open(status)
            mark = read_mark(connection, uuid, name, present=present, note=note)
            if mark["present"] != mark["was"] or mark["note"] != mark["was_note"]:
                draft.marks.append(mark)

    def undo(self, person: str) -> Operation | None:
        """Undo the latest action of ``person``; None if there is none.

        Raises ``RefusedError`` with the name of a person who changed the label since.
        """
        return self._reverse(person, "undo", self._stack(person).undo)

    def redo(self, person: str) -> Operation | None:
        """Revert the latest undo of ``person``; None if there is none."""
        return self._reverse(person, "redo", self._stack(person).redo)

    def _reverse(self, person: str, verb: str, stack: Sequence[str]) -> Operation | None:
        with self._lock:
            if not stack:
                return None
            target = stack[-1]
            with self.commit() as connection:
                (found,) = operation_log.read_operations(connection, "op_uuid = ?", (target,))
                draft = inverse_draft(connection, found)
                operation = self._append(connection, check_person(person), verb, draft, target)
            self._note(operation)
            return operation

    def _stack(self, person: str) -> UndoStacks:
        with self._lock:
            if person not in self._stacks:
                with self._database.reading() as connection:
                    self._stacks[person] = read_undo_stacks(connection, person)
            return self._stacks[person]

    def reload(self) -> None:
        """Read operations added by a merge: update undo, redo and all journals."""
        sites = self._database.rows("SELECT DISTINCT site FROM op")
        with self._lock:
            self._stacks.clear()
            self._follow(*(site for (site,) in sites))

    @contextmanager
    def commit(self) -> Iterator[sqlite3.Connection]:
        """Run one transaction on the log and write the journal after it."""
        self.refuse_if_frozen()
        with self._lock:
            with self._database.transaction() as connection:
                yield connection
            self._follow(self.site)
        self.after_commit()

    def refuse_if_frozen(self) -> None:
        """Raise ``RefusedError`` if the labels are read-only."""
        if self.frozen:
            raise RefusedError("labels are read-only", self.frozen)

    def _follow(self, *sites: str) -> None:
        try:
            with self._database.reading() as connection:
                for site in sites:
                    self._journal.catch_up(connection, site)
            self.journal_trouble = ""
        except OSError as error:
            # The operation is stored in the catalogue; the next append completes the journal.
            self.journal_trouble = f"The journal of labels lags behind: {error}."

    def _head_and_status(
        self, connection: sqlite3.Connection, uuid: str
    ) -> tuple[Revision, ReviewStatus]:
        status, head = read_review_status(connection, uuid), read_head(connection, uuid)
        assert head is not None  # its review status is read from the same row
        return head, status

    @contextmanager
    def edit(
        self, person: str, verb: str, context: AnswerContext | None = None
    ) -> Iterator[tuple[sqlite3.Connection, OperationDraft, str]]:
        """Collect a draft and commit it as one operation."""
        name, draft = check_person(person), OperationDraft()
        if context is not None:
            draft.extra = {"seen_ms": context.seen_ms, "blind": context.blind}
        with self._lock:
            operation = None
            with self.commit() as connection:
                yield connection, draft, name
                if draft.revs or draft.marks or draft.opinions or draft.apart:
                    operation = self._append(connection, name, verb, draft)
            if operation is not None:
                self._note(operation)

    def _append(self, connection: sqlite3.Connection, name: str, verb: str, draft: OperationDraft,
                target: str | None = None) -> Operation:  # fmt: skip
        operation, touched = operation_log.append_operation(
            connection, self.site, name, verb, draft, target
        )
        review.refresh_heads(connection, touched)
        return operation

    def _note(self, operation: Operation) -> None:
        if operation.actor in self._stacks:
            stacks = self._stacks[operation.actor]
            stacks.apply(operation.op_uuid, operation.verb, operation.target_op)


def _edited(head: Revision, label: Label, source: Source | None, verdict: Verdict | None,
            note: str | None) -> Revision:  # fmt: skip
    moved = label != head.label
    return replace(
        head,
        label=label,
        source=source or ("human" if moved else head.source),
        verdict=verdict or head.verdict,
        note=head.note if note is None else note,
    )
