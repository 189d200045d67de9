"""How far labels of the same episodes agree: bias and limits, ICC, kappa, alpha, patch overlap.

Sources: Bland and Altman, Lancet 1986; Shrout and Fleiss, Psychological Bulletin 86 (1979);
Cohen 1960; Krippendorff, Content Analysis. Undefined figures are NaN.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

LIMITS = 1.96
Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Bias:
    """Mean difference of two raters, its standard deviation (n - 1) and the 95 % limits."""

    mean: float
    deviation: float
    lower: float
    upper: float


def bias(first: ArrayLike, second: ArrayLike) -> Bias:
    """Return bias and limits of agreement of ``first`` minus ``second``, (n,) each."""
    d = np.asarray(first, dtype=np.float64) - np.asarray(second, dtype=np.float64)
    mean = float(d.mean()) if d.size else math.nan
    deviation = float(d.std(ddof=1)) if d.size > 1 else math.nan
    half = LIMITS * deviation
    return Bias(mean, deviation, mean - half, mean + half)


def icc(ratings: ArrayLike) -> float:
    """ICC(2,1): two-way random effects, absolute agreement, one rater; ``ratings`` (n, k)."""
    x = np.asarray(ratings, dtype=np.float64)
    n, k = x.shape
    if n < 2 or k < 2:
        return math.nan
    rows, columns, grand = x.mean(axis=1), x.mean(axis=0), x.mean()
    between_rows = k * float(((rows - grand) ** 2).sum()) / (n - 1)
    between_columns = n * float(((columns - grand) ** 2).sum()) / (k - 1)
    left = x - rows[:, None] - columns[None, :] + grand
    error = float((left**2).sum()) / ((n - 1) * (k - 1))
    spread = between_rows + (k - 1) * error + k * (between_columns - error) / n
    return (between_rows - error) / spread if spread else math.nan


def kappa(first: Sequence[Hashable], second: Sequence[Hashable]) -> float:
    """Cohen's kappa of two raters who named the same n items."""
    n = len(first)
    if not n or n != len(second):
        return math.nan
    observed = sum(a == b for a, b in zip(first, second, strict=True)) / n
    one, two = Counter(first), Counter(second)
    expected = sum(one[word] * two[word] for word in one) / n**2
    return (observed - expected) / (1 - expected) if expected < 1 else math.nan


def alpha(items: Sequence[Sequence[Hashable]]) -> float:
    """Krippendorff's alpha, nominal; per item the answers given, of any number of raters."""
    pairs: Counter[tuple[Hashable, Hashable]] = Counter()
    for answers in items:
        for pair in permutations(answers, 2):
            pairs[pair] += 1 / (len(answers) - 1)  # type: ignore[assignment]
    values: Counter[Hashable] = Counter()
    for (a, _), weight in pairs.items():
        values[a] += weight
    n = sum(values.values())
    if n <= 1:
        return math.nan
    observed = sum(weight for (a, b), weight in pairs.items() if a != b) / n
    expected = 1 - sum(count * (count - 1) for count in values.values()) / (n * (n - 1))
    return 1 - observed / expected if expected else math.nan


def rms_mm(first_mm: ArrayLike, second_mm: ArrayLike) -> float:
    """Root of the mean squared distance of two sets of offsets (n, 2)."""
    d = np.asarray(first_mm, dtype=np.float64) - np.asarray(second_mm, dtype=np.float64)
    return float(np.sqrt((d**2).sum(axis=-1).mean())) if d.size else math.nan


def patch_iou(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Overlap of two patches (N,) of one face; 1 where both are empty."""
    either = int(np.sum(first | second))
    return float(np.sum(first & second)) / either if either else 1.0
