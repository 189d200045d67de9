"""Layout of LeRobot datasets v3.0 by its documentation, read with pyarrow alone."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.backend.exchange.conftest import Hand

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


@pytest.fixture
def out(hand: Hand) -> Path:
    return hand("lerobot").folder


def test_info_says_version_counts_paths_and_features(out: Path) -> None:
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


def test_rows_are_frames_and_a_row_group_is_an_episode(out: Path) -> None:
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


def test_episodes_and_tasks_point_at_the_rows(out: Path) -> None:
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
