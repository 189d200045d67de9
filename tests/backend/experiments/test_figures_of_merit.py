"""Rates, reliability and twins against cases whose answer is known otherwise."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.values import CHANNELS
from touchdown.backend.experiments.collection import find_ambiguous_pairs, largest_marker_px
from touchdown.backend.experiments.statistics import (
    VerdictCounts,
    estimate_mean,
    estimate_rate,
    reliability_curve,
)
from touchdown.backend.experiments.tables import score_verdicts, stacking_cell


@pytest.mark.parametrize(
    ("k", "n", "low", "high"), [(8, 10, 0.490, 0.943), (40, 60, 0.541, 0.773), (0, 60, 0.0, 0.060)]
)
def test_wilson_as_printed_for_the_papers_counts(k: int, n: int, low: float, high: float) -> None:
    found = estimate_rate(k, n)
    assert (found.low, found.high) == (pytest.approx(low, abs=6e-4), pytest.approx(high, abs=6e-4))
    assert estimate_rate(0, 0).value is None


def test_the_interval_of_a_mean_covers_it_as_often_as_promised() -> None:
    rng = np.random.default_rng(3)
    held = 0
    for _ in range(400):
        found = estimate_mean(np.clip(rng.normal(0.5, 0.1, 40), 0, 1).tolist())
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 0.5 <= found.high
    assert 0.91 <= held / 400 <= 0.98


@pytest.mark.parametrize(
    ("values", "half"),
    # 1.96 s / sqrt(n) with s of n - 1 degrees of freedom: 0.1414 of two, 0.2 of three.
    [((0.4, 0.6), 0.1960), ((0.3, 0.5, 0.7), 0.2263), ((0.5,), 0.5)],
)
def test_the_interval_of_few_values_by_hand(values: tuple[float, ...], half: float) -> None:
    found = estimate_mean(values)
    assert (found.value, found.n) == (pytest.approx(0.5), len(values))
    assert found.low == pytest.approx(0.5 - half, abs=1e-4)
    assert found.high == pytest.approx(0.5 + half, abs=1e-4)


def test_counts_of_a_yes_or_no_answer() -> None:
    said = [True, True, True, False, False, False, False]
    true = [True, True, False, True, False, False, False]
    binary = VerdictCounts.of(said, true)
    assert binary == VerdictCounts(both=2, missed=1, unsafe=1, neither=3)
    found = binary.as_json()
    assert found["accuracy"]["value"] == pytest.approx(5 / 7)
    assert found["balanced"] == pytest.approx(0.5 * (2 / 3 + 3 / 4))
    assert found["base_rate"] == pytest.approx(4 / 7)
    assert (binary + binary).n == 14


def test_cases_too_close_to_call_are_left_out_and_no_support_is_not() -> None:
    margins = [[1.0, 1.0], [0.1, 0.1], [-0.3, -0.3], [None, None], [2.0, -1.0]]
    says = [True, True, True, False, True]
    every, left_out = score_verdicts(says, margins, interface=1)
    assert left_out == 1
    assert every == VerdictCounts(both=1, missed=0, unsafe=2, neither=1)
    top, _ = score_verdicts(says, margins, interface=0)
    assert top == VerdictCounts(both=2, missed=0, unsafe=1, neither=1)


def test_every_trial_counts() -> None:
    trials = [
        {"outcome": "placed", "probes": 3, "margins_mm": [4.0, 1.0]},
        {"outcome": "fell", "probes": 2, "margins_mm": [-0.5, 2.0]},
        {"outcome": "knocked_over", "probes": 1, "margins_mm": None},
        {"outcome": "gave_up", "probes": 8, "margins_mm": None},
        {"outcome": "aborted", "probes": 0, "margins_mm": None},
    ]
    cell = stacking_cell(trials)
    assert (cell["n"], cell["value"], cell["unsafe_releases"]) == (5, 0.2, 2)
    assert cell["probes"] == 3
    # The top interface alone would have called the second one placed.
    assert cell["top_interface"]["value"] == 0.4


def test_honest_probabilities_lie_on_the_diagonal_and_boasting_ones_do_not() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(60_000)
    truth = rng.random(60_000) < p
    honest = reliability_curve(p, truth)
    assert honest.ece < 0.01
    assert max(honest.count) - min(honest.count) <= 1
    boasting = np.where(p > 0.5, 0.5 + 0.5 * p, 0.5 * p)
    # An even number of bins: none lies across the middle, where both errors would cancel.
    assert reliability_curve(boasting, truth, bins=14).ece == pytest.approx(0.125, abs=0.01)


def test_planted_twins_are_found() -> None:
    rng = np.random.default_rng(1)
    signals = rng.standard_normal((120, CHANNELS))
    signals[70] = signals[11] + 1e-3 * rng.standard_normal(CHANNELS)
    signals[80] = signals[12]
    patch = np.zeros((120, 40), bool)
    patch[:, :20] = True
    patch[70] = ~patch[70]
    first = find_ambiguous_pairs(signals, patch, 1)[0]
    # 12 and 80 feel alike as well, but so are their patches.
    assert (first.first, first.second) == (11, 70)
    assert first.distance < 2e-3
    assert first.rank < 1e-3


def test_the_largest_marker_displacement_is_a_length() -> None:
    signals = np.zeros((1, CHANNELS))
    signals[0, 5], signals[0, 63 + 5] = 3.0, -4.0
    assert largest_marker_px(signals)[0] == pytest.approx(5.0)
