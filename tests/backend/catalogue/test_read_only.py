"""Datasets on a read-only disk: reading works, writing is refused."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import Record, context_for, small_episode
from touchdown.app.shell.datasets import dataset_opener
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.storage import DatasetInUseError, ReadOnlyFolderError
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError


@pytest.fixture
def closed(tmp_path: Path) -> Path:
    """Return the folder of a dataset with one episode, closed in order."""
    folder = tmp_path / "closed"
    with Dataset.open(folder, person="ann") as dataset:
        label, context = Label(0, 0, 0, 9), context_for(dataset)
        dataset.record(small_episode(), label, source="measured", context=context)
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


def test_it_is_looked_at_and_nothing_appears_beside_the_catalogue(
    closed: Path, read_only: None
) -> None:
    before = sorted(closed.rglob("*"))
    with Dataset.open(closed, create=False, write=False) as dataset:
        assert len(dataset.episodes()) == 1
        assert list(check_dataset(dataset.parts, whole=True)) == []
        assert sorted(closed.rglob("*")) == before
    with pytest.raises(ReadOnlyFolderError, match="cannot be written: Read-only file system"):
        Dataset.open(closed, person="ann")
    with pytest.raises(ReadOnlyFolderError):
        rebuild_dataset(closed, replace=False)
    opened = dataset_opener(closed, "ann")()
    assert "cannot be written" in opened.read_only
    assert not opened.dataset.writable
    opened.dataset.close()


def test_a_copy_of_an_open_dataset_is_not_shown_without_its_newest_labels(
    dataset: Dataset, record: Record, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    record()
    copy = tmp_path / "copy"
    shutil.copytree(dataset.folder, copy)
    (copy / "catalog.db-shm").unlink()
    request.getfixturevalue("read_only")
    with pytest.raises(InputError, match="was not closed, and its folder cannot be written"):
        Dataset.open(copy, create=False, write=False)


def test_a_rebuild_beside_a_writer_names_the_writer(dataset: Dataset, record: Record) -> None:
    record()
    with pytest.raises(DatasetInUseError, match="cleo"):
        rebuild_dataset(dataset.folder, replace=False)
