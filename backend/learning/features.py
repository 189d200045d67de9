"""Which of the 258 channels a model sees, and how they are standardised."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import CHANNELS, MARKERS, TACTILE_CHANNELS, WRENCH_CHANNELS

Modality = Literal["FT", "Tac", "FT+Tac"]
MODALITIES: tuple[Modality, ...] = ("FT", "Tac", "FT+Tac")
VECTOR_ORDER = "[sensor][axis][row][column] 2x2x7x9, then Fx Fy Fz Tx Ty Tz"
_COLUMNS: dict[Modality, slice] = {
    "FT": slice(TACTILE_CHANNELS, CHANNELS),
    "Tac": slice(0, TACTILE_CHANNELS),
    "FT+Tac": slice(0, CHANNELS),
}


def columns(modality: Modality) -> slice:
    """Return the channels of ``modality`` within the 258."""
    return _COLUMNS[modality]


def channel_groups() -> NDArray[np.int64]:
    """(258,) group of every channel: each finger and axis is one, each wrench value is one."""
    tactile = np.repeat(np.arange(TACTILE_CHANNELS // MARKERS), MARKERS)
    wrench = tactile[-1] + 1 + np.arange(WRENCH_CHANNELS)
    return np.concatenate([tactile, wrench])


@dataclass(frozen=True, slots=True)
class Normaliser:
    """``(x - mean) / scale``; both (channels,) float32."""

    mean: NDArray[np.float32]
    scale: NDArray[np.float32]


def fit_in_parts(parts: Iterable[NDArray[np.float32]], modality: Modality) -> Normaliser:
    """Fit on the episodes of all ``parts`` without holding them at once."""
    count, mean, squares = 0, np.zeros(CHANNELS), np.zeros(CHANNELS)
    for part in parts:
        flat = part.reshape(-1, part.shape[-1])
        added, their_mean = len(flat), flat.mean(axis=0, dtype=np.float64)
        # Means and squared deviations of two samples as of one (Chan, Golub, LeVeque 1983).
        step, total = their_mean - mean, count + added
        squares += flat.astype(np.float64).var(axis=0) * added + step**2 * (count * added / total)
        mean, count = mean + step * (added / total), total
    variance = squares / count
    groups = channel_groups()
    scale = np.sqrt(np.bincount(groups, variance) / np.bincount(groups))[groups]
    scale[scale < 1e-9] = 1.0
    seen = columns(modality)
    return Normaliser(mean[seen].astype(np.float32), scale[seen].astype(np.float32))
