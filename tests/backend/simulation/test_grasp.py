"""Grip slip and hysteresis of the simulated grasp."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.simulation.conftest import RAMP, Disc, drive, lattice, plain
from touchdown.backend.simulation import mechanics
from touchdown.backend.simulation.mechanics import GraspHistory, advance_probes, begin_probes

POINTS = lattice(25.4)
BOTTOM = Disc(15)


def offsets(count: int):
    rng = np.random.default_rng(0)
    kept = []
    while len(kept) < count:
        offset = rng.uniform(-20, 20, 2)
        if BOTTOM.contains(POINTS + offset).sum() >= 6:
            kept.append(offset)
    return np.array(kept)


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
    kept = GraspHistory(np.arange(18.0).reshape(3, 2, 3), np.zeros((3, 2, 4)))
    rows = np.array([2, 0])
    back = kept.replaced(rows, kept.take(rows))
    np.testing.assert_array_equal(back.slip, kept.slip)
    fresh = kept.replaced(np.array([1]), GraspHistory.fresh(1))
    assert not fresh.slip[1].any()
    assert fresh.slip[0].any()


def test_conditions_of_one_probe_can_be_picked() -> None:
    made = replace(plain(3, 33.0), mu=np.array([0.3, 0.4, 0.5]))
    assert made.take(np.array([2])).mu == pytest.approx([0.5])
