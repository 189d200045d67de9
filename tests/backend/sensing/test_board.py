"""The homography of the board: exact on exact points, within a pixel from a picture."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry.outlines import BOARD_DOTS_MM
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.sensing.scene_camera import (
    Homography,
    calibrate_scene_camera,
    fit_homography,
)
from touchdown.backend.simulation.scene_camera import camera_matrix, render_scene

TRUE = camera_matrix()[:, [0, 1, 3]] / camera_matrix()[2, 3]


@pytest.fixture(scope="module")
def scene():
    choice = SceneChoice("pot", ("circle25",), 3, jig=True)
    return make_scene(load_pieces(), choice, SimulationSettings())


def test_exact_points_give_the_homography_and_its_inverse() -> None:
    rng = np.random.default_rng(1)
    board = rng.uniform(-50, 50, (9, 2))
    seen = Homography(TRUE, 0.0).to_px(board)
    fitted = fit_homography(board, seen)
    np.testing.assert_allclose(fitted.matrix, TRUE, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(fitted.to_mm(fitted.to_px(board)), board, atol=1e-6)
    assert fitted.residual_px < 1e-8
    theirs, _ = cv2.findHomography(board, seen)
    np.testing.assert_allclose(fitted.matrix, theirs, rtol=1e-5, atol=1e-7)


def test_noisy_points_leave_a_residual() -> None:
    rng = np.random.default_rng(2)
    board = rng.uniform(-50, 50, (40, 2))
    seen = Homography(TRUE, 0.0).to_px(board) + rng.normal(0, 0.5, (40, 2))
    fitted = fit_homography(board, seen)
    assert 0.4 < fitted.residual_px < 0.9
    assert np.abs(fitted.to_mm(seen) - board).max() < 1.0


def test_a_picture_of_the_bench_is_a_calibration(scene) -> None:
    fitted = calibrate_scene_camera(render_scene(scene, (-80.0, 0.0), 0.0, 3.0))
    there = np.array([[0.0, 0.0], [12.5, 0.0], [0.0, -12.5], [-9.0, 9.0]])
    assert np.abs(fitted.to_px(there) - Homography(TRUE, 0.0).to_px(there)).max() < 0.5
    assert Homography.parse(fitted.text()).text() == fitted.text()


def test_the_face_is_drawn_where_the_homography_says(scene) -> None:
    fitted = calibrate_scene_camera(render_scene(scene, (-80.0, 0.0), 0.0, 3.0))
    with_piece = render_scene(scene, (6.0, -4.0), 0.0, 0.0).astype(int)
    without = render_scene(scene, (500.0, 0.0), 0.0, 0.0).astype(int)
    changed = np.argwhere(np.abs(with_piece - without).sum(axis=2) > 0)[:, ::-1]
    ring = np.array([6.0, -4.0]) + scene.piece.face.polygon(200)
    # The lowest edge of the piece in the picture is the near side of its face.
    lowest_px = fitted.to_px(ring)[:, 1].max()
    assert abs(changed[:, 1].max() - lowest_px) < 1.5


@pytest.mark.parametrize("points", [3, 0])
def test_too_few_points_are_refused(points) -> None:
    with pytest.raises(InputError, match="too few"):
        fit_homography(np.zeros((points, 2)), np.zeros((points, 2)))


def test_points_on_a_line_and_hidden_dots_are_refused(scene) -> None:
    line = np.column_stack([np.arange(6.0), 2 * np.arange(6.0)])
    with pytest.raises(InputError, match="line"):
        fit_homography(line, line)
    image = render_scene(scene, (-80.0, 0.0), 0.0, 3.0)
    x, y = Homography(TRUE, 0.0).to_px(BOARD_DOTS_MM[:1])[0].astype(int)
    hidden = image.copy()
    hidden[y - 30 : y + 30, x - 30 : x + 30] = 0
    with pytest.raises(InputError, match="3 dots are seen"):
        calibrate_scene_camera(hidden)


@pytest.mark.parametrize("text", ["", "{}", '{"matrix": [1], "residual_px": 0}',
                                  '{"matrix": [0,0,0,0,0,0,0,0,0], "residual_px": 0}'])  # fmt: skip
def test_a_damaged_homography_is_refused(text) -> None:
    with pytest.raises(InputError):
        Homography.parse(text)
