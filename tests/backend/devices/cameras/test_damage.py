"""Damage to a JPEG that the decoder does not notice: refused, or of no consequence.

A thousand of each kind, and native size, are figures of ``make bench``.
"""

from itertools import islice, pairwise

import cv2
import numpy as np
import pytest

from tests.backend.devices.cameras.damage import GELSIGHT, SCENES, outcomes
from tests.backend.sensing.known_truth import rest_dots
from touchdown.backend.core.values import MarkerState, TactileFrame
from touchdown.backend.sensing.damaged_frames import DamageCheckingTracker, neighbour_residual_px
from touchdown.backend.sensing.picture_files import read_pictures


@pytest.mark.promise("C4")
@pytest.mark.parametrize(
    ("kind", "off"), [("1 KiB lost", 0), ("64 bytes zeroed", 2), ("one bit", 3)]
)
def test_no_marker_is_wrong_after_damage_that_decodes(kind, off):
    found = outcomes(kind, 60, seed=1)
    assert found["wrong"] == 0
    assert found["off"] <= off
    if kind == "1 KiB lost":
        assert set(found) == {"bytes"}


@pytest.mark.promise("C4")
def test_whole_pictures_of_a_gel_that_slips_pass_but_for_a_few_and_never_two_fail_in_a_row():
    tracker, refused = DamageCheckingTracker("left"), []
    for frame in islice(read_pictures(GELSIGHT / "blue_box_exp2_camera_2.avi"), 380, 450):
        field = tracker.track(as_jpeg(frame))
        refused.append(field is None)
        assert field is None or (field.state == MarkerState.SEEN).all()
    assert tracker.refused == sum(refused) <= 5
    assert not any(a and b for a, b in pairwise(refused))


@pytest.mark.promise("C4")
def test_what_two_pictures_in_a_row_show_is_believed():
    image, rest = rest_dots()
    covered = image.copy()
    cv2.circle(covered, tuple(int(v) for v in rest[31]), 14, (120, 110, 105), -1)
    tracker = DamageCheckingTracker("left")
    fields = [
        tracker.track(TactileFrame("left", k, 0.04 * k, picture, from_jpeg=True))
        for k, picture in enumerate([image] * 4 + [covered] * 3)
    ]
    assert [field is None for field in fields] == [False] * 4 + [True, False, False]
    assert fields[-1].state[31] == MarkerState.INFERRED
    assert tracker.refused == 1


def test_lamps_that_fail_and_return_leave_no_finger_blind():
    image, _ = rest_dots()
    black = np.full_like(image, 3)
    tracker = DamageCheckingTracker("left")
    fields = [
        tracker.track(TactileFrame("left", k, 0.04 * k, picture, from_jpeg=True))
        for k, picture in enumerate([black] * 3 + [image] * 4 + [black] * 3 + [image] * 4)
    ]
    assert not any(a is None and b is None for a, b in pairwise(fields))
    assert (fields[-1].state == MarkerState.SEEN).all()


@pytest.mark.promise("C4")
def test_after_a_refused_picture_it_goes_on_as_if_that_had_never_come():
    clip, at = SCENES[0]
    frames = list(islice(read_pictures(GELSIGHT / clip), at, at + 6))
    torn = frames[4].image.copy()
    torn[120:] = np.roll(torn[120:], 16, axis=1)
    with_it, without = DamageCheckingTracker("left"), DamageCheckingTracker("left")
    for k, frame in enumerate(frames):
        if k == 4:
            assert with_it.track(TactileFrame("left", k, frame.t_s, torn, from_jpeg=True)) is None
            continue
        one, other = with_it.track(as_jpeg(frame)), without.track(as_jpeg(frame))
        assert np.array_equal(one.position_px, other.position_px)
    assert (with_it.refused, without.refused) == (1, 0)


def test_pictures_that_were_no_jpeg_are_not_judged():
    image, _ = rest_dots()
    tracker = DamageCheckingTracker("left")
    for k, picture in enumerate([image] * 4 + [np.roll(image, 9, axis=1)]):
        assert tracker.track(TactileFrame("left", k, 0.04 * k, picture)) is not None


def test_an_affine_motion_leaves_no_neighbour_and_one_marker_alone_does():
    grid = np.stack(np.divmod(np.arange(63), 9)[::-1], axis=1).astype(float)
    even = grid @ np.array([[0.3, -0.1], [0.2, 0.4]]) + (3.0, -2.0)
    assert neighbour_residual_px(even).max() < 1e-9
    even[31] += (0.3, 0.4)
    assert neighbour_residual_px(even)[31] == pytest.approx(0.5)


def as_jpeg(frame):
    return TactileFrame("left", frame.sequence, frame.t_s, frame.image, from_jpeg=True)
