"""Mass, centre of mass and bias against closed forms, and coverage by repeated noise."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from touchdown.backend.calibration.estimators import (
    FORCE_SIGMA_N,
    MOMENT_SIGMA_NM,
    estimate_level_payload,
    estimate_payload,
)
from touchdown.backend.core.faults import RefusedError

MASS_KG, COM_MM = 1.5, np.array([3.0, -2.0, -60.0])
BIAS = np.array([0.8, -1.2, 2.5, 0.03, -0.02, 0.01])
LEANS = np.radians([[0, 0, 0], [20, 0, 0], [-20, 0, 0], [0, 20, 0], [0, -20, 0], [14, 14, 0]])
TURNS = Rotation.from_rotvec(LEANS).as_matrix()


def readings(turns: np.ndarray) -> np.ndarray:
    """Return the readings of a perfect sensor with a bias, pose by pose."""
    rows = []
    for turn in turns:
        force = turn.T @ [0.0, 0.0, -MASS_KG * 9.80665]
        rows.append(np.concatenate([force, np.cross(1e-3 * COM_MM, force)]) + BIAS)
    return np.array(rows)


def test_perfect_readings_give_the_truth() -> None:
    found = estimate_payload(TURNS, readings(TURNS))
    values = np.array([q.value for q in found.quantities])
    np.testing.assert_allclose(values, [MASS_KG, *COM_MM, *BIAS], atol=1e-9)
    assert found.residual < 1e-9
    assert found.acceptable


def test_the_uncertainties_cover_the_truth_as_often_as_they_say() -> None:
    rng = np.random.default_rng(1)
    sigma = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)
    truth, perfect = np.array([MASS_KG, *COM_MM, *BIAS]), readings(TURNS)
    scores = []
    for _ in range(400):
        found = estimate_payload(TURNS, perfect + sigma * rng.standard_normal(perfect.shape))
        values = np.array([q.value for q in found.quantities])
        scores.append((values - truth) / [q.sigma for q in found.quantities])
    inside = (np.abs(scores) < 1.0).mean(axis=0)
    # 68.3 %, give or take four standard deviations of 400 draws.
    assert (np.abs(inside - 0.683) < 0.093).all()
    assert np.abs(np.mean(scores, axis=0)).max() < 4.0 / np.sqrt(400)


def test_the_covariance_is_that_of_repeated_measurements() -> None:
    rng = np.random.default_rng(2)
    sigma = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)
    perfect = readings(TURNS)
    values = [
        [q.value for q in estimate_payload(TURNS, noisy).quantities]
        for noisy in perfect + sigma * rng.standard_normal((600, *perfect.shape))
    ]
    told = estimate_payload(TURNS, perfect).covariance
    size = np.sqrt(np.diag(told))
    np.testing.assert_allclose(np.cov(np.array(values).T) / np.outer(size, size),
                               told / np.outer(size, size), atol=0.18)  # fmt: skip


def test_a_cable_that_pulls_in_one_pose_is_not_accepted() -> None:
    pulled = readings(TURNS)
    pulled[2, 0] += 1.0
    found = estimate_payload(TURNS, pulled)
    assert found.residual > 0.3
    assert not found.acceptable


@pytest.mark.parametrize(
    ("turns", "reason"),
    [
        (TURNS[:5], "POSES"),
        (np.tile(np.eye(3), (6, 1, 1)), "DEGENERATE"),
        # About the vertical nothing changes for gravity.
        (Rotation.from_euler("z", np.arange(6)[:, None]).as_matrix(), "DEGENERATE"),
    ],
)
def test_poses_that_do_not_tell_are_refused(turns, reason) -> None:
    with pytest.raises(RefusedError) as refused:
        estimate_payload(turns, readings(turns))
    assert refused.value.reason == reason


def test_a_reading_that_is_no_number_is_refused() -> None:
    broken = readings(TURNS)
    broken[0, 0] = np.nan
    for estimate in (
        lambda: estimate_payload(TURNS, broken),
        lambda: estimate_level_payload(broken),
    ):
        with pytest.raises(RefusedError, match="NOT-FINITE"):
            estimate()


def test_a_wrong_sign_is_named() -> None:
    assert "ft.sign" in estimate_payload(TURNS, -readings(TURNS)).obstacle
    with pytest.raises(RefusedError, match=r"ft\.sign"):
        estimate_level_payload(-readings(np.tile(np.eye(3), (6, 1, 1))))


def test_a_level_hand_gives_mass_and_place_in_the_plane_and_says_what_it_leaves_open() -> None:
    level = readings(np.tile(np.eye(3), (6, 1, 1))) - BIAS
    found = estimate_level_payload(level)
    assert [q.name for q in found.quantities] == ["mass_kg", "com_x_mm", "com_y_mm"]
    np.testing.assert_allclose([q.value for q in found.quantities], [MASS_KG, *COM_MM[:2]])
    assert found.acceptable
    assert "height" in found.note
    assert not estimate_level_payload(level + BIAS).acceptable


def test_the_covariance_of_a_level_hand_covers() -> None:
    rng = np.random.default_rng(3)
    sigma = np.repeat([FORCE_SIGMA_N, MOMENT_SIGMA_NM], 3)
    level = readings(np.tile(np.eye(3), (6, 1, 1))) - BIAS
    scores = []
    for _ in range(400):
        found = estimate_level_payload(level + sigma * rng.standard_normal(level.shape))
        errors = np.array([q.value for q in found.quantities]) - [MASS_KG, *COM_MM[:2]]
        scores.append(errors / [q.sigma for q in found.quantities])
    assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()
