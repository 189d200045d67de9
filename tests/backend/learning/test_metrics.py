"""Metrics compared with published vectors and shapely."""

import math

import numpy as np
import pytest
from shapely import MultiPoint, Point

from touchdown.backend.learning.metrics import (
    hull_margin_mm,
    iou,
    point_accuracy,
    score,
    stable_flags,
    wilson_interval,
)


def bits(*rows: str) -> np.ndarray:
    return np.array([[c == "1" for c in row] for row in rows])


def test_iou_is_a_mean_over_samples_and_an_empty_union_counts_one() -> None:
    assert iou(bits("1100", "0000", "1000"), bits("0110", "0000", "0001")) == pytest.approx(
        (1 / 3 + 1 + 0) / 3
    )
    assert point_accuracy(bits("1100", "0000"), bits("0110", "0000")) == pytest.approx(6 / 8)


@pytest.mark.parametrize(
    ("k", "n", "low", "high"),
    [(8, 10, 0.490, 0.943), (40, 60, 0.541, 0.773), (34, 60, 0.441, 0.684)],
)
def test_wilson_intervals_as_published(k: int, n: int, low: float, high: float) -> None:
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-4)


def test_wilson_without_trials_knows_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_hull_margin_agrees_with_shapely() -> None:
    rng = np.random.default_rng(8)
    for _ in range(300):
        points = rng.integers(-6, 7, (rng.integers(3, 12), 2)).astype(float)
        hull = MultiPoint(points).convex_hull
        got = hull_margin_mm(points)
        if hull.area == 0:
            assert got == -math.inf
            continue
        distance = hull.exterior.distance(Point(0, 0))
        sign = 1 if hull.covers(Point(0, 0)) else -1
        assert got == pytest.approx(sign * distance, abs=1e-5)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_points_never_support(count: int) -> None:
    assert hull_margin_mm(np.zeros((count, 2))) == -math.inf


def test_scores_of_a_known_case() -> None:
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    points = np.stack([x.ravel(), y.ravel()], 1)
    left, right, whole = x.ravel() < -0.5, x.ravel() > 0.5, np.ones(9, bool)
    truth = np.stack([left, right, whole, whole])
    assert stable_flags(truth, points).tolist() == [False, False, True, True]
    probability = np.stack([whole, right, whole, left]) * 0.96 + 0.02
    got = score(probability, truth, points, delta=0.9)
    assert got.stability_accuracy == 0.5
    assert got.unsafe == 0.5
    assert got.base_rate == 0.5
    assert got.iou == pytest.approx((3 / 9 + 1 + 1 + 3 / 9) / 4)
    # confident enough to be contact, not enough to be support
    assert score(probability * 0.9, truth, points, delta=0.9).unsafe == 0.0
