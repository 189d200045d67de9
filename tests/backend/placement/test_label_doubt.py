"""Doubt scores on constructed signals, with and without contact information."""

import numpy as np
import pytest

from touchdown.backend.placement.label_review import (
    DOUBT_FEWEST,
    displacement_doubt,
    summarise_signals,
)

COUNT, WRONG = 300, 8
FLAT_MM = 4.0
"""Within this radius the made-up signals do not depend on the displacement."""


def felt_at(offsets_mm, rng):
    """Six signals that bend with the displacement beyond ``FLAT_MM``; noisier to the right."""
    radius = np.maximum(np.linalg.norm(offsets_mm, axis=1), 1e-9)
    beyond = np.maximum(radius - FLAT_MM, 0.0)[:, None] * offsets_mm / radius[:, None]
    x, y = beyond.T
    clean = np.stack([x, y, np.sin(0.3 * x), np.cos(0.3 * y), 0.1 * x * y, x + y], axis=1)
    noise = 0.1 + 0.4 * (offsets_mm[:, :1] > 0)
    return clean + noise * rng.normal(size=clean.shape)


@pytest.fixture(scope="module")
def judged():
    rng = np.random.default_rng(4)
    true_mm = rng.uniform(-10, 10, (COUNT, 2))
    felt = felt_at(true_mm, rng)
    labels_mm = true_mm.copy()
    outside = np.flatnonzero((np.linalg.norm(true_mm, axis=1) > 6.0) & (true_mm[:, 0] < -3))
    wrong = outside[:WRONG]
    labels_mm[wrong] += [0.0, 2.0]
    felt /= felt.std(axis=0)
    return displacement_doubt(felt, labels_mm), felt, labels_mm, set(wrong.tolist())


def test_wrong_labels_come_first_and_where_nothing_is_felt_nothing_is_doubted(judged):
    found, felt, labels_mm, wrong = judged
    first = set(np.argsort(-found)[: 2 * WRONG].tolist())
    assert len(wrong & first) >= WRONG - 1
    inside = np.linalg.norm(labels_mm, axis=1) < FLAT_MM - 3.0
    assert np.percentile(found[inside], 90) < 0.2 * np.median(found[sorted(wrong)])
    assert (found >= 0).all()
    np.testing.assert_array_equal(found, displacement_doubt(felt, labels_mm))


def test_right_labels_are_doubted_alike_where_it_is_noisy_and_where_not(judged):
    found, _, labels_mm, wrong = judged
    right = np.array([k for k in range(COUNT) if k not in wrong])
    noisy = labels_mm[right, 0] > 1
    high = [np.percentile(found[right][side], 90) for side in (noisy, ~noisy)]
    assert 1 / 3 < high[0] / high[1] < 3  # the noise itself differs by 5


def test_few_episodes_tell_nothing():
    few = DOUBT_FEWEST - 1
    assert np.isnan(displacement_doubt(np.zeros((few, 3)), np.zeros((few, 2)))).all()


def test_signals_are_few_and_scaled_alike():
    rng = np.random.default_rng(1)
    found = summarise_signals(rng.uniform(0, 1, (50, 200)), rng.normal(3, 9, (50, 6)))
    assert found.shape == (50, 16)
    np.testing.assert_allclose(found.std(axis=0), 1.0)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-9)
