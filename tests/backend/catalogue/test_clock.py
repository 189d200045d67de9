"""A clock that is set back by an hour puts nothing out of order."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from backend.catalogue import uuid7 as ids
from backend.catalogue.backups import Backups
from backend.catalogue.dataset import Dataset
from backend.catalogue.recovery import examine
from backend.catalogue.uuid7 import follow, from_parts, uuid7
from backend.catalogue.values import Label
from backend.runs.campaign import new_campaign
from tests.backend.catalogue.conftest import context_for, small_episode

HOUR_NS = 3600 * 1_000_000_000


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
        assert list(examine(dataset.store, whole=True)) == []


def test_a_campaign_of_now_is_newer_than_one_of_an_hour_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = new_campaign("pot", "circle15", "random", 0, 3, None).uuid
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() - HOUR_NS)
    monkeypatch.setattr(ids, "_last", (0, 0))
    follow(before)
    assert uuid7() > before
    last_of_a_millisecond = from_parts(clock() // 1_000_000, (1 << 74) - 1)
    follow(last_of_a_millisecond)
    assert uuid7() > last_of_a_millisecond
    follow("no id")
    assert uuid7() > last_of_a_millisecond


def test_labels_are_backed_up_hourly_although_the_newest_copy_is_of_tomorrow(
    dataset: Dataset,
) -> None:
    now = datetime(2030, 5, 2, 12, tzinfo=UTC)
    keeper = Backups(dataset.database, dataset.folder / "b", lambda: now + timedelta(days=1))
    dataset.labels.skip("ann", dataset.record(
        small_episode(), Label(0, 0, 0, 9), source="measured", context=context_for(dataset)
    ).uuid)  # fmt: skip
    keeper.make("test")
    dataset.labels.flag("ann", dataset.episodes()[0].uuid)
    back = Backups(dataset.database, dataset.folder / "b", lambda: now)
    assert back.hourly() is not None
    assert back.hourly() is None
