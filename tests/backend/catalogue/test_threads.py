"""A dataset shared by threads: campaign, labelling page and jobs at the same time."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from tests.backend.catalogue.conftest import Record, context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import read_journal
from touchdown.backend.annotations.values import Label, first_broken_link
from touchdown.backend.core.faults import RefusedError

ROUNDS = 12


def test_recording_labelling_and_reading_at_once_lose_nothing(
    dataset: Dataset, record: Record
) -> None:
    uuids = [record().uuid for _ in range(3)]
    context = context_for(dataset)

    def collect(seed: int) -> str:
        episode = small_episode(seed=seed)
        entry = dataset.record(episode, Label(seed, 0), source="measured", context=context)
        return entry.uuid

    def label(number: int) -> int:
        person, uuid = f"person {number % 2}", uuids[number % 3]
        try:
            dataset.labels.set(person, uuid, Label(number, number, 0, 10))
            dataset.labels.undo(person)
        except RefusedError:
            return 0
        return 2

    def look(number: int) -> int:
        return len(dataset.labels.history(uuids[number % 3])) + len(dataset.episodes())

    with ThreadPoolExecutor(6) as pool:
        collected = pool.map(collect, range(ROUNDS))
        written = pool.map(label, range(3 * ROUNDS))
        looked = pool.map(look, range(3 * ROUNDS))
        new, count, seen = list(collected), sum(written), list(looked)
    assert min(seen) >= 1 + 3
    assert {entry.uuid for entry in dataset.episodes()} == {*uuids, *new}
    log = sorted(dataset.labels.log(limit=10_000), key=lambda op: op.seq)
    assert first_broken_link(log) is None
    assert list(read_journal(dataset.journal.path(dataset.description.site))) == log
    assert len([op for op in log if op.verb == "record"]) == 3 + ROUNDS
    assert len(log) >= 3 + ROUNDS + count
