"""Full or failing disks: one fault, no loss of recorded data, and work continues afterwards."""

import contextlib
import errno
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations import storage
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.storage import free_space_for
from touchdown.backend.annotations.values import EpisodeContext, Label
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.core.values import Episode
from touchdown.backend.runs.collector import EpisodeRecorder


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    """Let the system refuse to write any file beyond ``size`` bytes."""
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        signal.signal(signal.SIGXFSZ, handler)


def record(dataset: Dataset, seed: int) -> str:
    context = context_for(dataset)
    label = Label(seed, 0, 0, 1)
    return dataset.record(small_episode(seed=seed), label, source="commanded", context=context).uuid


def fill(dataset: Dataset) -> None:
    for seed in range(3, 60):
        record(dataset, seed)


def whole(dataset: Dataset, uuid: str, seed: int) -> bool:
    return np.array_equal(dataset.read(uuid).observation, small_episode(seed=seed).observation)


@pytest.mark.promise("D2")
@pytest.mark.parametrize("limit", [1, 500, 5_000, 15_000])
def test_a_full_disk_is_one_fault_and_costs_one_episode(tmp_path: Path, limit: int) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        first = record(dataset, 1)
        with no_file_above(limit), pytest.raises(FaultError) as error:
            record(dataset, 2)
        assert error.value.fault.code == "DISK-FULL"
        assert error.value.fault.next_step
        assert [entry.uuid for entry in dataset.episodes()] == [first]
        assert list(folder.rglob("*.part")) == []
        last = record(dataset, 3)
        assert whole(dataset, first, 1)
        assert whole(dataset, last, 3)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert len(dataset.episodes()) == 2
        assert dataset.database.one("PRAGMA integrity_check") == ("ok",)


Refusal = Callable[[], None]


@pytest.mark.promise("D1", "D3")
@pytest.mark.parametrize("nth", range(1, 7))
@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_the_nth_refusal_loses_nothing_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, nth: int
) -> None:
    folder = tmp_path / "data"
    acknowledged: dict[str, int] = {}
    with Dataset.open(folder) as dataset:
        acknowledged[record(dataset, 0)] = 0
        original, calls = getattr(os, name), 0

        def refuse(*args: object, **words: object) -> object:
            nonlocal calls
            calls += 1
            if calls == nth:
                raise OSError(errno.EIO, "Input/output error")
            return original(*args, **words)

        monkeypatch.setattr(os, name, refuse)
        for seed in range(1, 4):
            with contextlib.suppress(FaultError):
                acknowledged[record(dataset, seed)] = seed
        monkeypatch.undo()
        acknowledged[record(dataset, 9)] = 9
        assert calls >= nth or name == "replace"
    with Dataset.open(folder) as dataset:
        for uuid, seed in acknowledged.items():
            assert whole(dataset, uuid, seed)
        assert len(acknowledged) >= 4
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()


def test_a_commit_that_fails_leaves_the_file_to_be_adopted(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        record(dataset, 1)
        size = (folder / "catalog.db-wal").stat().st_size
        database = dataset.database
        with database.reading() as connection:
            connection.execute("PRAGMA wal_autocheckpoint = 0")
        record(dataset, 2)
        limit = max((folder / "catalog.db-wal").stat().st_size, size, 25_000)
        with no_file_above(limit), pytest.raises(FaultError) as error:
            fill(dataset)
        assert error.value.fault.code == "CATALOGUE-WRITE"
        listed = {entry.uuid for entry in dataset.episodes()}
        assert database.one("PRAGMA integrity_check") == ("ok",)
        record(dataset, 99)
    with Dataset.open(folder) as dataset:
        assert any("adopted" in notice for notice in dataset.notices)
        assert len(dataset.episodes()) == len(listed) + 2


def test_a_catalogue_without_room_is_a_full_disk_and_what_is_tried_again_the_same_episode(
    tmp_path: Path,
) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset, closing(EpisodeRecorder(dataset)) as recorder:
        context, label = context_for(dataset), Label(1, 0, 0, 1)
        room = limit_pages(dataset, 1)
        episode = recorded_until_full(recorder, context, label)
        listed = len(dataset.episodes())
        with pytest.raises(FaultError):
            recorder.settle()
        limit_pages(dataset, room)
        last = recorder.settle()
        names = {path.stem for path in (folder / "raw").rglob("*.mcap")}
        assert names == {entry.uuid for entry in dataset.episodes()}
        assert len(names) == listed + 1
        assert np.array_equal(dataset.read(last.uuid).observation, episode.observation)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()


def recorded_until_full(
    recorder: EpisodeRecorder, context: EpisodeContext, label: Label
) -> Episode:
    """Record until the disk is full; return the episode that it refused."""
    for seed in range(200):
        episode = replace(small_episode(seed=seed), episode_id="of the bench")
        recorder.record(episode, label, context)
        try:
            recorder.settle()
        except FaultError as error:
            if error.fault.code == "DISK-FULL":
                return episode
            raise
    raise AssertionError("the limit did not bind")


def limit_pages(dataset: Dataset, pages: int) -> int:
    """Let the catalogue have no more ``pages`` (or as many as it has); returns the former limit."""
    with dataset.database.reading() as reader:
        (used,) = reader.execute("PRAGMA page_count").fetchone()
    with dataset.database.transaction() as connection:
        (before,) = connection.execute("PRAGMA max_page_count").fetchone()
        connection.execute(f"PRAGMA max_page_count = {max(pages, used)}")
    return int(before)


class Usage:
    total, used = 10**12, 0

    def __init__(self, free: int) -> None:
        self.free = free


@pytest.mark.parametrize(
    ("free_mb", "bytes_each", "refused"),
    [(999, 20_000, True), (1001, 20_000, False), (1500, 20_000_000, True),
     (2001, 20_000_000, False)],
)  # fmt: skip
def test_no_campaign_on_a_disk_nearly_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mb: int, bytes_each: int, refused: bool
) -> None:
    usage = Usage(free_mb * 1_000_000)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda place: usage)
    folder = tmp_path / "not" / "yet"
    if refused:
        with pytest.raises(InputError, match="GB"):
            free_space_for(folder, 5, bytes_each)
        return
    room = free_space_for(folder, 200, bytes_each)
    assert room.episodes == usage.free // bytes_each
    assert room.enough == (room.episodes >= 200)
