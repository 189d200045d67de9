"""Repairs on opening: each situation is repaired once, and the next opening finds nothing."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import check_dataset, reconcile
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.episodes.episode_file import read_episode

Reopen = Callable[[], Dataset]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A dataset of three episodes, one with a label by a person; closed."""
    folder = tmp_path / "data"
    with Dataset.open(folder, person="cleo") as dataset:
        context = context_for(dataset)
        for number in range(3):
            label = Label(1000 * number, -500, 0, 150)
            dataset.record(small_episode(seed=number), label, source="commanded", context=context)
        first = dataset.episodes()[0].uuid
        dataset.labels.set("ann", first, Label(1234, 5, 0, 100))
    return folder


def uuids(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        return [entry.uuid for entry in dataset.episodes()]


def file_of(folder: Path, uuid: str) -> Path:
    return folder / "raw" / "series-1" / f"{uuid}.mcap"


def mended(folder: Path) -> tuple[str, ...]:
    """Return the messages of the first opening; later ones and a check have none."""
    with Dataset.open(folder) as dataset:
        notices = dataset.notices
    with Dataset.open(folder) as dataset:
        assert dataset.notices == ()
        assert [f for f in check_dataset(dataset.parts) if f.repair is not None] == []
    return notices


def forget_row(folder: Path, uuid: str) -> None:
    """Remove the row, as if the process had died before its commit."""
    with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
        for trigger in ("op_no_delete", "label_rev_no_delete"):
            connection.execute(f"DROP TRIGGER {trigger}")
        ops = "SELECT op_uuid FROM label_rev WHERE episode = ?"
        listed = [op for (op,) in connection.execute(ops, (uuid,)).fetchall()]
        connection.execute("DELETE FROM episode WHERE uuid = ?", (uuid,))
        connection.execute("DELETE FROM label_head WHERE episode = ?", (uuid,))
        connection.execute("DELETE FROM label_rev WHERE episode = ?", (uuid,))
        connection.executemany("DELETE FROM op WHERE op_uuid = ?", [(op,) for op in listed])
    journal = next((folder / "labels").glob("*.jsonl"))
    lines = journal.read_bytes().splitlines(keepends=True)
    kept = [line for line in lines if json.loads(line)["op_uuid"] not in listed]
    journal.write_bytes(b"".join(kept))


def test_a_clean_dataset_has_nothing_to_say(folder: Path) -> None:
    assert mended(folder) == ()
    with Dataset.open(folder) as dataset:
        assert list(check_dataset(dataset.parts, whole=True)) == []


def test_a_complete_file_without_a_row_is_adopted(tmp_path: Path) -> None:
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        context = context_for(dataset)
        entry = dataset.record(
            small_episode(), Label(700, -30, 5, 90), source="measured", context=context
        )
    forget_row(folder, entry.uuid)
    (notice,) = mended(folder)
    assert "adopted" in notice
    with Dataset.open(folder) as dataset:
        (back,) = dataset.episodes()
        assert back.adopted
        names = ("uuid", "series", "campaign", "plan_item", "path", "recorded_ns", "piece",
                 "bottom", "geometry", "grip_id", "mounting_id", "person", "mode", "quality",
                 "keep_frames", "sha256", "bytes", "file_state", "state")  # fmt: skip
        assert [getattr(back, n) for n in names] == [getattr(entry, n) for n in names]
        head = dataset.labels.head(entry.uuid)
        assert (head.label, head.source, head.state) == (
            Label(700, -30, 5, 90), "measured", "draft",
        )  # fmt: skip
        (event,) = dataset.database.rows("SELECT target FROM event WHERE verb = 'adopt'")
        assert event == (entry.uuid,)


def test_a_changed_byte_is_found_by_the_whole_check(folder: Path) -> None:
    uuid = uuids(folder)[1]
    path = file_of(folder, uuid)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert mended(folder) == ()
    with Dataset.open(folder) as dataset:
        (finding,) = reconcile(dataset.parts, whole=True)
        assert (finding.kind, finding.target) == ("damaged", uuid)
        assert dataset.entry(uuid).file_state == "damaged"
        assert reconcile(dataset.parts, whole=True) == []
    assert path.read_bytes() == bytes(data)


def test_a_file_of_another_size_is_damaged_until_it_is_put_back(folder: Path) -> None:
    uuid = uuids(folder)[1]
    path = file_of(folder, uuid)
    good = path.read_bytes()
    write_other_episode(folder, path)
    assert "marked as damaged" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "damaged"
        assert dataset.labels.head(uuid).label == Label(1000, -500, 0, 150)
    path.write_bytes(good)
    assert "is back" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "complete"


def write_other_episode(folder: Path, path: Path) -> None:
    """Replace the file of an episode by a readable file of another size."""
    from touchdown.backend.episodes.episode_file import write_episode

    write_episode(path, small_episode(seed=99), None, {"note": "another" * 50})


def test_a_torn_file_under_a_final_name_goes_to_quarantine(folder: Path) -> None:
    uuid = uuids(folder)[2]
    path = file_of(folder, uuid)
    whole = path.read_bytes()
    path.write_bytes(whole[:-300])
    (notice,) = mended(folder)
    assert "torn" in notice
    assert not path.exists()
    assert (folder / "quarantine" / path.name).read_bytes() == whole[:-300]
    saved = folder / "quarantine" / f"{uuid}.salvaged.mcap"
    assert read_episode(saved).episode_id == uuid
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "quarantined"
        assert dataset.labels.head(uuid).label == Label(2000, -500, 0, 150)


def test_an_empty_part_file_is_deleted(folder: Path) -> None:
    part = folder / "raw" / "series-1" / ".nothing.mcap.part"
    part.touch()
    assert "empty" in mended(folder)[0]
    assert not part.exists()


def test_an_unfinished_part_file_is_salvaged_and_stays(folder: Path) -> None:
    uuid = uuids(folder)[0]
    data = file_of(folder, uuid).read_bytes()
    part = folder / "raw" / "series-1" / ".torn.mcap.part"
    part.write_bytes(data[:-200])
    assert "never finished" in mended(folder)[0]
    assert part.read_bytes() == data[:-200]
    assert read_episode(folder / "quarantine" / "torn.mcap").episode_id == uuid
    assert len(uuids(folder)) == 3


def test_a_part_file_beside_its_finished_file_is_deleted(folder: Path) -> None:
    uuid = uuids(folder)[0]
    part = folder / "raw" / "series-1" / f".{uuid}.mcap.part"
    part.write_bytes(b"half of it")
    assert "finished file" in mended(folder)[0]
    assert not part.exists()


def test_a_missing_file_keeps_its_label_and_comes_back(folder: Path, tmp_path: Path) -> None:
    uuid = uuids(folder)[0]
    path, away = file_of(folder, uuid), tmp_path / "away.mcap"
    shutil.move(path, away)
    assert "missing" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "missing"
        assert dataset.labels.head(uuid).label == Label(1234, 5, 0, 100)
    shutil.move(away, path)
    assert "is back" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "complete"


def test_a_moved_file_is_found_again(folder: Path) -> None:
    uuid = uuids(folder)[0]
    there = folder / "raw" / "elsewhere" / "renamed.mcap"
    there.parent.mkdir()
    shutil.move(file_of(folder, uuid), there)
    assert any("moved to raw/elsewhere" in notice for notice in mended(folder))
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).path == "raw/elsewhere/renamed.mcap"
        assert dataset.entry(uuid).file_state == "complete"
        assert dataset.read(uuid).episode_id == uuid


@pytest.mark.parametrize("damaged", [False, True])
def test_of_two_files_with_one_uuid_the_true_one_stays(folder: Path, damaged: bool) -> None:
    uuid = uuids(folder)[0]
    path = file_of(folder, uuid)
    good = path.read_bytes()
    copy = path.with_name("copy.mcap")
    copy.write_bytes(good)
    if damaged:
        write_other_episode(folder, path)
    mended(folder)
    with Dataset.open(folder) as dataset:
        entry = dataset.entry(uuid)
        assert entry.file_state == "complete"
        assert (folder / entry.path).read_bytes() == good
    assert len(list((folder / "quarantine").iterdir())) == 1


def test_a_foreign_file_is_told_once_and_left(folder: Path) -> None:
    from touchdown.backend.episodes.episode_file import write_episode

    stray = folder / "raw" / "stray.mcap"
    write_episode(stray, small_episode(seed=5), None, {})
    assert "no label message" in mended(folder)[0]
    assert stray.exists()
    assert len(uuids(folder)) == 3


def test_what_is_missing_in_the_journal_is_written(folder: Path) -> None:
    journal = next((folder / "labels").glob("*.jsonl"))
    whole = journal.read_bytes()
    lines = whole.splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:2]) + lines[2][:40])
    (notice,) = mended(folder)
    assert "2 label operations were missing in the journal" in notice
    assert journal.read_bytes() == whole


def test_what_only_the_journal_has_is_replayed(folder: Path, tmp_path: Path) -> None:
    """A restored catalogue is older than journal and files: no label and no episode is lost."""
    old = tmp_path / "old"
    shutil.copytree(folder, old)
    home = json.loads((folder / "dataset.json").read_text())["home"]
    with Dataset.open(folder) as dataset:
        dataset.labels.set("ann", dataset.episodes()[1].uuid, Label(42, 43, 0, 10))
        dataset.labels.accept("ann", dataset.episodes()[1].uuid)
        context = context_for(dataset)
        dataset.record(small_episode(seed=8), Label(9, 9, 0, 1), source="commanded",
                       context=context)  # fmt: skip
        expected = tables(dataset)
    for name in ("catalog.db", "catalog.db-wal", "catalog.db-shm"):
        (folder / name).unlink(missing_ok=True)
        if (old / name).exists():
            shutil.copy(old / name, folder / name)
    assert json.loads((folder / "dataset.json").read_text())["home"] == home
    notices = mended(folder)
    assert any("3 label operations of the journal" in notice for notice in notices)
    with Dataset.open(folder) as dataset:
        assert tables(dataset) == expected


def tables(dataset: Dataset) -> dict[str, list[tuple[object, ...]]]:
    listed = {}
    for name in ("op", "label_rev", "label_head", "mark", "review", "closed"):
        rows = dataset.database.rows(f"SELECT * FROM {name}")
        listed[name] = sorted(rows, key=repr)
    columns = "uuid, series, path, sha256, bytes, piece, bottom, geometry, person, state"
    listed["episode"] = dataset.database.rows(f"SELECT {columns} FROM episode")
    return listed


@pytest.mark.parametrize("where", ["catalogue", "journal", "fork"])
def test_a_broken_chain_makes_labels_read_only(folder: Path, where: str) -> None:
    uuid = uuids(folder)[0]
    journal = next((folder / "labels").glob("*.jsonl"))
    lines = journal.read_text().splitlines(keepends=True)
    if where == "catalogue":
        with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
            connection.execute("DROP TRIGGER op_no_update")
            sql = "UPDATE op SET body = replace(body, '1234', '1235') WHERE seq = 4"
            connection.execute(sql)
        number = 4
    elif where == "journal":
        extra = json.loads(lines[-1]) | {"seq": 5, "op_uuid": "x", "prev_hash": "0" * 64}
        journal.write_text("".join(lines) + json.dumps(extra) + "\n")
        number = 5
    else:
        other = json.loads(lines[-1]) | {"hash": "1" * 64}
        journal.write_text("".join(lines[:-1]) + json.dumps(other) + "\n")
        number = 4
    for _ in range(2):
        with Dataset.open(folder) as dataset:
            (notice,) = dataset.notices
            assert f"at number {number}" in notice
            assert "read-only" in notice
            before = tables(dataset)
            with pytest.raises(RefusedError, match="read-only"):
                dataset.labels.set("ann", uuid, Label(1, 2, 0, 3))
            with pytest.raises(RefusedError):
                dataset.record(small_episode(seed=7), Label(), source="commanded",
                               context=context_for(dataset))  # fmt: skip
            assert tables(dataset) == before
            assert len(list((folder / "raw").rglob("*.mcap"))) == 3
            events = dataset.database.rows("SELECT 1 FROM event WHERE verb = 'broken-chain'")
            assert len(events) == 1


def test_wrong_heads_are_made_anew(folder: Path) -> None:
    with Dataset.open(folder) as dataset:
        expected = tables(dataset)
        with dataset.database.transaction() as connection:
            first = connection.execute("SELECT rev_uuid FROM label_rev LIMIT 1").fetchone()
            connection.execute("UPDATE label_head SET rev_uuid = ?", first)
    assert "heads" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert tables(dataset) == expected
        with dataset.database.transaction() as connection:
            connection.execute("UPDATE label_head SET conflict = 1")
        kinds = [finding.kind for finding in check_dataset(dataset.parts, whole=True)]
        assert kinds == ["heads"]


def test_half_made_files_are_deleted_but_not_those_being_made(folder: Path) -> None:
    (folder / "cache").mkdir()
    old, new = folder / "cache" / ".a.tmp", folder / "cache" / ".b.tmp"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (1, 1))
    assert "half-made" in mended(folder)[0]
    assert not old.exists()
    assert new.exists()


def test_many_findings_of_a_kind_are_one_line(folder: Path) -> None:
    for number in range(9):
        (folder / "raw" / "series-1" / f".{number}.mcap.part").touch()
    (notice,) = mended(folder)
    assert "9 times" in notice


def test_checking_changes_nothing(folder: Path) -> None:
    gone, torn, _ = uuids(folder)
    file_of(folder, gone).unlink()
    path = file_of(folder, torn)
    path.write_bytes(path.read_bytes()[:-100])
    with Dataset.open(folder, write=False) as dataset:
        kinds = {finding.kind for finding in check_dataset(dataset.parts, whole=True)}
        assert kinds == {"missing", "torn"}
        assert {e.file_state for e in dataset.episodes(EpisodeFilter())} == {"complete"}
    assert path.exists()
