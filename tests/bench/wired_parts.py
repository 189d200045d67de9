"""What the difference between first probes, simulated and over the wires, is made of.

The clock is wound by hand, so that the computer has no part in it: the noise of the sensor (two
simulated probes that differ in nothing else), the law of the arm (nearly without noise), and a
world that falls behind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tests.backend.emulators.wound import WoundWires, bursts, force_apart, simulated_press
from tests.bench.registry import Figure, figure
from tests.bench.wired import FIRST_SEED, TRIALS
from touchdown.backend.config.simulation import SimulationSettings

MOST_PC = 2.0
BEHIND_S = 0.06
NOISY = SimulationSettings()
STILL = SimulationSettings.model_validate({"wrist": {"white_n": 0.01, "white_nm": 0.0004}})
LONGER_S = 1.7
"""Another rest before the press is other noise; nothing else depends on it."""


def share(name: str, apart_pc: Sequence[float], *, promised: bool = True) -> Figure:
    """Return the median of one comparison, with how many are within the limit."""
    median_pc, within = float(np.median(apart_pc)), sum(pc <= MOST_PC for pc in apart_pc)
    note = f"median; {within} of {len(apart_pc)} within 2 %, largest {max(apart_pc):.1f} %"
    target, ok = ("<= 2", median_pc <= MOST_PC) if promised else ("stated", None)
    return Figure(f"first probe: {name}", median_pc, "% off", target, ok, note)


@figure("wired")
def parts_of_the_first_probe(trials: int = TRIALS) -> list[Figure]:
    noise, wires, behind, law = [], [], [], []
    for seed in range(FIRST_SEED, FIRST_SEED + trials):
        wanted = simulated_press(seed, NOISY)
        noise.append(force_apart(wanted, simulated_press(seed, NOISY, LONGER_S)))
        wires.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(0.0)).press()))
        behind.append(force_apart(wanted, WoundWires(seed, NOISY, bursts(BEHIND_S)).press()))
        still = simulated_press(seed, STILL)
        law.append(force_apart(still, WoundWires(seed, STILL, bursts(0.0)).press()))
    return [
        share("simulated twice, other sensor noise", noise, promised=False),
        share("wires, clock wound by hand", wires),
        share("the same, world up to 60 ms behind", behind),
        share("wires, nearly no sensor noise: the arm's law", law),
    ]
