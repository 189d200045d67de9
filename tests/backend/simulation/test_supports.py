"""Verification vectors of the mechanics: no noise, defaults, end of hold."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import root

from tests.backend.simulation.test_batch import everything, plan
from touchdown.backend.config.bench_description import bench_sha256
from touchdown.backend.config.method import ProbeSettings
from touchdown.backend.config.simulation import SimulationSettings, SupportSettings, load_simulation
from touchdown.backend.core.values import GRID_COLS, GRID_ROWS
from touchdown.backend.geometry import regions
from touchdown.backend.geometry.outlines import circle, face_points, rectangle, signed_distances_mm
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.sampling import draw_offset, draw_start, draw_tower, start_generator
from touchdown.backend.geometry.tower import (
    TOO_CLOSE_MM,
    Body,
    Tower,
    interface_overlap,
    judge_tower,
)
from touchdown.backend.placement.equilibrium import centre_of_pressure_mm
from touchdown.backend.simulation import batch as lockstep
from touchdown.backend.simulation import conditions as nuisance
from touchdown.backend.simulation.batch import LARGEST_FORCE_RATIO, simulate_episodes
from touchdown.backend.simulation.contact import RESIDUAL_LIMIT, RESIDUAL_SCALE
from touchdown.backend.simulation.gripper import HeldPiece, start_command_mm
from touchdown.backend.simulation.ground_truth import Scene
from touchdown.backend.simulation.marker_fields import build_gel
from touchdown.backend.simulation.mechanics import (
    ContactState,
    ProbeEquilibrium,
    advance_probes,
    begin_probes,
    elastic_zero,
    springs,
)
from touchdown.backend.simulation.pressing import press_batch
from touchdown.backend.simulation.supports import (
    SupportMotion,
    join_support_stacks,
    slide_bottoms,
    support_stack,
    topples,
)
from touchdown.backend.simulation.wrist_sensor import (
    Load,
    cable_wrench,
    held_piece_load,
    wrist_wrench,
)

TOPS = {"mushroom": 25.4, "barrel": 21.2, "pot": 15.0}
CENTRE = (GRID_ROWS // 2) * GRID_COLS + GRID_COLS // 2

TABLE = Path(__file__).parents[2] / "data" / "mechanics-vectors.csv"
WORDS = 2
FREE = load_simulation(preset="bench-v1")
FINER = SimulationSettings.model_validate({"preset": "bench-v1", "face": {"subcells": 3}})


def read_vectors():
    with TABLE.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return [(*row[:WORDS], *map(float, row[WORDS:])) for row in rows]


VECTORS = read_vectors()


@pytest.mark.parametrize("row", VECTORS, ids=lambda r: f"{r[0]}-{r[1]}-{r[2]:g}-{r[3]:g}")
def test_published_vector(row, press, shapes) -> None:
    disc, square = shapes
    bottoms = {"c15": disc(15.0), "c25": disc(25.0), "s15": square(15.0)}
    top, bottom, x, y, cells, f_x, f_y, f_z, m_x, m_y, rho_x, rho_y, *rest = row
    state, solved = press(TOPS[top], bottoms[bottom], (x, y))
    end = solved[-1]
    force, moment = end.wrench_g[0, :3], end.wrench_g[0, 3:]
    assert state.cells.count[0] == cells
    assert state.residual[0] <= 1e-6
    np.testing.assert_allclose(force, (f_x, f_y, f_z), rtol=0.01, atol=6e-4)
    np.testing.assert_allclose(moment[:2], (m_x, m_y), rtol=0.02, atol=6e-4)
    np.testing.assert_allclose(1e3 * end.q[0, 3:5], (rho_x, rho_y), rtol=0.01, atol=6e-3)
    np.testing.assert_allclose(end.cop_mm[0], rest[:2], rtol=0.01, atol=6e-3)
    at_wrist = wrist_wrench(end.wrench_g, 120.0)
    np.testing.assert_allclose(at_wrist[0, 3:5], rest[2:4], rtol=0.02, atol=6e-5)
    lever = 120.0 - state.cells.r_z[0]
    np.testing.assert_allclose(centre_of_pressure_mm(at_wrist, lever), end.cop_mm, atol=1e-9)
    field = build_gel((0.058, 0.058)).displacement_px(end.strain, end.normal_n, np.array([10.0]))
    np.testing.assert_allclose(field[0, :, CENTRE].ravel(), rest[4:], atol=0.05)


@pytest.mark.parametrize(("pitch_mm", "f_x"), [(2.0, 0.727), (1.0, 0.794), (0.5, 0.799)])
def test_discretisation_table(pitch_mm, f_x, press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), (9, 0), pitch_mm=pitch_mm)
    assert solved[-1].wrench_g[0, 0] == pytest.approx(f_x, rel=0.01)


@pytest.mark.parametrize(
    ("stiffness", "f_x"), [(2.0, 1.233), (5.0, 1.032), (20.0, 0.794), (100.0, 0.610)]
)
def test_foundation_table(stiffness, f_x, press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), (9, 0), foundation_n_mm3=stiffness)
    assert solved[-1].wrench_g[0, 0] == pytest.approx(f_x, rel=0.01)


@pytest.mark.parametrize("offset_mm", [(9.0, 0.0), (15.0, 8.0), (-12.4, 10.3), (3.3, -17.2)])
def test_cells_weighted_by_ninths_press_like_fine_cells(offset_mm, press, shapes) -> None:
    face, bottom = circle(25.4), circle(20.0)
    rng = np.random.default_rng(1)
    draws = (
        nuisance.draw_mounting(FREE, rng),
        nuisance.draw_gripping(FREE, 10.0, rng),
        nuisance.draw_probe(FREE, rng),
    )
    drawn = nuisance.conditions_from_draws(FREE, ProbeSettings(), 33.0, 30.0, [draws])

    def centre_mm(pitch_mm, subcells):
        points = face_points(face, pitch_mm)
        at = np.array([offset_mm])
        state = begin_probes(points, bottom, at, drawn, None, pitch_mm, subcells)
        for depth in np.linspace(0.1, 1.5, 15):
            state, solved = advance_probes(state, np.array([[0.0, 0.0, -depth]]), 0.1)
        return solved.cop_mm[0]

    fine = centre_mm(1 / 3, 1)
    assert np.abs(centre_mm(1 / 3, 3) - fine).max() < 0.12


def test_subcells_change_the_hash_of_a_bench_only_where_they_are_used() -> None:
    content = FREE.model_dump(mode="json")
    assert "subcells" not in content["face"]
    finer = SimulationSettings.model_validate(
        {**content, "face": {**content["face"], "subcells": 3}}
    )
    assert finer.model_dump(mode="json")["face"]["subcells"] == 3
    assert SimulationSettings.model_validate(finer.model_dump(mode="json")) == finer
    assert bench_sha256(finer) != bench_sha256(FREE)


@pytest.mark.parametrize("settings", [FREE, FINER], ids=["whole", "ninths"])
def test_devices_and_batch_press_the_same_cells(settings) -> None:
    catalogue = load_pieces()
    piece = catalogue.top("pot")
    scene = Scene(piece, Tower((catalogue.bottom("circle15").body(),)), (5.0, -3.0), 4, settings)
    holding = HeldPiece(scene, 0, ProbeSettings().grip_force_n)
    holding.begin_probe(ProbeSettings())
    command = start_command_mm(scene)
    command[2] = holding.touch_height_mm - 0.1
    holding.solve(command, 0.01)
    seen = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            lockstep.pressing,
            "press_batch",
            lambda state, *rest: seen.append(state) or press_batch(state, *rest),
        )
        bench = lockstep.BatchedTrials([scene])
        bench.press([0], bench.start_commands_mm())
    mine, other = holding._state.cells, seen[0].cells
    np.testing.assert_allclose(mine.normal, other.normal)
    np.testing.assert_allclose((mine.x, mine.y), (other.x, other.y), atol=1e-9)


BOTH = SupportSettings(rocks=True, slides=True)
OFF = SimulationSettings.model_validate({"preset": "off"})
FACE = rectangle(6.0, 6.0)
DEPTH_MM = 1.5


def block(width_mm=12.0, height_mm=40.0, mass_g=35.0, **more) -> Body:
    """A prism whose upper end overhangs its base: the press can be outside of it."""
    lower, upper = rectangle(width_mm, 40.0), rectangle(40.0, 40.0)
    return Body("block", lower, upper, height_mm, mass_g, height_mm / 2, **more)


def pressed(
    tower: Tower, offset_mm, support: SupportSettings = BOTH, side_mm=(0.0, 0.0), mu=0.4, steps=15
) -> tuple[ContactState, ProbeEquilibrium]:
    """Press a small square face at ``offset_mm``, then move the arm sideways by ``side_mm``."""
    ground = np.random.default_rng(0)
    draw = (
        nuisance.draw_mounting(OFF, ground),
        nuisance.draw_gripping(OFF, 10.0, ground),
        nuisance.draw_probe(OFF, ground),
    )
    conditions = nuisance.conditions_from_draws(OFF, ProbeSettings(), 30.0, 30.0, [draw])
    conditions.mu[:] = mu
    state = begin_probes(
        face_points(FACE), tower.bodies[-1].upper, np.array([offset_mm]), conditions
    ).on(support_stack(tower, support))
    for k in range(1, 2 * steps + 1):
        down, across = min(1.0, k / steps), max(0.0, k / steps - 1.0)
        command = np.array([[across * side_mm[0], across * side_mm[1], -DEPTH_MM * down]])
        state, solved = advance_probes(state, command, 0.1)
    assert solved.residual[0] <= RESIDUAL_LIMIT
    return state, solved


@pytest.mark.parametrize("x_mm", [4.0, 5.5, 5.9, 6.3, 7.0, 9.0])
def test_a_block_tips_when_it_is_pressed_beyond_its_base(x_mm) -> None:
    tower = Tower((block(),))
    state, solved = pressed(tower, (x_mm, 0.0))
    # A press alone, straight down at the middle of the face, with the weight at the middle.
    fz, weight = solved.pressing_n[0], 0.035 * 9.81
    resultant = x_mm * fz / (fz + weight)
    assert (state.pose.rock_rad[0, 0, 0] > 1e-6) == (resultant > 6.0)
    assert abs(state.pose.rock_rad[0, 0, 1]) < 1e-9


@pytest.mark.parametrize("x_mm", [5.0, 5.9, 6.25, 6.8])
def test_the_rigid_threshold_is_that_of_the_exact_judge(x_mm) -> None:
    tower = Tower((block(),))
    _, solved = pressed(tower, (x_mm, 0.0), SupportSettings())
    load_g = 1e3 * solved.pressing_n[0] / 9.81
    weight = Body("press", FACE, None, 1.0, load_g, 0.5, at_mm=(x_mm, 0.0))
    stands = judge_tower(tower.with_top(weight)).margins_mm[0] > 0.0
    state, _ = pressed(tower, (x_mm, 0.0))
    assert bool(state.pose.rock_rad.any()) != stands


def test_a_tipped_block_is_in_balance_about_its_edge() -> None:
    tower = Tower((block(height_mm=60.0),))
    state, solved = pressed(tower, (3.0, 0.0), side_mm=(1.2, 0.0), mu=0.6)
    (a, _), r_z = state.pose.rock_rad[0, 0], -30.0
    assert a > 1e-3
    fx, _, fz, _, my, _ = solved.wrench_g[0]
    # Moments about the edge at x = 6 of the press on the face (lever 60) and of the weight, both
    # where they have moved to; the sum is nothing.
    at = 3.0 + (-(my - r_z * fx) / fz) + solved.q[0, 0] + r_z * solved.q[0, 4]
    weight = 0.035 * 9.81
    moment = (at - 6.0) * fz - fx * 60.0 + weight * (30.0 * a - 6.0)
    assert moment == pytest.approx(0.0, abs=0.01)
    assert np.hypot(fx, 0.0) < 0.4 * (fz + weight)


@pytest.mark.parametrize("mu", [0.1, 0.2])
def test_a_block_slides_with_the_arm_when_friction_is_spent(mu) -> None:
    support = SupportSettings(slides=True, mu=mu)
    tower = Tower((block(width_mm=40.0),))
    state, solved = pressed(tower, (0.0, 0.0), support, side_mm=(6.0, 0.0), mu=0.6)
    fx, _, fz = solved.wrench_g[0, :3]
    assert -fx == pytest.approx(mu * (fz + 0.035 * 9.81), rel=1e-6)
    assert 0.5 < state.pose.slide_mm[0, 0, 0] < 6.0
    # With more friction below than at the face it is the face that slides.
    state, _ = pressed(tower, (0.0, 0.0), BOTH, side_mm=(6.0, 0.0), mu=0.2)
    assert not state.pose.slide_mm.any()


def test_what_rocked_comes_back_and_what_slid_stays() -> None:
    support = SupportSettings(rocks=True, slides=True, mu=0.1)
    state, _ = pressed(Tower((block(),)), (6.5, 0.0), support, side_mm=(0.0, 3.0), mu=0.6)
    assert state.pose.rock_rad.any()
    slide = state.pose.slide_mm.copy()
    for height in np.linspace(-1.0, 1.0, 15):
        state, solved = advance_probes(state, np.array([[0.0, 3.0, height]]), 0.1)
    assert solved.pressing_n[0] == 0.0
    assert not state.pose.rock_rad.any()
    assert slide[0, 0, 1] > 0.1
    assert np.abs(state.pose.slide_mm - slide).max() < 0.5


def test_a_body_topples_once_its_centre_of_mass_is_over_the_edge() -> None:
    stand = support_stack(Tower((block(),)), BOTH)
    for angle, falls in ((0.299, False), (0.301, True)):
        pose = SupportMotion(np.array([[[angle, 0.0]]]), np.zeros((1, 1, 2)))
        assert topples(stand, pose)[0] == falls  # 6 mm beside the middle, 20 mm high


def test_the_weights_of_a_tower_agree_with_the_judge() -> None:
    rng = np.random.default_rng(3)
    catalogue = load_pieces()
    short, long = catalogue.bottom("short"), catalogue.bottom("long")
    towers = [Tower((short.body(), long.body(tuple(rng.uniform(-12, 12, 2))))) for _ in range(60)]
    towers = [t for t in towers if TOO_CLOSE_MM <= abs(judge_tower(t).margin_mm) < np.inf]
    stands = join_support_stacks([support_stack(t, BOTH) for t in towers])
    falls = topples(stands, SupportMotion.upright(len(towers), 2))
    np.testing.assert_array_equal(falls, [not judge_tower(t).stands for t in towers])


def test_a_face_of_its_own_carries_like_one_within_a_wider_face() -> None:
    tower = Tower((load_pieces().bottom("short").body(),))
    table = join_support_stacks([support_stack(tower, BOTH)] * 200).area
    wider = replace(table, grown_mm=np.add(table.grown_mm, (0.0, 40.0)))
    points = np.random.default_rng(2).uniform(-25.0, 25.0, (200, 1, 2))
    for mine, other in zip(table.nearest(points), wider.nearest(points), strict=True):
        np.testing.assert_array_equal(mine, other)


@pytest.mark.parametrize(
    ("face", "diameter_mm", "at_mm", "corners"),
    [
        (regions.ring(24.0, 14.0), 20.0, (1.0, 0.5), 1),  # as smooth as the edge of a disc
        (regions.ring(24.0, 14.0), 20.0, (4.0, 1.0), 40),
        (regions.feet([(9.0, 0.0), (-4.5, 7.8), (-4.5, -7.8)], 6.0), 16.0, (5.0, 0.0), 20),
        (regions.channel(20.0, 18.0, 5.0), 18.0, (3.0, -2.0), 4),
    ],
)
def test_a_bottom_with_gaps_carries_within_the_hull_of_its_contact(
    face, diameter_mm, at_mm, corners
) -> None:
    lower = Body("gaps", face, face, 30.0, 30.0, 15.0)
    disc = circle(diameter_mm)
    tower = Tower((lower, Body("disc", disc, disc, 30.0, 30.0, 15.0, at_mm=at_mm)))
    stand = support_stack(tower, SupportSettings(rocks=True))
    assert stand is not None
    assert stand.area.core_mm.shape[-2] >= corners
    if corners == 1:
        assert stand.area.core_mm.shape[-2] == 1
    cuts = [interface_overlap(tower, k) for k in range(2)]
    for points in np.random.default_rng(4).uniform(-14.0, 14.0, (30, 1, 2, 2)):
        foot, _ = stand.area.nearest(points)
        away = np.hypot(*(foot - points)[0].T)
        margins = [signed_distances_mm(points[0, k] + at_mm, cuts[k]) for k in range(2)]
        assert away == pytest.approx(np.maximum(-np.array(margins), 0.0), abs=0.02)


def test_fixed_bottoms_and_settings_that_are_off_have_no_stand() -> None:
    catalogue = load_pieces()
    assert support_stack(Tower((catalogue.bottom("circle15").body(),)), BOTH) is None
    assert support_stack(Tower((catalogue.bottom("short").body(),)), SupportSettings()) is None
    on_board = Tower((catalogue.bottom("circle25").body(), catalogue.bottom("short").body()))
    stand = support_stack(on_board, BOTH)
    assert stand is not None
    assert stand.interfaces == 1


def test_a_slide_moves_all_that_stands_above_it() -> None:
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("short").body(), catalogue.bottom("long").body((2.0, 0.0))))
    moved = slide_bottoms(tower, np.array([[1.0, 0.0], [0.0, 0.5]]))
    assert [body.at_mm for body in moved.bodies] == [(1.0, 0.0), (3.0, 0.5)]


def test_episodes_are_the_same_bytes_where_the_supports_hold_still() -> None:
    tower = Tower((load_pieces().bottom("short").body(),))
    rigid = everything(simulate_episodes(plan(bottom="short", episodes=8)))
    off = everything(simulate_episodes(plan(bottom="short", episodes=8, bottoms=tower)))
    np.testing.assert_array_equal(rigid.observation, off.observation)
    disc = Body("disc", circle(200.0), circle(20.0), 1.0, 1e6, 0.5)
    settings = SimulationSettings(support=SupportSettings(rocks=True, slides=True, mu=5.0))
    heavy = plan(bottom="short", episodes=8, bottoms=Tower((disc,)), settings=settings)
    still = everything(simulate_episodes(heavy))
    np.testing.assert_allclose(still.observation, rigid.observation, atol=1e-4)


def test_no_press_on_free_bottoms_is_harder_than_a_spring_can_make_it() -> None:
    """A failed search must not leave its last forces, which would trip the arm."""
    catalogue, settings = load_pieces(), SimulationSettings.model_validate({"preset": "hard"})
    tower = Tower((catalogue.bottom("long").body(),))
    piece = catalogue.top("mushroom")
    scenes = [Scene(piece, tower, (0.0, 0.0), seed, settings) for seed in range(24)]
    places = draw_offset(np.random.default_rng(5), piece.face, tower.bodies[0].upper, len(scenes))
    seen = []

    def watched(*args, **more):
        seen.append(press_batch(*args, **more))
        return seen[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lockstep.pressing, "press_batch", watched)
        felt = lockstep.BatchedTrials(scenes).press(range(len(scenes)), places)
    wrench = seen[0].timeline.values[:, :, :6]
    assert np.isfinite(wrench).all()
    assert (
        wrench[:, :, 2].max() < LARGEST_FORCE_RATIO * 5.22 * 1.6
    )  # series stiffness times depth: reference 3.1
    assert (felt.detected & felt.truth.solved).mean() > 0.85
    assert (np.hypot(*np.moveaxis(seen[0].state.pose.rock_rad, -1, 0)) > 1e-4).mean() > 0.3


# Scenes in which the supports pass a state without equilibrium: they tip about another edge, or the
# face loses its hold.
SNAPPING = [(("short", "long"), 46), (("long",), 12)]


def unsteady_scene(bottoms: tuple[str, ...], seed: int) -> Scene:
    catalogue, rng = load_pieces(), np.random.default_rng([seed, 77])
    tower = draw_tower(rng, [catalogue.bottom(name) for name in bottoms])
    piece = catalogue.top("barrel")
    return Scene(piece, tower, draw_start(rng, piece.body(), tower), seed, FREE)


@pytest.mark.parametrize(("bottoms", "seed"), SNAPPING)
def test_a_press_beside_the_edge_ends_in_balance(bottoms, seed) -> None:
    """On the devices, in cycles of 10 ms, and in the batch."""
    scene = unsteady_scene(bottoms, seed)
    holding = HeldPiece(scene, 0, ProbeSettings().grip_force_n)
    holding.begin_probe(ProbeSettings())
    command = start_command_mm(scene)
    rocked = 0.0
    for height in np.arange(0.1, -0.6, -0.02):
        command[2] = holding.touch_height_mm + height
        if holding._state is not None:
            # Undivided steps: the sliders move once a cycle.
            holding._state = replace(holding._state, splits=0)
        before = holding._state
        holding.solve(command, 0.01)
        rocked = max(rocked, np.abs(holding._state.pose.rock_rad).max())
        if before is not None and rocked > 0.0:
            check_balance(scene.bottoms, before, holding._state, height)
    assert holding.residual <= RESIDUAL_LIMIT
    assert rocked > 1e-4
    bench = lockstep.BatchedTrials([scene])
    assert bench.press([0], bench.start_commands_mm()).truth.solved[0]


def test_the_whole_step_is_tried_where_its_halves_have_no_equilibrium() -> None:
    catalogue = load_pieces()
    piece = catalogue.top("pot")
    bottoms = [catalogue.bottom("short"), catalogue.bottom("rect12x28")]
    rng = start_generator(4_722_002, piece.name, *(bottom.name for bottom in bottoms))
    tower = draw_tower(rng, bottoms)
    scene = Scene(piece, tower, draw_start(rng, piece.body(), tower), 4_722_002, FREE)
    bench = lockstep.BatchedTrials([scene])
    assert bench.press([0], bench.start_commands_mm()).truth.solved[0]


def check_balance(tower: Tower, before: ContactState, after: ContactState, height: float) -> None:
    """Compare one step with the roots that scipy finds of statics written out for two discs.

    The unknowns are the motion of the piece and the rocking; nothing slides in these presses.
    """
    assert np.abs(after.pose.slide_mm).max() < 1e-9
    conditions, cells = before.conditions, before.cells
    spring = springs(conditions, before.relaxed, 0.01)
    unloaded = spring.hidden.copy()
    unloaded[:, :, :3] += after.slip
    zero = elastic_zero(np.array([[0.0, 0.0, height]]), unloaded, conditions.width_mm)[0]
    origin = np.array(tower.bodies[-1].at_mm)
    floors = np.cumsum([0.0, *(body.height_mm for body in tower.bodies)])
    r = np.stack([cells.x[0], cells.y[0], np.full_like(cells.x[0], cells.r_z[0])], axis=1)
    pivot = np.array([*before.pivot_mm[0], floors[-1] - cells.r_z[0]])
    discs = []
    for k, body in enumerate(tower.bodies):
        below = tower.bodies[max(k - 1, 0)]
        radii = body.lower.radius_mm, (below.upper if k else body.lower).radius_mm
        discs.append(
            [
                (np.array(b.at_mm) - origin, radius)
                for b, radius in zip((body, below), radii, strict=True)
            ]
        )

    def left_over(x):
        q, rocks = x[:6], x[6:].reshape(-1, 2) / 1e3
        ride = np.zeros_like(r)
        edges = [foremost(pair, rock) for pair, rock in zip(discs, rocks, strict=True)]
        for rock, edge, floor in zip(rocks, edges, floors, strict=False):
            about = np.array([-rock[1], rock[0], 0.0])
            ride += np.cross(about, pivot + r - np.array([*edge, floor]))
        u = q[:3] + np.cross(q[3:], r) - ride
        normal = cells.normal[0] * np.maximum(cells.gap_mm[0] - u[:, 2], 0.0)
        pull = -cells.tangential[0][:, None] * (u[:, :2] - before.anchor[:, 0].T)
        size = np.maximum(np.hypot(*pull.T), 1e-12)
        pull *= np.minimum(1.0, cells.mu[0] * normal / size)[:, None]
        force = np.column_stack([pull, normal])
        wrench = np.r_[force.sum(axis=0), np.cross(r, force).sum(axis=0)]
        found = [(wrench - spring.matrix_diagonal[0] * (q - zero)) * RESIDUAL_SCALE]
        # The face moves over the supports; the resultants are in the axes of the table.
        shift = q[:2] + cells.r_z[0] * np.array([q[4], -q[3]])
        points = pivot + r + np.array([*shift, 0.0])
        for k, floor in enumerate(floors[:-1]):
            arm = points - np.array([0.0, 0.0, floor])
            load, moment = normal.sum(), np.cross(arm, -force).sum(axis=0)
            for body, base in list(zip(tower.bodies, floors[:-1], strict=True))[k:]:
                weight = 9.81e-3 * body.mass_g
                lean = sum(
                    rocks[i] * (base + body.com_height_mm - floors[i])
                    for i in range(tower.bodies.index(body) + 1)
                )
                at = np.array(body.centre_mm) - origin + lean
                load += weight
                moment += np.cross([*at, 0.0], [0.0, 0.0, -weight])
            centre = np.array([moment[1], -moment[0]]) / load
            centre -= sum(rocks[i] * (floor - floors[i]) for i in range(k))
            found.append(0.4 * (centre - nearest_in_both(discs[k], centre + 1e3 * rocks[k])))
        return np.concatenate(found)

    ours = np.r_[after.q[0], 1e3 * after.pose.rock_rad[0].ravel()]
    assert np.linalg.norm(left_over(ours)) < 1e-4
    found = root(left_over, ours + 1e-5 * np.cos(np.arange(len(ours))), tol=1e-10)
    assert found.success
    np.testing.assert_allclose(found.x, ours, atol=2e-4)


def nearest_in_both(discs, point):
    """Nearest point in the overlap of two discs."""
    (a, r), (b, s) = discs

    def onto(centre, radius):
        away = point - centre
        return centre + away * min(1.0, radius / max(np.hypot(*away), 1e-12))

    for foot, (other, reach) in ((onto(a, r), (b, s)), (onto(b, s), (a, r))):
        if np.hypot(*(foot - other)) <= reach + 1e-9:
            return foot
    return min(crossings(discs), key=lambda p: np.hypot(*(p - point)))


def foremost(discs, direction):
    """Point of the overlap of two discs that is farthest along ``direction``."""
    size = np.hypot(*direction)
    if size == 0.0:
        return discs[0][0]
    return nearest_in_both(discs, discs[0][0] + 1e7 * direction / size)


def crossings(discs):
    (a, r), (b, s) = discs
    apart = np.hypot(*(b - a))
    along = (b - a) / apart
    near = (apart**2 + r**2 - s**2) / (2 * apart)
    side = np.sqrt(r**2 - near**2) * np.array([-along[1], along[0]])
    return [a + near * along + side, a + near * along - side]


def test_devices_and_batch_rock_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = SimulationSettings.model_validate(
        {"preset": "off", "spread": {"tilt_rad": 0.012}, "support": {"rocks": True, "slides": True}}
    )
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("long").body(),))
    scene = Scene(catalogue.top("pot"), tower, (5.0, -3.0), 4, settings)
    seen = []

    def watched(*args, **more):
        seen.append(press_batch(*args, **more))
        return seen[-1]

    monkeypatch.setattr(lockstep.pressing, "press_batch", watched)
    bench = lockstep.BatchedTrials([scene])
    felt = bench.press([0], bench.start_commands_mm())
    batch = seen[0].state
    rock = batch.pose.rock_rad[0, 0]
    assert np.hypot(*rock) > 5e-4
    holding = HeldPiece(scene, 0, ProbeSettings().grip_force_n)
    holding.begin_probe(ProbeSettings())
    command = start_command_mm(scene)
    for depth in np.linspace(-0.5, -batch.depth_mm[0], 150):
        command[2] = holding.touch_height_mm - depth
        values = holding.solve(command, 0.01)
    assert values[:3] == pytest.approx(seen[0].timeline.values[0, -1, :3], abs=0.02)
    assert holding._state.pose.rock_rad[0, 0] == pytest.approx(rock, abs=2e-5)
    assert holding.offset_mm(command) == pytest.approx(felt.truth.offset_mm[0], abs=1e-3)


def test_in_air_only_the_weights_are_felt() -> None:
    piece = held_piece_load(21.0, (0.0, 0.0, 33.0), 30.0, (0.4, -0.2))
    gripper = Load(1.5, (0.0, 0.0, 60.0))
    total = piece.wrench_g() + gripper.wrench_g()
    assert total[2] == pytest.approx(-(1.5 + 0.021) * 9.80665)
    # The piece's centre of mass lies 0.4 mm to -x of the pivot: its weight turns about +y.
    np.testing.assert_allclose(total[[3, 4, 5]], [0.0, -0.4 * 0.021 * 9.80665, 0.0], atol=1e-12)
    assert piece.position_mm == pytest.approx((-0.4, 0.0, 33.0 - 30.0 + 0.2))


def test_a_lateral_force_below_the_sensor_turns_it() -> None:
    at_wrist = wrist_wrench(np.array([2.0, 3.0, 5.0, 10.0, 20.0, 30.0]), 120.0)
    arm = np.array([0.0, 0.0, -120.0])
    torque = np.array([10.0, 20.0, 30.0]) + np.cross(arm, [2.0, 3.0, 5.0])
    np.testing.assert_allclose(at_wrist, [2.0, 3.0, 5.0, *(1e-3 * torque)])


def test_a_turned_sensor_keeps_lengths_and_the_vertical() -> None:
    wrench = np.array([[2.0, 3.0, 5.0, 10.0, 20.0, 30.0]])
    plain, turned = wrist_wrench(wrench, 120.0)[0], wrist_wrench(wrench, 120.0, np.pi / 2)[0]
    np.testing.assert_allclose(turned[:3], [plain[1], -plain[0], plain[2]], atol=1e-12)
    np.testing.assert_allclose(turned[3:], [plain[4], -plain[3], plain[5]], atol=1e-12)


def test_a_sensor_out_of_place_measures_the_same_force_about_another_point() -> None:
    force, torque = np.array([2.0, 3.0, 5.0]), np.array([10.0, 20.0, 30.0])
    wrench, lever = np.concatenate([force, torque])[None], np.array([[0.7, -0.4, 1.5]])
    found = wrist_wrench(wrench, 120.0, np.array([0.0]), lever)[0]
    about = torque + np.cross([0.7, -0.4, -121.5], force)
    np.testing.assert_allclose(found, [*force, *(1e-3 * about)])


def test_cables_pull_by_their_stiffness_times_the_travel() -> None:
    stiff = np.array([[0.01, 0.0, 0.002], [0.0, 0.0, -0.004], [0.0, 0.003, 0.005]])
    found = cable_wrench(stiff, np.array([10.0, -20.0, -5.0]), 60.0)
    force = np.array([0.09, 0.02, -0.085])
    np.testing.assert_allclose(found, [*force, -60.0 * force[1], 60.0 * force[0], 0.0], atol=1e-12)


def test_centre_of_pressure_of_a_single_force_is_its_point() -> None:
    point, force, lever = np.array([3.0, -2.0, -33.0]), np.array([0.5, -0.3, 7.0]), 153.0
    wrench_g = np.concatenate([force, np.cross(point, force)])
    found = centre_of_pressure_mm(wrist_wrench(wrench_g, 120.0), lever)
    np.testing.assert_allclose(found, point[:2])
    assert np.isnan(centre_of_pressure_mm(np.zeros(6), lever)).all()
