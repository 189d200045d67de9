"""Full or failing disks: one fault, no loss of recorded data, and work continues afterwards."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import shutil
import signal
import sqlite3
import stat
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest

from tests.backend.annotations.conftest import add, context_for, flip_byte, small_episode
from touchdown.app.shell.datasets import open_dataset
from touchdown.backend.annotations import episode_files, operation_log, reconciliation, storage
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import check_dataset, reconcile
from touchdown.backend.annotations.storage import ReadOnlyFolderError, check_free_space
from touchdown.backend.annotations.values import EpisodeContext, EpisodeFilter, Label
from touchdown.backend.core import Episode, FaultError, InputError
from touchdown.backend.episodes.episode_mcap import (
    read_compressed_episode,
    read_episode,
    write_episode,
)
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter, read_pack
from touchdown.backend.episodes.training_rows import patch_hex
from touchdown.backend.geometry import face_points, load_pieces, true_patch
from touchdown.backend.runs.campaign import new_campaign
from touchdown.backend.runs.collector import EpisodeRecorder
from touchdown.backend.runs.recorder import keep_photo


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
    return add(dataset, Label(seed, 0, 0, 1), seed=seed).uuid


def fill(dataset: Dataset) -> None:
    for seed in range(3, 60):
        record(dataset, seed)


def whole(dataset: Dataset, uuid: str, seed: int) -> bool:
    return np.array_equal(dataset.read(uuid).observation, small_episode(seed=seed).observation)


@pytest.mark.promise("D2")
@pytest.mark.parametrize("limit", [1, 500, 5_000, 15_000])
def test_a_full_disk_is_one_fault_and_costs_one_episode(tmp_path, limit):
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


@pytest.mark.promise("D1", "D3")
@pytest.mark.parametrize("nth", range(1, 7))
@pytest.mark.parametrize("name", ["fsync", "replace"])
def test_the_nth_refusal_loses_nothing_acknowledged(tmp_path, monkeypatch, name, nth):
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


def test_a_commit_that_fails_leaves_the_file_to_be_adopted(tmp_path):
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


def test_a_catalogue_without_room_is_a_full_disk_and_what_is_tried_again_the_same_episode(tmp_path):
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


def test_no_campaign_on_a_disk_nearly_full(tmp_path, monkeypatch):
    usage = SimpleNamespace(free=1_001_000_000)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda place: usage)
    check_free_space(tmp_path / "not" / "yet")
    usage.free = 999_000_000
    with pytest.raises(InputError, match=r"1\.00 GB"):
        check_free_space(tmp_path / "not" / "yet")


FORBIDDEN = set('<>:"/\\|?*') | {chr(code) for code in range(32)}
LABEL = Label(1000, -500, 0, 150)


def refusing_folders(monkeypatch: pytest.MonkeyPatch, code: int) -> list[int]:
    """Let every sync of a folder fail with ``code``; returns a list that grows by each."""
    asked, known = list[int](), os.fsync

    def fsync(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            asked.append(descriptor)
            raise OSError(code, os.strerror(code))
        known(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    return asked


def filled(folder: Path) -> list[str]:
    """Make a dataset with all that is written beside the catalogue; returns its episodes."""
    with Dataset.open(folder, person="cleo") as dataset:
        uuids = [add(dataset, LABEL, seed=k, source="measured").uuid for k in (1, 2)]
        dataset.labels.accept("ann", uuids[0], Label(1500, 0, 0, 50))
        assert not dataset.labels.journal_trouble
        dataset.back_up_for("test")
        assert not dataset.backup_trouble
        new_campaign("pot", "circle15", "random", 0, 4, None).save(folder)
    return uuids


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP])
def test_where_no_folder_can_be_synced_everything_is_kept(tmp_path, monkeypatch, code):
    asked = refusing_folders(monkeypatch, code)
    uuids = filled(tmp_path / "data")
    picture = tmp_path / "p.png"
    picture.write_bytes(b"\x89PNG\r\n\x1a\n")
    assert keep_photo(tmp_path / "run", 1, picture).is_file()
    assert asked
    with Dataset.open(tmp_path / "data") as dataset:
        assert dataset.notices == ()
        assert [entry.uuid for entry in dataset.episodes()] == uuids
        assert dataset.labels.head(uuids[0]).state == "submitted"
        assert dataset.film(uuids[1]).episode.episode_id == uuids[1]


def test_a_disk_that_fails_to_sync_a_folder_is_no_such_disk(tmp_path, monkeypatch):
    with Dataset.open(tmp_path / "data", person="cleo") as dataset:
        context = context_for(dataset)
        refusing_folders(monkeypatch, errno.EIO)
        with pytest.raises(FaultError) as caught:
            add(dataset, LABEL, source="measured", context=context)
        assert caught.value.fault.code == "EPISODE-WRITE"
        assert dataset.episodes() == []


def test_all_names_of_a_dataset_are_told_apart_and_allowed_on_fat(tmp_path):
    filled(tmp_path / "data")
    names = [path.relative_to(tmp_path) for path in (tmp_path / "data").rglob("*")]
    assert len(names) > 15
    assert len({str(name).casefold() for name in names}) == len(names)
    for name in names:
        assert not FORBIDDEN & set(name.name), name
        assert not name.name.endswith((".", " ")), name


def test_a_dataset_on_fat_says_what_a_power_cut_may_do(tmp_path, monkeypatch):
    mounts = [("/", "ext4"), (str(tmp_path), "vfat")]
    parts = [SimpleNamespace(mountpoint=at, fstype=kind) for at, kind in mounts]
    monkeypatch.setattr(psutil, "disk_partitions", lambda *, all: parts)
    with Dataset.open(tmp_path / "data") as dataset:
        (said,) = dataset.notices
    assert said.startswith("The dataset lies on a vfat disk, which a power cut can damage")
    assert storage.disk_weakness(Path("/elsewhere"), mounts) == ""


@contextmanager
def held(dataset: Dataset) -> Iterator[sqlite3.Connection]:
    """Another connection with a write transaction, as of another program."""
    with closing(sqlite3.connect(dataset.database.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield other
        if other.in_transaction:
            other.execute("ROLLBACK")


@pytest.mark.promise("D4")
def test_a_catalogue_that_stays_locked_is_one_fault_and_nothing_is_lost(dataset):
    first = record(dataset, 1)
    # As long as the settings of the connection say; the test has no time for it.
    assert dataset.database.one("PRAGMA busy_timeout")[0] == 2000
    dataset.database.first("PRAGMA busy_timeout = 20")
    with held(dataset):
        with pytest.raises(FaultError) as caught:
            record(dataset, 1)
        assert caught.value.fault.code == "CATALOGUE-BUSY"
        with pytest.raises(FaultError, match="Another program"):
            dataset.labels.set("ann", first, Label(100, 0, 0, 9))
        # Readers go on meanwhile.
        assert [entry.uuid for entry in dataset.episodes()] == [first]
        assert dataset.labels.head(first).label == Label(1, 0, 0, 1)
    second = record(dataset, 1)
    dataset.labels.set("ann", first, Label(100, 0, 0, 9))
    assert [entry.uuid for entry in dataset.episodes()] == [first, second]
    assert dataset.labels.head(first).label.x_um == 100
    assert dataset.database.one("PRAGMA integrity_check") == ("ok",)


@pytest.mark.promise("D4")
def test_a_writer_waits_for_a_lock_that_is_let_go(dataset):
    first = record(dataset, 1)
    dataset.database.first("PRAGMA busy_timeout = 30000")
    with held(dataset) as other:
        done: list[str] = []
        writer = threading.Thread(target=lambda: done.append(record(dataset, 1)))
        writer.start()
        # It may not write before the other one has: that is seen from outside.
        writer.join(0.1)
        assert writer.is_alive()
        assert done == []
        other.execute("ROLLBACK")
        writer.join(30.0)
    assert [entry.uuid for entry in dataset.episodes()] == [first, *done]


def write_pack(path: Path, count: int = 4, seed: int = 0, geometry: str | None = None) -> Path:
    pieces = load_pieces()
    pot, bottom = pieces.top("pot"), pieces.bottom("circle15")
    points = face_points(pot.face)
    rng = np.random.default_rng(seed)
    with PackWriter(path, {"simulated": "true"}) as pack:
        for number in range(count):
            x_um, y_um = (int(v) for v in rng.integers(-8000, 8000, 2))
            label: dict[str, object] = {
                "episode": f"pot-circle15-{seed}-{number}", "x_um": x_um, "y_um": y_um,
                "sigma_um": 300, "source": "commanded", "piece": "pot", "bottom": "circle15",
                "patch": patch_hex(true_patch(points, (x_um / 1e3, y_um / 1e3), bottom.face)),
                "points": len(points), "geometry": geometry or pot.sha256,
                "grip_id": f"g{number // 2}", "mounting_id": "m0", "person": "simulation",
                "seed": seed,
            }  # fmt: skip
            pack.write(PackedEpisode(rng.normal(size=(20, 258)).astype(np.float32), label))
    return path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap")
    return folder


def states(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        return [entry.file_state for entry in dataset.episodes()]


def calm(folder: Path) -> bool:
    with Dataset.open(folder) as dataset:
        found = (*dataset.problems, *check_dataset(dataset.parts, whole=True))
        return all(problem.lasting for problem in found)


def test_a_pack_becomes_episodes_with_commanded_drafts(folder):
    with Dataset.open(folder) as dataset:
        assert "4 episodes of packs/a.mcap entered" in dataset.notices[0]
        assert dataset.episodes(EpisodeFilter(accepted=False)) == []
        entries = dataset.episodes(EpisodeFilter(accepted=True))
        assert sorted(e.grip_id for e in entries) == ["g0", "g0", "g1", "g1"]
        assert {(e.piece, e.bottom, e.mode, e.state, e.keep_frames) for e in entries} == {
            ("pot", "circle15", "mass", "draft", "none")
        }
        ops = dataset.labels.log()
        assert [(op.verb, len(list(op.body["revs"]))) for op in ops] == [("adopt", 4)]
        heads = [dataset.labels.head(e.uuid) for e in entries]
        assert {head.source for head in heads} == {"commanded"}
        rng = np.random.default_rng(0)
        sent = set()
        for _ in range(4):
            sent.add(tuple(int(v) for v in rng.integers(-8000, 8000, 2)))
            rng.normal(size=(20, 258))
        assert {(head.label.x_um, head.label.y_um) for head in heads} == sent
    assert calm(folder)


def test_many_packs_are_entered_in_batches_and_not_all_read_before(folder, monkeypatch):
    steps = []
    read, enter = episode_files.read_pack_chunks, episode_files.enter_pack
    for seed in range(5, 9):
        write_pack(folder / "packs" / f"{seed}.mcap", seed=seed)
    monkeypatch.setattr(reconciliation, "REPAIRS_PER_TRANSACTION", 2)
    monkeypatch.setattr(operation_log, "LINES_PER_WRITE", 2)
    monkeypatch.setattr(
        episode_files, "read_pack_chunks", lambda path: (steps.append("read"), read(path))[1]
    )
    monkeypatch.setattr(
        episode_files, "enter_pack", lambda *given: (steps.append("enter"), enter(*given))
    )
    with Dataset.open(folder) as dataset:
        assert steps == ["read", "read", "enter", "enter"] * 2 + ["read", "enter"]
        assert all(problem.repair is None for problem in dataset.problems)
        journal = dataset.journal.path(dataset.description.site)
        assert [operation.seq for operation in operation_log.read_journal(journal)] == [
            1,
            2,
            3,
            4,
            5,
        ]
        first_checked = partial(
            reconciliation._first_checked, dataset.parts, dataset.description.site, 5
        )
        assert first_checked() == 0
        (size,) = dataset.database.one("SELECT max(length(body)) FROM op")
        monkeypatch.setattr(reconciliation, "CHECKED_CHARACTERS", 2.5 * size)
        assert first_checked() == 3
        for name in ("unlabelled", "coverage", "all"):
            order = dataset.queue(name, "ann")
            assert len(order) > 3
            assert dataset.queue(name, "ann", limit=3) == order[:3]
    assert calm(folder)


def test_a_packed_episode_is_read_like_any_other(folder):
    sent = {row.observation.tobytes(): row.label for row in read_pack(folder / "packs/a.mcap")}
    with Dataset.open(folder) as dataset:
        for entry in dataset.episodes():
            episode = dataset.read(entry.uuid)
            label = sent.pop(episode.observation.tobytes())
            assert (episode.episode_id, episode.piece) == (entry.uuid, "pot")
            film = dataset.film(entry.uuid)
            assert np.array_equal(film.episode.observation, episode.observation)
            assert all(len(pictures.packed) == 0 for pictures in film.pictures.values())
            stored = dataset.labels.head(entry.uuid).label
            assert stored.x_um == label["x_um"]
            assert np.array_equal(episode.offset_mm, stored.offset_mm)
            assert patch_hex(dataset.patch(entry.uuid).touching) == label["patch"]
    assert sent == {}


def test_the_same_pack_elsewhere_is_the_same_episodes(folder, tmp_path):
    with Dataset.open(folder) as dataset:
        before = [entry.uuid for entry in dataset.episodes()]
    other = tmp_path / "other"
    Dataset.open(other).close()
    write_pack(other / "packs" / "renamed.mcap")
    with Dataset.open(other) as dataset:
        assert [entry.uuid for entry in dataset.episodes()] == before


def test_a_renamed_pack_keeps_its_labels(folder):
    with Dataset.open(folder) as dataset:
        uuid = dataset.episodes()[0].uuid
        dataset.labels.set("ann", uuid, Label(1, 2, 0, 3))
    (folder / "packs" / "a.mcap").rename(folder / "packs" / "b.mcap")
    with Dataset.open(folder) as dataset:
        assert {e.path for e in dataset.episodes()} == {"packs/b.mcap"}
        assert {e.file_state for e in dataset.episodes()} == {"complete"}
        assert dataset.labels.head(uuid).label == Label(1, 2, 0, 3)
    assert calm(folder)


def test_a_second_copy_goes_to_quarantine(folder):
    states(folder)
    shutil.copy(folder / "packs" / "a.mcap", folder / "packs" / "copy.mcap")
    assert states(folder) == ["complete"] * 4
    assert (folder / "quarantine" / "copy.mcap").exists()
    assert calm(folder)


def test_a_missing_pack_is_told_and_comes_back(folder, tmp_path):
    states(folder)
    shutil.move(folder / "packs" / "a.mcap", tmp_path / "away.mcap")
    assert states(folder) == ["missing"] * 4
    assert calm(folder)
    shutil.move(tmp_path / "away.mcap", folder / "packs" / "a.mcap")
    assert states(folder) == ["complete"] * 4
    assert calm(folder)


@pytest.mark.parametrize("known", [True, False])
def test_a_torn_pack_keeps_its_whole_episodes(folder, known):
    if known:
        states(folder)
    pack = folder / "packs" / "a.mcap"
    whole = pack.read_bytes()
    pack.write_bytes(whole[: len(whole) // 2])
    with Dataset.open(folder) as dataset:
        assert any("whole episodes were saved" in notice for notice in dataset.notices)
        found = sorted(entry.file_state for entry in dataset.episodes())
        assert found == (["complete"] * 2 + ["damaged"] * 2 * known)
        kept = next(e for e in dataset.episodes() if e.file_state == "complete")
        assert kept.path == "packs/a.mcap"
        sent = {row.observation.tobytes() for row in read_pack(write_pack(folder / "whole.mcap"))}
        assert dataset.read(kept.uuid).observation.tobytes() in sent
    assert (folder / "quarantine" / "a.mcap").read_bytes() == whole[: len(whole) // 2]
    assert calm(folder)


def test_a_changed_byte_costs_one_pack_check_and_keeps_the_rest(folder):
    states(folder)
    flip_byte(folder / "packs" / "a.mcap")
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert [f.kind for f in reconcile(dataset.parts, whole=True)] == ["torn"]
        kinds = [entry.file_state for entry in dataset.episodes()]
        assert sorted(set(kinds)) == ["complete", "damaged"]
    assert calm(folder)


def test_a_pack_of_another_geometry_is_told_once(folder):
    write_pack(folder / "packs" / "b.mcap", seed=3, geometry="ab" * 32)
    with Dataset.open(folder) as dataset:
        assert any("was changed since" in notice for notice in dataset.notices)
        assert len(dataset.episodes()) == 4
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()


def test_other_files_among_the_packs_are_left(folder):
    write_episode(folder / "packs" / "single.mcap", small_episode(), None, {})
    with Dataset.open(folder) as dataset:
        assert any("single.mcap is no pack" in notice for notice in dataset.notices)
    assert (folder / "packs" / "single.mcap").exists()
    assert states(folder) == ["complete"] * 4


def test_a_pack_read_as_one_episode_says_that_no_pictures_were_kept(tmp_path):
    path = tmp_path / "a.mcap"
    write_pack(path, 3)
    for read in (read_compressed_episode, read_episode):
        with pytest.raises(InputError, match="no pictures were kept"):
            read(path)


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    """Return the folder of a dataset with one episode, closed in order."""
    folder = tmp_path / "closed"
    with Dataset.open(folder, person="ann") as dataset:
        add(dataset, Label(0, 0, 0, 9), source="measured")
    return folder


@pytest.fixture
def read_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every attempt to write a file fail as on a file system that is mounted read-only."""
    opened = os.open

    def refuse(path: str, flags: int, *rest: int, **named: int) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR):
            raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))
        return opened(path, flags, *rest, **named)

    monkeypatch.setattr(os, "open", refuse)
    monkeypatch.setattr(os, "access", lambda path, mode: not mode & os.W_OK)


def test_it_is_looked_at_and_nothing_appears_beside_the_catalogue(closed, read_only):
    before = sorted(closed.rglob("*"))
    with Dataset.open(closed, create=False, write=False) as dataset:
        assert len(dataset.episodes()) == 1
        assert list(check_dataset(dataset.parts, whole=True)) == []
        assert sorted(closed.rglob("*")) == before
    with pytest.raises(ReadOnlyFolderError, match="cannot be written: Read-only file system"):
        Dataset.open(closed, person="ann")
    with pytest.raises(ReadOnlyFolderError):
        rebuild_dataset(closed, replace=False)
    opened = open_dataset(closed, "ann")
    assert "cannot be written" in opened.read_only
    assert not opened.dataset.writable
    opened.dataset.close()


def test_a_copy_of_an_open_dataset_is_not_shown_without_its_newest_labels(
    dataset, record, tmp_path, request
):
    record()
    copy = tmp_path / "copy"
    shutil.copytree(dataset.folder, copy)
    (copy / "catalog.db-shm").unlink()
    request.getfixturevalue("read_only")
    with pytest.raises(InputError, match="was not closed, and its folder cannot be written"):
        Dataset.open(copy, create=False, write=False)
