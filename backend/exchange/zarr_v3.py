"""Zarr v3: one array per feature, first axis = episode, a hundred episodes per shard."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.features import FPS, PICTURES, require_package
from touchdown.backend.exchange.video import HEIGHT, WIDTH

FOLDER = "episodes.zarr"
SHARD = 100


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write the episodes of ``job`` as a Zarr group in ``folder``."""
    zarr = require_package("zarr")
    try:
        _write(zarr, job, folder)
    finally:
        # zarr keeps threads for later calls
        require_package("zarr.core.sync").cleanup_resources()
    return {"data": "zarr v3, sharding_indexed, zstd", "shard": SHARD}


def _write(zarr: Any, job: ExportJob, folder: Path) -> None:
    count = len(job.chosen)
    group = zarr.create_group(folder / FOLDER, zarr_format=3)
    arrays = {}
    for f in job.features:
        shape = f.shape if f.constant else (SAMPLES_PER_PROBE, *f.shape)
        arrays[f.key] = _array(zarr, group, f.key, (count, *shape), f.dtype)
    for key in PICTURES.values() if job.pictures else ():
        shape = (count, SAMPLES_PER_PROBE, HEIGHT, WIDTH, 3)
        arrays[key] = _array(zarr, group, key, shape, "uint8")
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


def _array(zarr: Any, group: Any, key: str, shape: tuple[int, ...], dtype: str) -> Any:
    return group.create_array(
        key,
        shape=shape,
        dtype=dtype,
        chunks=(1, *shape[1:]),
        shards=(SHARD, *shape[1:]),
        compressors=zarr.codecs.ZstdCodec(level=3),
    )
