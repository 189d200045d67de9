"""Deleted episodes: absent from new exports, present in old ones, restored with the same ids."""

from __future__ import annotations

import hashlib
import json
import re
from hashlib import sha256
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from touchdown.backend.annotations.reconciliation import copy_files
from touchdown.backend.core.faults import InputError
from touchdown.backend.exchange.manifest import MANIFEST_NAME, VERSION, read_manifest


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): sha256(p.read_bytes()).hexdigest() for p in files}


def uuids(folder: Path) -> list[str]:
    manifest = read_manifest(folder)
    return sorted(str(one["uuid"]) for one in manifest["episodes"])


def test_delete_export_and_undo(dataset, hand):
    raw = {e.uuid: dataset.path(e.uuid).read_bytes() for e in dataset.episodes()}
    first = hand("csv", "first").folder
    gone, before = uuids(first)[1], contents(first)
    dataset.labels.delete("ann", gone, "disturbed")
    second = hand("csv", "second").folder
    assert uuids(second) == [uuid for uuid in uuids(first) if uuid != gone]
    dataset.labels.undo("ann")
    assert {e.uuid: dataset.path(e.uuid).read_bytes() for e in dataset.episodes()} == raw
    assert uuids(hand("csv", "third").folder) == uuids(first)
    assert contents(first) == before  # an export that was made stays what it was


ROOT = Path(__file__).resolve().parents[3]
HOSTILE = ["../secret", "a/../../secret", "/etc/hostname", "link/secret", "x" * 300, "a\0b", ""]
UNPACKING = re.compile(r"import (zipfile|tarfile)|from (zipfile|tarfile)|unpack_archive")


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with a link that leads out of it, beside a file that is nobody's business."""
    inside = tmp_path / "inside"
    inside.mkdir()
    (tmp_path / "secret").write_bytes(b"secret")
    (inside / "link").symlink_to(tmp_path)
    return inside


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.promise("D7")
@pytest.mark.parametrize("name", HOSTILE)
def test_an_export_names_only_files_of_its_own(name, place):
    listed = {"path": name, "bytes": 6, "sha256": hashlib.sha256(b"secret").hexdigest()}
    (place / MANIFEST_NAME).write_text(json.dumps({"version": VERSION, "files": [listed]}))
    with pytest.raises(InputError) as caught:
        read_manifest(place)
    assert str(place / MANIFEST_NAME) in str(caught.value)


@pytest.mark.promise("D7")
@pytest.mark.parametrize("name", HOSTILE)
def test_a_merge_writes_nothing_outside_its_dataset(name, place, tmp_path):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (tmp_path / "theirs" / "secret").write_bytes(b"other")
    before = snapshot(tmp_path)
    with pytest.raises(InputError, match="outside its dataset"):
        copy_files(place, theirs, [name])
    assert snapshot(tmp_path) == before


@pytest.mark.promise("D7")
def test_a_link_that_leads_out_of_the_other_dataset_is_not_followed(place, tmp_path):
    (place / "raw").mkdir()
    with pytest.raises(InputError, match="outside its dataset"):
        copy_files(place / "raw", place, ["link/secret"])
    assert list((place / "raw").iterdir()) == []


@pytest.mark.promise("D7")
def test_no_archive_is_unpacked_anywhere():
    texts = {path: path.read_text() for path in (ROOT / "backend").rglob("*.py")}
    assert len(texts) > 100
    report = ROOT / "backend" / "cli" / "doctor" / "problem_report.py"  # writes an archive
    assert [path for path, text in texts.items() if UNPACKING.search(text)] == [report]
    assert set(re.findall(r"archive\.(\w+)", texts[report])) == {"writestr"}


EPISODES, TICKS = 6, 20
INFO = {
    "codebase_version": "v3.0",
    "fps": 10,
    "total_episodes": EPISODES,
    "total_frames": EPISODES * TICKS,
    "total_tasks": 1,
    "chunks_size": 1000,
    "data_files_size_in_mb": 100,
    "video_files_size_in_mb": 200,
    "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    "video_path": None,
}
FEATURES = {
    "observation.markers": ("float32", [252]),
    "observation.ft": ("float32", [6]),
    "observation.ft_window": ("float32", [100, 6]),
    "observation.state": ("float32", [7]),
    "action": ("float32", [7]),
    "label.offset_mm": ("float32", [2]),
    "label.patch": ("uint8", [177]),
    "timestamp": ("float32", [1]),
    "frame_index": ("int64", [1]),
    "episode_index": ("int64", [1]),
    "index": ("int64", [1]),
    "task_index": ("int64", [1]),
}


def test_a_lerobot_dataset_is_complete_and_consistent(hand):
    out = hand("lerobot").folder
    info = json.loads((out / "meta/info.json").read_text())
    assert {key: info[key] for key in INFO} == INFO
    assert isinstance(info["fps"], int)
    told = {key: (one["dtype"], one["shape"]) for key, one in info["features"].items()}
    assert told == FEATURES
    assert not any("/" in key for key in told)
    assert "robot_type" in info
    ends = sorted(tuple(map(int, span.split(":"))) for span in info["splits"].values())
    assert (ends[0][0], ends[-1][1]) == (0, EPISODES)
    assert all(one[1] == other[0] for one, other in pairwise(ends))
    # One row group an episode, one row a frame.
    file = pq.ParquetFile(out / "data/chunk-000/file-000.parquet")
    assert file.num_row_groups == EPISODES
    column = file.metadata.row_group(0).column(0)
    assert column.compression == "SNAPPY"
    table = file.read()
    assert set(table.column_names) == set(FEATURES)
    for name in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        assert table.schema.field(name).type == (
            pa.float32() if name == "timestamp" else pa.int64()
        )
    assert table["index"].to_pylist() == list(range(EPISODES * TICKS))
    assert table["frame_index"].to_pylist() == list(range(TICKS)) * EPISODES
    assert table["timestamp"].to_pylist()[:TICKS] == pytest.approx([k / 10 for k in range(TICKS)])
    assert [row.as_py() for row in table["episode_index"]] == [
        k for k in range(EPISODES) for _ in range(TICKS)
    ]
    # Episodes and tasks point at the rows.
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["episode_index"] for row in rows] == list(range(EPISODES))
    for k, row in enumerate(rows):
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (k * TICKS, (k + 1) * TICKS)
        assert row["length"] == TICKS
        places = ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index",
                  "meta/episodes/file_index")  # fmt: skip
        assert [row[name] for name in places] == [0, 0, 0, 0]
    tasks = pq.read_table(out / "meta/tasks.parquet")
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    assert tasks.schema.field("task_index").type == pa.int64()
    assert {text for row in rows for text in row["tasks"]} == set(tasks["task"].to_pylist())
    stats = json.loads((out / "meta/stats.json").read_text())
    assert {"min", "max", "mean", "std", "count"} <= set(stats["observation.ft"])
