"""Gold among the ordinary work: approved labels of others that look as if nobody had decided yet.

One episode in ``GOLD_EVERY`` of what a person is to label is gold. It shows the label that it was
recorded with and takes every action as the rest does; what is decided is kept as an opinion, and
the approved label never changes.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import blake2b

from backend.catalogue import review
from backend.catalogue.labels import LabelBook
from backend.catalogue.review import Action, Standing
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import (
    NO_LABEL,
    EpisodeEntry,
    Label,
    LabelState,
    Looked,
    Operation,
    Revision,
    Source,
    Verdict,
)
from backend.core.faults import InputError, RefusedError

GOLD_EVERY = 20
Shown = tuple[int, Revision]
"""Of a gold episode the time to show (``disguised``) and the revision that it was recorded with."""


def mixed(order: Sequence[str], gold: Sequence[str]) -> list[str]:
    """Return ``order`` with one of ``gold`` at some place of every 19 of them, while there are any.

    The places follow from the ids: the same queue is mixed in the same way again.
    """
    found, block, there = list[str](), GOLD_EVERY - 1, set(order)
    waiting = [uuid for uuid in gold if uuid not in there]
    for start in range(0, len(order), block):
        part = list(order[start : start + block])
        if waiting and len(part) == block:
            uuid = waiting.pop(0)
            part.insert(blake2b(uuid.encode(), digest_size=2).digest()[0] % GOLD_EVERY, uuid)
        found += part
    return found


def disguised(
    order: Sequence[str], entries: Mapping[str, EpisodeEntry], gold: Sequence[str]
) -> dict[str, int]:
    """Return for each of ``gold`` in ``order`` an instant (UTC ns) between those of its neighbours.

    Gold is older than what is still to be labelled: its own time would tell it from the rest.
    """
    told, chosen = {}, set(gold)
    for at, uuid in enumerate(order):
        if uuid in chosen:
            near = [order[k] for k in (at - 1, at + 1) if 0 <= k < len(order)]
            times = [entries[other].recorded_ns for other in near if other not in chosen]
            told[uuid] = sum(times) // len(times) if times else entries[uuid].recorded_ns
    return told


@dataclass(frozen=True, slots=True)
class _Step:
    """One action on gold: ``version`` followed ``before``, after the person's step ``after``.

    ``answer``: what is kept as an opinion, None where nothing was decided.
    """

    before: Revision
    version: Revision
    after: str | None
    answer: Label | None
    looked: Looked | None


class GoldBook:
    """The labels as the person at work sees and changes them; gold is kept apart from the rest.

    ``of`` is the one place where they part. Not for several threads at once: the saves of a sitting
    are made one after the other.
    """

    def __init__(self, book: LabelBook) -> None:
        self._book, self._gold = book, _Gold(book)
        self._times: Mapping[str, int] = {}

    def begin(self, person: str, gold: Mapping[str, Shown]) -> None:
        """Take the gold of a queue of ``person``."""
        self._times = {uuid: at_ns for uuid, (at_ns, _) in gold.items()}
        self._gold.begin(person, {uuid: recorded for uuid, (_, recorded) in gold.items()})

    def hides(self, uuid: str) -> bool:
        """Whether an episode is gold."""
        return uuid in self._times

    def of(self, uuid: str) -> LabelBook | _Gold:
        """Return where the label of an episode is seen and changed: both do what a page asks for.

        ``LabelBook`` says what each does. A decision about gold is kept as an opinion, of rejected
        or deleted gold one without displacement; gold that is skipped comes again where it was.
        """
        return self._gold if self.hides(uuid) else self._book

    def entry(self, entry: EpisodeEntry) -> EpisodeEntry:
        """Return the entry as it is to be seen."""
        if not self.hides(entry.uuid):
            return entry
        state = self._gold.head(entry.uuid).state
        return replace(entry, state=state, conflict=False, recorded_ns=self._times[entry.uuid])

    def undo(self, person: str) -> Operation | str | None:
        """Take back the last action: its operation, or the gold episode that it was on."""
        return self._gold.undo(person) or self._book.undo(person)

    def redo(self, person: str) -> Operation | str | None:
        """Take back the last undo."""
        return self._gold.redo(person) or self._book.redo(person)


class _Gold:
    """The gold of one person: what they did to it, none of which is in the labels."""

    def __init__(self, book: LabelBook) -> None:
        self._book = book
        self._person = ""
        self._versions: dict[str, list[Revision]] = {}
        self._authors: dict[str, tuple[str, ...]] = {}
        """Of each version: who wrote it."""
        self._done: list[_Step] = []
        self._undone: list[_Step] = []

    def begin(self, person: str, gold: Mapping[str, Revision]) -> None:
        if person != self._person:
            self._versions.clear()
            self._done.clear()
            self._undone.clear()
        self._person = person
        for uuid, recorded in gold.items():
            if uuid not in self._versions:
                self._versions[uuid] = [recorded]
                self._authors[recorded.rev_uuid] = ()

    def head(self, uuid: str) -> Revision:
        return self._versions[uuid][-1]

    def history(self, uuid: str) -> list[Revision]:
        return list(self._versions[uuid])

    def set(
        self,
        person: str,
        uuid: str,
        label: Label,
        *,
        source: Source | None = None,
        verdict: Verdict | None = None,
    ) -> Revision:
        head = self.head(uuid)
        said = self._said(person, uuid, label, source, verdict, self._after("set", uuid, person))
        same = (said.label, said.source, said.verdict) == (head.label, head.source, head.verdict)
        return head if same and head.state == "draft" else self._add(said)

    def accept(
        self,
        person: str,
        uuid: str,
        label: Label,
        *,
        source: Source | None = None,
        looked: Looked | None = None,
    ) -> Revision:
        state = None
        if label != self.head(uuid).label:
            state = self._after("set", uuid, person)
        state = self._after("accept", uuid, person, state)
        said = self._said(person, uuid, label, source, None, state)
        return self._add(said, label, looked)

    def reject(
        self, person: str, uuid: str, reason: str, *, looked: Looked | None = None
    ) -> Revision:
        state = self._after("reject", uuid, person)
        said = self._said(person, uuid, self.head(uuid).label, None, None, state)
        return self._add(replace(said, reason=reason), NO_LABEL, looked)

    def delete(self, person: str, uuid: str, reason: str) -> None:
        head = self.head(uuid)
        self._add(self._said(person, uuid, head.label, None, None, head.state), NO_LABEL)

    def take_over(self, person: str, uuid: str) -> Revision:
        head = self.head(uuid)
        if head.state not in ("draft", "rejected") or person in self._authors[head.rev_uuid]:
            raise RefusedError("nothing to take over", "This is no draft of another person.")
        return self._add(self._said(person, uuid, head.label, None, None, "draft"))

    def restore_revision(self, person: str, uuid: str, rev_uuid: str) -> Revision:
        for old in self._versions[uuid]:
            if old.rev_uuid == rev_uuid:
                return self.set(person, uuid, old.label, source=old.source, verdict=old.verdict)
        raise InputError("The revision is of another episode.", rev_uuid, "Look at its history")

    def skip(self, person: str, uuid: str) -> None:
        pass

    def undo(self, person: str) -> str | None:
        """Take back the last action on gold; None if another one came after it."""
        if not self._done or self._done[-1].after != self._book.last_step(person):
            self._undone.clear()
            return None
        # Nothing is forgotten before it is on disk: a refusal leaves the step to be undone again.
        step = self._done[-1]
        uuid = step.version.episode
        if step.answer is not None:
            self._book.opinion(person, uuid, NO_LABEL)
        self._done.pop()
        self._again(step.before)
        self._undone.append(step)
        return uuid

    def redo(self, person: str) -> str | None:
        """Take back the last undo on gold; None if another one came after it."""
        if not self._undone or self._undone[-1].after != self._book.last_step(person):
            return None
        step = self._undone[-1]
        self._keep(step)
        self._undone.pop()
        self._again(step.version)
        self._done.append(step)
        return step.version.episode

    # Inside

    def _after(
        self, action: Action, uuid: str, person: str, state: LabelState | None = None
    ) -> LabelState:
        """Return the state that an ordinary label would come to, or refuse as it would."""
        head = self.head(uuid)
        authors = self._authors[head.rev_uuid] if state is None else (person,)
        standing = Standing(state or head.state, authors, False, False, False)
        return review.after(action, standing, person)

    def _said(
        self,
        person: str,
        uuid: str,
        label: Label,
        source: Source | None,
        verdict: Verdict | None,
        state: LabelState,
    ) -> Revision:
        head = self.head(uuid)
        moved = "human" if label != head.label else head.source
        return replace(
            head, rev_uuid=uuid7(), parent=head.rev_uuid, label=label, source=source or moved,
            verdict=verdict or head.verdict, state=state, reason=None, person=person,
            at_ns=time.time_ns(),
        )  # fmt: skip

    def _add(
        self, version: Revision, answer: Label | None = None, looked: Looked | None = None
    ) -> Revision:
        before = self.head(version.episode)
        step = _Step(before, version, self._book.last_step(version.person), answer, looked)
        self._keep(step)
        authors = self._authors[before.rev_uuid]
        if version.state in ("draft", "submitted"):
            authors = tuple(sorted({*authors, version.person}))
        self._authors[version.rev_uuid] = authors
        self._versions[version.episode].append(version)
        self._done.append(step)
        self._undone.clear()
        return version

    def _keep(self, step: _Step) -> None:
        """Write the opinion of a decision."""
        if step.answer is not None:
            said = step.version
            self._book.opinion(
                said.person, said.episode, step.answer, verdict=said.verdict, looked=step.looked
            )

    def _again(self, old: Revision) -> None:
        """Add an old version as a new one, as undo and redo do."""
        head = self.head(old.episode)
        copy = replace(
            old, rev_uuid=uuid7(), parent=head.rev_uuid, person=self._person, at_ns=time.time_ns()
        )
        self._authors[copy.rev_uuid] = self._authors[old.rev_uuid]
        self._versions[old.episode].append(copy)
