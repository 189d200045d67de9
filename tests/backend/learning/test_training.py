"""Training data by side: held-out episodes are used for validation only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.backend.learning.test_learning import SMALL, rows
from touchdown.backend.episodes.training_rows import TrainingRows, split_rows
from touchdown.backend.learning.inference import fit_normaliser_in_parts
from touchdown.backend.learning.training import Trainer, binary_cross_entropy, predict_logits


def unlike_held_out() -> TrainingRows:
    """Episodes whose held-out side has other signals, and contact everywhere."""
    data = rows(24)
    held_out = split_rows(data, SMALL.validation_share, SMALL.seed, divide_series=True).held_out
    observation, patch = data.observation.copy(), data.patch.copy()
    observation[held_out] = 5.0 * observation[held_out] + 30.0
    patch[held_out] = True
    return replace(data, observation=observation, patch=patch)


def test_base_rate_and_normaliser_are_those_of_the_training_side() -> None:
    data = unlike_held_out()
    trainer = Trainer(data, SMALL)
    train = trainer.split.train
    assert 0 < len(train) < len(data)
    assert trainer.base_rate == pytest.approx(6 / 9)
    expected = fit_normaliser_in_parts([data.observation[train]], SMALL.modality)
    np.testing.assert_allclose(trainer.model.mean.numpy(), expected.mean, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(trainer.model.scale.numpy(), expected.scale, rtol=1e-5)


def test_the_weights_that_are_kept_are_those_of_the_best_epoch() -> None:
    """Nothing can be learnt here: the longer it goes on, the worse it does on what it never saw."""
    data = rows(24)
    order = np.random.default_rng(0).permutation(24)
    settings = SMALL.model_copy(update={"epochs": 12, "patience": 12, "learning_rate": 0.02})
    trainer = Trainer(replace(data, patch=data.patch[order]), settings)
    losses = [report.validation_loss for report in trainer.epochs()]
    assert losses[-1] > min(losses) + 0.05
    held_out = trainer.split.held_out
    truth = torch.from_numpy(data.patch[order][held_out].astype(np.float32))
    seen = torch.from_numpy(data.observation[held_out])
    loss = float(binary_cross_entropy(predict_logits(trainer.best_model(), seen), truth))
    assert loss == pytest.approx(min(losses), rel=1e-5)
    p = torch.from_numpy(trainer.predict_held_out())
    assert float(binary_cross_entropy(torch.logit(p), truth)) == pytest.approx(
        min(losses), rel=1e-4
    )
