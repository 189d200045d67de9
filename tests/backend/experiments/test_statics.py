"""Groups of probes for the static tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from backend.config.simulation import load_simulation
from backend.experiments import statics
from backend.experiments.scenes import Case
from backend.objects.catalogue import load_catalogue
from backend.simulation.lockstep import Lockstep, Presses

SEEDS = [70, 71, 72, 73]


def test_a_group_without_observations_is_left_out_and_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = Case.of(load_catalogue(), "pot", ("short",), load_simulation(preset="off"))
    whole = statics.probe_groups(case, SEEDS, 2)
    real = Lockstep.press

    def deaf(self: Lockstep, trials: list[int], commands_mm: np.ndarray) -> Presses:
        felt = real(self, trials, commands_mm)
        return replace(felt, valid=felt.valid & (np.asarray(trials) != 1))

    monkeypatch.setattr(Lockstep, "press", deaf)
    monkeypatch.setattr(statics, "ATTEMPTS", 2)
    groups = statics.probe_groups(case, SEEDS, 2)
    assert (groups.left_out, whole.left_out) == (1, 0)
    assert groups.rejected == whole.rejected + 2
    np.testing.assert_array_equal(groups.true_mm, whole.true_mm[[0, 2, 3]])
    np.testing.assert_array_equal(groups.margin_mm, whole.margin_mm[[0, 2, 3]])
