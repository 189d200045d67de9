"""What a strategy is told of the hand and the tower: the bench's facts and the operator's entry."""

from __future__ import annotations

import pytest

from backend.assembly import SimulatedBenchChoice, simulated_session
from backend.config.method import StackSettings, TowerSettings
from backend.core.faults import InputError
from backend.runs.requests import SceneChoice
from backend.runs.stack import held_by


def test_the_centre_of_mass_comes_from_the_piece() -> None:
    session = simulated_session(SimulatedBenchChoice())
    try:
        scene = session._set_scene(SceneChoice(piece="mug", bottoms=("short",), estimates=False))
        held = held_by(session._bench(scene, StackSettings()))
        assert (held.com_xy_mm, held.grip_height_mm) == ((1.7, -0.9), 32.0)
    finally:
        session.close()


def test_the_height_of_the_sensor_and_the_tower_come_from_bench_and_entry() -> None:
    session = simulated_session(SimulatedBenchChoice())
    try:
        tower = session._set_scene(SceneChoice(bottoms=("short", "long"), estimates=False))
        entry = TowerSettings(offset_mm=((2.0, -1.0),), sigma_mm=0.5)
        held = held_by(session._bench(tower, StackSettings(tower=entry)))
        assert held.lever_mm() == held.grip_height_mm + 120.0
        assert held.below is not None
        # What was entered, not where the simulated bench has it.
        assert (held.below.offset_mm, held.below.sigma_mm) == (((2.0, -1.0),), 0.5)
        assert [body.name for body in held.below.bodies] == ["short", "long"]
        wrong = TowerSettings(offset_mm=((1.0, 0.0), (1.0, 0.0)))
        with pytest.raises(InputError, match="were entered"):
            session._bench(tower, StackSettings(tower=wrong))
        single = session._set_scene(SceneChoice(bottoms=("short",), estimates=False))
        assert held_by(session._bench(single, StackSettings())).below is None
    finally:
        session.close()
