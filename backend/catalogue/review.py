"""Who may do what to a label in which state, and what state follows.

Edits make drafts, accepting submits, another person approves or rejects. Only a person ever
submits or reviews; with four eyes nobody reviews what they wrote.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from backend.catalogue.values import PROGRAM, LabelState
from backend.core.faults import InputError, RefusedError

Action = Literal["set", "accept", "approve", "reject"]

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
"""By the digits 1 to 9; the last one takes a text."""

MAX_NAME = 80


@dataclass(frozen=True, slots=True)
class Standing:
    """What decides about an action: the head of one episode, and the marks on it.

    ``approved_before``: an approved revision counts behind the head.
    """

    state: LabelState
    authors: tuple[str, ...]
    approved_before: bool
    conflict: bool
    deleted: bool


def check_person(person: str) -> str:
    """Return the name without outer spaces; raises ``InputError`` unless it can name a person."""
    name = person.strip()
    if not name or len(name) > MAX_NAME or not name.isprintable() or name == PROGRAM:
        raise InputError(
            "This is not the name of a person.",
            repr(person),
            f"Give a name of 1 to {MAX_NAME} printable characters other than '{PROGRAM}'.",
        )
    return name


def after(action: Action, standing: Standing, person: str, *, four_eyes: bool = True) -> LabelState:
    """Return the state after ``action``; raises ``RefusedError`` with the reason in words."""
    refuse_closed(standing)
    if action == "set":
        return _set(standing, person)
    if action == "accept":
        return _accept(standing)
    return _review(action, standing, person, four_eyes)


def refuse_closed(standing: Standing) -> None:
    """Raise ``RefusedError`` for an episode that is deleted or in conflict."""
    if standing.deleted:
        raise RefusedError("deleted", "The episode is deleted: restore it first.")
    if standing.conflict:
        raise RefusedError("conflict", "It has two labels since a merge: resolve that first.")


def refuse_own(authors: Sequence[str], person: str) -> None:
    """Raise ``RefusedError`` for a review by one of those who wrote the label."""
    if person in authors:
        raise RefusedError("four eyes", f"{person} wrote it: another person has to review it.")


def _set(standing: Standing, person: str) -> LabelState:
    if standing.state == "submitted":
        raise RefusedError(
            "waits for review",
            "It waits for review: undo the submission, or let the reviewer reject it.",
        )
    own = not standing.authors or person in standing.authors
    if standing.state in ("draft", "rejected") and not own:
        names = " and ".join(standing.authors)
        raise RefusedError("another's work", f"This is the work of {names}: take it over first.")
    return "draft"


def _accept(standing: Standing) -> LabelState:
    if standing.state != "draft":
        reasons = {
            "unlabelled": "There is no offset yet: set one.",
            "submitted": "It waits for review already.",
            "approved": "It is approved already.",
            "rejected": "It was rejected: change it first.",
        }
        raise RefusedError(f"is {standing.state}", reasons.get(standing.state, standing.state))
    return "submitted"


def _review(action: Action, standing: Standing, person: str, four_eyes: bool) -> LabelState:
    state = standing.state
    if action == "reject" and state in ("unlabelled", "draft"):
        # The labeller says that this episode cannot be labelled; nothing was submitted to review.
        return "rejected"
    if state != "submitted" and not (state == "draft" and standing.approved_before):
        raise RefusedError(f"is {state}", _NOT_SUBMITTED[state])
    if four_eyes:
        refuse_own(standing.authors, person)
    return "approved" if action == "approve" else "rejected"


_NOT_SUBMITTED = {
    "unlabelled": "There is no label to review.",
    "draft": "It is a draft: its author has to accept it first.",
    "approved": "It is approved: change the label, or delete the episode with a reason.",
    "rejected": "It is rejected already: its author has to change it.",
    "superseded": "A later revision replaced it.",
}
