"""Properties of hand and tower passed to a strategy: the bench description and the operator's
entry.
"""

from __future__ import annotations

import pytest

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config.method import StackSettings, TowerSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.runs.stack import grasped_piece


def test_the_centre_of_mass_comes_from_the_piece() -> None:
    session = simulated_session(SimulatedBenchChoice())
    try:
        scene = session._set_scene(SceneChoice(piece="mug", bottoms=("short",), estimates=False))
        held = grasped_piece(session._for_run(scene, StackSettings()))
        assert (held.com_xy_mm, held.grip_height_mm) == ((1.7, -0.9), 32.0)
    finally:
        session.close()


def test_the_height_of_the_sensor_and_the_tower_come_from_bench_and_entry() -> None:
    session = simulated_session(SimulatedBenchChoice())
    try:
        tower = session._set_scene(SceneChoice(bottoms=("short", "long"), estimates=False))
        entry = TowerSettings(offset_mm=((2.0, -1.0),), sigma_mm=0.5)
        held = grasped_piece(session._for_run(tower, StackSettings(tower=entry)))
        assert held.lever_mm() == held.grip_height_mm + 120.0
        assert held.below is not None
        # What was entered, not where the simulated bench has it.
        assert (held.below.offset_mm, held.below.sigma_mm) == (((2.0, -1.0),), 0.5)
        assert [body.name for body in held.below.bodies] == ["short", "long"]
        wrong = TowerSettings(offset_mm=((1.0, 0.0), (1.0, 0.0)))
        with pytest.raises(InputError, match="were entered"):
            session._for_run(tower, StackSettings(tower=wrong))
        single = session._set_scene(SceneChoice(bottoms=("short",), estimates=False))
        assert grasped_piece(session._for_run(single, StackSettings())).below is None
    finally:
        session.close()
