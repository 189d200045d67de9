"""Zarr: one array per feature. Zarr v3 with the episode as first axis, a hundred in a shard.

With the layout "replay-buffer", Zarr v2 with the steps of all episodes along one axis: ReplayBuffer
of diffusion policy and UMI (real-stanford/diffusion_policy, common/replay_buffer.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.core import require_package
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.features import FPS, short_name
from touchdown.backend.exchange.video import HEIGHT, WIDTH

FOLDER, BUFFER = "episodes.zarr", "replay_buffer.zarr"
SHARD = 100
BATCH = 10  # episodes in a chunk of the replay buffer; a chunk of pictures holds one picture


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write the episodes of ``job`` as a Zarr group in ``folder``."""
    zarr = require_package("zarr")
    try:
        if job.layout == "replay-buffer":
            _write_buffer(zarr, job, folder / BUFFER)
            return {"data": "zarr v2, blosc zstd"}
        _write(zarr, job, folder / FOLDER)
    finally:
        # zarr keeps threads for later calls
        require_package("zarr.core.sync").cleanup_resources()
    return {"data": "zarr v3, sharding_indexed, zstd", "shard": SHARD}


def _write(zarr: Any, job: ExportJob, path: Path) -> None:
    group, arrays = zarr.create_group(path, zarr_format=3), {}
    shapes = {
        f.key: (f.shape if f.constant else (SAMPLES_PER_PROBE, *f.shape), f.dtype)
        for f in job.features
    }
    shapes |= dict.fromkeys(job.cameras, ((SAMPLES_PER_PROBE, HEIGHT, WIDTH, 3), "uint8"))
    for key, (shape, dtype) in shapes.items():
        arrays[key] = group.create_array(
            key, shape=(len(job.chosen), *shape), dtype=dtype, chunks=(1, *shape),
            shards=(SHARD, *shape), compressors=zarr.codecs.ZstdCodec(level=3),
        )  # fmt: skip
    episodes, start = job.episodes(), 0
    while batch := list(islice(episodes, SHARD)):
        for key, array in arrays.items():
            values = [
                np.stack(one.pictures[key]) if key in one.pictures else one.values[key]
                for one in batch
            ]
            array[start : start + len(batch)] = np.stack(values)
        start += len(batch)
    group.attrs["fps"] = FPS
    group.attrs["episodes"] = [one.entry.uuid for one in job.chosen]
    group.attrs["splits"] = [one.split for one in job.chosen]
    group.attrs["committed"] = True


def _write_buffer(zarr: Any, job: ExportJob, path: Path) -> None:
    root = zarr.create_group(path, zarr_format=2)
    data, blosc = root.create_group("data"), require_package("numcodecs").Blosc("zstd", 5)
    ends = SAMPLES_PER_PROBE * np.arange(1, len(job.chosen) + 1, dtype=np.int64)
    episodes, start = job.episodes(), 0
    while batch := list(islice(episodes, BATCH)):
        rows = {f.key: [one.per_tick(f) for one in batch] for f in job.features}
        rows |= {key: [np.stack(one.pictures[key]) for one in batch] for key in job.cameras}
        for key, parts in rows.items():
            name, values = short_name(key), np.concatenate(parts)
            if start == 0:
                length = 1 if key in job.cameras else SAMPLES_PER_PROBE * BATCH
                shape, chunks = (ends[-1], *values.shape[1:]), (length, *values.shape[1:])
                data.create_array(name, shape=shape, dtype=values.dtype, chunks=chunks,
                                  compressors=blosc)  # fmt: skip
            data[name][start : start + len(values)] = values
        start += SAMPLES_PER_PROBE * len(batch)
    root.create_group("meta").create_array("episode_ends", data=ends, compressors=None)
