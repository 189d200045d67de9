"""Figures of merit (method.md 7)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

Bits = NDArray[np.bool_]
Z_95 = 1.959964
LEVEL = 0.5
"""A point counts as predicted contact above this probability [U]."""


def iou(predicted: Bits, truth: Bits) -> float:
    """Mean over samples of intersection over union; (n, N) each; an empty union counts as 1."""
    both = np.sum(predicted & truth, axis=1)
    either = np.sum(predicted | truth, axis=1)
    return float(np.mean(np.where(either == 0, 1.0, both / np.maximum(either, 1))))


def point_accuracy(predicted: Bits, truth: Bits) -> float:
    """Share of points predicted right; (n, N) each."""
    return float(np.mean(predicted == truth))


def hull_margin_mm(points_mm: FloatArray, centre_mm: tuple[float, float] = (0.0, 0.0)) -> float:
    """Signed distance of ``centre_mm`` to the edge of the hull of ``points_mm`` (k, 2).

    Positive inside; -inf if the points span no area.
    """
    if len(points_mm) < 3:
        return -math.inf
    hull = cv2.convexHull(np.ascontiguousarray(points_mm, dtype=np.float32))
    if len(hull) < 3 or cv2.contourArea(hull) < 1e-6:
        return -math.inf
    return float(cv2.pointPolygonTest(hull, centre_mm, True))


def stable_flags(patches: Bits, points_mm: FloatArray) -> Bits:
    """(n,) whether (0, 0) lies in the hull of each patch (n, N) of ``points_mm`` (N, 2)."""
    return np.array([hull_margin_mm(points_mm[patch]) >= 0.0 for patch in patches], dtype=bool)


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % Wilson interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, Z_95**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z_95 * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    half /= 1 + z2 / trials
    return max(0.0, centre - half), min(1.0, centre + half)


ReliabilityBin = tuple[float, float, int]
"""Mean predicted probability, share of points truly in contact, number of points."""


def reliability(
    probability: NDArray[np.floating], truth: Bits, bins: int = 10
) -> tuple[ReliabilityBin, ...]:
    """Return the filled ones of equal ``bins`` of ``probability`` (n, N), rising."""
    p = np.asarray(probability, dtype=np.float64).ravel()
    index = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    predicted = np.bincount(index, p, minlength=bins)
    hit = np.bincount(index, truth.ravel(), minlength=bins)
    return tuple(
        (float(predicted[k] / count[k]), float(hit[k] / count[k]), int(count[k]))
        for k in np.flatnonzero(count).tolist()
    )


def calibration_error(bins: Sequence[ReliabilityBin]) -> float:
    """Return the expected calibration error: mean distance of prediction and share, by points."""
    total = sum(count for _, _, count in bins)
    return sum(count * abs(p - share) for p, share, count in bins) / max(total, 1)


@dataclass(frozen=True, slots=True)
class Scores:
    """Figures over ``episodes`` samples; stability is judged from a single probe (n = 1).

    ``base_rate``: accuracy of always giving the commoner answer. ``unsafe``: share of the truly
    unstable samples called stable (NaN if there are none).
    """

    episodes: int
    iou: float
    point_accuracy: float
    stability_accuracy: float
    stability_interval: tuple[float, float]
    base_rate: float
    unsafe: float

    def as_json(self) -> dict[str, object]:
        """Return the figures by name, rounded to 1e-4; a missing figure is null."""
        return {
            "episodes": self.episodes,
            "iou": round(self.iou, 4),
            "point_accuracy": round(self.point_accuracy, 4),
            "stability_accuracy": round(self.stability_accuracy, 4),
            "stability_interval": [round(v, 4) for v in self.stability_interval],
            "base_rate": round(self.base_rate, 4),
            "unsafe": None if math.isnan(self.unsafe) else round(self.unsafe, 4),
        }


def score(
    probability: NDArray[np.floating], truth: Bits, points_mm: FloatArray, delta: float
) -> Scores:
    """Score ``probability`` (n, N) against ``truth`` (n, N); support means p > ``delta``."""
    predicted = probability > LEVEL
    says = stable_flags(probability > delta, points_mm)
    stands = stable_flags(truth, points_mm)
    right = int(np.sum(says == stands))
    share = float(np.mean(stands))
    unsafe = float(np.mean(says[~stands])) if not stands.all() else math.nan
    return Scores(
        len(truth),
        iou(predicted, truth),
        point_accuracy(predicted, truth),
        right / len(truth),
        wilson(right, len(truth)),
        max(share, 1.0 - share),
        unsafe,
    )
