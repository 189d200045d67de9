"""Presses of the second world against statics in closed form, independent of the solver."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from touchdown.backend.config import ProbeSettings, SimulationSettings, load_simulation
from touchdown.backend.geometry import (
    FLAT,
    Surface,
    Tower,
    contact_edges,
    load_pieces,
    signed_distances_mm,
)
from touchdown.backend.simulation import Conditions, Scene, mujoco_available, onset_rule
from touchdown.backend.simulation.second_world import finite_gel
from touchdown.backend.simulation.second_world.model import (
    HAND_JOINTS,
    HELD_JOINTS,
    STEP_S,
    MountedPiece,
    bottoms_after_press,
    build_model,
)
from touchdown.backend.simulation.second_world.trials import (
    HARDENING_MM,
    CreepingPads,
    SecondWorldPress,
    SecondWorldTrials,
)

pytestmark = [
    pytest.mark.optional,
    pytest.mark.skipif(not mujoco_available(), reason="needs the optional engine"),
]
FREE = {"support": {"rocks": True, "slides": True}}


class Bench(SecondWorldTrials):
    """With a way to the conditions of its first trial, for a mount of its own."""

    def mounted(self, at_mm: tuple[float, float]) -> MountedPiece:
        """Return the first trial's piece, mounted and nothing moved."""
        support = self.scenes[0].settings.support
        return build_model(
            self.scenes[0].piece, self.bottoms[0], self.own(), np.array(at_mm), support
        )

    def own(self) -> Conditions:
        """Return the conditions of the first trial's next probe."""
        return self._conditions(np.array([0]))


def bench(piece: str = "mushroom", bottom: str = "circle15", **given: object) -> Bench:
    settings = SimulationSettings.model_validate({"preset": "off", **given})
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom(bottom).body(),))
    return Bench([Scene(catalogue.top(piece), tower, (0.0, 0.0), 3, settings)])


def lowered(mounted: MountedPiece, depth_mm: float, seconds: float = 1.2) -> None:
    """Lower the hand slowly, then wait."""
    steps = round(seconds / STEP_S)
    for k in range(steps):
        share = min(1.0, 1.5 * k / steps)
        mounted.model.qpos_spring[2] = -1e-3 * depth_mm * share
        mounted.engine.mj_step(mounted.model, mounted.data)


def test_a_press_in_the_middle_is_springs_in_series() -> None:
    """Robot (15 N/mm) against two pads of 4 N/mm that harden."""
    world = bench(grasp={"slip": False})
    mounted, own = world.mounted((0.0, 0.0)), world.own()
    probe = ProbeSettings()
    pads = CreepingPads(own, np.zeros((2, 3)))
    rule = onset_rule(world.scenes[0].settings, probe)
    found = SecondWorldPress(mounted, pads, own, probe).run(0.2, np.zeros(2000), rule, 0.01)
    # Level faces touch where the hand's slide is zero.
    depth = -1e3 * mounted.model.qpos_spring[2]

    def left(u: float) -> float:
        return 15.0 * (depth - u) - 8.0 * u * (1.0 + (u / HARDENING_MM) ** 2)

    assert found.settled
    assert depth == pytest.approx(probe.depth_mm, abs=0.04)
    assert found.values[-1, 2] == pytest.approx(15.0 * (depth - brentq(left, 0.0, depth)), rel=5e-3)


def test_the_piece_turns_about_the_edge_that_it_sticks_to() -> None:
    """The pivot is 9 mm from the middle of a rim of 7.5 mm, 33 mm up.

    Its force acts where springs along that rim say, for the turn that was found. Stuck there the
    face cannot go aside, so the pivot does: springs of robot and pads in series (6.316 N/mm) over
    33 mm, and the pads' torsion (256 N mm/rad), hold the moment.
    """
    world = bench(mu=0.6)
    mounted = world.mounted((9.0, 0.0))
    lowered(mounted, 1.5)
    wrench, turn = mounted.wrench_g(), mounted.held()[4]
    angle = 2 * np.pi * np.arange(32) / 32
    inward = 7.5 * (1.0 - np.cos(angle))
    spring = 3.2 * 20.0 * 2 * np.pi * 7.5 / 32

    def pressing(depth: float) -> np.ndarray:
        return spring * np.maximum(depth - turn * inward, 0.0)

    depth = brentq(lambda d: pressing(d).sum() - wrench[2], 0.0, 1.0)
    arm = 1.5 + float((pressing(depth) * inward).sum()) / wrench[2]
    side, lever = 6.316, 33.0
    assert turn == pytest.approx(wrench[2] * arm / (side * lever**2 + 256.0), rel=0.05)
    assert wrench[0] == pytest.approx(side * lever * turn, rel=0.05)
    # Moment about where it presses: none, by force and arm alone.
    assert wrench[4] + lever * wrench[0] == pytest.approx(arm * wrench[2], rel=0.05)


def test_the_resultant_stays_in_the_overlap() -> None:
    world = bench()
    for at in ((5.0, 0.0), (0.0, -7.0), (-12.0, 4.0)):
        mounted = world.mounted(at)
        lowered(mounted, 1.5)
        f_x, f_y, f_z, m_x, m_y, _ = mounted.wrench_g()
        cop = np.array([-(m_y + 33.0 * f_x), m_x - 33.0 * f_y]) / f_z
        assert np.hypot(*(cop + at)) <= 7.5
        assert np.hypot(*cop) <= 12.7


@pytest.mark.parametrize(("bottom", "at"), [("ring24", (9.0, 2.0)), ("feet3", (-3.0, 4.0))])
def test_the_resultant_stays_in_the_hull_of_the_contact(
    bottom: str, at: tuple[float, float]
) -> None:
    world = bench(bottom=bottom)
    mounted = world.mounted(at)
    lowered(mounted, 1.5)
    f_x, f_y, f_z, m_x, m_y, _ = mounted.wrench_g()
    cop = np.array([-(m_y + 33.0 * f_x), m_x - 33.0 * f_y]) / f_z
    hull = contact_edges(world.scenes[0].piece.face, at, 0.0, world.scenes[0].surface)
    assert f_z > 5.0
    assert float(signed_distances_mm(cop + at, hull)) > -0.1


@pytest.mark.parametrize(
    ("surface", "low_mm", "high_mm"),
    [
        (FLAT, -0.3, 0.3),
        (Surface(tilt_rad=(0.0, -0.03)), 1.0, 8.0),  # rises along x, to the rim at 7.5
        (Surface(step_mm=0.5, step_line=(0.0, 3.0)), 2.9, 7.5),
        (Surface(dome_mm=200.0), -0.3, 0.3),
    ],
)
def test_a_face_that_is_not_flat_is_pressed_where_it_is_high(
    surface: Surface, low_mm: float, high_mm: float
) -> None:
    world = bench()
    body = replace(world.bottoms[0].bodies[0], surface=surface)
    world.bottoms[0] = Tower((body,))
    mounted = world.mounted((0.0, 0.0))
    lowered(mounted, 1.5)
    f_x, _, f_z, _, m_y, _ = mounted.wrench_g()
    assert f_z > 5.0
    assert low_mm < -(m_y + 33.0 * f_x) / f_z < high_mm


@pytest.mark.parametrize("along", [0, 1])
def test_dragged_sideways_the_face_slides_at_the_cone(along: int) -> None:
    """The piece leans back from the drag, and the plane in which it slides leans with it."""
    mounted = bench(mu=0.25).mounted((0.0, 0.0))
    lowered(mounted, 1.0)
    for k in range(600):
        mounted.model.qpos_spring[along] = 1e-3 * k / 300
        mounted.engine.mj_step(mounted.model, mounted.data)
    wrench, lean = mounted.wrench_g(), abs(mounted.held()[4 - along])
    assert lean > 5e-3
    assert -wrench[along] / wrench[2] == pytest.approx(np.tan(np.arctan(0.25) - lean), rel=0.01)
    assert wrench[1 - along] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(("lean_rad", "falls"), [(0.5, False), (0.64, True)])
def test_a_leaning_bottom_falls_beyond_its_edge(lean_rad: float, *, falls: bool) -> None:
    """Short: radius 10 mm, centre of mass 15 mm up: atan(10 / 15) = 0.588."""
    world = bench("pot", "short", **FREE)
    mounted = world.mounted((0.0, 0.0))
    half = 0.5 * lean_rad
    start = HELD_JOINTS.stop
    place = np.array([10.0 * (1.0 - np.cos(lean_rad)), 0.0, -30.0 + 10.0 * np.sin(lean_rad)])
    mounted.data.qpos[start : start + 3] = 1e-3 * place
    mounted.data.qpos[start + 3 :] = [np.cos(half), 0.0, np.sin(half), 0.0]
    mounted.engine.mj_kinematics(mounted.model, mounted.data)
    mounted.engine.mj_comPos(mounted.model, mounted.data)
    slide, fallen = bottoms_after_press(mounted, world.bottoms[0])
    assert fallen is falls
    assert slide == pytest.approx(np.zeros((1, 2)), abs=1e-3)


def test_a_bottom_that_is_dragged_beyond_friction_stays_where_it_slid_to() -> None:
    world = bench("pot", "short", mu=0.6, support={"rocks": True, "slides": True, "mu": 0.1})
    mounted = world.mounted((0.0, 0.0))
    lowered(mounted, 1.0)
    for k in range(600):
        mounted.model.qpos_spring[HAND_JOINTS.start] = 1e-3 * k / 300
        mounted.engine.mj_step(mounted.model, mounted.data)
    slide, fallen = bottoms_after_press(mounted, world.bottoms[0])
    # The drag cannot exceed friction on the table; springs of 6.316 N/mm hold the rest of 2 mm.
    wrench = mounted.wrench_g()
    assert -wrench[0] == pytest.approx(0.1 * (wrench[2] + 0.03 * 9.81), rel=0.05)
    assert slide[0, 0] == pytest.approx(2.0 + wrench[0] / 6.316, abs=0.1)
    assert not fallen


def test_draws_and_signals_are_those_of_the_scene_whatever_else_is_pressed() -> None:
    settings = load_simulation(preset="bench-v1")
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("short").body(),))
    scenes = [Scene(catalogue.top("pot"), tower, (0.0, 0.0), seed, settings) for seed in (5, 6)]
    together, alone = SecondWorldTrials(scenes), SecondWorldTrials(scenes[1:])
    at = np.array([[4.0, 2.0], [-6.0, 3.0]])
    both, one = together.press([0, 1], at), alone.press([0], at[1:])
    assert (both.detected & both.truth.solved).all()
    np.testing.assert_array_equal(both.observation[1], one.observation[0])
    assert np.isfinite(both.observation).all()
    # What crept in the hand is carried to the next press.
    again = alone.press([0], at[1:])
    assert again.truth.offset_mm[0] != pytest.approx(one.truth.offset_mm[0], abs=1e-9)


def test_the_finite_gel_changes_the_markers_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("skfem")
    coarse = finite_gel.GelShape(across=4, around=2, layers=2)
    build = finite_gel.marker_gels
    monkeypatch.setattr(finite_gel, "marker_gels", lambda *given: build(*given, coarse))
    world, at = bench("pot", "short"), np.array([[6.0, 2.0]])
    other, finite = world.press([0], at), finite_gel.FiniteGelTrials(world.scenes).press([0], at)
    np.testing.assert_array_equal(finite.observation[..., 252:], other.observation[..., 252:])
    assert finite.truth.solved.all()
    # Finger, axis, row, column at the end. Under the disc the gel moves as a whole.
    there, here = (press.observation[0, -1, :252].reshape(2, 2, 7, 9) for press in (other, finite))
    assert np.abs(there[:, 1, 3, 4]).min() > 10.0
    np.testing.assert_allclose(here[..., 2:5, 3:6], there[..., 2:5, 3:6], rtol=0.15, atol=0.3)
    assert (np.abs(here[:, 1, 0, 0]) < 0.6 * np.abs(there[:, 1, 0, 0])).all()
    # Near the limit of friction nodes slip on the trailing side, unless they stick.
    scenes, contact, moved = bench("pot", "short", mu_grip=0.45).scenes, finite_gel.DiscContact, []
    for factor in (1.0, 1000.0):
        monkeypatch.setattr(
            finite_gel,
            "DiscContact",
            lambda gel, stiff, mu, by=factor: contact(gel, stiff, by * mu),
        )
        press = finite_gel.FiniteGelTrials(scenes).press([0], at)
        moved.append(np.abs(press.observation[0, -1, :252].reshape(2, 2, 7, 9)[:, 1, :, 4]))
    slips, sticks = moved
    np.testing.assert_allclose(sticks[:, 5], sticks[:, 1], rtol=0.05)
    assert (slips[:, 5] < 0.9 * sticks[:, 5]).all()
