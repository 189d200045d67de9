"""The same first press in process and over the emulated wires, the clock wound by hand."""

import pytest

from tests.backend.emulators.wound import WoundWires, bursts, force_apart, simulated_press
from touchdown.backend.config.simulation import SimulationSettings

NEARLY_WITHOUT_NOISE = SimulationSettings.model_validate(
    {"wrist": {"white_n": 0.01, "white_nm": 0.0004}}
)


def test_a_world_that_falls_behind_bends_no_press():
    """Up to 60 ms behind. What is left over is the damping that the delay of the loop asks for."""
    wanted = simulated_press(306, NEARLY_WITHOUT_NOISE)
    found = WoundWires(306, NEARLY_WITHOUT_NOISE, bursts(0.06)).press()
    assert force_apart(wanted, found) <= 1.0
    assert found[-1] == pytest.approx(wanted[-1], rel=0.02, abs=0.05)
