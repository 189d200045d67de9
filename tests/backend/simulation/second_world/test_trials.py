"""The gel of the second world against integrals of point forces, and its creep against its law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.config import ProbeSettings, load_simulation
from touchdown.backend.simulation import Conditions
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation.second_world import trials
from touchdown.backend.simulation.second_world.trials import (
    CreepingPads,
    build_half_space_gel,
    shear_field,
    torsion_share,
)

A_MM, NU = 5.0, 0.5


def by_point_forces(at: tuple[float, float], *, twist: bool) -> np.ndarray:
    """Displacement of the surface at a point outside the patch: Cerruti's point forces, summed.

    The traction is that of a rigid patch, singular at the rim: with r = a sin(t) it is smooth.
    """
    t = (np.arange(400) + 0.5) / 400 * np.pi / 2
    angle = (np.arange(720) + 0.5) / 720 * 2 * np.pi
    r = A_MM * np.sin(t)[:, None]
    x, z = r * np.cos(angle), r * np.sin(angle)
    # q r dr dangle with q = 1 / cos(t), for a twist r / (a cos(t))
    weight = A_MM * r * (np.pi / 800) * (np.pi / 360)
    q = np.stack([z, -x]) / A_MM if twist else np.stack([np.ones_like(x), np.zeros_like(x)])
    dx, dz = at[0] - x, at[1] - z
    s = np.hypot(dx, dz)
    along = (q[0] * dx + q[1] * dz) / s**3
    u_x = (1 - NU) * q[0] / s + NU * dx * along
    u_z = (1 - NU) * q[1] / s + NU * dz * along
    # In units of traction over shear modulus such a patch moves by pi (2 - nu) a / 4, and turns by
    # pi / 4 (Reissner and Sagoci).
    size = np.pi / 4 if twist else np.pi * (2 - NU) * A_MM / 4
    return np.array([(weight * u_x).sum(), (weight * u_z).sum()]) / (2 * np.pi * size)


@pytest.mark.parametrize("at", [(7.6, 0.0), (0.0, 5.7), (5.7, 3.8), (-3.8, 5.7), (12.0, -9.0)])
def test_outside_the_patch_the_gel_follows_as_point_forces_say(at: tuple[float, float]) -> None:
    x, z = np.array([at[0]]), np.array([at[1]])
    assert shear_field(x, z, A_MM)[0] == pytest.approx(by_point_forces(at, twist=False), rel=2e-3)
    r = float(np.hypot(*at))
    turned = torsion_share(np.array([r]), A_MM)[0] * np.array([at[1], -at[0]])
    assert turned == pytest.approx(by_point_forces(at, twist=True), rel=2e-3, abs=1e-4)


def test_the_patch_moves_as_one_and_the_map_is_in_pixels() -> None:
    gel = build_half_space_gel((0.05, 0.1), 1.9, 0.0, A_MM)
    strain = np.array([[0.5, 0.2, 0.01], [0.5, 0.2, 0.01]])
    field = gel.displacement_px(strain, np.full(2, 10.0), np.array(10.0))
    # Column and row beside the middle: x = facing * 1.9 mm, z = 1.9 mm (row above).
    at = 2 * 9 + 5
    assert field[0, at] == pytest.approx([(0.5 + 0.01 * 1.9) / 0.05, -(0.2 - 0.01 * 1.9) / 0.05])
    assert field[1, at] == pytest.approx([-(0.5 + 0.01 * 1.9) / 0.1, -(0.2 + 0.01 * 1.9) / 0.1])


def test_gel_that_is_pressed_out_keeps_its_volume() -> None:
    gel = build_half_space_gel((1.0, 1.0), 1.9, 0.1, 3.0)
    field = gel.displacement_px(np.zeros((2, 3)), np.full(2, 20.0), np.array(10.0))[0]
    place = (gel.rest_px[0] - [160.0, 120.0]) * [1.0, -1.0]
    outward = (field * [1.0, -1.0] * place).sum(axis=1)
    outside = np.hypot(*place.T) > 3.0
    # Displacement times radius, in every direction that of the rim: 0.1 * 3 * 3.
    assert outward[outside] == pytest.approx(0.9)


@pytest.fixture
def conditions() -> Conditions:
    settings = load_simulation(preset="off")
    rng = np.random.default_rng(0)
    draw = (
        nuisance.draw_mounting(settings, rng),
        nuisance.draw_gripping(settings, 10.0, rng),
        nuisance.draw_probe(settings, rng),
    )
    return nuisance.conditions_from_draws(settings, ProbeSettings(), 30.0, 30.0, [draw])


def test_load_leaves_the_pads_as_the_power_law_says(
    conditions: Conditions, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trials, "HARDENING_MM", 1e6)
    gel = CreepingPads(replace(conditions, mu_grip=np.array([0.4])), np.zeros((2, 3)))
    held = np.array([0.0, 0.0, 0.95, 0.0, 0.0, 0.0])
    start = 4.0 * 0.95 / (0.4 * 10.0)
    for _ in range(1000):
        gel.follow(held, 4e-3)
    n, rate = trials.CREEP_POWER, 4.0 * trials.CREEP_MM_S / (0.4 * 10.0)
    expected = (start ** (1 - n) + (n - 1) * rate * 4.0) ** (1 / (1 - n))
    assert gel.strain[:, 1] == pytest.approx(expected, rel=5e-3)
    assert gel.slip[:, 1] == pytest.approx(0.95 - gel.strain[:, 1], rel=1e-3)
    assert gel.rest()[2] == pytest.approx(gel.slip[0, 1])


def test_markers_follow_late_and_never_all_the_way(conditions: Conditions) -> None:
    gel = CreepingPads(replace(conditions, slips=np.array([False])), np.zeros((2, 3)))
    held = np.array([0.6, 0.0, 0.8, 0.0, 0.0, 0.0])
    for _ in range(120):
        gel.follow(held, 1e-3)
    shown = trials.SATURATION_MM * np.tanh(1.0 / trials.SATURATION_MM)
    assert np.hypot(*gel.seen[0, :2]) == pytest.approx(shown * (1 - np.exp(-1)), rel=5e-3)
    assert gel.hardening == pytest.approx(1.0 + 1.0 / trials.HARDENING_MM**2)
