"""Rotations of the hand against scipy, and the margin of its tilt."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from touchdown.backend.core.rotations import (
    pose_rotation,
    rotation_angle_rad,
    rotation_from_vector,
    rotation_vector,
    tilt_margin_rad,
    tilt_rad,
)
from touchdown.backend.core.values import Pose

RNG = np.random.default_rng(5)


def test_a_turn_and_its_vector_are_those_of_scipy():
    for vector in RNG.normal(0.0, 1.0, (100, 3)):
        turn = rotation_from_vector(vector)
        assert turn == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-12)
        back = Rotation.from_matrix(turn).as_rotvec()
        assert rotation_vector(turn) == pytest.approx(back, abs=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, math.pi - 1e-5, math.pi])
def test_tiny_and_half_turns_come_back(size):
    for axis in (*np.eye(3), np.array([0.6, 0.0, -0.8])):
        turn = rotation_from_vector(size * axis)
        assert rotation_from_vector(rotation_vector(turn)) == pytest.approx(turn, abs=1e-8)
        assert np.linalg.norm(rotation_vector(turn)) == pytest.approx(size, abs=1e-8)


def test_a_turn_about_z_leans_nothing():
    assert tilt_rad(rotation_from_vector(np.array([0.0, 0.0, 2.0]))) == pytest.approx(
        0.0, abs=1e-12
    )
    assert tilt_rad(rotation_from_vector(np.array([0.3, 0.0, 0.0]))) == pytest.approx(0.3)
    pose = Pose(1.0, 2.0, 3.0, 0.0, 0.0, 0.25)
    assert rotation_angle_rad(pose) == 0.25
    assert tilt_rad(pose_rotation(pose)) == pytest.approx(0.0, abs=1e-12)


def test_the_room_ends_where_the_lean_does():
    most = math.radians(15.0)
    for _ in range(200):
        lean = RNG.uniform(0.0, 0.99) * most
        heading = RNG.uniform(-math.pi, math.pi)
        turn = rotation_from_vector(np.array([0.0, 0.0, RNG.uniform(-3, 3)]))
        turn = (
            rotation_from_vector(lean * np.array([math.cos(heading), math.sin(heading), 0.0]))
            @ turn
        )
        axis = RNG.normal(0.0, 1.0, 3)
        axis /= np.linalg.norm(axis)
        room = tilt_margin_rad(turn, axis, most)
        angles = np.linspace(0.0, min(room, 2 * math.pi), 60)
        leans = [tilt_rad(rotation_from_vector(angle * axis) @ turn) for angle in angles]
        assert max(leans) <= most + 1e-9
        if math.isfinite(room):
            assert leans[-1] == pytest.approx(most, abs=1e-9)


def test_at_the_limit_only_the_way_back_has_room():
    most = math.radians(15.0)
    x = np.array([1.0, 0.0, 0.0])
    turn = rotation_from_vector(most * x)
    assert tilt_margin_rad(turn, x, most) == pytest.approx(0.0, abs=1e-9)
    assert tilt_margin_rad(turn, -x, most) == pytest.approx(2 * most)
    beyond = rotation_from_vector(1.1 * most * x)
    assert tilt_margin_rad(beyond, x, most) == 0.0
    assert tilt_margin_rad(turn, np.array([0.0, 0.0, 1.0]), most) == math.inf
