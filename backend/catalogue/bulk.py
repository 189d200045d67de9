"""One change to many labels: previewed, applied as one operation, taken back by one undo.

An origin shift, a frame rotation and a corrected geometry keep the source: they correct where the
numbers are counted from, not who read them. The new revisions are drafts, to be reviewed again.
"""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace

from backend.catalogue import review
from backend.catalogue.chain import content_hash
from backend.catalogue.label_reading import standing_of
from backend.catalogue.operations import Draft, mark_of, new_revision, read_revision
from backend.catalogue.review import Action, Standing
from backend.catalogue.values import (
    GEOMETRY_CHANGED,
    Content,
    Label,
    LabelState,
    Revision,
)
from backend.core.faults import InputError, RefusedError


@dataclass(frozen=True, slots=True)
class ShiftOrigin:
    """The origin of the bottom was wrong: add this to every offset."""

    dx_um: int
    dy_um: int


@dataclass(frozen=True, slots=True)
class RotateFrame:
    """The axes of the bottom were turned: turn every offset (and rotation) counter-clockwise."""

    angle_mdeg: int


@dataclass(frozen=True, slots=True)
class MoveGeometry:
    """A dimension was corrected: labels with the pair ``old`` refer to the pair ``new``."""

    old: str
    new: str


@dataclass(frozen=True, slots=True)
class SetState:
    """Accept, approve or reject (with a ``reason``) as they are."""

    action: Action
    reason: str = ""


Change = ShiftOrigin | RotateFrame | MoveGeometry | SetState


@dataclass(frozen=True, slots=True)
class Row:
    """One label as it is and as it would be."""

    before: Revision
    after: Content
    state: LabelState

    @property
    def episode(self) -> str:
        """Whose label it is."""
        return self.before.episode


@dataclass(frozen=True, slots=True)
class Preview:
    """What a change would do: ``rows`` change, ``refused`` (episode, reason) do not.

    It holds the heads it has seen: applying it is refused once one of them has changed.
    """

    change: Change
    rows: tuple[Row, ...]
    refused: tuple[tuple[str, str], ...]

    @property
    def token(self) -> str:
        """Hash of the change and the heads seen."""
        seen = [row.before.rev_uuid for row in self.rows]
        return content_hash({"seen": seen, "change": {"kind": type(self.change).__name__}
                             | asdict(self.change)})  # fmt: skip


def preview(
    connection: sqlite3.Connection,
    uuids: Iterable[str],
    change: Change,
    person: str,
    *,
    four_eyes: bool,
) -> Preview:
    """Return what ``change`` would do to the heads of ``uuids``; nothing is written."""
    if isinstance(change, SetState) and change.action == "set":
        raise InputError("A state cannot be 'set'.", "action", "Use accept, approve or reject.")
    rows, refused = [], []
    for uuid in dict.fromkeys(uuids):
        try:
            standing = standing_of(connection, uuid)
            review.refuse_closed(standing)
            head = _head(connection, uuid)
            if isinstance(change, SetState):
                rows.append(_set_state(head, standing, change, person, four_eyes))
            else:
                rows.append(_corrected(head, change))
        except RefusedError as error:
            refused.append((uuid, error.detail))
    return Preview(change, tuple(rows), tuple(refused))


def fill(
    connection: sqlite3.Connection, draft: Draft, wanted: Preview, person: str, *, four_eyes: bool
) -> None:
    """Put what was previewed into ``draft``; raises ``RefusedError`` if a label changed since."""
    changed = []
    for row in wanted.rows:
        head, standing = _head(connection, row.episode), standing_of(connection, row.episode)
        if head.rev_uuid != row.before.rev_uuid or standing.conflict or standing.deleted:
            changed.append(head)
        elif isinstance(wanted.change, SetState):
            review.after(wanted.change.action, standing, person, four_eyes=four_eyes)
    if changed:
        raise RefusedError(
            "changed since the preview",
            f"{len(changed)} of {len(wanted.rows)} labels changed since the preview, the first by"
            f" {changed[0].person}: look at it again.",
        )
    change = wanted.change
    for row in wanted.rows:
        reason = row.before.reason if row.state == "rejected" else None
        if isinstance(change, SetState) and change.action in ("approve", "reject"):
            reason = change.reason or None
            done = {"rev_uuid": row.before.rev_uuid, "decision": row.state, "reason": reason}
            draft.reviews.append(done)
        parent = row.before.rev_uuid
        draft.revs.append(new_revision(row.episode, parent, row.after, row.state, reason))
        if isinstance(change, MoveGeometry):
            draft.marks.append(mark_of(connection, row.episode, GEOMETRY_CHANGED, present=True))


def _head(connection: sqlite3.Connection, uuid: str) -> Revision:
    row = connection.execute("SELECT rev_uuid FROM label_head WHERE episode = ?", (uuid,))
    return read_revision(connection, row.fetchone()[0])


def _set_state(
    head: Revision, standing: Standing, change: SetState, person: str, four_eyes: bool
) -> Row:
    if change.action == "reject" and not change.reason.strip():
        raise InputError("A rejection needs a reason.", "reason", "Say why in a few words.")
    state = review.after(change.action, standing, person, four_eyes=four_eyes)
    return Row(head, Content.of(head), state)


def _corrected(head: Revision, change: ShiftOrigin | RotateFrame | MoveGeometry) -> Row:
    said = Content.of(head)
    if isinstance(change, MoveGeometry):
        if head.geometry != change.old:
            raise RefusedError("other geometry", "It belongs to another geometry.")
        # What is rejected stays so: a corrected dimension is no reason to use it again.
        keeps = head.state in ("unlabelled", "rejected")
        return Row(head, replace(said, geometry=change.new), head.state if keeps else "draft")
    if not head.label.is_set:
        raise RefusedError("is unlabelled", "It has no offset.")
    if head.state == "rejected":
        raise RefusedError("is rejected", "It is rejected.")
    return Row(head, replace(said, label=_moved(head.label, change)), "draft")


def _moved(label: Label, change: ShiftOrigin | RotateFrame) -> Label:
    x_um, y_um = label.x_um or 0, label.y_um or 0
    if isinstance(change, ShiftOrigin):
        return replace(label, x_um=x_um + change.dx_um, y_um=y_um + change.dy_um)
    angle = math.radians(change.angle_mdeg / 1e3)
    c, s = math.cos(angle), math.sin(angle)
    theta = None if label.theta_mdeg is None else label.theta_mdeg + change.angle_mdeg
    return replace(
        label,
        x_um=round(c * x_um - s * y_um),
        y_um=round(s * x_um + c * y_um),
        theta_mdeg=theta,
    )
