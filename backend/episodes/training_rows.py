"""Labelled episodes as arrays, split into training and test rows without leaks.

A split keeps mountings, series or grips together, so that no errors are shared between the two
sides.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray, InputError, errors_as_input
from touchdown.backend.episodes.mcap_container import DAMAGED_FILE_FIX
from touchdown.backend.episodes.packs import PackedEpisode, read_pack


@dataclass(frozen=True, slots=True)
class TrainingRows:
    """n episodes of one grasped piece.

    Attributes
    ----------
    piece, geometry : str
        Name of the grasped piece and hash of its geometry.
    observation : ndarray, shape (n, 20, 258)
        Markers in px, wrench in N and N·m; float32, or float16 as a memory map of a training cache.
    offset_mm : ndarray, shape (n, 2)
        Labelled offset of the face in frame ``O``.
    patch : ndarray of bool, shape (n, N)
        True patch over the N face points.
    bottom, grip_id, mounting_id : tuple of str
        Bottom, grip and mounting of each episode.
    labels : tuple of mapping
        Labels as stored.
    fetch : callable, optional
        Reads ``observation[index]`` of a memory map.

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

    def inputs(self, index: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the observations at ``index`` in that order, (len(index), 20, 258) float32."""
        found = self.observation[index] if self.fetch is None else self.fetch(index)
        return found.astype(np.float32, copy=False)

    def __len__(self) -> int:
        return len(self.observation)

    def take(self, index: NDArray[np.int64]) -> TrainingRows:
        """Return the episodes at ``index``, in that order."""
        chosen = index.tolist()
        arrays: Any = {name: getattr(self, name)[index] for name in ARRAYS}
        lists: Any = {name: tuple(getattr(self, name)[i] for i in chosen) for name in LISTS}
        return TrainingRows(self.piece, self.geometry, **arrays, **lists)


ARRAYS = ("observation", "offset_mm", "patch")
LISTS = ("bottom", "grip_id", "mounting_id", "labels")


def patch_hex(patch: NDArray[np.bool_]) -> str:
    """Return a true patch (N,) as stored in a label: hexadecimal packed bits."""
    return np.packbits(patch).tobytes().hex()


def patch_bits(text: str, points: int) -> NDArray[np.bool_]:
    """Return the patch (points,) of its label form; raises ``ValueError`` for another length."""
    packed = np.frombuffer(bytes.fromhex(text), np.uint8)
    if packed.size != (points + 7) // 8:
        raise ValueError(f"the patch of a label has not {points} points")
    return np.unpackbits(packed, count=points).astype(bool)


def find_packs(folder: Path) -> list[Path]:
    """Return the packs in and below ``folder`` (or the file itself), sorted by name.

    Hidden files and folders belong to unfinished jobs and are left out.
    """
    if folder.is_file():
        return [folder]
    packs = folder.rglob("*.mcap")
    found = sorted(p for p in packs if "/." not in f"/{p.relative_to(folder).as_posix()}")
    if not found:
        what = f"There {'are no episode files here' if folder.exists() else 'is no such folder'}."
        raise InputError(what, str(folder), "Give a dataset, or the --out of 'touchdown simulate'.")
    return found


def load_rows(folder: Path, piece: str | None = None) -> TrainingRows:
    """Load every episode of ``piece`` (None: the only one) in and below ``folder``.

    Raises ``InputError`` for damaged or foreign files, mixed pieces or geometries.
    """
    rows: list[PackedEpisode] = []
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
        what = f"There are no episodes of '{piece}' here, only of {', '.join(sorted(seen))}."
        fix = "Choose one of these pieces, or simulate more episodes."
        raise InputError(what, str(folder), fix)
    labels = tuple(row.label for row in rows)
    lists: Any = {name: tuple(str(label[name]) for label in labels) for name in LISTS[:3]}
    return TrainingRows(
        wanted or "",
        geometry,
        np.stack([row.observation for row in rows]),
        np.array([[_number(k["x_um"]), _number(k["y_um"])] for k in labels]) / 1e3,
        np.stack(patches),
        labels=labels,
        **lists,
    )


def join_rows(parts: Sequence[TrainingRows]) -> TrainingRows:
    """Return all episodes in order; raises ``InputError`` for different pieces or geometries."""
    first = parts[0]
    for part in parts:
        if (part.piece, part.geometry) != (first.piece, first.geometry):
            what = f"The episodes belong to different pieces: {first.piece}, {part.piece}."
            fix = "Join episodes of one piece only."
            raise InputError(what, "episodes", fix)
    arrays: Any = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}
    lists: Any = {name: tuple(chain(*(getattr(part, name) for part in parts))) for name in LISTS}
    return TrainingRows(first.piece, first.geometry, **arrays, **lists)


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else float("nan")


def _text(label: Mapping[str, object], key: str, path: Path) -> str:
    value = label.get(key)
    if not isinstance(value, str) or not value:
        raise InputError(f"A label has no '{key}'.", str(path), DAMAGED_FILE_FIX)
    return value


def _patch(label: Mapping[str, object], path: Path) -> NDArray[np.bool_]:
    missing = {"x_um", "y_um", "bottom", "grip_id", "mounting_id"} - set(label)
    points = label.get("points")
    if missing or not isinstance(points, int) or not 0 < points < 1_000_000:
        lacking = ", ".join(sorted(missing)) or "points"
        raise InputError(f"A label lacks: {lacking}.", str(path), DAMAGED_FILE_FIX)
    with errors_as_input("A label is damaged", path, DAMAGED_FILE_FIX, ValueError):
        return patch_bits(_text(label, "patch", path), points)


def _mixed(where: Path, what: str) -> InputError:
    return InputError(
        f"The episodes belong to different {what}.",
        str(where),
        "Name one piece, or keep such episodes in separate folders.",
    )


MIN_MOUNTINGS = 30
# ends the advice of errors about too little data
SIMULATE_ADVICE = "of simulated probes make more ('touchdown simulate --episodes 2000')"


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of both sides, and the unit kept together ("mounting", "series" or "grip")."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    kept_together: str


def split_rows(
    rows: TrainingRows, share: float, seed: int, *, divide_series: bool = False
) -> Split:
    """Hold out about ``share`` (0..1) of the episodes: whole mountings, series or grips.

    Mountings if there are at least 30, else series of one pair; with ``divide_series`` grips
    instead of series. Raises ``InputError`` if nothing can be held out.
    """
    if divide_series:
        return split_grips(rows.mounting_id, rows.grip_id, share, seed)
    pairs = [f"{rows.piece} on {bottom}" for bottom in rows.bottom]
    return split_series(rows.mounting_id, pairs, share, seed)


def split_grips(
    mounting_id: Sequence[str], grip_id: Sequence[str], share: float, seed: int
) -> Split:
    """Split by mounting if there are at least 30, else by grip (validation shares the mountings).

    Raises ``InputError`` if all episodes come from one grip.
    """
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(mounting_id, "mounting", share, seed)
    keys = [f"{mounting}/{grip}" for mounting, grip in zip(mounting_id, grip_id, strict=True)]
    if len(set(keys)) < 2:
        raise InputError(
            "All episodes come from one grip, so validation would see what training saw.",
            "grip_id",
            "Collect another campaign of this piece, or one with fewer probes per grip; "
            f"{SIMULATE_ADVICE}.",
        )
    return _hold_out(keys, "grip", share, seed)


def split_series(mounting_id: Sequence[str], pair: Sequence[str], share: float, seed: int) -> Split:
    """Hold out whole mountings if there are at least 30, else whole series of one pair.

    A series is recorded on one mounting; ``pair`` names face and bottom of each episode. Every pair
    keeps a series for training. Raises ``InputError`` if no pair has two series.
    """
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(mounting_id, "mounting", share, seed)
    keys = list(zip(pair, mounting_id, strict=True))
    sizes = Counter(keys)
    of_pair = Counter(name for name, _ in sizes)
    if not of_pair or max(of_pair.values()) < 2:
        name = next(iter(of_pair), "one pair") if len(of_pair) < 2 else "each pair"
        raise InputError(
            f"There is one series only of {name}, so validation would know its errors.",
            "mounting_id",
            "Collect another campaign of the same pair (each is a series of its own); "
            f"{SIMULATE_ADVICE}. Or choose to divide series by grips (--divide-series).",
        )
    # Draw series up to the wanted number of episodes, or the smallest one if all are larger.
    names = sorted(key for key in sizes if of_pair[key[0]] > 1)
    order = np.random.default_rng([seed, 14]).permutation(len(names))
    shuffled = [names[k] for k in order.tolist()]
    drawn, total = set[tuple[str, str]](), 0
    for key in shuffled:
        if total + sizes[key] <= share * len(keys) and of_pair[key[0]] > 1:
            drawn.add(key)
            of_pair[key[0]] -= 1
            total += sizes[key]
    drawn = drawn or {min(shuffled, key=sizes.__getitem__)}
    held_out = np.array([key in drawn for key in keys])
    return Split(np.flatnonzero(~held_out), np.flatnonzero(held_out), "series")


def group_noun(kept_together: str) -> str:
    """Return the unit kept together, in the plural."""
    return "whole series" if kept_together == "series" else f"whole {kept_together}s"


def divided_indices(sides: Sequence[str], groups: Sequence[Hashable]) -> NDArray[np.int64]:
    """Return the indices of all episodes in ``groups`` that are on more than one side."""
    seen: dict[Hashable, set[str]] = {}
    for side, group in zip(sides, groups, strict=True):
        seen.setdefault(group, set()).add(side)
    return np.array([k for k, group in enumerate(groups) if len(seen[group]) > 1], dtype=np.int64)


def _hold_out(keys: Sequence[str], kind: str, share: float, seed: int) -> Split:
    """Draw whole groups of equal ``keys`` until ``share`` is reached; never all of them."""
    names, group, sizes = np.unique(keys, return_inverse=True, return_counts=True)
    order = np.random.default_rng([seed, 14]).permutation(len(names))
    wanted = share * len(keys)
    before = np.concatenate([[0], np.cumsum(sizes[order])[:-1]])
    chosen = order[: max(1, min(len(names) - 1, int(np.sum(before < wanted))))]
    held_out = np.isin(group, chosen)
    return Split(np.flatnonzero(~held_out), np.flatnonzero(held_out), kind)
