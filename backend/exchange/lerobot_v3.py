"""LeRobotDataset v3.0: parquet rows per tick, many episodes and videos per file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.core import require_package
from touchdown.backend.exchange.export_episode import ExportEpisode
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.features import FPS, Feature
from touchdown.backend.exchange.query import indices_by_side
from touchdown.backend.exchange.video import CHUNK_FILES, CODEC, VIDEO_MB, VideoWriter

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
# Quantiles are exact up to this number of episodes, then of an even sample; pixels are sampled.
MAX_BLOCKS, MAX_ROWS = 1000, 1000


class RunningStats:
    """Statistics over the first axis of all blocks (Chan, Golub and LeVeque 1979)."""

    def __init__(self) -> None:
        self.count: int = 0
        self._least: NDArray[Any] = np.array(np.inf)
        self._greatest: NDArray[Any] = np.array(-np.inf)
        self._mean: NDArray[Any] = np.array(0.0)
        self._squares: NDArray[Any] = np.array(0.0)
        self._blocks: list[NDArray[Any]] = []  # every ``_stride``-th block, for the quantiles
        self._stride, self._added = 1, 0

    def add(self, rows: NDArray[np.float64]) -> None:
        """Add a block (n, ...)."""
        n, mean = len(rows), rows.mean(axis=0)
        gap, total = mean - self._mean, self.count + n
        self._least = np.minimum(self._least, rows.min(axis=0))
        self._greatest = np.maximum(self._greatest, rows.max(axis=0))
        within = ((rows - mean) ** 2).sum(axis=0)
        self._squares = self._squares + within + gap**2 * (self.count * n / total)
        self._mean = self._mean + gap * (n / total)
        self.count = total
        if self._added % self._stride == 0:
            self._blocks.append(rows[:: len(rows) // MAX_ROWS + 1].astype(np.float32))
        self._added += 1
        if len(self._blocks) > MAX_BLOCKS:
            self._blocks, self._stride = self._blocks[::2], 2 * self._stride

    def result(self) -> dict[str, Any]:
        """Return min, max, mean, std and count as lists, in the form of LeRobot."""
        deviation = np.sqrt(self._squares / self.count)
        rows, levels = np.concatenate(self._blocks), list(QUANTILES.values())
        return {
            "min": self._least.tolist(),
            "max": self._greatest.tolist(),
            "mean": self._mean.tolist(),
            "std": deviation.tolist(),
            "count": [self.count],
            **dict(zip(QUANTILES, np.quantile(rows, levels, axis=0).tolist(), strict=True)),
        }


CODEBASE = "v3.0"
DATA_MB = 100
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-000/file-000.parquet"
COUNTERS = ("frame_index", "episode_index", "index", "task_index")
STATS_EVERY = 5  # every n-th image is used for the pixel statistics
CARD = """---
task_categories: [robotics]
tags: [LeRobot, tactile, touchdown]
configs: [{{config_name: default, data_files: data/*/*.parquet}}]
---

{episodes} presses of a held piece on a support at {fps} Hz, recorded by Touchdown ({robot}). Tasks:
{tasks}. Features: {features}. `meta/info.json` has their sizes and names, `manifest.json` episodes,
labels and hashes. Positions in `observation.state` are interpolated at the ticks.
"""


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write the episodes of ``job`` as a LeRobot dataset in ``folder``."""
    tasks = sorted({_task(one.entry.piece, one.entry.bottom) for one in job.chosen})
    rows: list[dict[str, Any]] = []
    stats: dict[str, RunningStats] = {}
    with ExitStack() as stack:
        data = stack.enter_context(closing(_ParquetWriter(folder, job.features)))
        films = {
            key: stack.enter_context(closing(VideoWriter(folder, VIDEO_PATH, key)))
            for key in job.cameras
        }
        for episode in job.episodes():
            task = _task(episode.chosen.entry.piece, episode.chosen.entry.bottom)
            row = data.add(episode, tasks.index(task))
            for key, film in films.items():
                row |= film.add(episode.pictures[key])
            rows.append({"episode_index": episode.chosen.index, "tasks": [task],
                         "length": SAMPLES_PER_PROBE, **row})  # fmt: skip
            _count(stats, episode, job.features)
    pa, path = require_package("pyarrow"), folder / EPISODES_PATH
    path.parent.mkdir(parents=True, exist_ok=True)
    places = {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
    table = pa.Table.from_pylist([{**row, **places} for row in rows])
    require_package("pyarrow.parquet").write_table(table, path, compression="snappy")
    _write_tasks(folder, tasks)
    info = _info(job, len(tasks))
    _write_json(folder / "meta/info.json", info)
    card = CARD.format(episodes=len(rows), fps=FPS, robot=job.signals.robot, tasks="; ".join(tasks),
                       features=", ".join(f"`{key}`" for key in info["features"]))  # fmt: skip
    (folder / "README.md").write_text(card, "utf-8")
    _write_json(folder / "meta/stats.json", {key: one.result() for key, one in stats.items()})
    return {"data": "parquet, snappy"} | ({"video": CODEC} if job.pictures else {})


def _task(piece: str, bottom: str) -> str:
    return f"press the {piece} on the {bottom}"


class _ParquetWriter:
    """Parquet files of rows: one row group per episode, a new file above 100 MB."""

    def __init__(self, folder: Path, features: Sequence[Feature]) -> None:
        pa = require_package("pyarrow")
        self._parquet = require_package("pyarrow.parquet")
        self._pa, self._folder, self._features = pa, folder, features
        fields = [pa.field(f.key, _type(pa, f.dtype, f.shape)) for f in features]
        fields.append(pa.field("timestamp", pa.float32()))
        fields += [pa.field(name, pa.int64()) for name in COUNTERS]
        self._schema = pa.schema(fields)
        self._writer: Any = None
        self._path = folder
        self._file, self._frames = -1, 0

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()

    def add(self, episode: ExportEpisode, task: int) -> dict[str, Any]:
        """Append the rows of one episode; return their position."""
        if self._writer is None or self._path.stat().st_size > DATA_MB * 1_000_000:
            self._next_file()
        frame = np.arange(SAMPLES_PER_PROBE, dtype=np.int64)
        index, first = episode.chosen.index, self._frames
        columns: dict[str, Any] = {
            f.key: episode.per_tick(f).astype(f.dtype, copy=False) for f in self._features
        }
        columns["timestamp"] = (frame / FPS).astype(np.float32)
        counters = (frame, np.full_like(frame, index), first + frame, np.full_like(frame, task))
        columns |= dict(zip(COUNTERS, counters, strict=True))
        arrays = [_array(self._pa, columns[f.name], f.type) for f in self._schema]
        self._writer.write_table(self._pa.Table.from_arrays(arrays, schema=self._schema))
        self._frames += SAMPLES_PER_PROBE
        chunk, number = divmod(self._file, CHUNK_FILES)
        return {
            "data/chunk_index": chunk,
            "data/file_index": number,
            "dataset_from_index": first,
            "dataset_to_index": self._frames,
        }

    def _next_file(self) -> None:
        self.close()
        self._file += 1
        chunk, number = divmod(self._file, CHUNK_FILES)
        self._path = self._folder / DATA_PATH.format(chunk_index=chunk, file_index=number)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._writer = self._parquet.ParquetWriter(self._path, self._schema, compression="snappy")


def _type(pa: Any, dtype: str, shape: Sequence[int]) -> Any:
    kind = pa.from_numpy_dtype(np.dtype(dtype))
    if len(shape) == 1:
        return pa.list_(kind, shape[0])
    for _ in shape:
        kind = pa.list_(kind)
    return kind


def _array(pa: Any, values: np.ndarray[Any, Any], kind: Any) -> Any:
    if values.ndim == 1:
        return pa.array(values, kind)
    flat = pa.array(values.reshape(-1))
    if values.ndim == 2:
        return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    rows, columns = values.shape[1:]
    inner = pa.ListArray.from_arrays(np.arange(0, values.size + 1, columns, dtype=np.int32), flat)
    return pa.ListArray.from_arrays(np.arange(0, len(inner) + 1, rows, dtype=np.int32), inner)


def _count(
    stats: dict[str, RunningStats], episode: ExportEpisode, features: Sequence[Feature]
) -> None:
    for f in features:
        stats.setdefault(f.key, RunningStats()).add(episode.per_tick(f).astype(np.float64))
    for key, pictures in episode.pictures.items():
        pixels = np.stack(pictures[::STATS_EVERY]).astype(np.float64) / 255.0
        by_channel = np.moveaxis(pixels, -1, 1).reshape(len(pixels), 3, -1)
        by_pixel = np.moveaxis(by_channel, 1, 2).reshape(-1, 3, 1, 1)
        stats.setdefault(key, RunningStats()).add(by_pixel)


def _write_tasks(folder: Path, tasks: Sequence[str]) -> None:
    """Write ``tasks.parquet``; its pandas metadata make the text the index."""
    pa = require_package("pyarrow")
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": list(tasks)})
    column = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    text = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [{"name": None, "field_name": None, "pandas_type": "unicode",
                            "numpy_type": "object", "metadata": {"encoding": "UTF-8"}}],
        "columns": [{"name": "task_index", "field_name": "task_index", **column},
                    {"name": "task", "field_name": "task", **text}],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }  # fmt: skip
    table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
    require_package("pyarrow.parquet").write_table(
        table, folder / "meta/tasks.parquet", compression="snappy"
    )


def _info(job: ExportJob, tasks: int) -> dict[str, Any]:
    listed: dict[str, Any] = {
        f.key: {"dtype": f.dtype, "shape": list(f.shape), "names": list(f.names) or None}
        for f in job.features
    }
    for key in job.cameras:
        listed[key] = VideoWriter.feature()
    listed["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    listed |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in COUNTERS}
    return {
        "codebase_version": CODEBASE,
        "robot_type": job.signals.robot,
        "total_episodes": len(job.chosen),
        "total_frames": len(job.chosen) * SAMPLES_PER_PROBE,
        "total_tasks": tasks,
        "chunks_size": CHUNK_FILES,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": FPS,
        # The episodes are sorted by side, so each side is a range.
        "splits": {
            side: f"{index[0]}:{index[-1] + 1}"
            for side, index in indices_by_side(job.chosen).items()
        },
        "data_path": DATA_PATH,
        "video_path": VIDEO_PATH if job.pictures else None,
        "features": listed,
    }


def _write_json(path: Path, content: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4), "utf-8")
