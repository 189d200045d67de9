"""All labelled episodes of a folder as arrays, ready for training and evaluation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.dataset.contents import FIX
from backend.dataset.pack_file import EpisodeRow, read_pack


@dataclass(frozen=True, slots=True)
class TrainingRows:
    """n episodes of one grasped piece.

    ``observation`` (n, 20, 258) float32, or float16 as a memory map of a training cache;
    ``offset_mm`` (n, 2) labelled displacement; ``patch`` (n, N) bool, the true patch over the face
    points; ``bottom``, ``grip_id`` and ``mounting_id`` per episode; ``labels`` as stored.
    """

    piece: str
    geometry: str
    observation: NDArray[np.float32]
    offset_mm: FloatArray
    patch: NDArray[np.bool_]
    bottom: tuple[str, ...]
    grip_id: tuple[str, ...]
    mounting_id: tuple[str, ...]
    labels: tuple[Mapping[str, object], ...]
    fetch: Callable[[NDArray[np.int64]], NDArray[np.floating]] | None = None
    """How ``observation[index]`` is read where it is on disk."""

    def inputs(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """(len(index), 20, 258) float32: the observations at ``index``, in that order."""
        found = self.observation[index] if self.fetch is None else self.fetch(index)
        return found.astype(np.float32, copy=False)

    def __len__(self) -> int:
        return len(self.observation)

    def take(self, index: NDArray[np.int64]) -> TrainingRows:
        """Return the episodes at ``index``, in that order."""
        chosen = index.tolist()
        return TrainingRows(
            self.piece,
            self.geometry,
            self.observation[index],
            self.offset_mm[index],
            self.patch[index],
            tuple(self.bottom[i] for i in chosen),
            tuple(self.grip_id[i] for i in chosen),
            tuple(self.mounting_id[i] for i in chosen),
            tuple(self.labels[i] for i in chosen),
        )


def patch_hex(patch: NDArray[np.bool_]) -> str:
    """Return the label form of a true patch (N,): hex of its packed bits."""
    return np.packbits(patch).tobytes().hex()


def patch_bits(text: str, points: int) -> NDArray[np.bool_]:
    """Return the (points,) patch of its label form; raises ``ValueError`` if the length differs."""
    packed = np.frombuffer(bytes.fromhex(text), np.uint8)
    if packed.size != (points + 7) // 8:
        raise ValueError(f"the patch of a label has not {points} points")
    return np.unpackbits(packed, count=points).astype(bool)


def find_packs(folder: Path) -> list[Path]:
    """Return the packs in and below ``folder`` (or the file itself), by name."""
    if folder.is_file():
        return [folder]
    found = sorted(p for p in folder.rglob("*.mcap") if not p.name.startswith("."))
    if not found:
        raise InputError(
            "There are no episode files here.",
            str(folder),
            "Give the folder that 'touchdown simulate --out' wrote.",
        )
    return found


def load_rows(folder: Path, piece: str | None = None) -> TrainingRows:
    """Load every episode of ``piece`` (None: the only piece there) in and below ``folder``.

    Raises ``InputError`` naming the file for damaged or foreign files, mixed pieces or geometries.
    """
    rows: list[EpisodeRow] = []
    patches: list[NDArray[np.bool_]] = []
    geometry, wanted = "", piece
    seen: set[str] = set()
    for path in find_packs(folder):
        for row in read_pack(path):
            name = _text(row.label, "piece", path)
            seen.add(name)
            wanted = wanted or name
            if name != wanted:
                continue
            geometry = geometry or _text(row.label, "geometry", path)
            if _text(row.label, "geometry", path) != geometry:
                raise _mixed(path, "geometries of the face")
            patches.append(_patch(row.label, path))
            rows.append(row)
    if piece is None and len(seen) > 1:
        raise _mixed(folder, f"grasped pieces ({', '.join(sorted(seen))})")
    if not rows:
        raise InputError(
            f"There are no episodes of '{piece}' here, only of {', '.join(sorted(seen))}.",
            str(folder),
            "Choose one of these pieces, or simulate more episodes.",
        )
    return _stack(rows, patches, wanted or "", geometry)


def join_rows(parts: Sequence[TrainingRows]) -> TrainingRows:
    """Return all episodes in order; raises ``InputError`` for different pieces or geometries."""
    first = parts[0]
    for part in parts:
        if (part.piece, part.geometry) != (first.piece, first.geometry):
            raise InputError(
                f"The episodes belong to different pieces: {first.piece}, {part.piece}.",
                "episodes",
                "Join episodes of one piece only.",
            )
    return TrainingRows(
        first.piece,
        first.geometry,
        np.concatenate([part.observation for part in parts]),
        np.concatenate([part.offset_mm for part in parts]),
        np.concatenate([part.patch for part in parts]),
        tuple(name for part in parts for name in part.bottom),
        tuple(name for part in parts for name in part.grip_id),
        tuple(name for part in parts for name in part.mounting_id),
        tuple(label for part in parts for label in part.labels),
    )


def _stack(
    rows: Sequence[EpisodeRow], patches: Sequence[NDArray[np.bool_]], piece: str, geometry: str
) -> TrainingRows:
    labels = tuple(row.label for row in rows)
    offset = np.array([[_number(k["x_um"]), _number(k["y_um"])] for k in labels]) / 1e3
    return TrainingRows(
        piece,
        geometry,
        np.stack([row.observation for row in rows]),
        offset,
        np.stack(patches),
        tuple(str(label["bottom"]) for label in labels),
        tuple(str(label["grip_id"]) for label in labels),
        tuple(str(label["mounting_id"]) for label in labels),
        labels,
    )


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _text(label: Mapping[str, object], key: str, path: Path) -> str:
    value = label.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(f"A label has no '{key}'.", str(path), FIX)
    return value


def _patch(label: Mapping[str, object], path: Path) -> NDArray[np.bool_]:
    missing = {"x_um", "y_um", "bottom", "grip_id", "mounting_id"} - set(label)
    points = label.get("points")
    if missing or not isinstance(points, int) or not 0 < points < 1_000_000:
        lacking = ", ".join(sorted(missing)) or "points"
        raise InputError(f"A label lacks: {lacking}.", str(path), FIX)
    try:
        return patch_bits(_text(label, "patch", path), points)
    except ValueError as error:
        raise InputError(f"A label is damaged: {error}.", str(path), FIX) from error


def _mixed(where: Path, what: str) -> InputError:
    return InputError(
        f"The episodes belong to different {what}.",
        str(where),
        "Name one piece, or keep such episodes in separate folders.",
    )
