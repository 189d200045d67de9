"""Plane and edges against the fit of numpy and against clipped outlines."""

from __future__ import annotations

import numpy as np
import pytest
from shapely import affinity
from shapely.geometry import box

from touchdown.backend.calibration.estimators import (
    EDGE_SIGMA_MM,
    TouchedEdge,
    estimate_board,
    fit_edges,
    fit_plane,
)
from touchdown.backend.core.faults import RefusedError

PLACES = np.array([[0, 0], [4, 4], [-4, 4], [4, -4], [-4, -4]], dtype=float)
TOUCHES = np.column_stack([PLACES, 30.0 + 0.004 * PLACES[:, 0] - 0.002 * PLACES[:, 1]])


def felt_edges(
    centre, yaw_rad, board=(40.0, 36.0), piece=(15.0, 15.0), along=8.0
) -> list[TouchedEdge]:
    """Return where a piece that is pushed off the board loses it, by shapely and halving."""
    ground = affinity.translate(
        affinity.rotate(box(-board[0] / 2, -board[1] / 2, board[0] / 2, board[1] / 2),
                        yaw_rad, origin=(0, 0), use_radians=True), *centre)  # fmt: skip
    held = box(-piece[0] / 2, -piece[1] / 2, piece[0] / 2, piece[1] / 2)
    edges = []
    for axis in range(2):
        for side in (-1.0, 1.0):
            for off in (-along, along):
                inside, outside = 0.0, 60.0
                while outside - inside > 1e-6:
                    middle = 0.5 * (inside + outside)
                    place = [off, off]
                    place[axis] = side * middle
                    if affinity.translate(held, *place).intersects(ground):
                        inside = middle
                    else:
                        outside = middle
                edges.append(TouchedEdge(axis, side, off, side * inside))
    return edges


def test_the_plane_is_the_one_that_numpy_fits() -> None:
    rng = np.random.default_rng(0)
    touches = TOUCHES + np.array([0, 0, 0.05]) * rng.standard_normal(TOUCHES.shape)
    ours = fit_plane(touches)
    theirs = np.linalg.lstsq(np.column_stack([np.ones(5), PLACES]), touches[:, 2], rcond=None)[0]
    np.testing.assert_allclose(ours.solution.x, theirs)


def test_edges_of_a_board_that_is_off_and_turned_give_place_and_yaw() -> None:
    found = fit_edges(felt_edges((0.8, -1.3), 0.02), yaw=True)
    # The turned corner stands out by a part of the second order.
    np.testing.assert_allclose(found.x[:2], [0.8, -1.3], atol=0.03)
    assert found.x[4] == pytest.approx(0.02, abs=2e-4)
    assert np.abs(found.residuals).max() < 0.02


def test_the_place_covers_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(4)
    edges = felt_edges((0.0, 0.0), 0.0)
    scores = []
    for _ in range(400):
        noisy = [TouchedEdge(e.axis, e.side, e.along_mm, e.at_mm + EDGE_SIGMA_MM * n)
                 for e, n in zip(edges, rng.standard_normal(8), strict=True)]  # fmt: skip
        found = fit_edges(noisy, yaw=True)
        scores.append((found.x[[0, 1, 4]]) / np.sqrt(np.diag(found.covariance)[[0, 1, 4]]))
    assert (np.abs((np.abs(scores) < 1.0).mean(axis=0) - 0.683) < 0.093).all()


def test_a_board_is_one_estimate_with_its_larger_residual() -> None:
    edges = felt_edges((0.8, -1.3), 0.01)
    found = estimate_board(TOUCHES, edges, "board")
    assert found.acceptable
    assert found.value("z_mm") == pytest.approx(30.0 + 0.004 * 0.8 + 0.002 * 1.3, abs=1e-3)
    assert found.value("slope_x_rad") == pytest.approx(0.004)
    bent = TOUCHES.copy()
    bent[0, 2] += 0.5
    assert estimate_board(bent, edges, "board").residual > 0.1
    off = [*edges[:-1], TouchedEdge(1, 1.0, 8.0, edges[-1].at_mm + 1.0)]
    assert not estimate_board(TOUCHES, off, "board").acceptable


@pytest.mark.parametrize(("yaw", "way"), [(0.05, " clockwise"), (-0.05, "counter-clockwise")])
def test_a_bottom_that_is_turned_is_turned_back_not_accepted(yaw: float, way: str) -> None:
    found = estimate_board(TOUCHES, felt_edges((0.0, 0.0), yaw), "board")
    assert found.residual <= found.limit
    assert not found.acceptable
    assert "2.9°" in found.obstacle
    assert way in found.obstacle
    # Of a piece that is held askew the bottom knows nothing.
    assert estimate_board(TOUCHES, felt_edges((0.0, 0.0), yaw), "piece").obstacle == ""


def test_round_edges_tell_no_yaw() -> None:
    found = estimate_board(TOUCHES, felt_edges((0, 0), 0.0, along=0.0), "")
    assert "yaw_rad" not in [q.name for q in found.quantities]
    assert "No yaw" in found.note


def test_too_little_is_refused_by_name() -> None:
    edges = felt_edges((0, 0), 0.0)
    cases = [
        (lambda: fit_plane(TOUCHES[:3]), "TOUCHES"),
        (lambda: fit_plane(TOUCHES[[0, 1, 4, 1]]), "DEGENERATE"),
        (lambda: fit_edges(edges[:5], yaw=True), "EDGES"),
        (lambda: fit_edges([e for e in edges if e.side > 0] * 2, yaw=True), "DEGENERATE"),
        (lambda: fit_edges(felt_edges((0, 0), 0.0, along=0.0), yaw=True), "DEGENERATE"),
    ]
    for call, reason in cases:
        with pytest.raises(RefusedError) as refused:
            call()
        assert refused.value.reason == reason
