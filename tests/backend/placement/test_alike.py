"""Labels compared with those of the most similar signals, on constructed signals."""

import numpy as np
import pytest

from touchdown.backend.placement.label_review import ALIKE_FEWEST, FLOOR_MM, neighbour_residual

COUNT, WRONG = 1500, 8
MIXED = np.random.default_rng(8).normal(size=(3, 6))


@pytest.fixture(scope="module")
def probes():
    """Places (mm), and six signals that bend with them; to the right they tell nothing of y."""
    rng = np.random.default_rng(3)
    at_mm = rng.uniform(-8, 8, (COUNT, 2))
    at_mm = at_mm[np.abs(at_mm[:, 0]) > 3]
    x, y = at_mm.T
    told_y = np.where(x > 0, 0.0, y)
    felt = np.stack([x, told_y, 0.05 * x**2], axis=1) @ MIXED
    felt += 0.05 * rng.normal(size=felt.shape)
    return at_mm, felt / felt.std(axis=0)


def test_labels_some_mm_off_come_first_where_signals_tell_the_place(probes):
    at_mm, felt = probes
    wrong = np.flatnonzero((at_mm[:, 0] < -4) & (np.abs(at_mm[:, 1]) < 6))[:WRONG]
    labels_mm = at_mm.copy()
    labels_mm[wrong] += [0.0, 2.5]
    found = neighbour_residual(felt, labels_mm)
    assert len(set(np.argsort(-found)[: 2 * WRONG].tolist()) & set(wrong.tolist())) >= WRONG - 1


def test_nothing_is_strange_where_alike_signals_have_labels_all_over(probes):
    at_mm, felt = probes
    blind = np.flatnonzero(at_mm[:, 0] > 3)
    labels_mm = at_mm.copy()
    labels_mm[blind[0], 1] = -at_mm[blind[0], 1]  # as good a guess as any other
    found = neighbour_residual(felt, labels_mm)
    assert found[blind].max() < 4.0


def test_the_distance_is_counted_in_that_of_the_others_by_hand():
    # One signal for all: the fit is the (robust) middle of the others' labels.
    labels_mm = np.zeros((ALIKE_FEWEST + 1, 2))
    labels_mm[0] = [2.0, 0.0]
    found = neighbour_residual(np.zeros((ALIKE_FEWEST + 1, 3)), labels_mm)
    assert found[0] == pytest.approx(2.0 / FLOOR_MM)
    assert found[1:].max() < 0.01


def test_few_episodes_tell_nothing():
    few = ALIKE_FEWEST - 1
    assert np.isnan(neighbour_residual(np.zeros((few, 3)), np.zeros((few, 2)))).all()
