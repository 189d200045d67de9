"""Control items in ordinary work: indistinguishable, and without effect on approved labels."""

from __future__ import annotations

import math
import random
import shutil
from pathlib import Path

import pytest

from tests.backend.annotations.conftest import Record, add
from touchdown.backend.annotations import operation_log
from touchdown.backend.annotations.agreement import AgreementReport, compare_with_control_items
from touchdown.backend.annotations.control_items import (
    CONTROL_ITEM_EVERY,
    ControlItemLabels,
    ControlItemView,
    mix_control_items,
    preceding,
    with_control_items,
)
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.training_set import labelled_episodes
from touchdown.backend.annotations.values import AnswerContext, ControlItemStep, Label
from touchdown.backend.core.faults import Fault, FaultError, RefusedError

ACTIONS = (
    "set", "accept", "reject", "take over", "restore", "verdict", "skip", "delete", "undo", "redo",
    "undo", "redo",
)  # fmt: skip


def gold_of(record: Record, dataset: Dataset, x_um: int = 1000) -> str:
    """Return an episode labelled by Bob 0.5 mm off its draft and approved by Cleo."""
    uuid = record(x_um, 0).uuid
    dataset.labels.accept("bob", uuid, Label(x_um + 500, 0, 0, 50))
    dataset.labels.approve("cleo", uuid)
    return uuid


@pytest.mark.parametrize("count", [0, 18, 19, 100])
def test_one_in_twenty_is_gold(count):
    order, gold = [f"o{k}" for k in range(count)], [f"g{k}" for k in range(3)]
    found = mix_control_items(order, gold)
    assert [uuid for uuid in found if uuid in order] == order
    at = [found.index(uuid) for uuid in gold if uuid in found]
    assert [k // CONTROL_ITEM_EVERY for k in at] == list(
        range(min(3, count // (CONTROL_ITEM_EVERY - 1)))
    )
    assert mix_control_items(order, gold) == found
    assert mix_control_items(order, order[:3]) == order


def test_what_was_begun_stands_where_it_stood_however_few_are_left(dataset, record):
    gold, order = gold_of(record, dataset), [record().uuid for _ in range(24)]
    recorded = dataset.labels.history(gold)[0]
    begun = {gold: ControlItemStep(recorded, beside=order[7])}
    assert mix_control_items(order, [gold], begun) == [*order[:8], gold, *order[8:]]
    assert mix_control_items(order[:3], [gold], begun) == [*order[:3], gold]
    assert mix_control_items(order[9:], [gold], begun)[0] == gold
    assert mix_control_items([], [gold], begun) == [gold]
    behind = {gold: ControlItemStep(recorded, skipped=True, beside=order[7])}
    put_off = [*order[9:], order[2], order[8]]
    assert mix_control_items(put_off, [gold], behind) == [*order[9:], order[2], gold, order[8]]
    assert mix_control_items(order, [gold], behind) == [*order, gold]
    # One of twenty all the same: what was begun has the place of another.
    assert mix_control_items(order, [gold, "new"], begun).count("new") == 0


def test_gold_keeps_its_own_time_and_knows_what_it_follows(dataset, record):
    old, a = gold_of(record, dataset), record().uuid
    assert preceding(["first", a, old], {a}) == {"first": "", old: a}
    book = sitting(dataset, old)
    entry = dataset.entry(old)
    assert book.entry(entry).recorded_ns == entry.recorded_ns
    assert book.of(old).history(old)[0].at_ns == dataset.labels.history(old)[0].at_ns


def sitting(dataset: Dataset, *uuids: str) -> ControlItemLabels:
    """Return the labels of Ann's session, with these episodes as control items."""
    book = ControlItemLabels(dataset.labels)
    recorded = {uuid: dataset.labels.history(uuid)[0] for uuid in uuids}
    book.begin("ann", {uuid: ControlItemView(r, "") for uuid, r in recorded.items()})
    return book


def measured(dataset: Dataset, person: str = "ann") -> AgreementReport:
    return compare_with_control_items(dataset.database, dataset.geometry, person)


def act(book: ControlItemLabels, dataset: Dataset, uuid: str, number: int) -> None:
    """Do an action determined by ``number``."""
    chosen = random.Random(number)
    name = chosen.choice(ACTIONS)
    label = Label(chosen.randrange(-3, 3) * 100, 0, 0, 100)
    labels = book.of(uuid)
    if name == "set":
        labels.set("ann", uuid, label)
    elif name == "accept":
        labels.accept("ann", uuid, chosen.choice([labels.head(uuid).label, label]))
    elif name == "reject":
        labels.reject("ann", uuid, "tilt")
    elif name == "take over":
        labels.take_over("ann", uuid)
    elif name == "restore":
        labels.restore_revision("ann", uuid, chosen.choice(labels.history(uuid)).rev_uuid)
    elif name == "verdict":
        labels.set("ann", uuid, labels.head(uuid).label, verdict="unsure")
    elif name == "skip":
        labels.skip("ann", uuid)
    elif name == "delete":
        labels.delete("ann", uuid, "torn gel")
    else:
        (dataset.labels.undo if name == "undo" else dataset.labels.redo)("ann")


def told(folder: Path, uuid: str, numbers: range, *, gold: bool) -> list[object]:
    """Return all that Ann sees during a series of actions, reopening in between.

    Of her log only actions, not ids.
    """
    seen: list[object] = []
    for start in range(0, len(numbers), 10):
        with Dataset.open(folder, person="ann") as dataset:
            book = sitting(dataset, *([uuid] if gold else []))
            for number in numbers[start : start + 10]:
                try:
                    act(book, dataset, uuid, number)
                except RefusedError as refusal:
                    seen.append((refusal.reason, refusal.detail))
                labels = book.of(uuid)
                seen.append([
                    (r.label, r.state, r.source, r.verdict, r.reason, r.person)
                    for r in [labels.head(uuid), *labels.history(uuid)]
                ])  # fmt: skip
                entry = book.entry(dataset.entry(uuid))
                seen.append((entry.state, entry.deleted, bool(dataset.labels._stack("ann").redo)))
            mine = [op for op in book.log() if op.actor == "ann"]
            seen.append([(op.verb, op.episodes) for op in mine])
    return seen


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gold_answers_every_key_as_the_rest_does_over_restarts(tmp_path, seed):
    numbers = range(100 * seed, 100 * seed + 60)
    with Dataset.open(tmp_path / "gold", person="cleo") as dataset:
        label = Label(1000, 0, 0, 150)
        uuid = add(dataset, label).uuid
    shutil.copytree(tmp_path / "gold", tmp_path / "plain")
    ordinary = told(tmp_path / "plain", uuid, numbers, gold=False)
    with Dataset.open(tmp_path / "gold", person="cleo") as dataset:
        dataset.labels.accept("bob", uuid, Label(1500, 0, 0, 50))
        dataset.labels.approve("cleo", uuid)
        before = dataset.labels.history(uuid)
    assert told(tmp_path / "gold", uuid, numbers, gold=True) == ordinary
    with Dataset.open(tmp_path / "gold", person="cleo") as dataset:
        # Not one of her steps is in a label; the log holds them all, and its chain is whole.
        assert dataset.labels.history(uuid) == before
        assert dataset.labels.marks(uuid) == {}
        (counts,) = labelled_episodes(dataset.database, "drafts")
        assert counts.label == Label(1500, 0, 0, 50)
        assert list(check_dataset(dataset.parts, whole=True)) == []
        steps = len(dataset.labels.control_item_steps("ann", uuid))
        assert steps == len([op for op in dataset.labels.log() if op.actor == "ann"]) > 10
    assert rebuild_dataset(tmp_path / "gold", replace=True).equal
    with Dataset.open(tmp_path / "gold", person="cleo") as dataset:
        assert len(dataset.labels.control_item_steps("ann", uuid)) == steps


def test_what_was_taken_back_is_gold_again_and_what_was_left_comes_first(
    dataset, record, monkeypatch
):
    monkeypatch.setattr("touchdown.backend.annotations.queues.AUDIT_SHARE", 1.0)
    gold = gold_of(record, dataset)
    plain = [record().uuid for _ in range(19)]

    def queue() -> tuple[list[str], ControlItemLabels]:
        order, entries = dataset.queue("unlabelled", "ann"), dataset.episodes()
        found, shown = with_control_items(dataset, "ann", order, {e.uuid: e for e in entries})
        book = ControlItemLabels(dataset.labels)
        book.begin("ann", shown)
        return found, book

    first, book = queue()
    assert sorted(first) == sorted([gold, *plain])
    at = first.index(gold)
    book.of(gold).set("ann", gold, Label(1100, 0, 0, 50))
    done = [uuid for uuid in plain if first.index(uuid) > at][:5]
    for uuid in done:
        dataset.labels.accept("ann", uuid)
    # Fewer than 19 are left: it stays where it was, as it was.
    again, book = queue()
    assert again == [uuid for uuid in first if uuid not in done]
    assert book.of(gold).head(gold).label.x_um == 1100
    book.of(gold).accept("ann", gold, Label(1100, 0, 0, 50))
    assert gold not in queue()[0]
    undone = dataset.labels.undo("ann")
    assert undone.episodes == [gold]
    assert queue()[0] == again
    queue()[1].of(gold).skip("ann", gold)
    assert queue()[0][-1] == gold


def test_the_log_tells_nothing_of_gold_while_it_waits(dataset, record):
    gold, plain = gold_of(record, dataset), record().uuid
    book = sitting(dataset, gold)
    for uuid in (gold, plain):
        book.of(uuid).set("ann", uuid, Label(1100, 0, 0, 50))
        book.of(uuid).accept("ann", uuid, Label(1100, 0, 0, 50))
    lines: dict[str, list[tuple[str, str]]] = {uuid: [] for uuid in (gold, plain)}
    for op in book.log():
        lines[op.episodes[0]].append((op.verb, op.actor))
    assert lines[gold] == lines[plain]
    assert {op.actor for op in dataset.labels.log()} >= {"bob", "cleo"}


def test_what_is_decided_is_an_opinion_that_undo_withdraws(dataset, record):
    near, far, none = (gold_of(record, dataset, x) for x in (1000, 2000, 3000))
    plain = record(4000, 0).uuid
    book, labels = sitting(dataset, near, far, none), dataset.labels
    book.of(near).accept("ann", near, Label(1600, 0, 0, 50), context=AnswerContext(3000))
    book.of(plain).accept("ann", plain, Label(4000, 0, 0, 50))
    book.of(far).accept("ann", far, Label(2800, 0, 0, 50), context=AnswerContext(5000))
    book.of(none).reject("ann", none, "tilt")
    found = measured(dataset)
    assert found.episodes == 3
    assert found.bias_x_mm.mean == pytest.approx((0.1 + 0.3) / 2)
    assert found.rms_mm == pytest.approx(((0.01 + 0.09) / 2) ** 0.5)
    assert found.seconds[0] == 4.0
    for uuid in (none, far, plain):
        undone = labels.undo("ann")
        assert undone.episodes == [uuid]
    assert labels.head(plain).state == "draft"
    assert measured(dataset).rms_mm == pytest.approx(0.1)
    labels.redo("ann")
    assert labels.head(plain).state == "submitted"
    labels.redo("ann")
    again = measured(dataset)
    assert again.rms_mm == pytest.approx(found.rms_mm)
    assert again.seconds[0] == 4.0
    # The draw of each id decides whether the undone one is asked again.
    assert set(dataset.queue("gold", "ann")) <= {none}
    # Who approved or wrote the label is measured against nothing of their own.
    assert measured(dataset, "bob").episodes == 0


def test_deleting_what_was_answered_and_taking_that_back_keeps_the_answer(dataset, record):
    gold = gold_of(record, dataset)
    book = sitting(dataset, gold)
    book.of(gold).accept("ann", gold, Label(1600, 0, 0, 50), context=AnswerContext(3000))
    book.of(gold).delete("ann", gold, "torn gel")
    assert math.isnan(measured(dataset).rms_mm)
    dataset.labels.undo("ann")
    assert measured(dataset).rms_mm == pytest.approx(0.1)


def test_a_disk_that_refuses_leaves_gold_to_be_done_again(dataset, record, monkeypatch):
    uuid = gold_of(record, dataset)
    book, labels = sitting(dataset, uuid), dataset.labels
    mend, full = operation_log.append_operation, Fault("DISK-FULL", "Full.", "Not saved.", "Room.")

    def refuse(*_args: object, **_named: object) -> None:
        raise FaultError(full)

    def accept(person: str) -> None:
        book.of(uuid).accept(person, uuid, Label(1600, 0, 0, 50))

    for again, state in ((accept, "submitted"), (labels.undo, "draft"), (labels.redo, "submitted")):
        before = book.of(uuid).head(uuid)
        monkeypatch.setattr(operation_log, "append_operation", refuse)
        with pytest.raises(FaultError):
            again("ann")
        assert book.of(uuid).head(uuid) == before
        monkeypatch.setattr(operation_log, "append_operation", mend)
        again("ann")
        assert book.of(uuid).head(uuid).state == state
    assert measured(dataset).episodes == 1
