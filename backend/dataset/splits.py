"""Split episodes so that nothing of one side is known to the other.

Errors of a grip or a mounting are shared by all its probes; a split by probe would let the model
recognise them. So whole mountings are held out, or whole grips where there are too few mountings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.dataset.rows import TrainingRows

MIN_MOUNTINGS = 30


@dataclass(frozen=True, slots=True)
class Split:
    """Indices of both sides, and what was kept together ("mounting" or "grip")."""

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
        keys, kind = list(mounting_id), "mounting"
    else:
        pairs = zip(mounting_id, grip_id, strict=True)
        keys, kind = [f"{mounting}/{grip}" for mounting, grip in pairs], "grip"
    names, group, sizes = np.unique(keys, return_inverse=True, return_counts=True)
    if len(names) < 2:
        raise InputError(
            "All episodes come from one grip, so validation would see what training saw.",
            "grip_id",
            "Use episodes of at least two grips (simulate with a smaller --probes-per-grip).",
        )
    order = np.random.default_rng([seed, 14]).permutation(len(names))
    wanted = share * len(keys)
    before = np.concatenate([[0], np.cumsum(sizes[order])[:-1]])
    chosen = order[: max(1, min(len(names) - 1, int(np.sum(before < wanted))))]
    held_out = np.isin(group, chosen)
    return Split(np.flatnonzero(~held_out), np.flatnonzero(held_out), kind)
