from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.values import FloatArray
from touchdown.backend.placement.equilibrium import centre_of_pressure_mm, pressed_at_mm

# Bench reference, table of section 3.8 (mushroom on circle15): Fx Fy Fz in N, Tx Ty in N·m at the
# wrist, and the centre of pressure in mm. Grip height 33 mm, sensor 120 mm above the pivot.
TABLE = [
    ((0.215, 0.0, 7.794, 0.0, -0.0256), (-0.95, 0.0)),
    ((0.0, 0.297, 7.798, 0.0343, 0.0), (0.0, -1.43)),
    ((0.794, 0.0, 7.699, 0.0, -0.0943), (-3.53, 0.0)),
    ((0.589, 0.795, 7.692, 0.0918, -0.0699), (-2.62, -3.89)),
    ((-1.364, 0.558, 7.511, 0.0643, 0.1619), (6.22, -2.79)),
]


@pytest.mark.parametrize(("five", "expected"), TABLE)
def test_published_centres_of_pressure(
    five: tuple[float, ...], expected: tuple[float, float]
) -> None:
    wrench = np.array([*five, 0.0])
    # Moments are printed to 0.1 N·mm: 0.05 / 7.7 N and the rounding of the forces remain.
    np.testing.assert_allclose(centre_of_pressure_mm(wrench, 153.0), expected, atol=0.03)


def test_the_short_formula_would_mislead() -> None:
    wrench = np.array([*TABLE[2][0], 0.0])
    assert centre_of_pressure_mm(wrench, 0.0)[0] == pytest.approx(12.2, abs=0.06)


def test_forces_at_known_points() -> None:
    rng = np.random.default_rng(4)
    lever_mm = 150.0
    places = np.column_stack((rng.uniform(-10, 10, (6, 2)), np.full(6, -lever_mm)))
    pushes = np.column_stack((rng.normal(0, 1, (6, 2)), rng.uniform(0.5, 3, 6)))
    moment_nm = 1e-3 * np.cross(places, pushes).sum(axis=0)
    wrench = np.concatenate((pushes.sum(axis=0), moment_nm))
    expected = (places[:, :2] * pushes[:, 2:]).sum(axis=0) / pushes[:, 2].sum()
    np.testing.assert_allclose(centre_of_pressure_mm(wrench, lever_mm), expected, atol=1e-9)


def test_without_press_there_is_no_centre() -> None:
    assert np.isnan(centre_of_pressure_mm(np.zeros(6), 153.0)).all()
    assert np.isnan(centre_of_pressure_mm(np.full(6, np.nan), 153.0)).all()
    series = np.zeros((3, 6))
    series[1, 2] = 5.0
    assert np.isfinite(centre_of_pressure_mm(series, 153.0)[:, 0]).tolist() == [False, True, False]


def press(at_mm: tuple[float, float], offset: FloatArray | float = 0.0) -> FloatArray:
    """Wrench (20, 6) at a sensor 150 mm above the face: a force growing at ``at_mm`` of the face,
    with a lateral part; ``offset`` (6,) is what the tare left.
    """
    fz = np.linspace(0.4, 8.0, 20)
    fx, fy = 0.1 * fz, -0.05 * fz
    x, y = at_mm
    tx, ty = y * fz + 150.0 * fy, -x * fz - 150.0 * fx
    zero = np.zeros_like(fz)
    return np.stack([fx, fy, fz, 1e-3 * tx, 1e-3 * ty, zero], axis=1) + offset


def test_what_the_tare_left_does_not_move_the_centre_of_pressure() -> None:
    left = np.array([0.4, -0.4, 0.3, 0.02, -0.03, 0.0])
    assert pressed_at_mm(press((-3.0, 2.0)), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert pressed_at_mm(press((-3.0, 2.0), left), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert np.isnan(pressed_at_mm(0.2 * press((0.0, 0.0)), 150.0)).all()
