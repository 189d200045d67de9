"""A clock that is set back by an hour does not disturb the order."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations import values as ids
from touchdown.backend.annotations.backups import BackupStore
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.values import Label, follow_uuid, uuid7, uuid7_from_parts
from touchdown.backend.runs.campaign import new_campaign

HOUR_NS = 3600 * 1_000_000_000


@pytest.mark.promise("P2")
def test_labels_and_episodes_keep_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder, person="ann") as dataset:
        context = context_for(dataset)

        def record() -> str:
            label = Label(0, 0, 0, 9)
            made = dataset.record(small_episode(), label, source="measured", context=context)
            return made.uuid

        first = record()
        dataset.labels.set("ann", first, Label(100, 0, 0, 9))
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() - HOUR_NS)
    monkeypatch.setattr(ids, "_last", (0, 0))  # as in a process that starts now
    with Dataset.open(folder, person="ann") as dataset:
        assert dataset.notices == ()
        second = record()
        dataset.labels.set("ann", first, Label(200, 0, 0, 9))
        assert [e.uuid for e in dataset.episodes()] == [first, second]
        assert dataset.labels.head(first).label.x_um == 200
        assert [r.label.x_um for r in dataset.labels.history(first)] == [0, 100, 200]
        dataset.labels.undo("ann")
        assert dataset.labels.head(first).label.x_um == 100
        assert list(check_dataset(dataset.parts, whole=True)) == []


def test_a_campaign_of_now_is_newer_than_one_of_an_hour_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = new_campaign("pot", "circle15", "random", 0, 3, None).uuid
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() - HOUR_NS)
    monkeypatch.setattr(ids, "_last", (0, 0))
    follow_uuid(before)
    assert uuid7() > before
    last_of_a_millisecond = uuid7_from_parts(clock() // 1_000_000, (1 << 74) - 1)
    follow_uuid(last_of_a_millisecond)
    assert uuid7() > last_of_a_millisecond
    follow_uuid("no id")
    assert uuid7() > last_of_a_millisecond


def test_labels_are_backed_up_hourly_although_the_newest_copy_is_of_tomorrow(
    dataset: Dataset,
) -> None:
    now = datetime(2030, 5, 2, 12, tzinfo=UTC)
    keeper = BackupStore(dataset.database, dataset.folder / "b", lambda: now + timedelta(days=1))
    dataset.labels.skip("ann", dataset.record(
        small_episode(), Label(0, 0, 0, 9), source="measured", context=context_for(dataset)
    ).uuid)  # fmt: skip
    keeper.make("test")
    dataset.labels.flag("ann", dataset.episodes()[0].uuid)
    back = BackupStore(dataset.database, dataset.folder / "b", lambda: now)
    assert back.hourly() is not None
    assert back.hourly() is None
