"""One axis of the compliant arm against a spring, built apart from the driver: delay, lag, contact.

The law alone is the shipped one.
"""

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from touchdown.backend.devices.streamed.compliance import (
    AT_REST,
    AdmittanceLaw,
    Deflection,
    LoopDelays,
    deflect,
)


@dataclass
class Plant:
    """Commands reach the arm ``loop.dead_cycles`` late, and the arm lags behind by first order."""

    loop: LoopDelays
    place_mm: float = 0.0
    waiting: deque[float] = field(init=False)

    def __post_init__(self):
        self.waiting = deque([self.place_mm] * self.loop.dead_cycles)

    def step(self, command_mm):
        self.waiting.append(command_mm)
        heard = self.waiting.popleft()
        share = 1.0 - math.exp(-self.loop.cycle_s / self.loop.arm_lag_s)
        self.place_mm += share * (heard - self.place_mm)
        return self.place_mm


def slowest_root(
    law: AdmittanceLaw, loop: LoopDelays, environment_n_mm: float, axis: int = 2
) -> float:
    """Return the largest |root| of law and plant glued to a spring: stable below 1.

    Found column by column: each unit state is passed through one cycle of the shipped law.
    """
    # Besides the dead cycles of the link: the cycle that a command is held for, and that of
    # the sample which it answers.
    dead = loop.dead_cycles + 2
    size = 3 + 1 + dead
    columns = []
    for k in range(size):
        state = np.zeros(size)
        state[k] = 1e-6
        d, v, g, place = state[:4]
        waiting = list(state[4:])
        force = -environment_n_mm * place
        give = deflect(law, Deflection(_on(axis, d), _on(axis, v), _on(axis, g)), _on(axis, force))
        waiting.append(give.d_mm[axis])
        share = 1.0 - math.exp(-loop.cycle_s / loop.arm_lag_s)
        after = place + share * (waiting[0] - place)
        columns.append([give.d_mm[axis], give.v_mm_s[axis], give.g_n[axis], after, *waiting[1:]])
    return float(np.abs(np.linalg.eigvals(1e6 * np.array(columns).T)).max())


def largest_stable(law: AdmittanceLaw, loop: LoopDelays, axis: int = 2) -> float:
    """Return the stiffness of the environment at which the loop begins to swing, N/mm."""
    low, high = 0.1, 2000.0
    while high / low > 1.001:
        middle = math.sqrt(low * high)
        if slowest_root(law, loop, middle, axis) < 1.0:
            low = middle
        else:
            high = middle
    return low


@dataclass
class Pressed:
    """One press, by the rule of the reference document: 1.5 mm beyond the detection."""

    peak_n: float
    last_n: float
    ripple_n: float
    bounced: bool


def press(
    law: AdmittanceLaw,
    loop: LoopDelays,
    environment_n_mm: float,
    speed_mm_s: float,
    *,
    noise_n: float = 0.1,
    seed: int = 0,
    stall: float = 0.0,
) -> Pressed:
    """Approach from 0.5 mm above and press at one speed. ``stall``: share of skipped cycles."""
    rng = np.random.default_rng(seed)
    t = loop.cycle_s
    plant = Plant(loop, 0.5)
    reference, goal, give, high = 0.5, -math.inf, AT_REST, 0
    command = reference
    forces = []
    for _ in range(round(5.0 / t)):
        true_n = environment_n_mm * max(-plant.place_mm, 0.0)
        forces.append(true_n)
        felt = true_n + rng.normal(0.0, noise_n)
        if rng.random() >= stall:
            high = high + 1 if felt > 1.0 else 0
            if goal == -math.inf and high >= 3:
                goal = reference - 1.5
            reference = max(reference - speed_mm_s * t, goal)
            if goal > -math.inf:
                give = deflect(law, give, _on(2, felt))
            command = reference + float(give.d_mm[2])
        plant.step(command)
    after = np.array(forces)
    touched = int(np.argmax(after > 1.0))
    last = after[-round(0.5 / t) :]
    return Pressed(
        float(after.max()),
        float(last.mean()),
        float(np.ptp(last)),
        bool((after[touched + 5 :] <= 0.0).any()),
    )


def _on(axis: int, value: float):
    vector = np.zeros(3)
    vector[axis] = value
    return vector
