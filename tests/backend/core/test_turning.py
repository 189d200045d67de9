"""Turns of the hand against scipy, and how far it may lean."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from backend.core.flow import Pose
from backend.core.turning import (
    room_to_tilt_rad,
    tilt_rad,
    turn_about,
    turn_of,
    turned_rad,
    vector_of,
)

RNG = np.random.default_rng(5)


def test_a_turn_and_its_vector_are_those_of_scipy():
    for vector in RNG.normal(0.0, 1.0, (100, 3)):
        turn = turn_about(vector)
        assert turn == pytest.approx(Rotation.from_rotvec(vector).as_matrix(), abs=1e-12)
        back = Rotation.from_matrix(turn).as_rotvec()
        assert vector_of(turn) == pytest.approx(back, abs=1e-9)


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, math.pi - 1e-5, math.pi])
def test_tiny_and_half_turns_come_back(size):
    for axis in (*np.eye(3), np.array([0.6, 0.0, -0.8])):
        turn = turn_about(size * axis)
        assert turn_about(vector_of(turn)) == pytest.approx(turn, abs=1e-8)
        assert np.linalg.norm(vector_of(turn)) == pytest.approx(size, abs=1e-8)


def test_a_turn_about_z_leans_nothing():
    assert tilt_rad(turn_about(np.array([0.0, 0.0, 2.0]))) == pytest.approx(0.0, abs=1e-12)
    assert tilt_rad(turn_about(np.array([0.3, 0.0, 0.0]))) == pytest.approx(0.3)
    pose = Pose(1.0, 2.0, 3.0, 0.0, 0.0, 0.25)
    assert turned_rad(pose) == 0.25
    assert tilt_rad(turn_of(pose)) == pytest.approx(0.0, abs=1e-12)


def test_the_room_ends_where_the_lean_does():
    most = math.radians(15.0)
    for _ in range(200):
        lean = RNG.uniform(0.0, 0.99) * most
        heading = RNG.uniform(-math.pi, math.pi)
        turn = turn_about(np.array([0.0, 0.0, RNG.uniform(-3, 3)]))
        turn = turn_about(lean * np.array([math.cos(heading), math.sin(heading), 0.0])) @ turn
        axis = RNG.normal(0.0, 1.0, 3)
        axis /= np.linalg.norm(axis)
        room = room_to_tilt_rad(turn, axis, most)
        angles = np.linspace(0.0, min(room, 2 * math.pi), 60)
        leans = [tilt_rad(turn_about(angle * axis) @ turn) for angle in angles]
        assert max(leans) <= most + 1e-9
        if math.isfinite(room):
            assert leans[-1] == pytest.approx(most, abs=1e-9)


def test_at_the_limit_only_the_way_back_has_room():
    most = math.radians(15.0)
    x = np.array([1.0, 0.0, 0.0])
    turn = turn_about(most * x)
    assert room_to_tilt_rad(turn, x, most) == pytest.approx(0.0, abs=1e-9)
    assert room_to_tilt_rad(turn, -x, most) == pytest.approx(2 * most)
    beyond = turn_about(1.1 * most * x)
    assert room_to_tilt_rad(beyond, x, most) == 0.0
    assert room_to_tilt_rad(turn, np.array([0.0, 0.0, 1.0]), most) == math.inf
