"""Review queues: contents, order, and injected errors first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.catalogue.conftest import Record, context_for
from tests.backend.catalogue.filling import fill
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.queues import AUDIT_SHARE, QUEUES, Suggestion, disagreement
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError


def test_work_moves_from_queue_to_queue(dataset: Dataset, record: Record) -> None:
    labels, (a, b, c) = dataset.labels, [record().uuid for _ in range(3)]
    assert dataset.queue("unlabelled", "ann") == [a, b, c]
    labels.skip("ann", a)
    assert dataset.queue("unlabelled", "ann") == [b, c, a]
    assert dataset.queue("unlabelled", "ann", limit=1) == [b]
    labels.accept("ann", b)
    assert dataset.queue("unlabelled", "ann") == [c, a]
    assert dataset.queue("review", "ann") == []
    assert dataset.queue("review", "bob") == [b]
    labels.reject("bob", b, "tilt")
    assert dataset.queue("returned", "ann") == [b]
    assert dataset.queue("returned", "bob") == []
    labels.delete("ann", c, "test")
    assert dataset.queue("unlabelled", "ann") == [a]
    assert dataset.counts() == {"deleted": 1, "rejected": 1, "unlabelled": 1}
    with pytest.raises(InputError, match="no queue 'all'"):
        dataset.queue("all", "ann")


def test_coverage_brings_the_emptiest_squares_first(dataset: Dataset, record: Record) -> None:
    labels = dataset.labels
    crowded = [record(100 * k, 100).uuid for k in range(4)]
    lonely = record(-100, 100).uuid
    other_pair = dataset.record(
        replace(dataset.read(lonely), episode_id="another"),
        Label(100, 100), source="commanded", context=context_for(dataset, "pot", "hex20"),
    ).uuid  # fmt: skip
    for uuid in crowded[:2]:
        labels.accept("ann", uuid)
        labels.approve("bob", uuid)
    assert dataset.queue("coverage", "ann") == [lonely, other_pair, *crowded[2:]]
    labels.accept("ann", lonely)
    labels.approve("bob", lonely)
    assert dataset.queue("coverage", "ann") == [other_pair, *crowded[2:]]


def test_injected_errors_come_first_in_the_queue_of_disagreement(dataset: Dataset) -> None:
    uuids = fill(dataset, 1000)
    rng = np.random.default_rng(3)
    wrong = set(rng.choice(uuids, 20, replace=False).tolist())
    values = {}
    for uuid in uuids:
        head = dataset.labels.head(uuid)
        noise = rng.normal(0, 150, 2) + (2000 if uuid in wrong else 0)
        x, y = head.label.offset_mm * 1e3 + noise
        guess = Suggestion(Label(round(x), round(y), 0, 150), "model:m", 0)
        value = disagreement(head, guess)
        assert value is not None
        values[uuid] = value
    dataset.scores.put("disagreement", values, "m")
    first = dataset.queue("disagreement", "ann", limit=100)
    precision = len(wrong & set(first)) / 100
    base_rate = len(wrong) / len(uuids)
    assert precision == 0.2 > 5 * base_rate
    assert set(first[:20]) == wrong
    assert dataset.queue("disagreement", "ann")[:100] == first
    dataset.labels.set("ann", first[0], Label(1, 1))
    assert first[0] not in dataset.queue("disagreement", "ann")
    assert dataset.scores.of(first[1]) == {"disagreement": values[first[1]]}


def test_uncertain_and_duplicate_signals(dataset: Dataset, record: Record) -> None:
    a, b, c = (record().uuid for _ in range(3))
    dataset.scores.put("uncertainty", {a: 0.1, b: 0.7, c: 0.4, "gone": 9.0}, "m")
    dataset.scores.put("duplicates", {a: 1.1, c: 7.5}, "m")
    assert dataset.queue("uncertainty", "ann") == [b, c, a]
    assert dataset.queue("duplicates", "ann") == [c, a]
    dataset.labels.accept("ann", b)
    assert dataset.queue("uncertainty", "ann") == [b, c, a]
    dataset.labels.approve("bob", b)
    assert dataset.queue("uncertainty", "ann") == [c, a]
    with pytest.raises(InputError, match="no score"):
        dataset.scores.put("beauty", {a: 1.0}, "m")


def test_a_random_audit_is_a_share_that_its_seed_repeats(dataset: Dataset) -> None:
    uuids = fill(dataset, 2000, approved=2000)
    first = dataset.queue("audit", "ann", seed=1)
    assert first == dataset.queue("audit", "bob", seed=1)
    assert first != dataset.queue("audit", "ann", seed=2)
    assert len(first) == pytest.approx(AUDIT_SHARE * len(uuids), rel=0.35)
    assert first != sorted(first)


def test_gold_items_are_answered_once_and_never_by_their_author(dataset: Dataset) -> None:
    fill(dataset, 500, approved=500)
    gold = dataset.queue("gold", "cleo", seed=4)
    assert gold
    dataset.labels.opinion("cleo", gold[0], Label(1, 1, 0, 100))
    assert dataset.queue("gold", "cleo", seed=4) == gold[1:]
    assert dataset.queue("gold", "ann", seed=4) == []


def test_every_queue_answers_on_an_empty_dataset(dataset: Dataset) -> None:
    for name in QUEUES:
        assert dataset.queue(name, "ann") == []


def test_a_suggestion_is_no_label(dataset: Dataset, record: Record) -> None:
    entry = record()
    before = dataset.labels.history(entry.uuid)
    assert dataset.scores.suggestion(entry.uuid) is None
    dataset.scores.suggest({entry.uuid: Label(5, 6, 0, 700)}, "abc")
    found = dataset.scores.suggestion(entry.uuid)
    assert found is not None
    assert (found.label, found.source) == (Label(5, 6, 0, 700), "model:abc")
    assert dataset.labels.history(entry.uuid) == before
