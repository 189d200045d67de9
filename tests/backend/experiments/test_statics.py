"""Groups of probes for the static tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.experiments import statics
from touchdown.backend.experiments.trials import SceneSetup
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.simulation.batch import BatchedTrials, TrialPresses

SEEDS = [70, 71, 72, 73]


def test_a_group_without_observations_is_left_out_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="off"))
    whole = statics.probe_groups(case, SEEDS, 2)
    real = BatchedTrials.press

    def deaf(self: BatchedTrials, trials: list[int], commands_mm: np.ndarray) -> TrialPresses:
        felt = real(self, trials, commands_mm)
        return replace(felt, valid=felt.valid & (np.asarray(trials) != 1))

    monkeypatch.setattr(BatchedTrials, "press", deaf)
    monkeypatch.setattr(statics, "ATTEMPTS", 2)
    groups = statics.probe_groups(case, SEEDS, 2)
    assert (groups.left_out, whole.left_out) == (1, 0)
    assert groups.rejected == whole.rejected + 2
    np.testing.assert_array_equal(groups.true_mm, whole.true_mm[[0, 2, 3]])
    np.testing.assert_array_equal(groups.margin_mm, whole.margin_mm[[0, 2, 3]])
