"""A dataset on a disk of the FAT family: no folder can be synced, names know no case.

Simulated by what such a disk answers: the calls it refuses, the names it does not tell apart.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations import storage
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import FaultError
from touchdown.backend.runs.campaign import new_campaign
from touchdown.backend.runs.recorder import keep_photo

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
        context = context_for(dataset)
        uuids = [
            dataset.record(small_episode(seed=k), LABEL, source="measured", context=context).uuid
            for k in (1, 2)
        ]
        dataset.labels.accept("ann", uuids[0], Label(1500, 0, 0, 50))
        assert not dataset.labels.journal_trouble
        dataset.back_up_for("test")
        assert not dataset.backup_trouble
        new_campaign("pot", "circle15", "random", 0, 4, None).save(folder)
    return uuids


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOTSUP])
def test_where_no_folder_can_be_synced_everything_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
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


def test_a_disk_that_fails_to_sync_a_folder_is_no_such_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Dataset.open(tmp_path / "data", person="cleo") as dataset:
        context = context_for(dataset)
        refusing_folders(monkeypatch, errno.EIO)
        with pytest.raises(FaultError) as caught:
            dataset.record(small_episode(), LABEL, source="measured", context=context)
        assert caught.value.fault.code == "EPISODE-WRITE"
        assert dataset.episodes() == []


def test_all_names_of_a_dataset_are_told_apart_and_allowed_on_fat(tmp_path: Path) -> None:
    filled(tmp_path / "data")
    names = [path.relative_to(tmp_path) for path in (tmp_path / "data").rglob("*")]
    assert len(names) > 15
    assert len({str(name).casefold() for name in names}) == len(names)
    for name in names:
        assert not FORBIDDEN & set(name.name), name
        assert not name.name.endswith((".", " ")), name


def test_a_dataset_on_fat_says_what_a_power_cut_may_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mounts = [("/", "ext4"), (str(tmp_path), "vfat")]
    monkeypatch.setattr(storage, "_mounts", lambda: mounts)
    with Dataset.open(tmp_path / "data") as dataset:
        (said,) = dataset.notices
    assert said.startswith("The dataset lies on a vfat disk, which a power cut can damage")
    assert storage.disk_weakness(Path("/elsewhere"), mounts) == ""
