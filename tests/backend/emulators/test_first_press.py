"""The first press in process and over the emulated wires, with a manual clock."""

import pytest

from tests.backend.emulators.wound import WoundWires, bursts, force_apart, simulated_press
from touchdown.backend.config.simulation import SimulationSettings

NEARLY_WITHOUT_NOISE = SimulationSettings.model_validate(
    {"wrist": {"white_n": 0.01, "white_nm": 0.0004}}
)


def test_a_world_that_falls_behind_bends_no_press():
    """Delays of up to 60 ms. The rest is the damping required by the delay of the loop."""
    wanted = simulated_press(306, NEARLY_WITHOUT_NOISE)
    found = WoundWires(306, NEARLY_WITHOUT_NOISE, bursts(0.06)).press()
    assert force_apart(wanted, found) <= 1.0
    assert found[-1] == pytest.approx(wanted[-1], rel=0.02, abs=0.05)
