"""Limits of the marker tracker: what is damage, what is in reach, what is carried on."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from touchdown.backend.core.values import (
    FINGERS,
    MarkerField,
    MarkerState,
    Recording,
    TactileFrame,
)
from touchdown.backend.sensing.damaged_frames import DamageCheckingTracker, shifted_along_rows
from touchdown.backend.sensing.detector import Blobs, Detector, order_grid
from touchdown.backend.sensing.episode import assemble_episode
from touchdown.backend.sensing.tracker import HiddenMarkers, nearest_dots

REST_PX = 30.0 + 30.0 * np.stack(np.meshgrid(np.arange(9.0), np.arange(7.0)), axis=-1).reshape(
    -1, 2
)
MIDDLE = 3 * 9 + 4
GREY = np.full((240, 320, 3), 120, np.uint8)


class ToldTracker:
    """A marker tracker that sees what it is told."""

    def __init__(self) -> None:
        self.looks = np.full((63, 2), 50.0)
        self.position, self.state = REST_PX.copy(), np.full(63, MarkerState.SEEN, np.uint8)

    def remember(self) -> None:
        return None

    def recall(self, memory: None) -> None:
        return None

    def track(self, frame: TactileFrame) -> MarkerField:
        at, state = self.position.copy(), self.state.copy()
        return MarkerField("left", frame.sequence, frame.t_s, at, at - REST_PX, state, 1.0)


class Watched:
    """The check of damage around a ``ToldTracker``."""

    def __init__(self) -> None:
        self.told, self.checked, self.count = ToldTracker(), DamageCheckingTracker("left"), 0
        self.checked.tracker = self.told  # type: ignore[assignment]

    def refuses(self, moved: dict[int, tuple[float, float]], unseen: tuple[int, ...] = ()) -> bool:
        """Show one picture with some markers moved from rest and some unseen."""
        self.told.position, self.told.state[:] = REST_PX.copy(), MarkerState.SEEN
        for marker, step in moved.items():
            self.told.position[marker] += step
        self.told.state[list(unseen)] = MarkerState.INFERRED
        self.count += 1
        frame = TactileFrame("left", self.count, 0.04 * self.count, GREY, from_jpeg=True)
        return self.checked.track(frame) is None


@pytest.mark.parametrize(
    ("step", "refused"), [((0.0, 3.0), False), ((0.0, 4.5), True), ((-4.5, 0.0), True)]
)
def test_a_marker_that_leaves_its_neighbours_is_damage(step, refused) -> None:
    watched = Watched()
    assert not watched.refuses({})
    assert watched.refuses({MIDDLE: step}) is refused


def test_all_markers_may_not_jump_at_once() -> None:
    # A smooth jump away from the first markers: only its size tells that it is damage.
    share = np.clip(np.arange(63) // 9 / 3.0, 0.0, 1.0)
    jump = {k: (0.0, 7.6 * float(share[k])) for k in range(63)}
    watched = Watched()
    assert not watched.refuses({})
    assert watched.refuses(jump)


def test_a_marker_that_is_not_seen_cannot_be_torn_from_its_neighbours() -> None:
    watched = Watched()
    assert not watched.refuses({}, unseen=(MIDDLE,))
    assert not watched.refuses({MIDDLE: (0.0, 5.0)}, unseen=(MIDDLE,))
    assert not watched.refuses({MIDDLE: (0.0, 0.0)})


def test_a_marker_is_steady_after_three_pictures_in_a_row() -> None:
    watched = Watched()
    for unseen in ((MIDDLE,), (), (), (MIDDLE,)):
        assert not watched.refuses({}, unseen=unseen)
    for unseen in ((), (), ()):
        assert not watched.refuses({}, unseen=unseen)
    assert watched.refuses({}, unseen=(MIDDLE,))


def test_a_row_that_slides_along_itself_is_damage_and_one_across_is_not() -> None:
    along, across = np.zeros((2, 63, 2))
    along[18:27, 0] = -1.2
    across[18:27, 1] = 1.2
    assert shifted_along_rows(along)
    assert not shifted_along_rows(across)
    along[18:27, 0] = 0.7
    assert not shifted_along_rows(along)


def test_a_dot_at_the_end_of_the_reach_is_in_reach() -> None:
    dots = np.array([[13.0, 14.0]])
    assert nearest_dots(np.array([[10.0, 10.0]]), dots, 5.0).tolist() == [0]
    assert nearest_dots(np.array([[10.0, 10.0]]), dots, 4.999).tolist() == [-1]


@pytest.mark.parametrize("dots", [1, 2])
def test_false_dots_outside_the_grid_are_left_over(dots: int) -> None:
    outside = REST_PX[8 : 8 + 9 * dots : 9] + np.array([30.0, 0.0])
    ordered = order_grid(Blobs(np.concatenate([REST_PX, outside]), np.ones(63 + dots, dtype=bool)))
    assert ordered.report.complete
    np.testing.assert_array_equal(ordered.index, np.arange(63))


def test_a_hidden_marker_keeps_its_deviation_to_both_sides() -> None:
    for step in ((2.0, -1.5), (-3.0, 0.0)):
        hidden, seen = HiddenMarkers(REST_PX), np.ones(63, dtype=bool)
        position = REST_PX + np.array([4.0, -3.0])
        position[MIDDLE] += step
        hidden.fill(position, seen)
        seen = seen.copy()
        seen[MIDDLE] = False
        found = hidden.fill(position, seen)
        np.testing.assert_allclose(found[MIDDLE], position[MIDDLE], atol=1e-9)


def test_a_hidden_marker_keeps_at_most_eight_pixels() -> None:
    hidden, seen = HiddenMarkers(REST_PX), np.ones(63, dtype=bool)
    position = REST_PX + np.array([4.0, -3.0])
    smooth = position[MIDDLE].copy()
    position[MIDDLE] += [12.0, -16.0]
    hidden.fill(position, seen)
    seen = seen.copy()
    seen[MIDDLE] = False
    np.testing.assert_allclose(hidden.fill(position, seen)[MIDDLE] - smooth, [4.8, -6.4], atol=1e-9)


def test_the_centre_of_a_slanted_dot_does_not_depend_on_the_start() -> None:
    dot = np.zeros((8 * 240, 8 * 320), np.float32)
    cv2.ellipse(dot, (1296, 950), (64, 32), 40.0, 0.0, 360.0, 1.0, -1)
    dark = cv2.GaussianBlur(cv2.resize(dot, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), 1.0)
    detector = Detector()
    detector.look(np.dstack([(180.0 * (1.0 - 0.7 * dark)).astype(np.uint8)] * 3))
    away = np.array([[0.0, 0.0], [2.0, 1.0], [-2.0, 2.0], [3.0, -3.0], [4.0, 0.0], [0.0, -4.0]])
    found = detector.refine(np.array([161.5, 118.25]) + away).position_px
    np.testing.assert_allclose(found, np.broadcast_to([161.5, 118.25], found.shape), atol=0.1)
    assert np.ptp(found, axis=0).max() < 0.01


@pytest.mark.parametrize(("after_s", "missing"), [(4.74, 0), (6.0, 3), (7.05, 0)])
def test_frames_missing_outside_the_probe_do_not_count(after_s: float, missing: int) -> None:
    """The probe lasts from 5 to 7 s; after ``after_s`` three numbers of each finger are missing."""
    rest, seen = np.zeros((63, 2)), np.zeros(63, np.uint8)
    fields = [
        MarkerField(finger, k + 3 * (t_s > after_s), t_s, rest + 100.0, rest, seen, 1.0)
        for finger in FINGERS
        for k, t_s in enumerate((4.713 + 0.04 * np.arange(60)).tolist())
    ]
    t_s, pose_t_s = 4.7 + 1e-3 * np.arange(2400), 4.7 + 0.01 * np.arange(240)
    wrench, pose_mm = np.full((2400, 6), 5.0), np.full((240, 3), 30.0)
    recording = Recording(t_s, wrench, tuple(fields), (), pose_t_s, pose_mm, np.zeros(6))
    episode = assemble_episode(recording, onset_s=5.0, offset_mm=np.array([3.0, -1.0]), piece="pot")
    assert episode.quality.dropped_frames == 2 * missing
