"""Labelled episodes of a dataset as training rows, read through a memory-mapped cache.

The cache gives random access to observations without decoding files.
"""

from __future__ import annotations

import json
import math
import os
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import episodes
from touchdown.backend.annotations.database import CATALOGUE_FILE, Database
from touchdown.backend.annotations.geometry_records import GeometryStore, Pair, face_record
from touchdown.backend.annotations.values import Label, canonical_json
from touchdown.backend.config import SAMPLES_PER_PROBE
from touchdown.backend.core import CHANNELS, FloatArray, InputError, sync_folder, write_atomically
from touchdown.backend.geometry import Piece, face_points, load_pieces, true_patch

CACHE_VERSION = 1  # increment when the same file gives different numbers
KEPT_CACHES = 3  # newest caches to keep
LISTED = ("episode", "sha256", "revision", "x_um", "y_um", "pair")
SHAPE = (SAMPLES_PER_PROBE, CHANNELS)
WIDTH = "float16"


@dataclass(frozen=True, slots=True)
class CacheRow:
    """One episode: location of its observation, and its label revision.

    ``chunk``: (offset, length) within a pack; None for an episode file.
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
        """Return the observations at ``index`` (B, 20, 258), in that order."""
        self._read_ahead(index)
        return np.asarray(self.observation[index])

    def close(self) -> None:
        """Close the file; returned arrays stay valid."""
        os.close(self._descriptor)

    def _read_ahead(self, index: NDArray[np.integer]) -> None:
        """Prefetch all rows at once: single page faults are three times slower."""
        if not hasattr(os, "posix_fadvise"):
            return
        for row in np.sort(index[~self._asked[index]]).tolist():
            place = self._start + row * self._row_bytes
            os.posix_fadvise(self._descriptor, place, self._row_bytes, os.POSIX_FADV_WILLNEED)
        self._asked[index] = True


def cache_spec(rows: Sequence[CacheRow]) -> dict[str, object]:
    """Return everything a cache depends on; equal specs have equal numbers."""
    return {
        "episodes": [[row.episode, row.sha256, row.revision] for row in rows],
        "features": CACHE_VERSION,
        "ticks": SAMPLES_PER_PROBE,
        "channels": CHANNELS,
        "rate_hz": 10,
        "resampling": "markers linear between frames, wrench mean of 100 ms",
        "dtype": WIDTH,
    }


def open_cache(dataset: Path, rows: Sequence[CacheRow]) -> TrainingCache:
    """Open the cache of ``rows`` (by episode); build it if it does not exist.

    Raises ``InputError`` for a damaged file.
    """
    ordered = sorted(rows, key=lambda row: row.episode)
    spec = cache_spec(ordered)
    name = sha256(canonical_json(spec)).hexdigest()
    folder = dataset / "cache"
    path = folder / f"{name}.npy"
    if not _fits(path, len(ordered)):
        folder.mkdir(parents=True, exist_ok=True)
        _write(path, dataset, ordered)
        columns = {name: [getattr(row, name) for row in ordered] for name in LISTED}
        header = {"spec": {**spec, "episodes": len(ordered)}, **columns}
        write_atomically(path.with_suffix(".json"), json.dumps(header).encode())
    _delete_old(folder, path)
    return TrainingCache(path, ordered)


def _fits(path: Path, count: int) -> bool:
    """Return True if the cache is complete: its ``.json`` is written last."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError):
        return False
    whole = (array.shape, array.dtype.name) == ((count, *SHAPE), WIDTH)
    return whole and path.with_suffix(".json").exists()


def _write(path: Path, dataset: Path, rows: Sequence[CacheRow]) -> None:
    header = {"descr": np.dtype(WIDTH).str, "fortran_order": False, "shape": (len(rows), *SHAPE)}
    descriptor, part = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(descriptor, "wb") as file:
            np.lib.format.write_array_header_1_0(file, header)
            for row in rows:
                file.write(read_observation(dataset, row).astype(WIDTH).tobytes())
            file.flush()
            os.fsync(file.fileno())
        Path(part).replace(path)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def stored_observation(path: Path, chunk: tuple[int, int] | None) -> NDArray[np.float32]:
    """Return the observation of an episode file, or of a ``chunk`` of a pack."""
    group = episodes.read_first(path) if chunk is None else episodes.read_chunk(path, *chunk)
    with episodes.input_errors(path):
        return episodes.unpack_observation(group.messages[episodes.OBSERVATION_TOPIC.name])


def read_observation(dataset: Path, row: CacheRow) -> NDArray[np.float32]:
    """Return the observation (20, 258) of one row; raises ``InputError`` for a damaged file."""
    path = dataset / row.path
    observation = stored_observation(path, row.chunk)
    if observation.shape != SHAPE or not (np.abs(observation) < np.finfo(np.float16).max).all():
        fix = episodes.DAMAGED_FILE_FIX
        raise InputError("The observation is no probe of 20 ticks.", str(path), fix)
    return observation


def _delete_old(folder: Path, used: Path) -> None:
    with suppress(OSError):
        os.utime(used)
        by_age = sorted(folder.glob("*.npy"), key=lambda path: -path.stat().st_mtime_ns)
        for path in by_age[KEPT_CACHES:]:
            path.unlink(missing_ok=True)
            path.with_suffix(".json").unlink(missing_ok=True)


# ``submitted`` adds labels that wait for review, ``drafts`` also labels of simulated benches.
LabelChoice = Literal["approved", "submitted", "drafts"]
LABEL_CHOICES: tuple[LabelChoice, ...] = get_args(LabelChoice)

_QUERY = """
SELECT e.uuid, e.sha256, e.path, e.chunk_off, e.chunk_len, e.piece, e.bottom, e.grip_id,
    e.mounting_id, e.mode, r.rev_uuid, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, r.source,
    r.geometry
FROM episode e JOIN label_head h ON h.episode = e.uuid
JOIN label_rev r ON r.rev_uuid = {revision}
WHERE e.state = 'complete' AND e.accepted AND NOT h.conflict AND NOT h.deleted
    AND h.state != 'rejected' AND r.x_um IS NOT NULL AND ({allowed})
ORDER BY e.uuid
"""
_WAITING = "h.state = 'submitted'"
_SIMULATED = (
    "h.state = 'draft' AND e.mode IN ('live simulation', 'stepped', 'mass')"
    " AND r.source IN ('commanded', 'measured')"
)


@dataclass(frozen=True, slots=True)
class LabelledEpisode:
    """One episode and the label revision used for training."""

    row: CacheRow
    label: Label
    source: str
    piece: str
    bottom: str
    grip_id: str
    mounting_id: str
    mode: str


def is_dataset(folder: Path) -> bool:
    """Return True if ``folder`` is a dataset (and not a folder of packs)."""
    return (folder / CATALOGUE_FILE).is_file()


def load_training_set(
    folder: Path, piece: str | None = None, labels: LabelChoice = "approved"
) -> episodes.TrainingRows:
    """Return the labelled episodes of ``piece`` (None: the only one) in a dataset.

    Works while another process writes the dataset. Raises ``InputError`` if there are no episodes,
    or episodes of several pieces.
    """
    with closing(Database.open(folder / CATALOGUE_FILE, write=False)) as database:
        listed = labelled_episodes(database, labels)
    chosen = _of_one_piece(listed, piece, folder, labels)
    pairs = {e.row.pair: None for e in chosen}
    store = GeometryStore(folder / "geometry")
    geometry = {name: store.pair(name) for name in pairs}
    top = load_pieces().piece(chosen[0].piece)
    _check_face(top, geometry.values(), folder)
    cache = open_cache(folder, [e.row for e in chosen])
    return episodes.TrainingRows(
        top.name,
        top.sha256,
        cache.observation,
        np.stack([e.label.offset_mm for e in chosen]),
        _patches(chosen, geometry, face_points(top.face)),
        tuple(e.bottom for e in chosen),
        tuple(e.grip_id for e in chosen),
        tuple(e.mounting_id for e in chosen),
        tuple(_label_facts(e) for e in chosen),
        fetch=cache.batch,
    )


def labelled_episodes(database: Database, labels: LabelChoice) -> list[LabelledEpisode]:
    """Return the usable episodes with their labels for training, by uuid."""
    revision, allowed = "h.counting", "1"
    if labels != "approved":
        also = _WAITING if labels == "submitted" else f"{_WAITING} OR ({_SIMULATED})"
        # An approved revision counts until a newer one is approved.
        revision = "coalesce(h.counting, h.rev_uuid)"
        allowed = f"h.counting IS NOT NULL OR {also}"
    rows = database.rows(_QUERY.format(revision=revision, allowed=allowed))
    return [_labelled(row) for row in rows]


def _labelled(row: Sequence[Any]) -> LabelledEpisode:
    uuid, sha256, path, offset, length, piece, bottom, grip, mounting, mode = row[:10]
    revision, x_um, y_um, theta_mdeg, sigma_um, source, pair = row[10:]
    chunk = None if offset is None else (offset, length)
    cached = CacheRow(uuid, sha256, revision, path, chunk, x_um, y_um, pair)
    label = Label(x_um, y_um, theta_mdeg, sigma_um)
    return LabelledEpisode(cached, label, source, piece, bottom, grip, mounting, mode)


def _of_one_piece(
    listed: Sequence[LabelledEpisode], piece: str | None, folder: Path, labels: LabelChoice
) -> list[LabelledEpisode]:
    found = sorted({e.piece for e in listed})
    if not found:
        further = LABEL_CHOICES[LABEL_CHOICES.index(labels) + 1 :]
        fix = "Label and approve some"
        fix += (
            f", or train on labels that are {' or '.join(further)} (--labels)." if further else "."
        )
        raise InputError("No episode has a label to train on.", str(folder), fix)
    if piece is None and len(found) > 1:
        what = f"The episodes belong to different grasped pieces ({', '.join(found)})."
        fix = "Choose one of them."
        raise InputError(what, str(folder), fix)
    chosen = [e for e in listed if e.piece == (piece or found[0])]
    if not chosen:
        what = f"There are no labelled episodes of '{piece}' here, only of {', '.join(found)}."
        fix = "Choose one of these pieces."
        raise InputError(what, str(folder), fix)
    return chosen


def _check_face(piece: Piece, pairs: Iterable[Pair], folder: Path) -> None:
    """Raise ``InputError`` unless all labels refer to the face of ``piece``."""
    face = face_record(piece.face)
    if any(face_record(pair.face) != face for pair in pairs):
        what = f"Some labels refer to another face than that of the piece '{piece.name}'."
        fix = "Move them to the corrected geometry by a bulk operation."
        raise InputError(what, str(folder), fix)


def _patches(
    chosen: Sequence[LabelledEpisode], pairs: Mapping[str, Pair], points: FloatArray
) -> NDArray[np.bool_]:
    """Return the true patches (n, N) over ``points`` (N, 2), per pair and rotation at once."""
    patch = np.zeros((len(chosen), len(points)), dtype=np.bool_)
    offset: FloatArray = np.stack([e.label.offset_mm for e in chosen])
    groups = defaultdict[tuple[str, int], list[int]](list)
    for i, e in enumerate(chosen):
        groups[e.row.pair, e.label.theta_mdeg or 0].append(i)
    for (name, theta_mdeg), index in groups.items():
        yaw_rad = math.radians(theta_mdeg / 1e3)
        patch[index] = true_patch(points, offset[index], pairs[name].bottom, yaw_rad)
    return patch


def _label_facts(e: LabelledEpisode) -> dict[str, object]:
    names = ("source", "piece", "bottom", "grip_id", "mounting_id", "mode")
    return {
        "episode": e.row.episode,
        "revision": e.row.revision,
        "x_um": e.label.x_um,
        "y_um": e.label.y_um,
        "sigma_um": e.label.sigma_um,
        **{name: getattr(e, name) for name in names},
        "file": e.row.path,
        "file_sha256": e.row.sha256,
    }
