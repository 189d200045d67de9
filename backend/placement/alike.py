"""Which labels lie off those of the most alike signals? A fit of the label to the signals nearby.

Where the signals tell the displacement, few tenths of a mm off are strange; where they do not, as
with a face wholly on the bottom, alike signals have labels all over, and nothing is strange.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from backend.core.flow import FloatArray

FEWEST = 30
"""Fewer episodes of a pair have nothing alike among them."""
ALIKE = 40
"""So many of the most alike signals say where the face should be."""
RIDGE = 3.0
"""Of the fit: signals are scaled alike, and labels should not follow their noise."""
ROUNDS = 3
HELD = 2.0
"""Labels so many deviations off count less in the fit: wrong ones are among them."""
FLOOR_MM = 0.5
"""What is not strange, however well the others agree."""
PART = 500


def strangeness(signals: FloatArray, offsets_mm: FloatArray) -> FloatArray:
    """Return how far (n,) each label lies off where the most alike signals put it.

    ``signals`` (n, d) scaled alike and ``offsets_mm`` (n, 2) as labelled, of one pair. The distance
    is counted in the median distance of those others, plus ``FLOOR_MM``. NaN below ``FEWEST``.
    """
    count = len(signals)
    if count < FEWEST:
        return np.full(count, np.nan)
    near = cKDTree(signals).query(signals, k=min(ALIKE, count - 1) + 1)[1]
    near = _without_own(np.asarray(near, dtype=np.intp))
    parts = [slice(at, at + PART) for at in range(0, count, PART)]
    return np.concatenate([_off(signals, offsets_mm, near, part) for part in parts])


def _without_own(near: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the neighbours (n, k) but each episode itself, which equal signals may hide."""
    own = near == np.arange(len(near))[:, None]
    own[~own.any(axis=1), -1] = True
    return np.asarray(near[~own].reshape(len(near), -1), dtype=np.intp)


def _off(
    signals: FloatArray, offsets_mm: FloatArray, near: NDArray[np.intp], part: slice
) -> FloatArray:
    """Fit the labels of the others linearly to their signals, and compare the own one."""
    others = offsets_mm[near[part]]
    apart = signals[near[part]] - signals[part, None]
    terms = np.concatenate([np.ones((*apart.shape[:2], 1)), apart], axis=2)
    ridge = RIDGE * np.eye(terms.shape[2])
    ridge[0, 0] = 0.0
    weight = np.ones(apart.shape[:2])
    for _ in range(ROUNDS):
        weighted = terms * weight[:, :, None]
        square = np.einsum("nki,nkj->nij", weighted, weighted) + ridge
        fit = np.linalg.solve(
            square, np.einsum("nki,nkj->nij", weighted, weight[:, :, None] * others)
        )
        left = np.linalg.norm(others - terms @ fit, axis=2)
        usual = np.median(left, axis=1)
        weight = 1.0 / np.maximum(1.0, left / (HELD * usual[:, None] + 1e-6))
    own = np.linalg.norm(offsets_mm[part] - fit[:, 0], axis=1)
    return np.asarray(own / (usual + FLOOR_MM))
