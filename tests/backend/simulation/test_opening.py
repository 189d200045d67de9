"""A piece that turns while the jaws open: closed forms, and MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from tests.backend.simulation.conftest import plain
from tests.release_study import SUPPORTED_S, OpeningPlan, open_in_steps
from touchdown.backend.config import SimulationSettings
from touchdown.backend.geometry import load_pieces
from touchdown.backend.geometry.outlines import circle, rectangle
from touchdown.backend.geometry.tower import Body, Tower
from touchdown.backend.simulation.ground_truth import Scene
from touchdown.backend.simulation.opening import (
    FALLEN_RAD,
    NO_SUPPORT_MM,
    LooseGrip,
    LoosePads,
    StandingPiece,
    standing_piece,
)
from touchdown.backend.simulation.release_mujoco import mujoco_available, simulate_release

WEIGHT_N, HEIGHT_MM, GRIP_MM, HALF_MM = 0.2, 25.0, 30.0, 15.0
SHORT = OpeningPlan(steps=4, hold_s=0.2)


def standing(margin_mm: float, axis_deg: float = 0.0, **changes) -> StandingPiece:
    axis = np.radians([axis_deg])
    mass_kg = WEIGHT_N / 9.80665
    sideways = HALF_MM * np.sin(axis)
    piece = StandingPiece(
        margin_mm=np.array([margin_mm]),
        span_mm=np.array([12.0]),
        axis_rad=axis,
        com_height_mm=np.array([HEIGHT_MM]),
        weight_n=np.array([WEIGHT_N]),
        inertia_kg_mm2=np.array([mass_kg * (12.0**2 / 4 + 50.0**2 / 12)]),
        grip_height_mm=np.array([GRIP_MM]),
        pads_mm=margin_mm - np.stack([sideways, -sideways], axis=1),
    )
    return replace(piece, **changes)


def pads(force_n: float, mu: float = 0.8) -> LoosePads:
    return LoosePads(
        stiffness=np.array([[4.0, 4.0, 128.0]]),
        normal_n_mm=np.array([10.0]),
        mu_grip=np.array([mu]),
        limit_radius_mm=np.array([3.8]),
        half_width_mm=np.array([HALF_MM]),
        force_n=np.array([force_n]),
        strain=np.zeros((1, 2, 3)),
    )


def inertia(piece: StandingPiece) -> float:
    mass_kg = WEIGHT_N / 9.80665
    return piece.inertia_kg_mm2[0] + mass_kg * (
        piece.margin_mm[0] ** 2 + piece.com_height_mm[0] ** 2
    )


@pytest.mark.parametrize("margin_mm", [-0.3, -1.0])
def test_without_pads_a_small_angle_grows_like_the_hyperbolic_cosine(margin_mm) -> None:
    piece = standing(margin_mm)
    course = open_in_steps(piece, pads(0.0), SHORT)
    rate = np.sqrt(1e3 * WEIGHT_N * HEIGHT_MM / inertia(piece))
    small = course.angle_rad[0] < 0.06
    exact = -margin_mm / HEIGHT_MM * (np.cosh(rate * course.t_s) - 1.0)
    np.testing.assert_allclose(course.angle_rad[0, small], exact[small], rtol=0.01, atol=2e-5)


def test_the_time_of_a_fall_is_that_of_the_energy_integral() -> None:
    piece = standing(-0.8)
    course = open_in_steps(piece, pads(0.0), SHORT, sample_s=0.001)

    def gained_nmm(angle: float) -> float:
        return WEIGHT_N * (HEIGHT_MM * (1.0 - np.cos(angle)) + 0.8 * np.sin(angle))

    def slowness(root: float) -> float:  # with angle = root², the integrand has no pole
        speed = np.sqrt(2e3 * gained_nmm(root**2) / inertia(piece))
        return 2.0 * root / speed

    exact_s = quad(slowness, 1e-9, np.sqrt(np.radians(10.0)))[0]
    assert course.reached_s(np.radians(10.0))[0] == pytest.approx(exact_s, abs=0.002)
    assert course.angle_rad[0, -1] == pytest.approx(FALLEN_RAD, abs=2e-3)


@pytest.mark.parametrize("axis_deg", [0.0, 40.0, 90.0])
def test_pads_that_hold_turn_by_moment_over_stiffness(axis_deg) -> None:
    piece = standing(-1.0, axis_deg)
    course = open_in_steps(piece, pads(20.0, mu=5.0), SHORT)
    along, across = np.cos(np.radians(axis_deg)), np.sin(np.radians(axis_deg))
    stiffness = 2 * 4.0 * (along * GRIP_MM) ** 2 + 4.0 * (piece.pads_mm[0] ** 2).sum()
    stiffness += 2 * 128.0 * along**2 + 2 * 10.0 * (across * GRIP_MM) ** 2
    exact = WEIGHT_N * 1.0 / (stiffness - WEIGHT_N * HEIGHT_MM)
    assert course.angle_rad[0, -1] == pytest.approx(exact, rel=1e-3)
    held = course.wrench_g[0, -1]
    assert held[0] == pytest.approx(2 * 4.0 * along * GRIP_MM * exact, rel=1e-3, abs=1e-9)


def test_it_falls_once_the_friction_of_the_pads_is_less_than_its_moment() -> None:
    piece = standing(-1.0)
    # Force at which the strain of the balance is on the limit surface; steps of 0.5 N a finger.
    strain = np.array([GRIP_MM, -1.0, 1.0])
    stiffness = np.array([4.0, 4.0, 128.0])
    turn = WEIGHT_N / (2 * (stiffness * strain**2).sum() - WEIGHT_N * HEIGHT_MM)
    force = stiffness * strain * turn
    needed_n = np.sqrt(force[0] ** 2 + force[1] ** 2 + (force[2] / 3.8) ** 2) / 0.8
    assert 0.001 < needed_n < 0.1
    for spare_n, falls in ((1.3, False), (0.8, True)):
        plan = OpeningPlan(steps=1, hold_s=0.8)
        course = open_in_steps(piece, pads(0.5 + spare_n * needed_n), plan)
        assert (course.angle_rad[0, -1] > 0.1) == falls


def test_a_piece_that_falls_towards_a_finger_leans_on_it() -> None:
    plan = OpeningPlan(steps=3, hold_s=0.3)
    course = open_in_steps(standing(-1.0, 90.0), pads(0.4), plan)
    gap_mm = 0.5 * 3 * 0.1 - 0.04
    assert course.angle_rad[0, -1] == pytest.approx(gap_mm / GRIP_MM, rel=0.03)
    assert course.normal_n[0, -1, 0] > 0.0
    assert course.normal_n[0, -1, 1] == 0.0


@pytest.mark.parametrize("strain", [(0.0, 0.0, 0.0), (0.005, 0.01, 0.004)])
def test_a_stable_piece_stands_flat_when_the_jaws_are_open(strain) -> None:
    grip = pads(0.6)
    grip.strain[:] = strain
    course = open_in_steps(standing(1.0), grip, SHORT)
    assert course.angle_rad[0, -1] == 0.0
    assert not course.wrench_g[0, -1].any() or np.abs(course.wrench_g[0, -1]).max() < 1e-6
    assert course.t_s[-1] == pytest.approx(SUPPORTED_S + 0.8, abs=0.011)


@pytest.mark.skipif(not mujoco_available(), reason="needs the extra 'mujoco'")
@pytest.mark.parametrize("margin_mm", [-0.8, -1.5])
def test_the_fall_takes_as_long_as_in_mujoco(margin_mm) -> None:
    base = Body("base", rectangle(12.0, 40.0), None, 20.0, 0.0, 1.0, fixed=True)
    base = replace(base, upper=base.lower)
    mass_g = 1e3 * WEIGHT_N / 9.80665
    top = Body("top", circle(24.0), None, 50.0, mass_g, HEIGHT_MM, at_mm=(6.0 - margin_mm, 0.0))
    _, fall = simulate_release(Tower((base, top)), seconds=1.0, frame_hz=500.0)
    tilt = 2.0 * np.arcsin(np.linalg.norm(fall.pose[:, 1, 4:6], axis=1))
    theirs_s = np.interp(np.radians(8.0), tilt, fall.t_s)
    round_kg_mm2 = 1e-3 * mass_g * (12.0**2 / 4 + 50.0**2 / 12)
    piece = standing(margin_mm, inertia_kg_mm2=np.array([round_kg_mm2]))
    course = open_in_steps(piece, pads(0.0), OpeningPlan(steps=1, hold_s=0.5), sample_s=0.001)
    ours_s = course.reached_s(np.radians(8.0))[0]
    # The edge of MuJoCo is up to 0.06 mm nearer.
    assert ours_s == pytest.approx(theirs_s, rel=0.06)


def test_the_piece_of_a_scene_turns_about_the_nearest_edge_of_its_support() -> None:
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("circle25").body(),))
    scene = Scene(catalogue.top("pot"), tower, (0.0, 0.0), 5, SimulationSettings(preset="off"))
    away = np.radians(30.0)
    at = (13.5 * np.cos(away), 13.5 * np.sin(away))
    piece = standing_piece(scene, at, 0.0)
    assert piece.margin_mm == pytest.approx(12.5 - 13.5, abs=0.01)
    assert np.degrees(piece.axis_rad) == pytest.approx(30.0, abs=0.5)
    # The overlap of two circles of 15 and 25 mm, 13.5 mm apart, is 6.5 mm wide.
    assert piece.span_mm == pytest.approx(12.5 + 7.5 - 13.5, abs=0.05)
    assert piece.weight_n == pytest.approx(0.015 * 9.80665)
    pads = -1.0 - 15.0 * np.sin(away) * np.array([1.0, -1.0])
    assert piece.pads_mm[0] == pytest.approx(pads, abs=0.15)
    moved = standing_piece(scene, at, 0.0, (-2.0 * np.cos(away), -2.0 * np.sin(away)))
    assert moved.margin_mm == pytest.approx(1.0, abs=0.01)
    beside = standing_piece(scene, (40.0, 0.0), 0.0)
    assert (beside.margin_mm[0], beside.span_mm[0]) == (NO_SUPPORT_MM, 0.0)


def test_a_grip_that_carries_nothing_explains_its_equilibrium() -> None:
    """The weight hangs on the pads in air; a support that carries it moves them up again."""
    conditions, piece = plain(1, GRIP_MM), standing(2.0)
    values = np.zeros(14)
    values[2] = WEIGHT_N
    values[[7, 10]] = 0.5 * WEIGHT_N / conditions.shear_n_mm
    values[12:] = 10.0
    loose = LooseGrip(piece, conditions, values, np.array([0, 0, -WEIGHT_N, 0, 0, 0]))
    assert loose._left[:6] == pytest.approx(np.zeros(6), abs=1e-9)
    assert loose.advance(0.5, 0.01)[:3] == pytest.approx([0.0, 0.0, WEIGHT_N], abs=1e-6)
    assert loose.turned_rad == 0.0
