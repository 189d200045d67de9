"""Plain faces, outlines and undisturbed conditions for the tests of the mechanics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from touchdown.backend.config import ProbeSettings, SimulationSettings
from touchdown.backend.simulation import Conditions, begin_probes, conditions
from touchdown.backend.simulation.mechanics import ContactState, ProbeEquilibrium, advance_probes


@dataclass(frozen=True)
class Disc:
    diameter_mm: float

    def contains(self, points_mm):
        return (points_mm**2).sum(axis=-1) <= (self.diameter_mm / 2) ** 2


@dataclass(frozen=True)
class Square:
    side_mm: float

    def contains(self, points_mm):
        return (np.abs(points_mm) <= self.side_mm / 2).all(axis=-1)


def lattice(diameter_mm: float, pitch_mm: float = 1.0):
    n = int(diameter_mm / 2 / pitch_mm) + 1
    axis = pitch_mm * np.arange(-n, n + 1)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[(points**2).sum(axis=1) <= (diameter_mm / 2) ** 2 + 1e-9]


GRIP_HEIGHT_MM = {25.4: 33.0, 21.2: 40.0, 15.0: 30.0}


def plain(count: int, grip_height_mm: float, **changes) -> Conditions:
    settings = SimulationSettings(preset="off")
    rng = np.random.default_rng(0)
    draw = (
        conditions.draw_mounting(settings, rng),
        conditions.draw_gripping(settings, 10.0, rng),
        conditions.draw_probe(settings, rng),
    )
    made = conditions.conditions_from_draws(
        settings, ProbeSettings(), grip_height_mm, 30.0, [draw] * count
    )
    return replace(
        made, **{k: np.broadcast_to(v, getattr(made, k).shape).copy() for k, v in changes.items()}
    )


def drive(
    state: ContactState, depths_mm, dt_s: float = 0.1
) -> tuple[ContactState, list[ProbeEquilibrium]]:
    solved = []
    for depth in depths_mm:
        command = np.zeros((state.conditions.count, 3))
        command[:, 2] = -np.asarray(depth)
        state, now = advance_probes(state, command, dt_s)
        solved.append(now)
    return state, solved


RAMP = 1.5 * np.minimum(1.0, 0.1 * np.arange(1, 21) / 1.5)


@pytest.fixture
def press() -> Callable[..., tuple[ContactState, list[ProbeEquilibrium]]]:
    """Press pieces of one face diameter on one bottom along the standard ramp."""

    def run(top_mm, bottom, offsets, *, depths=RAMP, dt_s=0.1, pitch_mm=1.0, **changes):
        offsets = np.atleast_2d(np.asarray(offsets, dtype=float))
        made = plain(len(offsets), GRIP_HEIGHT_MM[top_mm], **changes)
        state = begin_probes(lattice(top_mm, pitch_mm), bottom, offsets, made, pitch_mm=pitch_mm)
        return drive(state, depths, dt_s)

    return run


@pytest.fixture
def shapes():
    return Disc, Square
