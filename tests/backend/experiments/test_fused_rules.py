"""Rules of release on the same trials: counted by hand, and against trials that let go."""

from __future__ import annotations

from typing import Any

import pytest

from touchdown.backend.config.method import FusedSettings, StackSettings
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.experiments.fusion import (
    INSETS_MM,
    THRESHOLD_BOTTOMS,
    count_under_threshold,
    held_out_setup,
    record_trials,
)
from touchdown.backend.experiments.strategies import uninformed_model
from touchdown.backend.experiments.trials import stack_in_lockstep, start_scene
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.learning.fused.checkpoint import shipped_path
from touchdown.backend.sensing.episode import EpisodeLimits


def trial(outcome: str, *steps: tuple[float, float]) -> dict[str, Any]:
    said = [{"inset_mm": inset, "exceeds": len(INSETS_MM) * [p]} for inset, p in steps]
    return {"outcome": outcome, "steps": said}


def test_counted_by_hand() -> None:
    trials = [
        trial("gave_up", (-1.0, 0.5), (0.5, 0.91), (2.0, 0.99)),
        trial("gave_up", (-0.1, 0.95), (2.0, 0.99)),
        trial("knocked_over", (-3.0, 0.1)),
        trial("aborted", (1.0, 0.8)),
    ]
    bold, shy, never = (count_under_threshold(trials, risk, 0) for risk in (0.1, 0.02, 0.001))
    assert (bold["placed"], bold["unsafe"], bold["not_released"], bold["probes"]) == (1, 2, 1, 2.0)
    assert (shy["placed"], shy["unsafe"], shy["not_released"], shy["probes"]) == (2, 1, 1, 2.5)
    assert (never["placed"], never["unsafe"], never["not_released"]) == (0, 1, 3)


def test_a_rule_counts_what_trials_under_it_come_to() -> None:
    """The strategy itself, let go by the rule, on the same seeds."""
    settings = SimulationSettings.model_validate(
        {"preset": "off", "support": {"rocks": False, "slides": False}}
    )
    case, seeds = held_out_setup("pot", "disc 22", settings), range(70, 73)
    found = count_under_threshold(
        record_trials(case, seeds, shipped_path()), 0.1, INSETS_MM.index(0.5)
    )
    rule = StackSettings(strategy="fused", fused=FusedSettings(risk=0.1, inset_mm=0.5))
    scenes = [scene for seed in seeds if (scene := start_scene(case, seed)) is not None]
    ends = stack_in_lockstep(scenes, uninformed_model(case), rule, EpisodeLimits())
    words = [end.outcome.value for end in ends]
    assert words.count("placed") == found["placed"]
    assert words.count("fell") == found["unsafe"]


@pytest.mark.parametrize("name", THRESHOLD_BOTTOMS)
def test_no_bottom_of_the_tables_is_among_them(name: str) -> None:
    catalogue = load_pieces()
    tables = {catalogue.bottom(b).face for b in ("short", "long", "hex20", "rect12x28")}
    assert THRESHOLD_BOTTOMS[name] not in tables
