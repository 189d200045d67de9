"""Grip slip and hysteresis of the simulated grasp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from tests.backend.simulation.conftest import RAMP, Disc, Square, drive, lattice, plain
from touchdown.backend.geometry import FLAT, Surface
from touchdown.backend.simulation import contact, mechanics
from touchdown.backend.simulation.contact import RESIDUAL_LIMIT
from touchdown.backend.simulation.mechanics import GraspHistory, advance_probes, begin_probes

POINTS = lattice(25.4)
BOTTOM = Disc(15)


def random_offsets(rng, count, top_mm, bottom):
    points, kept = lattice(top_mm), []
    while len(kept) < count:
        offset = rng.uniform(-20, 20, 2)
        if bottom.contains(points + offset).sum() >= 6:
            kept.append(offset)
    return np.array(kept)


def offsets(count: int):
    return random_offsets(np.random.default_rng(0), count, 25.4, BOTTOM)


def shear_slip(slip):
    return np.hypot(slip[..., 0], slip[..., 1]).max(axis=-1)


@pytest.mark.parametrize(
    ("mu_grip", "force_n", "low", "high"),
    [
        (0.80, 10.0, 0.0, 0.0),
        (0.45, 10.0, 0.0, 0.15),
        (0.40, 10.0, 0.4, 0.8),
        (0.35, 10.0, 0.9, 1.0),
        (0.80, 5.0, 0.6, 0.9),
        (0.80, 4.0, 0.95, 1.0),
    ],
)
def test_share_of_slipping_probes_follows_the_published_table(mu_grip, force_n, low, high) -> None:
    made = plain(60, 33.0, mu_grip=mu_grip, grip_force_n=force_n)
    state, _ = drive(begin_probes(POINTS, BOTTOM, offsets(60), made), RAMP)
    share = (shear_slip(state.slip) > 0.02).mean()
    assert low <= share <= high


def test_slip_stops_on_the_limit_surface() -> None:
    made = plain(30, 33.0, mu_grip=0.35)
    _, solved = drive(begin_probes(POINTS, BOTTOM, offsets(30), made), RAMP)
    strain, normal = solved[-1].strain, solved[-1].normal_n
    force = strain * np.array([4.0, 4.0, 128.0])
    limit = 0.35 * normal
    phi = (force[..., 0] ** 2 + force[..., 1] ** 2) / limit**2
    phi += (force[..., 2] / (limit * 3.8)) ** 2
    assert phi.max() <= 1.0 + 1e-3
    assert phi.max() == pytest.approx(1.0, abs=1e-3)


def test_slip_stays_after_lifting_and_moves_the_next_touch() -> None:
    made = plain(1, 33.0, mu_grip=0.35)
    state, _ = drive(begin_probes(POINTS, BOTTOM, np.array([[5.0, 0.0]]), made), RAMP)
    state, (lifted,) = drive(state, [-3.0])
    assert shear_slip(lifted.slip)[0] > 0.05
    np.testing.assert_allclose(lifted.strain[..., :2], 0.0, atol=1e-9)
    again = begin_probes(POINTS, BOTTOM, np.array([[5.0, 0.0]]), made, previous=state)
    raised = float(again.slip[0, :, 1].mean())
    _, felt = drive(again, [-1.0, 0.9 * raised, 1.1 * raised + 0.05])
    assert felt[1].pressing_n[0] == pytest.approx(0.0, abs=0.05)
    assert felt[2].pressing_n[0] > 0.1


def test_slip_can_be_switched_off() -> None:
    made = plain(5, 33.0, mu_grip=0.35, slips=False)
    state, _ = drive(begin_probes(POINTS, BOTTOM, offsets(5), made), RAMP)
    assert not state.slip.any()


def test_a_hysteretic_gel_is_stiffer_at_first_and_then_relaxes() -> None:
    bottom = Disc(25)
    plain_gel, soft = plain(1, 30.0), plain(1, 30.0, alpha=0.1)
    forces = []
    for made in (plain_gel, soft):
        state = begin_probes(lattice(15.0), bottom, np.zeros((1, 2)), made)
        _, solved = drive(state, [1.5] * 60, dt_s=0.1)
        forces.append([s.pressing_n[0] for s in solved])
    elastic, creeping = forces
    assert creeping[0] > 1.03 * elastic[0]
    assert creeping[-1] == pytest.approx(elastic[-1], rel=1e-3)
    assert (np.diff(creeping) <= 1e-9).all()


def test_maxwell_step_equals_the_written_out_formula() -> None:
    made = plain(1, 30.0, alpha=0.2, relax_s=0.5)
    v, e, dt = 0.3, 0.7, 0.1
    relaxed = np.full((1, 2, 4), v)
    v_new = (v + dt / 0.5 * e) / (1 + dt / 0.5)
    np.testing.assert_allclose(mechanics.relax(relaxed, np.full((1, 2, 4), e), made, dt), v_new)
    spring = mechanics.springs(made, relaxed, dt)
    force = spring.finger[0, 0] * (e - spring.hidden[0, 0, 0])
    assert force == pytest.approx(4.0 * (1.2 * e - 0.2 * v_new))


def test_creep_adds_a_slower_branch_of_the_same_form() -> None:
    made = plain(1, 30.0, alpha=0.2, relax_s=0.5, creep=0.05, creep_s=8.0)
    fast, slow, e, dt = 0.3, -0.1, 0.7, 0.1
    relaxed = np.repeat([[[fast, slow]] * 2], 4, axis=2).reshape(1, 2, 8)
    after = [(v + dt / t * e) / (1 + dt / t) for v, t in ((fast, 0.5), (slow, 8.0))]
    found = mechanics.relax(relaxed, np.full((1, 2, 4), e), made, dt)
    np.testing.assert_allclose(found, np.repeat([[after] * 2], 4, axis=2).reshape(1, 2, 8))
    spring = mechanics.springs(made, relaxed, dt)
    force = spring.finger[0, 0] * (e - spring.hidden[0, 0, 0])
    assert force == pytest.approx(4.0 * (1.25 * e - 0.2 * after[0] - 0.05 * after[1]))


def test_a_domed_face_falls_away_with_the_square_of_the_radius() -> None:
    made = plain(2, 33.0, crown_rad=0.006)
    made.crown_rad[1] = -0.006
    flat = begin_probes(POINTS, Disc(60), np.zeros((2, 2)), plain(2, 33.0))
    domed = begin_probes(POINTS, Disc(60), np.zeros((2, 2)), made)
    r2 = flat.cells.x**2 + flat.cells.y**2
    reach = np.hypot(*POINTS.T).max()
    fall = 0.5 * 0.006 * r2 / reach
    np.testing.assert_allclose(domed.cells.gap_mm[0], -fall[0], atol=1e-12)
    np.testing.assert_allclose(domed.cells.gap_mm[1], fall[1] - fall[1].max(), atol=1e-12)
    assert not flat.cells.gap_mm.any()


def test_hysteresis_is_carried_to_the_next_probe_and_fades_in_air() -> None:
    made = plain(1, 33.0, alpha=0.1)
    state, _ = drive(begin_probes(POINTS, BOTTOM, np.array([[5.0, 0.0]]), made), RAMP)
    assert np.abs(state.relaxed).max() > 0.3
    again = begin_probes(POINTS, BOTTOM, np.array([[5.0, 0.0]]), made, previous=state)
    np.testing.assert_array_equal(again.relaxed, state.relaxed)
    rested = again
    for _ in range(50):
        rested, solved = advance_probes(rested, np.array([[0.0, 0.0, 3.0]]), 0.1)
    np.testing.assert_allclose(solved.strain, 0.0, atol=1e-3)
    np.testing.assert_allclose(rested.relaxed, 0.0, atol=1e-3)


def test_carried_grips_are_taken_and_put_back_by_row() -> None:
    kept = GraspHistory(np.arange(18.0).reshape(3, 2, 3), np.zeros((3, 2, 8)))
    rows = np.array([2, 0])
    back = kept.replaced(rows, kept.take(rows))
    np.testing.assert_array_equal(back.slip, kept.slip)
    fresh = kept.replaced(np.array([1]), GraspHistory.fresh(1))
    assert not fresh.slip[1].any()
    assert fresh.slip[0].any()


def test_conditions_of_one_probe_can_be_picked() -> None:
    made = replace(plain(3, 33.0), mu=np.array([0.3, 0.4, 0.5]))
    assert made.take(np.array([2])).mu == pytest.approx([0.5])


def rough(rng, count, grip_height_mm, **changes):
    """Return conditions with every mechanical nuisance on."""
    gel = np.clip(1 + 0.1 * rng.standard_normal(count), 0.7, 1.3)
    made = plain(count, grip_height_mm)
    return replace(
        made,
        shear_n_mm=4 * gel,
        normal_n_mm=10 * gel,
        torsion_nmm=128 * gel,
        mu=np.clip(0.4 + 0.06 * rng.standard_normal(count), 0.2, 0.6),
        mu_grip=np.clip(0.8 + 0.08 * rng.standard_normal(count), 0.35, 1.1),
        grip_force_n=10 + 0.3 * rng.standard_normal(count),
        grasp_offset_mm=0.5 * rng.standard_normal((count, 2)),
        tilt_rad=0.004 * rng.standard_normal((count, 2)),
        yaw_rad=0.0175 * rng.standard_normal(count),
        foundation_n_mm3=np.exp(rng.uniform(np.log(5), np.log(50), count)),
        **changes,
    )


@pytest.mark.parametrize(
    ("top_mm", "bottom"), [(25.4, Disc(15)), (21.2, Square(15)), (15.0, Disc(25))]
)
def test_random_probes_converge_within_the_sanity_bound(top_mm, bottom) -> None:
    rng = np.random.default_rng(11)
    made = rough(rng, 150, 33.0)
    offsets = random_offsets(rng, 150, top_mm, bottom)
    state, solved = drive(begin_probes(lattice(top_mm), bottom, offsets, made), RAMP)
    assert state.residual.max() <= 1e-6 < RESIDUAL_LIMIT
    series = 2 * made.shear_n_mm * 15 / (2 * made.shear_n_mm + 15)
    assert (solved[-1].pressing_n <= 1.3 * series * 1.5).all()
    assert (solved[-1].pressing_n > 0.5 * series * 1.5).all()


def test_forces_balance_the_springs_and_are_resultants_of_the_cells() -> None:
    rng = np.random.default_rng(3)
    made = rough(rng, 60, 33.0)
    state = begin_probes(POINTS, BOTTOM, random_offsets(rng, 60, 25.4, BOTTOM), made)
    before, _ = drive(state, RAMP[:-1])
    after, (end,) = drive(before, RAMP[-1:])
    spring = mechanics.springs(made, before.relaxed, 0.1)
    command = np.tile([0.0, 0.0, -1.5], (60, 1))
    unloaded = np.concatenate([after.slip, np.zeros((60, 2, 1))], axis=2)
    zero = mechanics.elastic_zero(command, unloaded, made.width_mm)
    from_springs = spring.matrix_diagonal * (end.q - zero)
    np.testing.assert_allclose(end.wrench_g, from_springs, atol=2e-5)
    # Newton by Newton, cell by cell: the sums written out without moments.
    cells = after.cells
    now = contact.contact_forces(cells, before.anchor, end.q)
    force = np.stack([-now.share * now.pull_x, -now.share * now.pull_y, now.normal_n], axis=-1)
    arm = np.stack([cells.x, cells.y, np.broadcast_to(cells.r_z[:, None], cells.x.shape)], -1)
    np.testing.assert_allclose(end.wrench_g[:, :3], force.sum(axis=1), atol=1e-9)
    np.testing.assert_allclose(end.wrench_g[:, 3:], np.cross(arm, force).sum(axis=1), atol=1e-8)


def test_friction_never_exceeds_coulomb() -> None:
    rng = np.random.default_rng(4)
    made = rough(rng, 40, 33.0)
    state = begin_probes(POINTS, BOTTOM, random_offsets(rng, 40, 25.4, BOTTOM), made)
    before, _ = drive(state, RAMP[:-1])
    _, (end,) = drive(before, RAMP[-1:])
    now = contact.contact_forces(before.cells, before.anchor, end.q)
    tangential = now.share * now.size
    assert (tangential <= made.mu[:, None] * now.normal_n + 1e-9).all()
    assert (now.share < 1.0).any()


def test_tangent_is_the_derivative_of_the_forces() -> None:
    rng = np.random.default_rng(5)
    made = rough(rng, 20, 33.0)
    bottom = Square(15)
    state = begin_probes(lattice(21.2), bottom, random_offsets(rng, 20, 21.2, bottom), made)
    state, (end,) = drive(state, [0.7])
    anchor = state.anchor + 0.002 * rng.standard_normal(state.anchor.shape)
    exact = contact.tangent_stiffness(
        state.cells, contact.contact_forces(state.cells, anchor, end.q)
    )
    step = 1e-7
    for axis in range(6):
        nudge = np.zeros(6)
        nudge[axis] = step
        up = contact.contact_forces(state.cells, anchor, end.q + nudge).wrench
        down = contact.contact_forces(state.cells, anchor, end.q - nudge).wrench
        scale = np.abs(exact[:, :, axis]).max(axis=1, keepdims=True)
        error = np.abs((up - down) / (2 * step) - exact[:, :, axis]) / scale
        # A cell that changes between stick and slide within the nudge spoils its probe only.
        assert np.quantile(error, 0.9) < 1e-5


def test_flat_punch_pressed_in_the_centre_has_uniform_pressure(press, shapes) -> None:
    state, solved = press(15.0, shapes[0](25.0), (0, 0))
    end = solved[-1]
    normal = contact.contact_forces(state.cells, state.anchor, end.q).normal_n[0]
    series = 8 * 15 / 23
    depth = 1.5 / (1 + series / (20 * 177))
    np.testing.assert_allclose(normal, normal[0], rtol=1e-9)
    np.testing.assert_allclose(end.wrench_g[0, 2], series * depth, rtol=1e-9)
    np.testing.assert_allclose(np.delete(end.wrench_g[0], 2), 0.0, atol=1e-9)


def test_centre_of_pressure_lies_in_the_hull_of_the_overlap() -> None:
    rng = np.random.default_rng(6)
    offsets = random_offsets(rng, 40, 25.4, BOTTOM)
    made = replace(rough(rng, 40, 33.0), yaw_rad=np.zeros(40))
    _, solved = drive(begin_probes(POINTS, BOTTOM, offsets, made), RAMP)
    for k in range(40):
        patch = POINTS[BOTTOM.contains(POINTS + offsets[k])]
        hull = ConvexHull(patch).equations
        # The centre of pressure counts from the pivot's axis, the face centre lies at -g_x.
        centre = solved[-1].cop_mm[k] + [made.grasp_offset_mm[k, 0], 0.0]
        assert (hull[:, :2] @ centre + hull[:, 2]).max() <= 1e-6


@pytest.mark.parametrize(("x", "y"), [(9.0, 3.0), (-5.0, 7.0)])
def test_mirrored_offsets_mirror_the_forces(x, y, press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), [(x, y), (-x, y), (x, -y)])
    wrench = solved[-1].wrench_g
    np.testing.assert_allclose(wrench[1], wrench[0] * [-1, 1, 1, 1, -1, -1], atol=1e-4)
    np.testing.assert_allclose(wrench[2], wrench[0] * [1, -1, 1, -1, 1, -1], atol=1e-4)


def test_without_friction_there_is_no_lateral_force(press, shapes) -> None:
    _, solved = press(25.4, shapes[0](15.0), [(9, 0), (-6, 7)], mu=0.0)
    np.testing.assert_allclose(solved[-1].wrench_g[:, [0, 1, 5]], 0.0, atol=1e-9)
    assert (solved[-1].wrench_g[:, 2] > 6.5).all()


def test_unloading_returns_to_zero_and_never_gains_energy(press, shapes) -> None:
    cycle = np.concatenate([np.linspace(0.05, 1.5, 30), np.linspace(1.45, -0.1, 32)])
    _, solved = press(25.4, shapes[0](15.0), [(9, 0), (7, 7), (-3, -10)], depths=cycle)
    np.testing.assert_allclose(solved[-1].wrench_g, 0.0, atol=1e-6)
    np.testing.assert_allclose(solved[-1].strain, 0.0, atol=1e-6)
    force = np.array([s.pressing_n for s in solved])
    depth = np.concatenate([[0.0], cycle])
    force = np.concatenate([np.zeros((1, 3)), force])
    work = (0.5 * (force[1:] + force[:-1]) * np.diff(depth)[:, None]).sum(axis=0)
    largest = (0.5 * (force[1:31] + force[:30]) * np.diff(depth)[:30, None]).sum(axis=0)
    assert (work >= -1e-4 * largest).all()
    assert (work <= 0.05 * largest).all()


def test_beside_the_bottom_nothing_is_felt(press, shapes) -> None:
    state, solved = press(15.0, shapes[0](15.0), (40, 0))
    assert state.cells.count[0] == 0
    np.testing.assert_allclose(solved[-1].wrench_g, 0.0, atol=1e-9)
    assert np.isnan(solved[-1].cop_mm).all()


def test_finer_time_steps_change_little(press, shapes) -> None:
    offsets = [(9, 0), (7, 7), (-12, 4), (2, -9)]
    _, coarse = press(25.4, shapes[0](15.0), offsets)
    _, fine = press(25.4, shapes[0](15.0), offsets, depths=np.linspace(0.01, 1.5, 150), dt_s=0.01)
    np.testing.assert_allclose(coarse[-1].wrench_g[:, :3], fine[-1].wrench_g[:, :3], atol=0.02)


def test_a_batch_gives_what_single_probes_give(press, shapes) -> None:
    offsets = [(9, 0), (-12, 4), (0, 0)]
    _, together = press(25.4, shapes[0](15.0), offsets)
    for k, offset in enumerate(offsets):
        _, alone = press(25.4, shapes[0](15.0), offset)
        np.testing.assert_allclose(together[-1].wrench_g[k], alone[-1].wrench_g[0], atol=1e-4)


def test_sideways_drag_in_contact_meets_friction(press, shapes) -> None:
    state, _ = press(15.0, shapes[0](25.0), (0, 0), slips=False)
    for x in np.linspace(0.5, 20.0, 40):
        state, dragged = advance_probes(state, np.array([[x, 0.0, -1.5]]), 0.1)
    force = dragged.wrench_g[0]
    assert force[0] == pytest.approx(-0.4 * force[2], rel=1e-6)


def gaps(offset_mm, surface: Surface, **changes):
    made = plain(1, 33.0, **changes)
    state = begin_probes(POINTS, Disc(60), np.array([offset_mm]), made, surfaces=[surface])
    return state.cells.gap_mm[0]


def test_a_tilted_support_is_felt_as_the_opposite_tilt_of_the_piece() -> None:
    tilted = gaps((4.0, -3.0), Surface(tilt_rad=(0.02, -0.01)))
    np.testing.assert_allclose(
        tilted, gaps((4.0, -3.0), FLAT, tilt_rad=(-0.02, 0.01)), rtol=0.0, atol=1e-12
    )


def test_a_step_and_a_dome_lie_where_the_support_is() -> None:
    at = POINTS + np.array([4.0, -3.0])
    step = gaps((4.0, -3.0), Surface(step_mm=0.4, step_line=(np.pi / 2, 0.5)))
    np.testing.assert_allclose(step, np.where(at[:, 1] >= 0.5, 0.0, -0.4), atol=1e-12)
    dome = gaps((4.0, -3.0), Surface(dome_mm=200.0))
    np.testing.assert_allclose(dome, -(at**2).sum(axis=1) / 400.0, atol=1e-12)


def test_the_pressure_is_on_the_higher_part_and_near_the_apex() -> None:
    made = plain(3, 33.0)
    surfaces = [FLAT, Surface(step_mm=0.5, step_line=(0.0, 6.5)), Surface(dome_mm=200.0)]
    state = begin_probes(POINTS, Disc(60), np.full((3, 2), (4.0, 0.0)), made, surfaces=surfaces)
    _, solved = drive(state, [0.1, 0.2, 0.3])
    flat, step, dome = solved[-1].cop_mm[:, 0]
    assert flat == pytest.approx(0.0, abs=0.3)
    assert step > 1.9
    assert dome < flat - 0.5
