"""Table of states: every action in every state, with the reason of each refusal."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.backend.catalogue.conftest import Record
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.review import ReviewStatus, check_person, state_after
from touchdown.backend.annotations.values import AnswerContext, Label
from touchdown.backend.core.faults import InputError, RefusedError

MOVED = Label(2000, 300, 0, 200)


def standing(state: str, authors: tuple[str, ...] = ("ann",), before: bool = False) -> ReviewStatus:
    return ReviewStatus(state, authors, before, conflict=False, deleted=False)  # type: ignore[arg-type]


TABLE = {
    ("unlabelled", "set"): "draft",
    ("unlabelled", "accept"): "no offset",
    ("unlabelled", "approve"): "no label to review",
    ("unlabelled", "reject"): "rejected",
    ("draft", "set"): "draft",
    ("draft", "accept"): "submitted",
    ("draft", "approve"): "its author has to accept",
    ("draft", "reject"): "rejected",
    ("submitted", "set"): "waits for review",
    ("submitted", "accept"): "waits for review already",
    ("submitted", "approve"): "ann wrote it",
    ("submitted", "reject"): "ann wrote it",
    ("approved", "set"): "draft",
    ("approved", "accept"): "approved already",
    ("approved", "approve"): "It is approved",
    ("approved", "reject"): "It is approved",
    ("rejected", "set"): "draft",
    ("rejected", "accept"): "was rejected",
    ("rejected", "approve"): "rejected already",
    ("rejected", "reject"): "rejected already",
}
STATES = ("draft", "submitted", "approved", "rejected")
BY_ANOTHER = {
    ("draft", "set"): "work of ann",
    ("rejected", "set"): "work of ann",
    ("submitted", "approve"): "approved",
    ("submitted", "reject"): "rejected",
}


def outcome(wanted: str, call: Callable[[], str]) -> None:
    if wanted in STATES:
        assert call() == wanted
    else:
        with pytest.raises(RefusedError, match=wanted):
            call()


@pytest.mark.parametrize(("state", "action"), TABLE)
def test_every_state_by_every_action(state: str, action: str) -> None:
    found, key = standing(state), (state, action)
    outcome(TABLE[key], lambda: state_after(action, found, "ann"))  # type: ignore[arg-type]
    wanted = BY_ANOTHER.get(key, TABLE[key])
    outcome(wanted, lambda: state_after(action, found, "bob"))  # type: ignore[arg-type]


@pytest.mark.parametrize("action", ["set", "accept", "approve", "reject"])
@pytest.mark.parametrize("state", ["unlabelled", *STATES])
def test_nothing_is_done_to_what_is_deleted_or_in_conflict(state: str, action: str) -> None:
    for closed, word in (({"deleted": True}, "deleted"), ({"conflict": True}, "two labels")):
        flags = {"conflict": False, "deleted": False} | closed
        found = ReviewStatus(state, (), False, **flags)  # type: ignore[arg-type]
        with pytest.raises(RefusedError, match=word):
            state_after(action, found, "bob")  # type: ignore[arg-type]


def test_one_pair_of_eyes_may_be_allowed_and_a_changed_approved_draft_can_be_reviewed() -> None:
    assert state_after("approve", standing("submitted"), "ann", four_eyes=False) == "approved"
    assert state_after("approve", standing("draft", before=True), "bob") == "approved"
    with pytest.raises(RefusedError, match="ann wrote it"):
        state_after("approve", standing("draft", before=True), "ann")


@pytest.mark.parametrize("name", ["", "  ", "program", "a\nb", "x" * 81])
def test_only_a_person_acts(dataset: Dataset, record: Record, name: str) -> None:
    with pytest.raises(InputError, match="name of a person"):
        dataset.labels.accept(name, record().uuid)
    assert check_person("  Jörg  ") == "Jörg"


def test_the_way_of_a_label_from_the_campaign_to_approval(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    assert labels.head(uuid).source == "commanded"
    assert labels.set("ann", uuid, MOVED).source == "human"
    accepted = labels.accept("ann", uuid, context=AnswerContext(4200))
    assert (accepted.state, accepted.source, accepted.label) == ("submitted", "human", MOVED)
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", uuid)
    approved = labels.approve("bob", uuid, context=AnswerContext(900, blind=True))
    assert labels.counting(uuid) == approved
    edited = labels.set("ann", uuid, Label(0, 0, 0, 100))
    assert edited.state == "draft"
    assert labels.counting(uuid) == approved
    labels.accept("ann", uuid)
    final = labels.approve("bob", uuid)
    assert labels.counting(uuid) == final
    states = [revision.state for revision in labels.history(uuid)]
    assert states == ["draft", "draft", "submitted", "superseded", "draft", "submitted", "approved"]
    reviews = dataset.database.rows("SELECT reviewer, decision, seen_ms, blind FROM review")
    assert reviews == [("bob", "approved", 900, 1), ("bob", "approved", None, None)]


def test_accepting_a_changed_offset_is_one_revision(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    revision = labels.accept("ann", uuid, MOVED)
    assert (revision.state, revision.source, revision.label) == ("submitted", "human", MOVED)
    assert len(labels.history(uuid)) == 2
    suggested = record().uuid
    revision = labels.accept("ann", suggested, MOVED, source="model:abc")
    assert revision.source == "model:abc"
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", suggested)


def test_rejected_work_goes_back_to_its_author(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    labels.accept("ann", uuid, MOVED)
    with pytest.raises(InputError, match="reason"):
        labels.reject("bob", uuid, " ")
    rejected = labels.reject("bob", uuid, "tilt")
    assert (rejected.state, rejected.reason) == ("rejected", "tilt")
    assert labels.review_status(uuid).authors == ("ann",)
    assert labels.counting(uuid) is None
    with pytest.raises(RefusedError, match="work of ann"):
        labels.set("bob", uuid, Label(1, 1))
    labels.take_over("bob", uuid)
    assert labels.review_status(uuid).authors == ("ann", "bob")
    labels.set("bob", uuid, Label(1, 1))
    labels.accept("bob", uuid)
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", uuid)
    labels.approve("cleo", uuid)


def test_the_source_of_an_untouched_offset_never_changes(dataset: Dataset, record: Record) -> None:
    labels, entry = dataset.labels, record()
    before = labels.head(entry.uuid)
    assert labels.set("ann", entry.uuid, before.label) == before
    noted = labels.set("ann", entry.uuid, before.label, note="looks odd", verdict="unsure")
    assert (noted.source, noted.note, noted.verdict) == ("commanded", "looks odd", "unsure")
    labels.accept("ann", entry.uuid)
    labels.undo("ann")
    labels.redo("ann")
    labels.approve("bob", entry.uuid)
    sources = {revision.source for revision in labels.history(entry.uuid)}
    assert sources == {"commanded"}


def test_any_old_revision_can_be_written_again(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    first = labels.head(uuid)
    labels.set("ann", uuid, MOVED)
    again = labels.restore_revision("ann", uuid, first.rev_uuid)
    assert (again.label, again.source, again.state) == (first.label, "commanded", "draft")
    assert len(labels.history(uuid)) == 3
    with pytest.raises(InputError, match="another episode"):
        labels.restore_revision("ann", record().uuid, first.rev_uuid)


def test_deleting_hides_and_restoring_brings_back(dataset: Dataset, record: Record) -> None:
    labels, entry = dataset.labels, record()
    content = dataset.path(entry.uuid).read_bytes()
    labels.delete("ann", entry.uuid, "wrong piece")
    assert dataset.episodes() == []
    assert labels.marks(entry.uuid) == {"deleted": "wrong piece"}
    with pytest.raises(RefusedError, match="deleted"):
        labels.flag("ann", entry.uuid)
    labels.undo("ann")
    assert dataset.episodes() == [entry]
    assert dataset.path(entry.uuid).read_bytes() == content


def test_the_log_can_be_searched(dataset: Dataset, record: Record) -> None:
    labels, first, second = dataset.labels, record().uuid, record().uuid
    labels.set("ann", first, MOVED, note="bent corner")
    labels.flag("bob", second)
    assert [op.verb for op in labels.log()] == ["flag", "label.set", "record", "record"]
    assert [op.verb for op in labels.log(actor="bob")] == ["flag"]
    assert [op.verb for op in labels.log(episode=first)] == ["label.set", "record"]
    assert [op.actor for op in labels.log(text="bent corner")] == ["ann"]
    assert labels.people() == ["ann", "bob", "cleo"]
    with pytest.raises(InputError, match="no such episode"):
        labels.head("nothing")
