"""The tracker on the real pictures and clips."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.backend.sensing.known_truth import GELSIGHT, plain_detector
from touchdown.backend.core.values import MarkerState
from touchdown.backend.sensing.picture_files import read_pictures
from touchdown.backend.sensing.tracker import MarkerTracker

LARGE = (
    "artificial_strawberry_exp2_camera_0.avi",
    "plug_3D_exp3_camera_2.avi",
    "screw_driver_red_exp1_camera_2.avi",
    "avocado_real_exp1_camera_2.avi",
    "blue_box_exp2_camera_2.avi",
)
SMALL = ("artificial_strawberry_exp2_camera_2.avi", "plug_3D_exp3_camera_0.avi")


def ordered_independently(dots: np.ndarray) -> np.ndarray:
    """Rows by v, which must be apart, then columns by u: no lattice and no tracking."""
    by_row = dots[np.argsort(dots[:, 1])].reshape(7, 9, 2)
    assert (by_row[1:, :, 1].min(axis=1) > by_row[:-1, :, 1].max(axis=1)).all()
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def test_rest_frame_has_the_published_places() -> None:
    table = np.loadtxt(GELSIGHT / "rest_positions.csv", delimiter=",", skiprows=1)
    frame = next(read_pictures(GELSIGHT / "nocontact_train_sensor.png"))
    field = MarkerTracker("left").track(frame)
    assert (field.state == MarkerState.SEEN).all()
    assert field.quality == 1.0
    away = np.linalg.norm(field.position_px - table[:, 2:], axis=1)
    assert away.max() <= 0.3


def test_pressed_cuboid_frame_shows_63() -> None:
    frame = next(read_pictures(GELSIGHT / "cuboid_10-2-284.png"))
    tracker = MarkerTracker("left")
    field = tracker.track(frame)
    assert (field.state == MarkerState.SEEN).all()
    assert tracker.grid.complete
    assert "63" in tracker.grid.message
    independent = ordered_independently(plain_detector(frame.image))
    assert np.linalg.norm(field.position_px - independent, axis=1).max() < 2.0


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_450_frames_without_a_swap(name: str) -> None:
    tracker = MarkerTracker("left")
    seen, near, compared = [], 0, 0
    for frame in read_pictures(GELSIGHT / name):
        field = tracker.track(frame)
        seen.append(int((field.state == MarkerState.SEEN).sum()))
        assert (field.state != MarkerState.LOST).all()
        grid = field.position_px.reshape(7, 9, 2)
        assert np.diff(grid[:, :, 0], axis=1).min() > 16
        assert np.diff(grid[:, :, 1], axis=0).min() > 16
        if frame.sequence % 10 == 0:
            dots = plain_detector(frame.image)
            own = field.position_px[field.state == MarkerState.SEEN]
            near += int((cKDTree(dots).query(own)[0] <= 1.0).sum())
            compared += len(own)
            same = ordered_independently(dots)
            assert np.linalg.norm(field.position_px - same, axis=1).max() < 2.0
    assert len(seen) == 450
    assert seen[0] == 63
    assert np.sum(seen) >= 0.99 * 63 * 450
    assert near >= 0.98 * compared


@pytest.mark.parametrize("name", SMALL)
def test_small_dot_gel_is_named_and_never_misread(name: str) -> None:
    tracker = MarkerTracker("left")
    for frame in read_pictures(GELSIGHT / name):
        field = tracker.track(frame)
        assert field.quality == 0.0
        assert (field.state == MarkerState.LOST).all()
        assert "8x10 small-dot gel recognised" in tracker.grid.message
        if frame.sequence == 100:
            break


def test_sixty_starts_give_the_same_bits() -> None:
    frame = next(read_pictures(GELSIGHT / LARGE[0]))
    starts = {MarkerTracker("left").track(frame).position_px.tobytes() for _ in range(60)}
    assert len(starts) == 1


@pytest.mark.parametrize("gain", [0.75, 1.25])
def test_light_does_not_move_markers(gain: float, tmp_path: Path) -> None:
    picture = cv2.imread(str(GELSIGHT / "nocontact_train_sensor.png"))
    lit = tmp_path / "lit.png"
    cv2.imwrite(str(lit), np.clip(gain * picture, 0, 255).astype(np.uint8))
    plain = next(read_pictures(GELSIGHT / "nocontact_train_sensor.png"))
    before = MarkerTracker("left").track(plain).position_px
    after = MarkerTracker("left").track(next(read_pictures(lit))).position_px
    assert np.sqrt(((after - before) ** 2).sum(axis=1).mean()) < 0.05
