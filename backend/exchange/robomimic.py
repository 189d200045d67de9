"""robomimic HDF5: one group per episode, actions within -1 to 1, the split as masks.

HDF5 aborts the process if it cannot close its file. ``DiskFullSafeFile`` lets it close on a full
disk.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.core import require_package
from touchdown.backend.exchange.export_episode import ExportEpisode
from touchdown.backend.exchange.exports import ExportJob
from touchdown.backend.exchange.features import ACTION, FPS, OFFSET, PATCH, Feature, short_name


class DiskFullSafeFile:
    """New file that accepts every write; ``check`` raises the first ``OSError``.

    After the first error all data are kept in memory, so callers check often.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self._at = self._end = 0
        self._late: list[tuple[int, bytes]] = []
        self._refused: OSError | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def check(self) -> None:
        """Raise the first error of the disk, if there was one."""
        if self._refused is not None:
            raise self._refused

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Move the position of the next read or write and return it."""
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        self._at = start + offset
        return self._at

    def tell(self) -> int:
        """Return the position of the next read or write."""
        return self._at

    def write(self, content: bytes | memoryview) -> int:
        """Write all of ``content`` to the disk, or to memory after an error."""
        data, done = bytes(content), 0
        try:
            self.check()
            self._file.seek(self._at)
            while done < len(data):
                done += self._file.write(data[done:])
        except OSError as error:
            self._refused = error
            self._late.append((self._at + done, data[done:]))
        self._at += len(data)
        self._end = max(self._end, self._at)
        return len(data)

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes, less at the end."""
        count = min(size, max(self._end - self._at, 0))
        self._file.seek(self._at)
        found = bytearray(self._file.read(count) or b"").ljust(count, b"\0")
        for place, data in self._late:
            first, last = max(place, self._at), min(place + len(data), self._at + count)
            if first < last:
                found[first - self._at : last - self._at] = data[first - place : last - place]
        self._at += count
        return bytes(found)

    def truncate(self, size: int) -> int:
        """Shorten or extend the file."""
        try:
            self.check()
            self._file.truncate(size)
        except OSError as error:
            self._refused = error
        self._end = size
        return size

    def flush(self) -> None:
        """Do nothing: writes go to the disk at once."""


DEMOS = "demos.hdf5"
GYM = 2
ENVIRONMENT = "Touchdown"
ACTION_SIZE = 7


def write(job: ExportJob, folder: Path) -> Mapping[str, object]:
    """Write the episodes of ``job`` to ``demos.hdf5`` in ``folder``."""
    h5py = require_package("h5py")
    with DiskFullSafeFile(folder / DEMOS) as disk:
        with h5py.File(disk, "w") as file:
            scale = _write_all(file, job, disk)
        disk.check()
    return {"data": "hdf5", "action_scale": scale}


def _write_all(file: Any, job: ExportJob, disk: DiskFullSafeFile) -> float:
    """Write all demos and masks; return the scale of the actions. Raises ``OSError``."""
    greatest = 0.0
    sides: dict[str, list[str]] = {}
    data = file.create_group("data")
    for episode in job.episodes():
        one = episode.chosen
        name = f"demo_{one.index}"
        action = _write_demo(data.create_group(name), episode, job.features)
        greatest = max(greatest, float(np.abs(action).max()))
        sides.setdefault(one.split, []).append(name)
        disk.check()
    scale = action_scale(greatest)
    if scale != 1.0:
        for demo in data.values():
            demo["actions"][...] = demo["actions"][...] / np.float32(scale)
    data.attrs["total"] = SAMPLES_PER_PROBE * len(job.chosen)
    kwargs = {"action_scale": scale, "fps": FPS}
    environment = {"env_name": ENVIRONMENT, "env_type": GYM, "env_kwargs": kwargs}
    data.attrs["env_args"] = json.dumps(environment)
    masks = file.create_group("mask")
    for side, names in sides.items():
        masks.create_dataset(side, data=np.array(names, dtype="S"))
    return scale


def action_scale(greatest: float) -> float:
    """Return the power of two that scales actions up to ``greatest`` into -1 to 1.

    Division by a power of two is exact.
    """
    return 2.0 ** max(0, int(np.ceil(np.log2(greatest)))) if greatest > 1.0 else 1.0


def _write_demo(
    demo: Any, episode: ExportEpisode, features: tuple[Feature, ...]
) -> NDArray[np.float32]:
    demo.attrs["num_samples"] = SAMPLES_PER_PROBE
    demo.attrs["product_episode"] = episode.chosen.entry.uuid
    demo.attrs["product_rev"] = episode.chosen.revision.rev_uuid
    action = np.zeros((SAMPLES_PER_PROBE, ACTION_SIZE), dtype=np.float32)
    for feature in features:
        if feature.key == ACTION:
            action = episode.values[ACTION]
        elif feature.key in (OFFSET, PATCH):
            _dataset(demo, short_name(feature.key), episode.per_tick(feature))
        else:
            _observation(demo, feature.key, episode.values[feature.key])
    for key, pictures in episode.pictures.items():
        _observation(demo, key, np.stack(pictures))
    dones = np.zeros(SAMPLES_PER_PROBE, dtype=np.int64)
    dones[-1] = 1
    _dataset(demo, "actions", action)
    _dataset(demo, "rewards", np.zeros(SAMPLES_PER_PROBE, dtype=np.float32))
    _dataset(demo, "dones", dones)
    _dataset(demo, "states", np.zeros((SAMPLES_PER_PROBE, 1), dtype=np.float32))
    return action


def _observation(demo: Any, key: str, values: NDArray[Any]) -> None:
    name = short_name(key)
    _dataset(demo, f"obs/{name}", values)
    _dataset(demo, f"next_obs/{name}", np.concatenate([values[1:], values[-1:]]))


def _dataset(demo: Any, name: str, values: NDArray[Any]) -> None:
    # Chunks of one episode, so that readers can load single ticks of an image.
    demo.create_dataset(name, data=values, compression=1 if values.ndim > 2 else None)
