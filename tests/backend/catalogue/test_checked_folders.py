"""Opening skips unchanged folders and still finds every change."""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations import consistency, episode_files
from touchdown.backend.annotations.backups import restore_backup
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import reconcile
from touchdown.backend.annotations.values import Label

SERIES = ("a", "b", "c")
EACH = 3


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A closed dataset of three series that were in order at the last opening."""
    # Nothing here changes within one tick of the clock, so that nobody has to wait.
    monkeypatch.setattr(consistency, "SETTLED_NS", 0)
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        for number in range(EACH * len(SERIES)):
            context = replace(context_for(dataset), series=SERIES[number // EACH])
            label = Label(number, 0, 0, 1)
            dataset.record(small_episode(seed=number), label, source="commanded", context=context)
    Dataset.open(folder).close()
    return folder


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Folders whose files were read since."""
    seen: set[str] = set()
    original = episode_files._files

    def files(place: Path, name: str) -> object:
        seen.add(name)
        return original(place, name)

    monkeypatch.setattr(episode_files, "_files", files)
    return seen


def first(folder: Path, series: str) -> Path:
    return min((folder / "raw" / series).glob("*.mcap"))


def die_open(folder: Path) -> None:
    """Open for writing in a child and kill it."""
    pid = os.fork()
    if not pid:
        try:
            Dataset.open(folder)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(pid, 0)


def notices(folder: Path) -> tuple[str, ...]:
    with Dataset.open(folder) as dataset:
        return dataset.notices


def test_what_looks_as_it_did_is_not_looked_at(folder: Path, looked: set[str]) -> None:
    assert notices(folder) == ()
    assert looked == {"raw"}


def test_after_a_crash_everything_is_looked_at(folder: Path, looked: set[str]) -> None:
    die_open(folder)
    assert notices(folder) == ()
    assert looked == {"raw", "raw/a", "raw/b", "raw/c"}


def remove(folder: Path) -> None:
    first(folder, "b").unlink()


def remove_folder(folder: Path) -> None:
    shutil.rmtree(folder / "raw" / "b")


def rename(folder: Path) -> None:
    first(folder, "b").rename(folder / "raw" / "b" / "other.mcap")


def move(folder: Path) -> None:
    path = first(folder, "b")
    path.rename(folder / "raw" / "c" / path.name)


def add_foreign(folder: Path) -> None:
    (folder / "raw" / "b" / "foreign.mcap").write_bytes(b"no episode")


def add_copy(folder: Path) -> None:
    shutil.copyfile(first(folder, "b"), folder / "raw" / "a" / "again.mcap")


def replace_by_shorter(folder: Path) -> None:
    path = first(folder, "b")
    content = path.read_bytes()[:-100]
    path.unlink()
    path.write_bytes(content)


def replace_folder(folder: Path) -> None:
    """Put a copy in its place that has the same times, but a file less."""
    place, copy = folder / "raw" / "b", folder / "copy"
    times = place.stat()
    shutil.copytree(place, copy)
    shutil.rmtree(place)
    min(copy.iterdir()).unlink()
    copy.rename(place)
    os.utime(place, ns=(times.st_atime_ns, times.st_mtime_ns))


@pytest.mark.parametrize("crash", [False, True], ids=["closed", "killed"])
@pytest.mark.parametrize(
    ("change", "said"),
    [(remove, "missing"), (remove_folder, "missing"), (rename, "was moved to"),
     (move, "was moved to"), (add_foreign, "torn"), (add_copy, "second file"),
     (replace_by_shorter, "torn"), (replace_folder, "missing")],
    ids=lambda value: getattr(value, "__name__", ""),
)  # fmt: skip
def test_whatever_comes_or_goes_is_found(
    folder: Path, change: Callable[[Path], None], said: str, crash: bool
) -> None:
    if crash:
        die_open(folder)
    change(folder)
    found = notices(folder)
    assert found
    assert all(said in line for line in found)
    # Once only, and the folders are trusted again after that.
    assert notices(folder) == ()
    with Dataset.open(folder) as dataset:
        assert reconcile(dataset.parts, whole=True) == []


def test_an_episode_that_comes_back_is_found(folder: Path) -> None:
    path = first(folder, "b")
    path.rename(folder / "kept")
    assert len(notices(folder)) == 1
    assert notices(folder) == ()
    (folder / "kept").rename(path)
    assert "is back" in notices(folder)[0]


def cut(folder: Path) -> None:
    path = first(folder, "b")
    os.truncate(path, path.stat().st_size - 100)


def test_a_file_cut_in_place_is_found_after_a_crash(folder: Path) -> None:
    cut(folder)
    die_open(folder)
    assert "torn" in notices(folder)[0]


def test_a_file_cut_in_place_is_found_by_verify_after_a_clean_close(folder: Path) -> None:
    cut(folder)
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert [f.kind for f in reconcile(dataset.parts, whole=True)] == ["torn"]


def test_a_file_cut_in_place_is_found_within_a_week(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cut(folder)
    monkeypatch.setattr(consistency, "WEEK_NS", 0)
    assert "torn" in notices(folder)[0]


def test_a_folder_that_changed_a_moment_ago_is_looked_at_again(
    folder: Path, looked: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Dataset.open(folder) as dataset:
        context = replace(context_for(dataset), series="b")
        dataset.record(small_episode(seed=99), Label(1, 1, 0, 1), source="commanded",
                       context=context)  # fmt: skip
    monkeypatch.setattr(consistency, "SETTLED_NS", 3600 * 10**9)
    for _ in range(2):
        looked.clear()
        assert notices(folder) == ()
        assert looked == {"raw", "raw/b"}
    monkeypatch.setattr(consistency, "SETTLED_NS", 0)
    notices(folder)
    looked.clear()
    notices(folder)
    assert looked == {"raw"}


def test_a_file_put_there_while_the_dataset_is_open_is_found(folder: Path) -> None:
    with Dataset.open(folder):
        add_copy(folder)
    assert "second file" in notices(folder)[0]


def test_rows_that_no_folder_accounts_for_are_found(folder: Path) -> None:
    with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
        connection.execute(
            "INSERT INTO episode SELECT 'lost', series, campaign, plan_item, kind,"
            " 'raw/a/lost.mcap', chunk_off, chunk_len, crc, sha256, bytes, recorded_ns, piece,"
            " bottom, geometry, grip_id, mounting_id, person, mode, quality, accepted,"
            " keep_frames, state, adopted FROM episode LIMIT 1"
        )
    assert "missing" in notices(folder)[0]


def test_a_restored_catalogue_knows_no_folder(folder: Path, looked: set[str]) -> None:
    with Dataset.open(folder) as dataset:
        backup = dataset.backups.make("test")
    restore_backup(folder, backup)
    looked.clear()
    assert notices(folder) == ()
    assert looked == {"raw", "raw/a", "raw/b", "raw/c"}
