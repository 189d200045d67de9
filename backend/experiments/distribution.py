"""What the data look like: signals over the displacement, and presses that feel alike but are not.

The paper shows that its signals are not symmetric about the middle of the bottom, and that very
different patches give very similar signals. Such pairs are searched for here, not constructed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import CHANNELS, TACTILE_CHANNELS, FloatArray
from backend.dataset.rows import TrainingRows
from backend.learning.features import channel_groups

HELD_TICKS = 5
"""The hold at the end of the press: the signals have settled."""
UNLIKE_IOU = 0.25
"""Patches that overlap by less than this are very different."""
LEAST_SHARE = 0.15
"""Of the face: a patch smaller than this is unlike any other by its size alone."""
BLOCK = 500


@dataclass(frozen=True, slots=True)
class Twin:
    """Two presses ``first``, ``second`` (row numbers) with like signals and unlike patches.

    ``distance``: rms difference in units of the channel groups' spread over the data; ``rank``:
    share of all pairs of the data that are nearer than this one.
    """

    first: int
    second: int
    distance: float
    patch_iou: float
    rank: float


def held(rows: TrainingRows) -> FloatArray:
    """Return (n, 258) mean signals of the hold."""
    signals = rows.observation[:, -HELD_TICKS:].mean(axis=1, dtype=np.float64)
    return np.asarray(signals, dtype=np.float64)


def largest_marker_px(signals: FloatArray) -> FloatArray:
    """Return (n,) the largest displacement of a marker."""
    field = signals[:, :TACTILE_CHANNELS].reshape(len(signals), 2, 2, -1)
    return np.asarray(np.hypot(field[:, :, 0], field[:, :, 1]).max(axis=(1, 2)))


def standardised(signals: FloatArray) -> FloatArray:
    """Return (n, 258) with each channel group of unit spread and equal weight in a distance."""
    groups = channel_groups()
    centred = signals - signals.mean(axis=0)
    size = np.bincount(groups)
    spread = np.sqrt(np.bincount(groups, (centred**2).mean(axis=0)) / size)
    spread[spread < 1e-12] = 1.0
    count = len(size)
    return np.asarray(centred / (spread * np.sqrt(size * count))[groups], dtype=np.float64)


def find_twins(
    signals: FloatArray, patch: NDArray[np.bool_], count: int, unlike_iou: float = UNLIKE_IOU
) -> list[Twin]:
    """Return the ``count`` nearest pairs of ``signals`` (n, 258) with unlike ``patch`` (n, N).

    Both patches cover at least ``LEAST_SHARE`` of the face. No press occurs twice. All pairs are
    looked at.
    """
    if signals.shape[1] != CHANNELS:
        raise ValueError(f"signals have {signals.shape[1]} channels, not {CHANNELS}")
    place = standardised(signals)
    squares = (place**2).sum(axis=1)
    size = patch.sum(axis=1)
    large = size >= LEAST_SHARE * patch.shape[1]
    bits = patch.astype(np.float32)
    found: list[tuple[float, int, int, float]] = []
    everything = []
    for start in range(0, len(place), BLOCK):
        rows = slice(start, start + BLOCK)
        distance = squares[rows, None] + squares - 2.0 * place[rows] @ place.T
        both = bits[rows] @ bits.T
        iou = both / np.maximum(size[rows, None] + size - both, 1.0)
        later = np.arange(start, start + len(distance))[:, None] < np.arange(len(place))
        everything.append(distance[later])
        i, j = np.nonzero(later & (iou < unlike_iou) & large[rows, None] & large)
        best = np.argsort(distance[i, j])[: 20 * count]
        found += [
            (float(distance[i[k], j[k]]), start + int(i[k]), int(j[k]), float(iou[i[k], j[k]]))
            for k in best
        ]
    pairs = np.sort(np.concatenate(everything))
    twins: list[Twin] = []
    used: set[int] = set()
    for square, first, second, iou_of in sorted(found):
        if len(twins) < count and not used & {first, second}:
            used |= {first, second}
            rank = float(np.searchsorted(pairs, square) / len(pairs))
            twins.append(Twin(first, second, max(square, 0.0) ** 0.5, iou_of, rank))
    return twins
