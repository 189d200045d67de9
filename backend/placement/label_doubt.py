"""Which labels do the signals speak against? Each is judged by the other episodes of its pair.

The others tell what is felt at a displacement: a smooth function of it, with a scatter that differs
from place to place. A label is in doubt as far as what was felt would be likelier a few mm away.
Nothing has to be known of how sure a model is, and where a displacement cannot be felt, as with a
face wholly on the bottom, nothing is doubted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from backend.core.flow import FloatArray

FEWEST = 200
"""Fewer episodes of a pair do not tell what is felt where."""
PARTS = 10
"""Principal parts of the estimated patch that are compared, beside the wrench."""
SMOOTH_MM = 3.0
RIDGE = 0.5
FOLDS = 8
NEAR = 80
"""So many labels nearby tell the scatter."""
MOST = 1500
"""More episodes than this make the smooth function no better, only slower."""
CLIP = 0.01
SHRINK = 0.1
SHIFTS_MM = (1.0, 2.0, 3.0, 5.0)
TURNS = 12


def signals_of(probability: FloatArray, wrench: FloatArray) -> FloatArray:
    """Return what was felt in few numbers, (n, d), scaled alike.

    ``probability`` (n, N) of the estimated patches, ``wrench`` (n, 6) of the settled press; all of
    one pair.
    """
    return np.hstack([_parts(probability), _standard(wrench)])


def doubts(felt: FloatArray, offsets_mm: FloatArray) -> FloatArray:
    """Return how much likelier (n,) each episode is a few mm from its label: twice log likelihoods.

    ``felt`` (n, d) as ``signals_of`` gives it, ``offsets_mm`` (n, 2) as labelled; all of one pair.
    NaN below ``FEWEST`` episodes.
    """
    count = len(offsets_mm)
    if count < FEWEST:
        return np.full(count, np.nan)
    error = felt - _expected_without_own(offsets_mm, felt)
    expected = _smooth(offsets_mm, felt, np.random.default_rng(0))
    near = _nearest(offsets_mm, min(NEAR, count - 1))
    shifts = _shifts_mm()
    found = np.empty(count)
    for k in range(count):
        middle, scale, inverse = _scatter(error[near[k]])
        moved = expected(offsets_mm[k] + shifts)
        apart = (error[k] - middle - (moved - moved[0])) / scale
        distance = np.einsum("ij,jk,ik->i", apart, inverse, apart)
        found[k] = distance[0] - distance.min()
    return found


def _nearest(at_mm: FloatArray, count: int) -> NDArray[np.intp]:
    """Return the indices (n, count) of the nearest other places."""
    found = np.asarray(cKDTree(at_mm).query(at_mm, k=count + 1)[1], dtype=np.intp)
    return found[:, 1:]


def _parts(probability: FloatArray) -> FloatArray:
    """Return the first principal parts of the log odds, (n, PARTS), scaled alike."""
    p = np.clip(probability, CLIP, 1 - CLIP)
    odds = np.log(p / (1 - p))
    left, sizes, _ = np.linalg.svd(odds - odds.mean(axis=0), full_matrices=False)
    return _standard(left[:, :PARTS] * sizes[:PARTS])


def _standard(values: FloatArray) -> FloatArray:
    return np.asarray((values - values.mean(axis=0)) / np.maximum(values.std(axis=0), 1e-9))


class _Smooth:
    """A smooth function of the displacement, fitted to what was felt (kernel ridge)."""

    def __init__(self, at_mm: FloatArray, felt: FloatArray) -> None:
        self._at_mm, self._mean = at_mm, felt.mean(axis=0)
        ridge = RIDGE * np.eye(len(at_mm))
        self._weights = np.linalg.solve(_kernel(at_mm, at_mm) + ridge, felt - self._mean)

    def __call__(self, at_mm: FloatArray) -> FloatArray:
        return np.asarray(_kernel(at_mm, self._at_mm) @ self._weights + self._mean)


def _smooth(at_mm: FloatArray, felt: FloatArray, rng: np.random.Generator) -> _Smooth:
    if len(at_mm) > MOST:
        chosen = np.sort(rng.choice(len(at_mm), MOST, replace=False))
        at_mm, felt = at_mm[chosen], felt[chosen]
    return _Smooth(at_mm, felt)


def _kernel(one_mm: FloatArray, other_mm: FloatArray) -> FloatArray:
    apart = ((one_mm[:, None] - other_mm) ** 2).sum(axis=2)
    return np.asarray(np.exp(-apart / (2 * SMOOTH_MM**2)))


def _expected_without_own(at_mm: FloatArray, felt: FloatArray) -> FloatArray:
    """Return what the others say is felt at each label: no episode speaks for itself."""
    rng = np.random.default_rng(1)
    fold = rng.permutation(len(at_mm)) % FOLDS
    expected = np.empty_like(felt)
    for number in range(FOLDS):
        others = fold != number
        expected[~others] = _smooth(at_mm[others], felt[others], rng)(at_mm[~others])
    return expected


def _scatter(error: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return middle and scale (d,) of errors (k, d), and the inverse covariance in that scale.

    Wrong labels among them are held to three deviations.
    """
    middle = np.median(error, axis=0)
    scale = 1.4826 * np.median(np.abs(error - middle), axis=0) + 1e-6
    z = np.clip((error - middle) / scale, -3.0, 3.0)
    covariance = np.cov(z.T) + SHRINK * np.eye(error.shape[1])
    return middle, scale, np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def _shifts_mm() -> FloatArray:
    """Return the shifts that are tried, (m, 2); the first is none."""
    turn = 2 * np.pi * np.arange(TURNS) / TURNS
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return np.concatenate([np.zeros((1, 2)), *(by * ring for by in SHIFTS_MM)])
