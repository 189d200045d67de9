"""Rules of release on the same trials: counted by hand, and against trials that let go."""

from __future__ import annotations

from typing import Any

import pytest

from backend.config.method import FusedSettings, StackSettings
from backend.config.simulation import SimulationSettings
from backend.experiments.beyond import no_model
from backend.experiments.closed_loop import stack_in_lockstep
from backend.experiments.fused_rules import BOTTOMS, INSETS_MM, counted, own_case, watched_trials
from backend.experiments.scenes import start_scene
from backend.learning.fused.checkpoint import shipped_path
from backend.objects.catalogue import load_catalogue
from backend.sensing.episode import EpisodeLimits


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
    bold, shy, never = (counted(trials, risk, 0) for risk in (0.1, 0.02, 0.001))
    assert (bold["placed"], bold["unsafe"], bold["not_released"], bold["probes"]) == (1, 2, 1, 2.0)
    assert (shy["placed"], shy["unsafe"], shy["not_released"], shy["probes"]) == (2, 1, 1, 2.5)
    assert (never["placed"], never["unsafe"], never["not_released"]) == (0, 1, 3)


def test_a_rule_counts_what_trials_under_it_come_to() -> None:
    """The strategy itself, let go by the rule, on the same seeds."""
    settings = SimulationSettings.model_validate(
        {"preset": "off", "support": {"rocks": False, "slides": False}}
    )
    case, seeds = own_case("pot", "disc 22", settings), range(70, 73)
    found = counted(watched_trials(case, seeds, shipped_path()), 0.1, INSETS_MM.index(0.5))
    rule = StackSettings(strategy="fused", fused=FusedSettings(risk=0.1, inset_mm=0.5))
    scenes = [scene for seed in seeds if (scene := start_scene(case, seed)) is not None]
    ends = stack_in_lockstep(scenes, no_model(case), rule, EpisodeLimits())
    words = [end.outcome.value for end in ends]
    assert words.count("placed") == found["placed"]
    assert words.count("fell") == found["unsafe"]


@pytest.mark.parametrize("name", BOTTOMS)
def test_no_bottom_of_the_tables_is_among_them(name: str) -> None:
    catalogue = load_catalogue()
    tables = {catalogue.bottom(b).face for b in ("short", "long", "hex20", "rect12x28")}
    assert BOTTOMS[name] not in tables
