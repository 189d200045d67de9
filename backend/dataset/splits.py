"""Split episodes so that nothing of one side is known to the other.

Errors of a grip or a mounting are shared by all its probes; a split by probe would let the model
recognise them. So whole mountings are held out, or whole grips where there are too few mountings.
What is handed on goes further: no pair of a series is divided unless somebody says so.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.dataset.rows import TrainingRows

MIN_MOUNTINGS = 30


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of both sides, and what was kept together ("mounting", "series" or "grip")."""

    train: NDArray[np.int64]
    held_out: NDArray[np.int64]
    kept_together: str


def split_rows(rows: TrainingRows, share: float, seed: int) -> Split:
    """Hold out about ``share`` (0..1) of the episodes, in whole mountings or grips.

    Mountings where there are at least 30, else grips. Raises ``InputError`` if all episodes come
    from one grip: then every split would leak.
    """
    return split_groups(rows.mounting_id, rows.grip_id, share, seed)


def split_groups(
    mounting_id: Sequence[str], grip_id: Sequence[str], share: float, seed: int
) -> Split:
    """Split as ``split_rows`` does, from the mounting and the grip of each episode."""
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(list(mounting_id), "mounting", share, seed)
    pairs = zip(mounting_id, grip_id, strict=True)
    keys = [f"{mounting}/{grip}" for mounting, grip in pairs]
    if len(set(keys)) < 2:
        raise InputError(
            "All episodes come from one grip, so validation would see what training saw.",
            "grip_id",
            "Use episodes of at least two grips: collect or simulate with fewer probes per grip.",
        )
    return _hold_out(keys, "grip", share, seed)


def split_series(mounting_id: Sequence[str], pair: Sequence[str], share: float, seed: int) -> Split:
    """Hold out whole mountings where there are at least 30, else whole series of one pair.

    A series is what was recorded on one mounting; ``pair`` names face and bottom of each episode.
    Raises ``InputError`` if there is but one such series.
    """
    if len(set(mounting_id)) >= MIN_MOUNTINGS:
        return _hold_out(list(mounting_id), "mounting", share, seed)
    keys = [f"{mounting}/{name}" for mounting, name in zip(mounting_id, pair, strict=True)]
    if len(set(keys)) < 2:
        raise InputError(
            "All episodes come from one series of one pair, so validation would know its errors.",
            "mounting_id",
            "Collect another series, or let its grips be divided (--divide-series).",
        )
    return _hold_out(keys, "series", share, seed)


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
