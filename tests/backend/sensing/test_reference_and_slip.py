from __future__ import annotations

import numpy as np
import pytest

from tests.backend.sensing.known_truth import GELSIGHT
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.core.values import MarkerField, TactileFrame
from touchdown.backend.sensing.picture_files import read_pictures
from touchdown.backend.sensing.slip import fit_rigid, slip_mm
from touchdown.backend.sensing.tracker import MarkerTracker
from touchdown.backend.sensing.zeroing import TactileReference, shape_change_px, take_reference

ROW, COL = np.divmod(np.arange(63), 9)
GRID = np.stack([20 + 33.0 * COL, 18 + 32.0 * ROW], axis=1)


def made(
    position: np.ndarray, k: int = 0, *, hidden: int = 0, rest: np.ndarray | None = None
) -> MarkerField:
    state = np.zeros(63, np.uint8)
    state[:hidden] = 1
    moved = position - (GRID if rest is None else rest)
    return MarkerField("left", k, k / 25, position.copy(), moved.copy(), state, 1.0)


def still(count: int = 10, sigma: float = 0.03) -> list[MarkerField]:
    rng = np.random.default_rng(0)
    return [made(GRID + rng.normal(0, sigma, GRID.shape), k) for k in range(count)]


def test_reference_is_the_mean_with_the_noise_of_each_marker() -> None:
    fields = still(200)
    reference = take_reference(fields)
    np.testing.assert_allclose(reference.position_px, GRID, atol=0.01)
    np.testing.assert_allclose(reference.noise_px, 0.03, rtol=0.25)
    assert reference.frames == 200
    assert reference.t_s == fields[-1].t_s


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        (still(2), "frames"),
        ([*still(9), made(GRID, 9, hidden=1)], "markers"),
        ([made(GRID + 0.1 * k, k) for k in range(10)], "motion"),
    ],
)
def test_reference_is_refused(fields: list[MarkerField], reason: str) -> None:
    with pytest.raises(RefusedError) as refused:
        take_reference(fields)
    assert refused.value.reason == reason


def tracked(name: str) -> list[MarkerField]:
    image = next(read_pictures(GELSIGHT / name)).image
    tracker = MarkerTracker("left")
    return [tracker.track(TactileFrame("left", k, k / 25, image)) for k in range(10)]


@pytest.mark.promise("C7")
def test_a_pressed_gel_is_refused_against_the_stored_template() -> None:
    template = take_reference(tracked("nocontact_train_sensor.png"))
    with pytest.raises(RefusedError) as refused:
        take_reference(tracked("cuboid_10-2-284.png"), template)
    assert refused.value.reason == "contact"
    again = take_reference(tracked("nocontact_train_sensor.png"), template)
    np.testing.assert_allclose(again.position_px, template.position_px, atol=1e-9)


def test_moving_and_stretching_the_whole_grid_is_no_contact() -> None:
    stretch = np.array([[1.01, 0.02], [-0.02, 0.99]])
    moved = GRID @ stretch + [3.0, -2.0]
    assert shape_change_px(moved, GRID) == pytest.approx(0.0, abs=1e-9)
    template = TactileReference("left", 0.0, GRID.copy(), np.zeros(63), 10)
    take_reference([made(moved, k) for k in range(5)], template)


@pytest.mark.parametrize("turn", [-0.3, 0.002, 0.1])
def test_rigid_fit_finds_the_motion_it_was_made_of(turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    middle = GRID.mean(axis=0)
    moved = (GRID - middle) @ np.array([[c, s], [-s, c]]) + middle + [2.0, -1.0]
    motion = fit_rigid(GRID, moved - GRID)
    np.testing.assert_allclose(motion.shift_px, [2.0, -1.0], atol=1e-9)
    assert motion.turn_rad == pytest.approx(turn)
    assert motion.residual_px == pytest.approx(0.0, abs=1e-9)


def test_rigid_fit_leaves_shear_as_residual() -> None:
    gamma = 0.02
    shear = np.stack([gamma * (GRID[:, 1] - GRID[:, 1].mean()), np.zeros(63)], axis=1)
    # Simple shear is half turn and half pure shear: the residual is that of the pure half.
    x, y = (GRID - GRID.mean(axis=0)).T
    best = min(
        np.sqrt(((gamma * y + a * y) ** 2 + (a * x) ** 2).mean())
        for a in np.linspace(-0.02, 0.02, 4001)
    )
    assert fit_rigid(GRID, shear).residual_px == pytest.approx(best, rel=1e-3)


def test_slip_is_the_movement_between_two_fields_in_mm() -> None:
    before, after = made(GRID + np.array([1.0, 0.5])), made(GRID + np.array([4.0, 4.5]))
    assert slip_mm(before, after, 0.06) == pytest.approx(0.06 * 5.0)
    assert slip_mm(before, before, 0.06) == 0.0
    assert np.isnan(slip_mm(before, made(GRID, hidden=63), 0.06))
