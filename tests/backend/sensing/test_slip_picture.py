"""Position of the face in a picture, against pictures rendered for a known position."""

import cv2
import numpy as np
import pytest

from touchdown.backend.bench.assembly import make_scene
from touchdown.backend.config.simulation import SimulationSettings
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.requests import SceneChoice
from touchdown.backend.sensing.scene_camera import calibrate_scene_camera, observe_offset
from touchdown.backend.simulation.scene_camera import render_scene


@pytest.fixture(scope="module")
def face():
    return load_pieces().piece("pot").face.polygon(96)


@pytest.fixture(scope="module")
def board():
    """Calibrate with the piece in its jig, where it hides no dot."""
    return calibrate_scene_camera(drawn("pot", "circle15", (-80.0, 0.0)))


def drawn(piece, bottom, at_mm):
    """Return a picture of the piece pressed at a known place."""
    choice = SceneChoice(piece, (bottom,), 3, jig=True)
    scene = make_scene(load_pieces(), choice, SimulationSettings())
    return render_scene(scene, at_mm, 0.0, 0.0)


@pytest.mark.parametrize("bottom", ["circle15", "square15", "rect12x28"])
@pytest.mark.parametrize("at", [(0.0, 0.0), (6.0, -4.0), (-9.0, 5.0), (2.0, 9.0)])
@pytest.mark.parametrize("slip", [(0.0, 0.0), (1.0, 0.0), (-3.0, 0.5), (1.5, -2.0)])
def test_the_face_is_found_within_three_sigma(face, board, bottom, at, slip):
    true = np.add(at, slip)
    image = drawn("pot", bottom, tuple(true))
    _, packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])
    image = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    seen = observe_offset(image, board, face, np.array(at))
    assert seen is not None
    assert np.abs(seen.offset_mm - true).max() < 0.25
    assert np.hypot(*(seen.offset_mm - true)) < 3 * seen.sigma_mm
    assert seen.sigma_mm < 0.2


def test_noise_and_blur_move_it_little(face, board):
    image = drawn("pot", "circle15", (4.0, 3.0))
    rng = np.random.default_rng(3)
    blurred = cv2.GaussianBlur(image, (0, 0), 1.2).astype(float)
    noisy = np.clip(blurred + rng.normal(0, 6, image.shape), 0, 255).astype(np.uint8)
    seen = observe_offset(noisy, board, face, np.array([3.0, 3.0]))
    assert seen is not None
    assert np.abs(seen.offset_mm - (4.0, 3.0)).max() < 0.35


def test_without_a_piece_there_is_no_place(face, board):
    plain = np.full((480, 640, 3), 128, np.uint8)
    assert observe_offset(plain, board, face, np.zeros(2)) is None


def test_a_piece_that_is_farther_off_than_it_is_looked_for_is_not_measured_wrongly(face, board):
    image = drawn("pot", "circle15", (12.0, 0.0))
    seen = observe_offset(image, board, face, np.zeros(2))
    assert seen is None or np.hypot(*(seen.offset_mm - (12.0, 0.0))) < 3 * seen.sigma_mm
