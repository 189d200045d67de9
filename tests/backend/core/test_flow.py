"""Shared values are immutable."""

import numpy as np
import pytest

from touchdown.backend.core.values import (
    CHANNELS,
    MARKERS,
    TACTILE_CHANNELS,
    BeliefMap,
    ContactPatch,
    TactileFrame,
)


def test_the_observation_has_252_displacements_and_6_wrench_values():
    assert (MARKERS, TACTILE_CHANNELS, CHANNELS) == (63, 252, 258)


def test_arrays_of_values_are_read_only():
    patch = ContactPatch(np.zeros((4, 2)), np.zeros(4))
    with pytest.raises(ValueError, match="read-only"):
        patch.probability[0] = 1.0
    with pytest.raises(AttributeError):
        patch.probability = np.ones(4)
    frame = TactileFrame("left", 0, 0.0, np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(ValueError, match="read-only"):
        frame.image[:] = 1


def test_belief_cells_and_probabilities():
    belief = BeliefMap(
        np.array([[0.0, np.log(9.0), -np.log(9.0)]]), np.ones((1, 3), bool), (-1.0, 5.0), 2.0, 1
    )
    np.testing.assert_allclose(belief.probability, [[0.5, 0.9, 0.1]], rtol=0, atol=1e-15)
    assert belief.cell_centres_mm().tolist() == [[[-1.0, 5.0], [1.0, 5.0], [3.0, 5.0]]]


def test_extreme_log_odds_stay_probabilities():
    belief = BeliefMap(np.array([[-20.0, 20.0]]), np.ones((1, 2), bool), (0.0, 0.0), 1.0, 1)
    assert 0 < belief.probability[0, 0] < 1e-8
    assert 1 - 1e-8 < belief.probability[0, 1] < 1
