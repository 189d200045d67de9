"""Split episodes so that nothing of one side is known to the other.

Errors of a grip or a mounting are shared by all its probes; a split by probe would let the model
recognise them. So whole mountings are held out, or where there are few of them whole series of one
pair. Whole grips only where somebody says so: their mounting is then on both sides.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.dataset.rows import TrainingRows

MIN_MOUNTINGS = 30
SIMULATED = "of simulated probes make more ('touchdown simulate --episodes 2000')"
"""The cure where nothing was collected."""


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of both sides, and what was kept together ("mounting", "series" or "grip")."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    kept_together: str


def split_rows(
    rows: TrainingRows, share: float, seed: int, *, divide_series: bool = False
) -> Split:
    """Hold out about ``share`` (0..1) of the episodes: whole mountings, series or grips.

    Mountings where there are at least 30, else series of one pair; with ``divide_series`` grips
    instead of series. Raises ``InputError`` if that leaves nothing to hold out.
    """
    if divide_series:
        return split_grips(rows.mounting_id, rows.grip_id, share, seed)
    pairs = [f"{rows.piece} on {bottom}" for bottom in rows.bottom]
    return split_series(rows.mounting_id, pairs, share, seed)


def split_grips(
    mounting_id: Sequence[str], grip_id: Sequence[str], share: float, seed: int
) -> Split:
    """Split by mounting where there are at least 30, else by grip: validation knows the mountings.

    Raises ``InputError`` if all episodes come from one grip.
    """
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(list(mounting_id), "mounting", share, seed)
    pairs = zip(mounting_id, grip_id, strict=True)
    keys = [f"{mounting}/{grip}" for mounting, grip in pairs]
    if len(set(keys)) < 2:
        raise InputError(
            "All episodes come from one grip, so validation would see what training saw.",
            "grip_id",
            "Collect another campaign of this piece, or one with fewer probes per grip; "
            f"{SIMULATED}.",
        )
    return _hold_out(keys, "grip", share, seed)


def split_series(mounting_id: Sequence[str], pair: Sequence[str], share: float, seed: int) -> Split:
    """Hold out whole mountings where there are at least 30, else whole series of one pair.

    A series is what was recorded on one mounting; ``pair`` names face and bottom of each episode.
    Every pair keeps a series to train on. Raises ``InputError`` if no pair has two of them.
    """
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(list(mounting_id), "mounting", share, seed)
    keys = list(zip(pair, mounting_id, strict=True))
    sizes = Counter(keys)
    of_pair = Counter(name for name, _ in sizes)
    if not of_pair or max(of_pair.values()) < 2:
        name = next(iter(of_pair), "one pair")
        raise InputError(
            f"There is one series only of {name}, so validation would know its errors."
            if len(of_pair) < 2
            else "There is one series only of each pair, so validation would know its errors.",
            "mounting_id",
            "Collect another campaign of the same pair (each is a series of its own); "
            f"{SIMULATED}. Or choose to divide series by grips (--divide-series).",
        )
    chosen = _chosen_series(sizes, of_pair, share * len(keys), seed)
    held_out = np.array([key in chosen for key in keys])
    return Split(np.flatnonzero(~held_out), np.flatnonzero(held_out), "series")


def _chosen_series(
    sizes: Counter[tuple[str, str]], of_pair: Counter[str], wanted: float, seed: int
) -> set[tuple[str, str]]:
    """Draw series up to ``wanted`` episodes, or the smallest one if none is so small."""
    names = sorted(key for key in sizes if of_pair[key[0]] > 1)
    order = np.random.default_rng([seed, 14]).permutation(len(names))
    drawn, left, total = set[tuple[str, str]](), Counter(of_pair), 0
    for key in (names[k] for k in order.tolist()):
        if total + sizes[key] <= wanted and left[key[0]] > 1:
            drawn.add(key)
            left[key[0]] -= 1
            total += sizes[key]
    return drawn or {min((names[k] for k in order.tolist()), key=lambda key: sizes[key])}


def kept_words(kept_together: str) -> str:
    """Say in the plural what was never divided."""
    return "whole series" if kept_together == "series" else f"whole {kept_together}s"


def divided(sides: Sequence[str], groups: Sequence[Hashable]) -> NDArray[np.int64]:
    """Return the indices of all episodes of those ``groups`` that are on more than one side."""
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
