"""Agreement figures compared with published examples and independent computations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.annotations import agreement
from touchdown.backend.learning.metrics import wilson_interval

SHROUT_FLEISS = [
    [9, 2, 5, 8],
    [6, 1, 3, 2],
    [8, 4, 6, 8],
    [7, 1, 2, 6],
    [10, 5, 6, 9],
    [6, 2, 4, 7],
]
ONE = ["yes"] * 25 + ["no"] * 25
TWO = ["yes"] * 20 + ["no"] * 5 + ["yes"] * 10 + ["no"] * 15


def test_bias_and_limits() -> None:
    found = agreement.agreement_limits([0.1, -0.2, 0.3, 0.0, 0.3], np.zeros(5))
    figures = (found.mean, found.deviation, found.lower, found.upper)
    assert figures == pytest.approx((0.1, 0.21213, -0.3158, 0.5158), abs=5e-5)
    assert math.isnan(agreement.agreement_limits([1.0], [0.0]).lower)
    assert math.isnan(agreement.agreement_limits([], []).mean)


def test_icc_of_shrout_and_fleiss() -> None:
    assert agreement.intraclass_correlation(SHROUT_FLEISS) == pytest.approx(0.290, abs=5e-4)
    assert agreement.intraclass_correlation([[1, 1], [2, 2], [5, 5]]) == pytest.approx(1.0)
    assert math.isnan(agreement.intraclass_correlation([[1, 2]]))


def test_kappa_and_alpha_of_one_table() -> None:
    assert agreement.cohen_kappa(ONE, TWO) == pytest.approx(0.4)
    pairs = list(zip(ONE, TWO, strict=True))
    assert agreement.krippendorff_alpha(pairs) == pytest.approx(0.4)
    assert math.isnan(agreement.cohen_kappa(["a"], ["a"]))
    assert math.isnan(agreement.krippendorff_alpha([["a"], ["b"]]))


def test_alpha_of_krippendorffs_own_example_with_gaps() -> None:
    # Krippendorff, "Computing Krippendorff's alpha-reliability" (2011), example C: 0.743.
    observers = [
        [1, 2, 3, 3, 2, 1, 4, 1, 2, None, None, None],
        [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, None, 3],
        [None, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, None],
        [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, None],
    ]
    items = [[a for a in unit if a is not None] for unit in zip(*observers, strict=True)]
    assert agreement.krippendorff_alpha([unit for unit in items if len(unit) > 1]) == pytest.approx(
        0.743, abs=5e-4
    )


INTERVALS = [(8, 10, 0.490, 0.943), (40, 60, 0.541, 0.773), (34, 60, 0.441, 0.684)]


@pytest.mark.parametrize(("k", "n", "low", "high"), INTERVALS)
def test_wilson_intervals(k: int, n: int, low: float, high: float) -> None:
    assert wilson_interval(k, n) == pytest.approx((low, high), abs=5e-4)


def test_distance_and_overlap() -> None:
    assert agreement.rms_mm([[0, 0], [3, 4]], np.zeros((2, 2))) == pytest.approx(math.sqrt(12.5))
    a, b = np.array([1, 1, 0, 0], bool), np.array([0, 1, 1, 0], bool)
    assert agreement.patch_iou(a, b) == pytest.approx(1 / 3)
    assert agreement.patch_iou(a & False, b & False) == 1.0


@given(st.lists(st.tuples(st.sampled_from("abc"), st.sampled_from("abc")), min_size=2, max_size=30))
def test_figures_do_not_depend_on_who_is_first_nor_on_the_order(
    pairs: list[tuple[str, str]],
) -> None:
    one, two = (list(side) for side in zip(*pairs, strict=True))
    for figure in (
        lambda a, b: agreement.cohen_kappa(a, b),
        lambda a, b: agreement.krippendorff_alpha(list(zip(a, b, strict=True))),
    ):
        value, swapped, turned = figure(one, two), figure(two, one), figure(one[::-1], two[::-1])
        assert swapped == pytest.approx(value, nan_ok=True)
        assert turned == pytest.approx(value, nan_ok=True)
        assert math.isnan(value) or value <= 1.0 + 1e-12
