"""Gold among the ordinary work: nobody can tell it, and no approved label is touched."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path

import pytest

from backend.catalogue.comparison import against_gold
from backend.catalogue.dataset import Dataset
from backend.catalogue.gold import GOLD_EVERY, GoldBook, disguised, mixed
from backend.catalogue.values import Label, Looked
from backend.core.faults import Fault, FaultError, RefusedError
from tests.backend.catalogue.conftest import Record, context_for, small_episode

ACTIONS = ("set", "accept", "reject", "take over", "restore", "verdict", "undo", "redo")


def gold_of(record: Record, dataset: Dataset, x_um: int = 1000) -> str:
    """Return an episode that Bob labelled 0.5 mm off its draft and Cleo approved."""
    uuid = record(x_um, 0).uuid
    dataset.labels.accept("bob", uuid, Label(x_um + 500, 0, 0, 50))
    dataset.labels.approve("cleo", uuid)
    return uuid


@pytest.mark.parametrize("count", [0, 18, 19, 100])
def test_one_in_twenty_is_gold(count: int) -> None:
    order, gold = [f"o{k}" for k in range(count)], [f"g{k}" for k in range(3)]
    found = mixed(order, gold)
    assert [uuid for uuid in found if uuid in order] == order
    at = [found.index(uuid) for uuid in gold if uuid in found]
    assert [k // GOLD_EVERY for k in at] == list(range(min(3, count // (GOLD_EVERY - 1))))
    assert mixed(order, gold) == found
    assert mixed(order, order[:3]) == order


def test_gold_shows_a_time_between_its_neighbours(dataset: Dataset, record: Record) -> None:
    old = gold_of(record, dataset)
    entries = {e.uuid: e for e in [dataset.entry(old), record(), record()]}
    _, a, b = entries
    entries[old] = replace(entries[old], recorded_ns=5)
    told = disguised([a, old, b], entries, [old])
    assert entries[a].recorded_ns <= told[old] <= entries[b].recorded_ns


def act(book: GoldBook, uuid: str, number: int) -> None:
    """Do something that ``number`` alone decides."""
    chosen = random.Random(number)
    name = chosen.choice(ACTIONS)
    label = Label(chosen.randrange(-3, 3) * 100, 0, 0, 100)
    if name == "set":
        book.of(uuid).set("ann", uuid, label)
    elif name == "accept":
        book.of(uuid).accept("ann", uuid, chosen.choice([book.of(uuid).head(uuid).label, label]))
    elif name == "reject":
        book.of(uuid).reject("ann", uuid, "tilt")
    elif name == "take over":
        book.of(uuid).take_over("ann", uuid)
    elif name == "restore":
        book.of(uuid).restore_revision(
            "ann", uuid, chosen.choice(book.of(uuid).history(uuid)).rev_uuid
        )
    elif name == "verdict":
        book.of(uuid).set("ann", uuid, book.of(uuid).head(uuid).label, verdict="unsure")
    else:
        (book.undo if name == "undo" else book.redo)("ann")


def told(book: GoldBook, dataset: Dataset, uuid: str, numbers: range) -> list[object]:
    """Return all that Ann sees while she does one thing after the other."""
    seen: list[object] = []
    for number in numbers:
        try:
            act(book, uuid, number)
        except RefusedError as refusal:
            seen.append((refusal.reason, refusal.detail))
        seen.append([
            (r.label, r.state, r.source, r.verdict, r.reason, r.person)
            for r in [book.of(uuid).head(uuid), *book.of(uuid).history(uuid)]
        ])  # fmt: skip
        seen.append(book.entry(dataset.entry(uuid)).state)
    return seen


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_gold_answers_every_key_as_the_rest_does(tmp_path: Path, seed: int) -> None:
    numbers = range(100 * seed, 100 * seed + 40)
    with Dataset.open(tmp_path / "plain", person="cleo") as plain:
        context = context_for(plain)
        label = Label(1000, 0, 0, 150)
        uuid = plain.record(small_episode(), label, source="commanded", context=context).uuid
        ordinary = told(GoldBook(plain.labels), plain, uuid, numbers)
    with Dataset.open(tmp_path / "gold", person="cleo") as dataset:
        uuid = dataset.record(small_episode(), label, source="commanded", context=context).uuid
        dataset.labels.accept("bob", uuid, Label(1500, 0, 0, 50))
        dataset.labels.approve("cleo", uuid)
        before = dataset.labels.history(uuid)
        book = GoldBook(dataset.labels)
        book.begin("ann", {uuid: (7, before[0])})
        assert told(book, dataset, uuid, numbers) == ordinary
        assert dataset.labels.history(uuid) == before
        verbs = {op.verb for op in dataset.labels.log(actor="ann")}
        assert verbs == {"label.opinion"}


def test_what_is_decided_is_an_opinion_that_undo_withdraws(
    dataset: Dataset, record: Record
) -> None:
    near, far, none = (gold_of(record, dataset, x) for x in (1000, 2000, 3000))
    plain = record(4000, 0).uuid
    book = GoldBook(dataset.labels)
    book.begin("ann", {u: (7, dataset.labels.history(u)[0]) for u in (near, far, none)})
    book.of(near).accept("ann", near, Label(1600, 0, 0, 50), looked=Looked(3000))
    book.of(plain).accept("ann", plain, Label(4000, 0, 0, 50))
    book.of(far).accept("ann", far, Label(2800, 0, 0, 50), looked=Looked(5000))
    book.of(none).reject("ann", none, "tilt")
    found = against_gold(dataset.database, dataset.geometry, "ann")
    assert found.episodes == 3
    assert found.bias_x_mm.mean == pytest.approx((0.1 + 0.3) / 2)
    assert found.rms_mm == pytest.approx(((0.01 + 0.09) / 2) ** 0.5)
    assert found.seconds[0] == 4.0
    assert book.undo("ann") == none
    assert book.undo("ann") == far
    undone = book.undo("ann")
    assert not isinstance(undone, str)
    assert undone is not None
    assert dataset.labels.head(plain).state == "draft"
    assert against_gold(dataset.database, dataset.geometry, "ann").rms_mm == pytest.approx(0.1)
    book.redo("ann")
    assert dataset.labels.head(plain).state == "submitted"
    assert dataset.queue("gold", "ann") == []
    # Who approved or wrote the label is measured against nothing of their own.
    assert against_gold(dataset.database, dataset.geometry, "bob").episodes == 0


def test_a_disk_that_refuses_leaves_undo_and_redo_of_gold_to_be_done_again(
    dataset: Dataset, record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    uuid = gold_of(record, dataset)
    book = GoldBook(dataset.labels)
    book.begin("ann", {uuid: (7, dataset.labels.history(uuid)[0])})
    book.of(uuid).accept("ann", uuid, Label(1600, 0, 0, 50))
    keep, full = dataset.labels.opinion, Fault("DISK-FULL", "Full.", "Not saved.", "Room.")

    def refuse(*_args: object, **_named: object) -> None:
        raise FaultError(full)

    for again, state in ((book.undo, "draft"), (book.redo, "submitted")):
        before = book.of(uuid).head(uuid)
        monkeypatch.setattr(dataset.labels, "opinion", refuse)
        with pytest.raises(FaultError):
            again("ann")
        assert book.of(uuid).head(uuid) == before
        monkeypatch.setattr(dataset.labels, "opinion", keep)
        assert again("ann") == uuid
        assert book.of(uuid).head(uuid).state == state
    assert against_gold(dataset.database, dataset.geometry, "ann").episodes == 1
