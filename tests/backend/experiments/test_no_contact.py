"""A press beside the bottom: the end of a trial for the paper, a hint for learned fusion."""

from __future__ import annotations

import numpy as np
import pytest

from backend.assembly import make_scene
from backend.config.method import BeliefSettings, PolicySettings, StackSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import FloatArray, Outcome
from backend.experiments.closed_loop import Model, TrialEnd, stack_in_lockstep
from backend.objects.catalogue import load_catalogue
from backend.objects.surface import face_points
from backend.runs.requests import SceneChoice
from backend.sensing.episode import EpisodeLimits
from backend.simulation.lockstep import Lockstep

BESIDE_MM = -18.5
"""A pot of 15 mm and a bottom of 20 mm part at 17.5 mm."""


class Beside(Lockstep):
    """Trials whose first press meets nothing; the first place of a spiral lies 3 mm nearer."""

    def start_commands_mm(self) -> FloatArray:
        return np.tile([BESIDE_MM, 0.0], (len(self.scenes), 1))


def ended(strategy: str, most: int) -> TrialEnd:
    catalogue = load_catalogue()
    points = face_points(catalogue.top("pot").face)
    model = Model(lambda seen: np.full((len(seen), len(points)), 0.5), points, None)
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
