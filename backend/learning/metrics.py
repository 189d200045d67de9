"""Evaluation metrics of predicted contact patches, and sample predictions.

Definitions: method.md 7.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray, InputError, parse_json, write_atomically
from touchdown.backend.episodes import TrainingRows, patch_bits, patch_hex

Bits = NDArray[np.bool_]
Z_95 = 1.959964
CONTACT_LEVEL = 0.5  # probability above which a point is predicted as contact [U]


def overlap_shares(predicted: Bits, truth: Bits) -> FloatArray:
    """Return the intersection over union (...,) of samples (..., N); 1 for an empty union."""
    both, either = (predicted & truth).sum(axis=-1), (predicted | truth).sum(axis=-1)
    return np.where(either == 0, 1.0, both / np.maximum(either, 1))


def iou(predicted: Bits, truth: Bits) -> float:
    """Return the mean intersection over union of samples (n, N)."""
    return float(overlap_shares(predicted, truth).mean())


def point_accuracy(predicted: Bits, truth: Bits) -> float:
    """Return the share of correctly predicted points; (n, N) each."""
    return float(np.mean(predicted == truth))


def hull_margin_mm(points_mm: FloatArray, centre_mm: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return the signed distance of ``centre_mm`` to the hull edge of ``points_mm`` (k, 2).

    Positive inside; -inf if the points span no area.
    """
    if len(points_mm) < 3:
        return -math.inf
    hull = cv2.convexHull(np.ascontiguousarray(points_mm, dtype=np.float32))
    if len(hull) < 3 or cv2.contourArea(hull) < 1e-6:
        return -math.inf
    return float(cv2.pointPolygonTest(hull, centre_mm, True))


def stable_flags(patches: Bits, points_mm: FloatArray) -> Bits:
    """Return (n,) True if (0, 0) lies in the hull of a patch (n, N) of ``points_mm`` (N, 2)."""
    return np.array([hull_margin_mm(points_mm[patch]) >= 0.0 for patch in patches], dtype=bool)


def wilson_interval(successes: float, trials: float, z: float = Z_95) -> tuple[float, float]:
    """Return the Wilson interval of a success rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    share, z2 = successes / trials, z**2
    centre = (share + z2 / (2 * trials)) / (1 + z2 / trials)
    half = z * math.sqrt(share * (1 - share) / trials + z2 / (4 * trials**2))
    half /= 1 + z2 / trials
    return max(0.0, centre - half), min(1.0, centre + half)


def rate_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval of the rate of independent trials; (0, 1) without trials.

    Wilson's. Without events on one side the exact one-sided bound (Clopper and Pearson, 1934): none
    of 299 gives at most 1 %.
    """
    if trials and successes in (0, trials):
        bound = 0.05 ** (1.0 / trials)
        return (0.0, 1.0 - bound) if successes == 0 else (bound, 1.0)
    return wilson_interval(successes, trials)


def clustered_interval(right: NDArray[np.bool_], cluster: Sequence[str]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of ``right`` (n,), dependent within a ``cluster``.

    Wilson's, of as many trials as the variance between clusters allows (Kish's design effect, at
    least 1) and with Student's quantile. One cluster counts as one trial.
    """
    # Imported here: the window needs rates only.
    from scipy.special import stdtrit

    _, index = np.unique(np.array(cluster, dtype=str), return_inverse=True)
    size = np.bincount(index)
    count, n = len(size), len(right)
    if count == n:
        return rate_interval(int(right.sum()), n)
    share = float(np.mean(right))
    if count == 1:
        return wilson_interval(share, 1)
    if share in (0.0, 1.0):
        return rate_interval(round(share * count), count)
    off = np.bincount(index, right) - share * size
    variance = count / (count - 1) * float(off @ off) / n**2
    effect = max(1.0, variance * n / (share * (1.0 - share)))
    return wilson_interval(share * n / effect, n / effect, float(stdtrit(count - 1, 0.975)))


# mean predicted probability, share of points in contact, number of points
ReliabilityBin = tuple[float, float, int]


def reliability(
    probability: NDArray[np.floating], truth: Bits, bins: int = 10
) -> tuple[ReliabilityBin, ...]:
    """Return the non-empty ones of ``bins`` equal bins of ``probability`` (n, N), ascending."""
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
    """Return the expected calibration error: mean |prediction - share|, weighted by points."""
    total = sum(count for _, _, count in bins)
    return sum(count * abs(p - share) for p, share, count in bins) / max(total, 1)


@dataclass(frozen=True, slots=True)
class EvaluationScores:
    """Scores of a model over ``episodes`` probes. Stability is judged from a single probe (n = 1).

    Attributes
    ----------
    episodes : int
        Number of probes.
    iou : float
        Mean intersection over union of predicted and true contact patch, 0 to 1.
    point_accuracy : float
        Share of face points classified correctly, 0 to 1.
    stability_accuracy : float
        Share of probes whose stability is judged correctly, 0 to 1.
    stability_interval : tuple of float
        95 % Wilson interval of ``stability_accuracy``.
    base_rate : float
        Accuracy of always giving the commoner answer.
    unsafe : float
        Share of the unstable probes that are called stable, NaN without unstable probes.

    Examples
    --------
    >>> scores = EvaluationScores(2, 0.7, 0.9, 1.0, (0.34, 1.0), 0.5, 0.0)
    >>> scores.as_json()["episodes"]
    2
    """

    episodes: int
    iou: float
    point_accuracy: float
    stability_accuracy: float
    stability_interval: tuple[float, float]
    base_rate: float
    unsafe: float

    def as_json(self) -> dict[str, object]:
        """Return the scores by name, rounded to 1e-4; null for a missing score."""
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
    probability: NDArray[np.floating],
    truth: Bits,
    points_mm: FloatArray,
    delta: float,
    mounting: Sequence[str],
) -> EvaluationScores:
    """Score ``probability`` (n, N) against ``truth`` (n, N); support means p > ``delta``.

    ``mounting`` (n,): the interval is by mounting.
    """
    predicted = probability > CONTACT_LEVEL
    released = stable_flags(probability > delta, points_mm)
    stable = stable_flags(truth, points_mm)
    right = released == stable
    share = float(np.mean(stable))
    unsafe = float(np.mean(released[~stable])) if not stable.all() else math.nan
    return EvaluationScores(
        len(truth),
        iou(predicted, truth),
        point_accuracy(predicted, truth),
        float(np.mean(right)),
        clustered_interval(right, mounting),
        max(share, 1.0 - share),
        unsafe,
    )


SAMPLES = "samples.json"
MOST = 12
MAX_BYTES = 10_000_000


@dataclass(frozen=True, slots=True)
class SamplePrediction:
    """Prediction of one held-out episode: ``probability`` and ``truth`` (N,) of the face points."""

    episode: str
    bottom: str
    offset_mm: tuple[float, float]
    iou: float
    probability: FloatArray
    truth: NDArray[np.bool_]


def choose_samples(
    rows: TrainingRows, held_out: NDArray[np.int64], probability: NDArray[np.floating]
) -> list[SamplePrediction]:
    """Return up to 12 held-out episodes, evenly spread from the best to the worst IoU."""
    each = overlap_shares(probability > CONTACT_LEVEL, rows.patch[held_out]).tolist()
    order = np.argsort([-v for v in each], kind="stable")
    places = np.unique(np.linspace(0, len(order) - 1, min(MOST, len(order))).round().astype(int))
    found = []
    for k in order[places].tolist():
        i = int(held_out[k])
        x_mm, y_mm = rows.offset_mm[i].tolist()
        episode = str(rows.labels[i].get("episode", i))
        found.append(
            SamplePrediction(
                episode, rows.bottom[i], (x_mm, y_mm), each[k], probability[k], rows.patch[i]
            )
        )
    return found


def bottom_figures(
    rows: TrainingRows, held_out: NDArray[np.int64], probability: NDArray[np.floating]
) -> dict[str, dict[str, float]]:
    """Return episodes, IoU and point accuracy of the validation side, per bottom."""
    bottoms = np.array([rows.bottom[i] for i in held_out.tolist()])
    predicted, truth = probability > CONTACT_LEVEL, rows.patch[held_out]
    found = {}
    for name in sorted(set(bottoms.tolist())):
        at = bottoms == name
        found[name] = {
            "episodes": int(at.sum()),
            "iou": round(iou(predicted[at], truth[at]), 4),
            "point_accuracy": round(point_accuracy(predicted[at], truth[at]), 4),
        }
    return found


def save_samples(folder: Path, samples: list[SamplePrediction]) -> None:
    """Write ``samples.json``."""
    lines = [
        {
            "episode": s.episode,
            "bottom": s.bottom,
            "offset_mm": list(s.offset_mm),
            "iou": round(s.iou, 4),
            "probability": [round(float(p), 4) for p in s.probability],
            "truth": patch_hex(s.truth),
        }
        for s in samples
    ]
    write_atomically(folder / SAMPLES, json.dumps({"version": 1, "samples": lines}).encode())


def load_samples(folder: Path) -> list[SamplePrediction]:
    """Read ``samples.json``; empty if the file does not exist. Raises ``InputError``."""
    path = folder / SAMPLES
    try:
        if path.stat().st_size > MAX_BYTES:
            raise ValueError("the file is too large")
        content = parse_json(path.read_bytes())
        return [_sample(line) for line in content["samples"]]
    except FileNotFoundError:
        return []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError("The sample predictions cannot be read.", str(path), "Train again.") from (
            error
        )


def _sample(line: dict[str, Any]) -> SamplePrediction:
    probability = np.asarray(line["probability"], dtype=np.float64)
    x_mm, y_mm = line["offset_mm"]
    return SamplePrediction(
        str(line["episode"]),
        str(line["bottom"]),
        (float(x_mm), float(y_mm)),
        float(line["iou"]),
        probability,
        patch_bits(line["truth"], probability.size),
    )
