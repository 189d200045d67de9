"""A press beside the bottom: the end of a trial for the paper, a hint for learned fusion."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.method import BeliefSettings, PolicySettings, StackSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.values import FloatArray, Outcome
from touchdown.backend.experiments.trials import BatchModel, BatchTrialResult, stack_in_lockstep
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.sensing.episode import EpisodeLimits
from touchdown.backend.simulation.batch import BatchedTrials

BESIDE_MM = -18.5
"""A pot of 15 mm and a bottom of 20 mm part at 17.5 mm."""


class Beside(BatchedTrials):
    """Trials whose first press meets nothing; the first place of a spiral lies 3 mm nearer."""

    def start_commands_mm(self) -> FloatArray:
        return np.tile([BESIDE_MM, 0.0], (len(self.scenes), 1))


def ended(strategy: str, most: int) -> BatchTrialResult:
    catalogue = load_pieces()
    points = face_points(catalogue.top("pot").face)
    model = BatchModel(lambda seen: np.full((len(seen), len(points)), 0.5), points, None)
    settings = StackSettings.model_validate(
        {
            "strategy": strategy,
            "policy": PolicySettings(max_probes=most),
            "belief": BeliefSettings(half_extent_mm=24.0),
        }
    )
    scene = make_scene(catalogue, SceneChoice(seed=5), SimulationSettings(preset="off"))
    return stack_in_lockstep([scene], model, settings, EpisodeLimits(), world=Beside)[0]


@pytest.mark.parametrize("strategy", ["paper", "zero-wrench"])
def test_two_presses_without_contact_end_the_run(strategy: str) -> None:
    end = ended(strategy, 2)
    assert end.outcome is Outcome.ABORTED
    assert end.reason.startswith("Probe 1 was rejected 2 times: no contact was found")
    assert end.probes == 0


def test_learned_fusion_presses_elsewhere() -> None:
    end = ended("fused", 2)
    assert end.outcome is Outcome.GAVE_UP
    assert end.probes == 1
    assert end.steps[0].offset_mm == pytest.approx((BESIDE_MM + 3.0, 0.0))
    assert ended("fused", 1).reason == "No contact was found after 1 probes, the most allowed."
