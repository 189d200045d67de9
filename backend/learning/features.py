"""Which of the 258 channels a model sees, and how they are standardised."""

from __future__ import annotations

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


def fit_normaliser(observation: NDArray[np.float32], modality: Modality) -> Normaliser:
    """Fit on ``observation`` (n, 20, 258): mean per channel, one scale per channel group.

    One scale per group keeps the sizes of neighbouring markers comparable. A group that never
    changes gets scale 1.
    """
    flat = observation.reshape(-1, observation.shape[-1])
    mean = flat.mean(axis=0, dtype=np.float64)
    square = flat.astype(np.float64).var(axis=0)
    groups = channel_groups()
    variance = np.bincount(groups, square) / np.bincount(groups)
    scale = np.sqrt(variance)[groups]
    scale[scale < 1e-9] = 1.0
    part = columns(modality)
    return Normaliser(mean[part].astype(np.float32), scale[part].astype(np.float32))
