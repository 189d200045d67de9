"""Wrench at the wrist sensor against statics in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.simulation.wrist_sensor import (
    Load,
    centre_of_pressure_mm,
    held_piece_load,
    wrist_wrench,
)


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


def test_centre_of_pressure_of_a_single_force_is_its_point() -> None:
    point, force, lever = np.array([3.0, -2.0, -33.0]), np.array([0.5, -0.3, 7.0]), 153.0
    wrench_g = np.concatenate([force, np.cross(point, force)])
    found = centre_of_pressure_mm(wrist_wrench(wrench_g, 120.0), lever)
    np.testing.assert_allclose(found, point[:2])
    assert np.isnan(centre_of_pressure_mm(np.zeros(6), lever)).all()
