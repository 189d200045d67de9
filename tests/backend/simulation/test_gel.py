"""The marker field of the simulated pads: rest grid, mirror, rotation, units."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.simulation.marker_fields import build_gel

GEL = build_gel((0.058, 0.058))
NONE = np.zeros((1, 2, 3))
FORCE = np.array([10.0])


def field(strain, normal=10.0):
    moved = GEL.displacement_px(strain, np.full((1, 2), normal), FORCE)
    return moved[0].reshape(2, 7, 9, 2)


def test_rest_grid_is_ordered_as_displayed_on_both_fingers() -> None:
    rest = GEL.rest_px.reshape(2, 7, 9, 2)
    assert (np.diff(rest[..., 0], axis=2) > 30).all()
    assert (np.diff(rest[..., 1], axis=1) > 30).all()
    np.testing.assert_allclose(rest[:, 3, 4], [[160, 120], [160, 120]])


def test_no_strain_no_motion() -> None:
    assert not field(NONE).any()


def test_a_shift_along_x_is_mirrored_and_a_rise_is_not() -> None:
    strain = NONE.copy()
    strain[..., 0], strain[..., 1] = 0.1, 0.5
    left, right = field(strain)
    np.testing.assert_allclose(left[3, 4], [0.1 / 0.058, -0.5 / 0.058])
    np.testing.assert_allclose(right[3, 4], [-0.1 / 0.058, -0.5 / 0.058])


def test_torsion_turns_the_flat_middle_rigidly() -> None:
    strain = NONE.copy()
    strain[..., 2] = 0.01
    left, right = field(strain)
    # +Z above the centre moves to +X: to the right on the left camera, to the left on the other.
    phi = np.exp(-((1.9 / 6.0) ** 4))
    assert left[2, 4, 0] == pytest.approx(0.01 * 1.9 / 0.058 * phi)
    assert right[2, 4, 0] == pytest.approx(-left[2, 4, 0])
    assert left[3, 5, 1] == pytest.approx(0.01 * 1.9 / 0.058 * np.exp(-((1.9 / 7.0) ** 4)))


def test_a_firmer_grip_spreads_the_markers() -> None:
    left, right = field(NONE, normal=12.0)
    for spread in (left, right):
        assert spread[3, 8, 0] == pytest.approx(0.01 * 4 * 1.9 * 0.2 / 0.058)
        assert spread[0, 4, 1] == pytest.approx(-0.01 * 3 * 1.9 * 0.2 / 0.058)


def test_each_sensor_has_its_own_scale() -> None:
    strain = NONE.copy()
    strain[..., 1] = 0.58
    both = build_gel((0.058, 0.0725)).displacement_px(strain, np.full((1, 2), 10.0), FORCE)
    np.testing.assert_allclose(both[0, :, 31, 1], [-10.0, -8.0])
