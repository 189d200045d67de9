"""Observations of a training set as one memory map: read at random without decoding any file.

``cache/<spec>.npy`` (N, 20, 258) float16 and ``cache/<spec>.json``, which names every row. The
spec names episodes, files and label revisions; where it no longer matches, a new cache is built.
float16 steps are 0.004 px below 8 px and 0.016 N at 16 to 32 N: below the noise of the sensors.
A cache may be deleted at any time.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from backend.catalogue.chain import canonical
from backend.config.method import SAMPLES_PER_PROBE
from backend.core.faults import InputError
from backend.core.files import sync_folder, write_atomically
from backend.core.flow import CHANNELS
from backend.dataset.channels import OBS
from backend.dataset.contents import FIX, explained, read_chunk, read_first
from backend.dataset.unpacking import unpack_observation

FEATURES = 1
"""Raised whenever the same file would give other numbers."""
KEPT = 3
"""So many caches stay, the newest first."""
LISTED = ("episode", "sha256", "revision", "x_um", "y_um", "pair")
SHAPE = (SAMPLES_PER_PROBE, CHANNELS)
Width = Literal["float16", "float32"]


@dataclass(frozen=True, slots=True)
class CacheRow:
    """One episode: where its observation stands, and the label revision it goes with.

    ``chunk``: (offset, length) within a pack; None for an episode file of its own.
    """

    episode: str
    sha256: str
    revision: str
    path: str
    chunk: tuple[int, int] | None
    x_um: int
    y_um: int
    pair: str


class TrainingCache:
    """An open cache: ``rows`` in order, ``observation`` (N, 20, 258) as a read-only memory map."""

    def __init__(self, path: Path, rows: Sequence[CacheRow]) -> None:
        self.path, self.rows = path, tuple(rows)
        self.observation: NDArray[np.floating] = np.load(path, mmap_mode="r", allow_pickle=False)
        self._start = path.stat().st_size - self.observation.nbytes
        self._row_bytes = self.observation.nbytes // max(len(rows), 1)
        self._asked = np.zeros(len(rows), dtype=bool)
        self._descriptor = os.open(path, os.O_RDONLY)

    def __len__(self) -> int:
        return len(self.rows)

    def batch(self, index: NDArray[np.integer]) -> NDArray[np.floating]:
        """Return the observations at ``index`` (B, 20, 258) as stored, in that order."""
        self._read_ahead(index)
        return np.asarray(self.observation[index])

    def close(self) -> None:
        """Close the file; arrays already returned stay valid."""
        os.close(self._descriptor)

    def _read_ahead(self, index: NDArray[np.integer]) -> None:
        """Ask for all rows at once: one page fault after the other is three times slower."""
        if not hasattr(os, "posix_fadvise"):
            return
        for row in np.sort(index[~self._asked[index]]).tolist():
            place = self._start + row * self._row_bytes
            os.posix_fadvise(self._descriptor, place, self._row_bytes, os.POSIX_FADV_WILLNEED)
        self._asked[index] = True


def spec_of(rows: Sequence[CacheRow], width: Width = "float16") -> dict[str, object]:
    """Return what a cache depends on; two equal specs have equal numbers."""
    return {
        "episodes": [[row.episode, row.sha256, row.revision] for row in rows],
        "features": FEATURES,
        "ticks": SAMPLES_PER_PROBE,
        "channels": CHANNELS,
        "rate_hz": 10,
        "resampling": "markers linear between frames, wrench mean of 100 ms",
        "dtype": width,
    }


def open_cache(
    dataset: Path,
    rows: Sequence[CacheRow],
    width: Width = "float16",
    advance: Callable[[int], None] = lambda done: None,
) -> TrainingCache:
    """Open the cache of ``rows`` (by episode), building it first if it is not there.

    ``advance`` gets the number of rows done. Raises ``InputError`` naming a damaged file.
    """
    ordered = sorted(rows, key=lambda row: row.episode)
    spec = spec_of(ordered, width)
    name = sha256(canonical(spec)).hexdigest()
    folder = dataset / "cache"
    path = folder / f"{name}.npy"
    if not _fits(path, len(ordered), width):
        folder.mkdir(parents=True, exist_ok=True)
        _write(path, _observations(dataset, ordered, advance), len(ordered), width)
        write_atomically(path.with_suffix(".json"), _facts(spec, ordered))
    _forget_old(folder, path)
    return TrainingCache(path, ordered)


def _fits(path: Path, count: int, width: Width) -> bool:
    """Whether the cache is whole: its name is the spec, and its ``.json`` was written last."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return False
    whole = (array.shape, array.dtype.name) == ((count, *SHAPE), width)
    return whole and path.with_suffix(".json").exists()


def _facts(spec: dict[str, object], rows: Sequence[CacheRow]) -> bytes:
    columns = {name: [getattr(row, name) for row in rows] for name in LISTED}
    return json.dumps({"spec": {**spec, "episodes": len(rows)}, **columns}).encode()


def _write(
    path: Path, observations: Iterator[NDArray[np.float32]], count: int, width: Width
) -> None:
    header = {"descr": np.dtype(width).str, "fortran_order": False, "shape": (count, *SHAPE)}
    descriptor, part = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            for observation in observations:
                file.write(observation.astype(width).tobytes())
            file.flush()
            os.fsync(file.fileno())
        Path(part).replace(path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def _observations(
    dataset: Path, rows: Sequence[CacheRow], advance: Callable[[int], None]
) -> Iterator[NDArray[np.float32]]:
    for done, row in enumerate(rows):
        yield read_observation(dataset, row)
        if done % 64 == 0:
            advance(done)
    advance(len(rows))


def read_observation(dataset: Path, row: CacheRow) -> NDArray[np.float32]:
    """Return (20, 258) of one row from its file; raises ``InputError`` naming a damaged one."""
    path = dataset / row.path
    group = read_first(path) if row.chunk is None else read_chunk(path, *row.chunk)
    with explained(path):
        observation = unpack_observation(group.messages[OBS.name])
    if observation.shape != SHAPE or not (np.abs(observation) < np.finfo(np.float16).max).all():
        raise InputError("The observation is no probe of 20 ticks.", str(path), FIX)
    return observation


def _forget_old(folder: Path, used: Path) -> None:
    with contextlib.suppress(OSError):
        os.utime(used)
        by_age = sorted(folder.glob("*.npy"), key=lambda path: -path.stat().st_mtime_ns)
        for path in by_age[KEPT:]:
            path.unlink(missing_ok=True)
            path.with_suffix(".json").unlink(missing_ok=True)
