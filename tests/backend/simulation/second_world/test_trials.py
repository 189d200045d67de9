"""The gels of the second world against closed forms, and their creep against its law."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from touchdown.backend.config import ProbeSettings, load_simulation
from touchdown.backend.simulation import Conditions
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation.second_world import trials
from touchdown.backend.simulation.second_world.finite_gel import (
    CondensedGel,
    DiscContact,
    GelShape,
    assemble_stiffness,
    condense_gel,
)
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


# Radius 1 on a layer four times as thick, wide enough to be infinite.
LAYER = GelShape((16.0, 16.0), 4.0, 0.48, 1.0, across=4, around=3, layers=3)


@pytest.fixture(scope="module")
def layer() -> CondensedGel:
    pytest.importorskip("skfem")
    return condense_gel(LAYER, np.array([[0.3, -0.2], [0.0, 1.5], [0.0, -1.5]]))


def spin(gel: CondensedGel) -> np.ndarray:
    """Displacement of the nodes for a unit rotation of the disc."""
    return np.stack([gel.at_mm[:, 1], -gel.at_mm[:, 0], 0.0 * gel.at_mm[:, 0]], axis=1)


@pytest.mark.parametrize(
    ("axis", "modulus"),
    [(2, 2.0 + 2.0 * 0.48 / (1.0 - 2.0 * 0.48)), (0, 1.0)],
    ids=["confined compression", "pure shear"],
)
def test_a_uniform_field_has_the_energy_of_its_modulus(axis: int, modulus: float) -> None:
    """Oedometer modulus 2 G + lambda, and G, over the thickness, times the area."""
    pytest.importorskip("skfem")
    shape = replace(LAYER, size_mm=(5.0, 4.0), across=2, around=2, layers=2)
    basis, stiffness = assemble_stiffness(shape)
    field = np.zeros((3, basis.N))
    field[axis] = 1.0 - basis.doflocs[2] / 4.0
    forces = stiffness @ field.ravel()
    assert field.ravel() @ forces == pytest.approx(modulus * 5.0 * 4.0 / 4.0)
    inside = (np.abs(basis.doflocs) * [[2.0], [2.0], [1.0]] < [[5.0], [4.0], [4.0]]).all(axis=0)
    inside &= basis.doflocs[2] > 0.0
    assert np.abs(forces.reshape(3, -1)[:, inside]).max() < 1e-9


def pressed_layer(thickness: float) -> tuple[float, float]:
    """Stiffness of a smooth punch of radius 1, and mean square radius of its pressure.

    Relative to those on a half-space, 4 G / (1 - nu) and 2 / 3: the dual integral equations of a
    layer on a rigid base (Hayes et al. 1972) as one of Fredholm, on Gauss points.
    """
    k = 3.0 - 4.0 * 0.48
    x = np.linspace(1e-6, 20.0, 4000)
    near = (2 * k * np.sinh(2 * x) - 4 * x) / (2 * k * np.cosh(2 * x) + 4 * x**2 + 1 + k**2)
    t, weight = (np.polynomial.legendre.leggauss(24)[i] for i in (0, 1))
    t, weight = 0.5 * (t + 1.0), 0.5 * weight
    wave = np.cos(np.outer(t, x / thickness))
    kernel = (wave * ((1.0 - near) * (x[1] - x[0]) / thickness)) @ wave.T
    found = np.linalg.solve(np.eye(24) - 2.0 / np.pi * kernel * weight, np.ones(24))
    # The pressures of flat punches of radius t, each with a second moment of int 2 t^2 dt.
    total = weight @ found
    return float(total), float(3.0 * (weight * t**2) @ found / total)


def test_a_smooth_punch_presses_as_on_an_elastic_layer(layer: CondensedGel) -> None:
    contact = DiscContact(layer, 1.0, 0.0)
    contact.follow(np.zeros(3), 1.0)
    stiffer, wider = pressed_layer(4.0)
    assert 1.0 / contact.depth_mm == pytest.approx(stiffer * 4.0 / (1.0 - 0.48), rel=0.05)
    assert contact.force_n[:, 2].min() > 0.0
    square = contact.force_n[:, 2] @ (layer.at_mm**2).sum(axis=1)
    assert square == pytest.approx(wider * 2.0 / 3.0, rel=0.03)
    assert contact.force_n[:, :2] == pytest.approx(0.0, abs=1e-9)


def test_a_stuck_disc_turns_as_reissner_and_sagoci_say(layer: CondensedGel) -> None:
    turned = spin(layer)
    moment = turned.ravel() @ layer.stiffness_n_mm @ turned.ravel()
    assert moment == pytest.approx(16.0 / 3.0, rel=0.04)
    outside = (layer.shown @ turned.ravel()).reshape(-1, 2)
    assert outside[0] == pytest.approx([-0.2, -0.3], abs=1e-9)  # under the disc
    assert outside[1, 0] == pytest.approx(1.5 * torsion_share(np.array([1.5]), 1.0)[0], rel=0.12)
    assert outside[1] == pytest.approx(-outside[2], abs=1e-6)


def test_a_disc_that_slips_entirely_is_at_the_limit_of_coulomb(layer: CondensedGel) -> None:
    """Force mu N against the motion; moment mu N times the mean radius, pi / 4 of a punch."""
    dragged, twisted = DiscContact(layer, 1.0, 0.3), DiscContact(layer, 1.0, 0.3)
    for share in (0.0, 0.25, 0.5, 1.0):
        dragged.follow(share * np.array([0.6, 0.8, 0.0]), 1.0)
        twisted.follow(share * np.array([0.0, 0.0, 1.0]), 1.0)
    assert dragged.solved
    assert twisted.solved
    assert dragged.force_n.sum(axis=0) == pytest.approx([0.18, 0.24, 1.0], abs=2e-3)
    assert (spin(layer) * twisted.force_n).sum() == pytest.approx(0.3 * np.pi / 4, rel=0.03)
    limit = 0.3 * dragged.force_n[:, 2]
    assert np.hypot(*dragged.force_n[:, :2].T) == pytest.approx(limit, abs=1e-5)


def test_a_disc_that_sticks_returns_and_one_that_slipped_does_not(layer: CondensedGel) -> None:
    stuck, slipped = DiscContact(layer, 1.0, 50.0), DiscContact(layer, 1.0, 0.3)
    for contact in (stuck, slipped):
        rest = contact.follow(np.zeros(3), 1.0)
        shown = contact.follow(np.array([0.0, 0.1, 0.0]), 1.0)
        again = contact.follow(np.zeros(3), 1.0)
        if contact is stuck:
            assert shown[:2] - rest[:2] == pytest.approx([0.0, 0.1], abs=1e-9)
            assert contact.force_n[:, 1].sum() == pytest.approx(0.0, abs=1e-9)
            assert again == pytest.approx(rest, abs=1e-9)
        else:
            assert shown[1] - rest[1] < 0.09
            assert contact.force_n[:, 1].sum() < -0.01
            assert (again - rest)[1] < -1e-4
