"""Face centre and yaw of the sensor against closed forms, and coverage by repeated noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from touchdown.backend.calibration.estimators import (
    FELT_SIGMA_MM,
    FORCE_SIGMA_N,
    estimate_payload,
    estimate_tool,
    estimate_wrist,
)
from touchdown.backend.calibration.result import CalibrationEstimate
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.simulation.wrist_sensor import wrist_wrench

FACE, BOTTOM = np.array([0.4, -0.3]), np.array([1.2, 2.5])
LEANS = np.radians([[0, 0, 0], [14, 0, 0], [-14, 0, 0], [0, 14, 0], [0, -14, 0], [10, 10, 0]])
TURNS = Rotation.from_rotvec(LEANS).as_matrix()
BIAS = np.array([0.8, -1.2, 2.5, 0.03, -0.02, 0.01])


def leaning(yaw: float) -> np.ndarray:
    """Return the readings of a biased sensor rotated by ``yaw``, pose by pose."""
    rows = []
    for turn in TURNS:
        force = turn.T @ [0.0, 0.0, -1.5 * 9.80665]
        at_g = np.concatenate([force, np.cross([1.0, 2.0, 60.0], force)])
        rows.append(wrist_wrench(at_g, 120.0, yaw) + BIAS)
    return np.array(rows)


def scores_of(found: CalibrationEstimate, truth) -> list[float]:
    return [(q.value - t) / q.sigma for q, t in zip(found.quantities, truth, strict=True)]


def test_the_face_centre_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(6)
    scores = []
    for _ in range(400):
        grips = BOTTOM - FACE + FELT_SIGMA_MM * rng.standard_normal((5, 2))
        found = estimate_tool(BOTTOM + 0.1 * rng.standard_normal(2), 0.1, grips)
        scores.append(scores_of(found, FACE))
    assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()


def test_grips_that_scatter_are_not_accepted() -> None:
    scattered = BOTTOM - FACE + np.array([[0.0, 0.0], [0.6, 0.0], [0.0, -0.6]])
    assert not estimate_tool(BOTTOM, 0.1, scattered).acceptable


@pytest.mark.parametrize("yaw", [0.0, 0.02, -0.5, 1.6, 3.0])
def test_the_yaw_of_the_sensor_is_found_whatever_its_bias(yaw) -> None:
    found = estimate_wrist(TURNS, leaning(yaw))
    assert found.value("yaw_rad") == pytest.approx(yaw, abs=1e-9)
    assert found.value("mass_kg") == pytest.approx(1.5)
    assert found.residual < 1e-9
    assert bool(found.obstacle) == (abs(yaw) > 0.1)


def test_a_turned_sensor_is_no_payload() -> None:
    assert estimate_payload(TURNS, leaning(0.0)).acceptable
    assert not estimate_payload(TURNS, leaning(0.2)).acceptable


def test_the_yaw_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    perfect = leaning(0.02)
    scores = []
    for _ in range(400):
        noisy = perfect + FORCE_SIGMA_N * rng.standard_normal(perfect.shape)
        scores.append(scores_of(estimate_wrist(TURNS, noisy), [0.02, 1.5]))
    assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()


def test_too_little_is_refused_by_name() -> None:
    level = np.tile(np.eye(3), (6, 1, 1))
    for call, reason in (
        (lambda: estimate_tool(BOTTOM, 0.1, np.zeros((2, 2))), "GRIPS"),
        (lambda: estimate_wrist(TURNS[:5], leaning(0.0)[:5]), "POSES"),
        (lambda: estimate_wrist(level, leaning(0.0)), "DEGENERATE"),
    ):
        with pytest.raises(RefusedError) as refused:
            call()
        assert refused.value.reason == reason
