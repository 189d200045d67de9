"""Face centre and yaw of the sensor against closed forms, and coverage by repeated noise."""

from __future__ import annotations

import numpy as np
import pytest

from backend.calibration.estimate import Estimate
from backend.calibration.tool import FELT_SIGMA_MM, estimate_tool, estimate_turned_tool
from backend.calibration.wrist import MOMENT_SIGMA_NM, estimate_wrist
from backend.core.faults import RefusedError
from backend.simulation.wrench import wrist_wrench

FACE, BOTTOM = np.array([0.4, -0.3]), np.array([1.2, 2.5])
TURNS = np.radians([0.0, 90.0, 180.0, -90.0])
CENTRES = np.array([[-4.0, 0.0], [4.0, 0.0], [0.0, -4.0], [0.0, 4.0]])
LEVER_MM = 150.0


def felt() -> np.ndarray:
    rows = []
    for turn in TURNS:
        c, s = np.cos(turn), np.sin(turn)
        rows.append(BOTTOM - np.array([[c, -s], [s, c]]) @ FACE)
    return np.array(rows)


def pressed(yaw: float) -> np.ndarray:
    """Return tared wrenches at the sensor of presses with a little friction sideways."""
    rows = []
    for k, (x, y) in enumerate(CENTRES):
        force = np.array([0.4 * (-1) ** k, 0.3, 9.0 + k])
        at_g = np.concatenate([force, np.cross([x, y, -30.0], force)])
        rows.append(wrist_wrench(at_g, LEVER_MM - 30.0, yaw))
    return np.array(rows)


def scores_of(found: Estimate, truth) -> list[float]:
    return [(q.value - t) / q.sigma for q, t in zip(found.quantities, truth, strict=True)]


def test_turning_the_hand_tells_face_and_bottom_apart() -> None:
    found = estimate_turned_tool(TURNS, felt())
    np.testing.assert_allclose([q.value for q in found.quantities], [*FACE, *BOTTOM], atol=1e-12)
    assert found.acceptable
    moved = felt()
    moved[1] += 1.0
    assert not estimate_turned_tool(TURNS, moved).acceptable


def test_the_face_centre_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(6)
    turned, known = [], []
    for _ in range(400):
        noisy = felt() + FELT_SIGMA_MM * rng.standard_normal((4, 2))
        found = estimate_turned_tool(TURNS, noisy)
        turned.append(scores_of(found, [*FACE, *BOTTOM]))
        grips = BOTTOM - FACE + FELT_SIGMA_MM * rng.standard_normal((5, 2))
        found = estimate_tool(BOTTOM + 0.1 * rng.standard_normal(2), 0.1, grips)
        known.append(scores_of(found, FACE))
    for scores in (turned, known):
        assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()


def test_grips_that_scatter_are_not_accepted() -> None:
    scattered = BOTTOM - FACE + np.array([[0.0, 0.0], [0.6, 0.0], [0.0, -0.6]])
    assert not estimate_tool(BOTTOM, 0.1, scattered).acceptable


@pytest.mark.parametrize("yaw", [0.0, 0.02, -0.5, 1.6, 3.0])
def test_the_yaw_of_the_sensor_is_found_under_sideways_friction(yaw) -> None:
    found = estimate_wrist(CENTRES, pressed(yaw), LEVER_MM)
    assert found.value("yaw_rad") == pytest.approx(yaw, abs=1e-9)
    assert found.residual < 1e-9
    assert bool(found.obstacle) == (abs(yaw) > 0.1)


def test_the_yaw_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(7)
    perfect = pressed(0.02)
    scores = []
    for _ in range(400):
        noisy = perfect.copy()
        noisy[:, 3:5] += MOMENT_SIGMA_NM * rng.standard_normal((4, 2))
        found = estimate_wrist(CENTRES, noisy, LEVER_MM).quantities[0]
        scores.append((found.value - 0.02) / found.sigma)
    assert abs((np.abs(scores) < 1.0).mean() - 0.683) < 0.093


def test_too_little_is_refused_by_name() -> None:
    weak = pressed(0.0)
    weak[0, 2] = 0.2
    middle = np.zeros((4, 2))
    for call, reason in (
        (lambda: estimate_turned_tool(TURNS[:2], felt()[:2]), "TURNS"),
        (lambda: estimate_turned_tool(np.zeros(4), felt()), "DEGENERATE"),
        (lambda: estimate_tool(BOTTOM, 0.1, felt()[:2]), "GRIPS"),
        (lambda: estimate_wrist(CENTRES[:3], pressed(0.0)[:3], LEVER_MM), "PUSHES"),
        (lambda: estimate_wrist(CENTRES, weak, LEVER_MM), "WEAK-PUSH"),
        (lambda: estimate_wrist(middle, pressed(0.0), LEVER_MM), "DEGENERATE"),
    ):
        with pytest.raises(RefusedError) as refused:
            call()
        assert refused.value.reason == reason
