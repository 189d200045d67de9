""""""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.backend.sensing.known_truth import (
    SMEAR_BGR,
    Case,
    bump_field,
    rest_dots,
    shear_field,
    shots,
    true_places,
    warp,
)
from touchdown.backend.core.values import MarkerField, MarkerState, TactileFrame
from touchdown.backend.sensing import MarkerTracker, take_reference
from touchdown.backend.sensing.detector import Blobs, Detector, order_grid
from touchdown.backend.sensing.tracker import assign_remaining, misordered_markers, nearest_dots
from touchdown.backend.simulation import TactileRenderer, load_gel_appearance


def lattice(rows: int, cols: int, pitch: float = 32.0) -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1).reshape(-1, 2)
    return 20.0 + pitch * grid


def blobs(dots: np.ndarray, whole: np.ndarray | None = None) -> Blobs:
    whole = np.ones(len(dots), dtype=bool) if whole is None else whole
    return Blobs(dots, whole)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_order_is_geometry_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-0.08, 0.08)
    bend = 6 * np.sin(lattice(7, 9) / rng.uniform(60, 120) + rng.uniform(0, 6, 2))[:, ::-1]
    turned = lattice(7, 9) @ np.array([[1, turn], [-turn, 1]]) + bend
    shuffle = rng.permutation(63)
    ordered = order_grid(blobs(turned[shuffle]))
    assert ordered.report.complete
    np.testing.assert_array_equal(shuffle[ordered.index], np.arange(63))


def test_decoys_between_the_dots_are_left_over() -> None:
    rng = np.random.default_rng(3)
    dots = lattice(7, 9) + rng.normal(0, 1, (63, 2))
    decoys = lattice(6, 8) + 16.0
    ordered = order_grid(blobs(np.concatenate([decoys, dots])))
    np.testing.assert_array_equal(ordered.index, 48 + np.arange(63))


def test_missing_cells_are_named() -> None:
    assert order_grid(blobs(np.zeros((0, 2)))).report.rows == 0
    dots = np.delete(lattice(7, 9), [0, 9 * 3 + 4], axis=0)
    ordered = order_grid(blobs(dots))
    assert ordered.report.missing == ((0, 0), (3, 4))
    assert ordered.report.usable
    assert not ordered.report.complete
    assert "(0, 0), (3, 4)" in ordered.report.message
    assert (ordered.index == -1).sum() == 2


@pytest.mark.promise("C7")
@pytest.mark.parametrize(
    ("rows", "cols", "words"),
    [(8, 10, "8x10 small-dot"), (6, 9, "6 rows x 9"), (7, 8, "7 rows x 8"), (3, 3, "3 rows x 3")],
)
def test_other_grids_are_named_and_not_used(rows: int, cols: int, words: str) -> None:
    ordered = order_grid(blobs(lattice(rows, cols, 29.0)))
    assert not ordered.report.usable
    assert (ordered.index == -1).all()
    assert words in ordered.report.message


def test_cut_dots_give_the_grid_its_size_but_are_not_whole() -> None:
    dots = lattice(7, 9)
    whole = dots[:, 1] > dots[:, 1].min()
    ordered = order_grid(blobs(dots, whole))
    assert ordered.report.missing == tuple((0, col) for col in range(9))
    assert (ordered.index[:9] == -1).all()


def test_nearest_both_ways_is_one_to_one() -> None:
    rng = np.random.default_rng(5)
    places, dots = rng.uniform(0, 100, (63, 2)), rng.uniform(0, 100, (80, 2))
    owner = nearest_dots(places, dots, 8.0)
    taken = owner[owner >= 0]
    assert len(taken) == len(set(taken))
    for place, dot in zip(places, owner, strict=True):
        if dot >= 0:
            gaps = np.linalg.norm(dots - place, axis=1)
            assert gaps[dot] == gaps.min() <= 8.0
    assert (nearest_dots(places, np.zeros((0, 2)), 8.0) == -1).all()


def test_the_rest_is_shared_out_at_least_total_distance() -> None:
    places = np.array([[0.0, 0.0], [10.0, 0.0], [50.0, 50.0]])
    dots = np.array([[9.0, 0.0], [18.0, 0.0], [90.0, 90.0]])
    none = np.full(3, -1)
    np.testing.assert_array_equal(assign_remaining(none, places, dots, 12.0), [0, 1, -1])
    held = np.array([1, -1, -1])
    np.testing.assert_array_equal(assign_remaining(held, places, dots, 12.0), [1, 0, -1])


def test_exchanged_neighbours_are_out_of_order() -> None:
    dots = lattice(7, 9)
    assert not misordered_markers(dots).any()
    dots[[30, 31]] = dots[[31, 30]]
    assert misordered_markers(dots)[[30, 31]].all()
    assert not misordered_markers(dots)[:18].any()


COVERED = np.array([2 * 9 + 5, 2 * 9 + 6, 2 * 9 + 7, 3 * 9 + 3, 3 * 9 + 4, 3 * 9 + 8])


def frame(image: np.ndarray, k: int) -> TactileFrame:
    return TactileFrame("left", k, k / 25, image)


@pytest.fixture(scope="module")
def rest() -> tuple[np.ndarray, np.ndarray]:
    return rest_dots()


def smeared(line: np.ndarray, occluded: range) -> list[MarkerField]:
    tracker = MarkerTracker("left")
    noise = np.random.default_rng(7)
    moves = shots(Case(0.0, "occl"), noise, line=line, occluded=occluded)
    return [tracker.track(frame(shot.image, shot.k)) for shot in moves]


def test_states_go_from_seen_through_inferred_to_lost_and_back() -> None:
    fields = smeared(np.zeros(75), range(10, 70))
    state = np.stack([field.state for field in fields])[:, COVERED]
    # Frame 9 is the last one seen; lost from more than 2 s after it.
    assert (state[:10] == MarkerState.SEEN).all()
    assert (state[11:60] == MarkerState.INFERRED).all()
    assert (state[60:70] == MarkerState.LOST).all()
    assert (state[71:] == MarkerState.SEEN).all()
    assert fields[30].quality == pytest.approx(57 / 63)
    assert all(np.isfinite(field.position_px).all() for field in fields)
    others = np.delete(np.stack([field.state for field in fields]), COVERED, axis=1)
    assert (others == MarkerState.SEEN).all()


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((240, 320, 3), np.uint8),
        np.full((240, 320, 3), 255, np.uint8),
        np.random.default_rng(0).integers(0, 255, (240, 320, 3)).astype(np.uint8),
        np.zeros((240, 320), np.uint8),
        np.zeros((0, 0, 3), np.uint8),
        np.zeros((480, 640, 3), np.uint8),
        np.zeros((240, 320, 3), np.float32),
    ],
    ids=["black", "white", "noise", "grey", "empty", "large", "float"],
)
def test_a_bad_image_has_quality_zero_and_leaves_no_trace(
    image: np.ndarray, rest: tuple[np.ndarray, np.ndarray]
) -> None:
    good, _ = rest
    tracker = MarkerTracker("left")
    before = tracker.track(frame(good, 0))
    bad = tracker.track(frame(image, 1))
    after = tracker.track(frame(good, 2))
    assert bad.quality == pytest.approx(0.0, abs=0.05)
    assert (bad.state != MarkerState.SEEN).sum() >= 60
    np.testing.assert_array_equal(after.state, MarkerState.SEEN)
    np.testing.assert_allclose(after.position_px, before.position_px, atol=0.02)
    assert MarkerTracker("left").track(frame(image, 0)).quality == 0.0
    np.testing.assert_array_equal(good, rest_dots()[0], "the image is left as it was")


@pytest.mark.parametrize("amplitude", [15.0, 25.0, 36.0])
def test_one_jump_of_more_than_reach_keeps_identities(
    amplitude: float, rest: tuple[np.ndarray, np.ndarray]
) -> None:
    image, dots = rest
    tracker = MarkerTracker("left")
    tracker.track(frame(image, 0))
    for k in range(1, 8):
        field = tracker.track(frame(warp(image, shear_field, amplitude), k))
    truth = true_places(dots, shear_field, amplitude)
    assert np.linalg.norm(field.position_px - truth, axis=1).max() < 0.8


def test_displacement_counts_from_the_reference_and_not_before(
    rest: tuple[np.ndarray, np.ndarray],
) -> None:
    image, dots = rest
    tracker = MarkerTracker("right")
    still = [tracker.track(TactileFrame("right", k, k / 25, image)) for k in range(10)]
    assert (still[-1].displacement_px == 0).all()
    assert tracker.reference is None
    reference = take_reference(still)
    tracker.set_reference(reference)
    moved = tracker.track(TactileFrame("right", 10, 0.4, warp(image, bump_field, 6.0)))
    truth = true_places(dots, bump_field, 6.0) - dots
    assert moved.finger == "right"
    assert np.sqrt(((moved.displacement_px - truth) ** 2).sum(axis=1).mean()) < 0.05
    assert moved.residual_px > 0.5
    np.testing.assert_allclose(
        moved.displacement_px, moved.position_px - reference.position_px, atol=1e-9
    )


def test_dots_hidden_at_the_start_are_inferred_once_the_grid_is_certain() -> None:
    fields = smeared(np.zeros(20), range(10))
    _, dots = rest_dots()
    assert (fields[0].state[COVERED] != MarkerState.SEEN).all()
    away = np.linalg.norm(fields[0].position_px[COVERED] - dots[COVERED], axis=1)
    assert away.max() < 3.0
    assert (fields[-1].state == MarkerState.SEEN).all()
    assert np.linalg.norm(fields[-1].position_px - dots, axis=1).max() < 0.8


def test_a_recalled_state_is_that_of_before(rest: tuple[np.ndarray, np.ndarray]) -> None:
    image, dots = rest
    tracker, same, hidden = MarkerTracker("left"), MarkerTracker("left"), image.copy()
    for place in dots[COVERED]:
        cv2.circle(hidden, tuple(map(int, place)), 12, SMEAR_BGR, -1)
    for k in range(3):
        tracker.track(frame(image, k))
        same.track(frame(image, k))
    memory = tracker.remember()
    tracker.track(frame(hidden, 3))
    assert tracker._restless > same._restless
    tracker.recall(memory)
    assert tracker._restless == same._restless
    for k, picture in ((3, image), (4, hidden), (60, hidden)):
        ours, theirs = tracker.track(frame(picture, k)), same.track(frame(picture, k))
        assert np.array_equal(ours.position_px, theirs.position_px)
        assert np.array_equal(ours.state, theirs.state)
        assert ours.quality == theirs.quality


def test_a_centre_does_not_depend_on_where_it_was_looked_for(
    rest: tuple[np.ndarray, np.ndarray],
) -> None:
    image, dots = rest
    detector = Detector()
    detector.look(image)
    centre = detector.refine(dots).position_px
    for shift in ([2.0, 0.0], [-1.5, -1.5], [0.0, 4.0]):
        away = np.linalg.norm(detector.refine(dots + np.array(shift)).position_px - centre, axis=1)
        assert np.sqrt((away**2).mean()) < 0.01
        assert away.max() < 0.05


def test_following_from_frame_to_frame_finds_what_a_look_at_the_whole_image_finds() -> None:
    noise = np.random.default_rng(3)
    following = MarkerTracker("left")
    for shot in shots(Case(14.0, "none"), noise, line=np.linspace(0.0, 14.0, 8)):
        followed = following.track(frame(shot.image, shot.k)).position_px
        anew = MarkerTracker("left").track(frame(shot.image, shot.k))
        assert (anew.state == MarkerState.SEEN).all()
        assert np.linalg.norm(followed - anew.position_px, axis=1).max() < 0.05


def pressed_gel(
    levels: np.ndarray, *, shade: float = 0.0, veil: float = 0.0, dim: float = 0.0
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Images of a simulated gel pressed beside its lower right corner, and the true places.

    The gel is sheared by up to 14 px there. ``shade``: share of light lost on a square of 44 px;
    ``veil``: grey levels of glare; ``dim``: share of contrast lost in the whole image.
    """
    look = load_gel_appearance()
    renderer = TactileRenderer(look, seed=5)
    away = look.rest_px - [276.0, 200.0]
    shear = np.exp(-np.sum(away**2, axis=1) / 55.0**2)[:, None] * [10.0, 8.0]
    square = np.zeros((240, 320, 1), np.float32)
    square[170:214, 238:282] = 1.0
    soft = cv2.GaussianBlur(square, (0, 0), 3.0)[..., None]
    glare = np.zeros((240, 320, 1), np.float32)
    cv2.circle(glare, (300, 150), 20, 1.0, -1)
    bright = cv2.GaussianBlur(glare, (0, 0), 8.0)[..., None]
    shown = []
    for level in map(float, levels):
        image = renderer.render(level * shear, np.zeros(63, dtype=bool)).astype(float)
        image = image * (1.0 - shade * level * soft) + veil * level * bright
        image = image.mean(axis=(0, 1)) + (1.0 - dim) * (image - image.mean(axis=(0, 1)))
        shown.append((np.clip(image, 0, 255).astype(np.uint8), look.rest_px + level * shear))
    return shown


PRESS = np.concatenate([np.linspace(0.0, 1.0, 12), np.ones(3)])


@pytest.mark.parametrize(
    ("levels", "marks"),
    [
        (PRESS, {"shade": 0.5}),
        (np.array([0.0, 0.5, 1.0, 1.0, 1.0]), {"shade": 0.5}),
        (np.ones(4), {"shade": 0.5}),
        (PRESS, {"veil": 110.0}),
        (PRESS, {"dim": 0.6}),
    ],
    ids=["shaded", "shaded at once", "shaded from the start", "in glare", "of low contrast"],
)
def test_visible_markers_beside_a_strong_contact_are_seen(levels, marks) -> None:
    tracker = MarkerTracker("left")
    for k, (image, truth) in enumerate(pressed_gel(levels, **marks)):
        field = tracker.track(frame(image, k))
        assert field.quality > 0.0
        np.testing.assert_array_equal(field.state, MarkerState.SEEN, f"frame {k}")
        assert np.linalg.norm(field.position_px - truth, axis=1).max() < 1.5


def test_a_covered_corner_beside_a_strong_contact_is_not_seen() -> None:
    corner = np.array([5 * 9 + 7, 5 * 9 + 8, 6 * 9 + 7, 6 * 9 + 8])
    tracker = MarkerTracker("left")
    for k, (image, truth) in enumerate(pressed_gel(PRESS, shade=0.3)):
        if k >= 5:
            for u, v in truth[corner].astype(int).tolist():
                cv2.circle(image, (u, v), 17, SMEAR_BGR, -1)
        field = tracker.track(frame(image, k))
        if k >= 5:
            assert (field.state[corner] != MarkerState.SEEN).all()
            assert (np.delete(field.state, corner) == MarkerState.SEEN).all()


def test_a_shaded_dot_is_centred_by_its_outline(rest: tuple[np.ndarray, np.ndarray]) -> None:
    """A shadow beside the dot pulls the centroid off by 3 px; the outline stays where it was."""
    image, tracker = rest[0], MarkerTracker("left")
    start = tracker.track(frame(image, 0)).position_px
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1)
    shaded = [32, 40]
    shadow = sum(
        np.exp(-(((grid - start[m] + [9.0, 0.0]) / [6.0, 8.0]) ** 2).sum(axis=-1)) for m in shaded
    )
    dark = (image * (1.0 - 0.6 * shadow[..., None])).astype(np.uint8)
    fields = [tracker.track(frame(dark, k)) for k in range(1, 5)]
    off_px = np.linalg.norm(fields[-1].position_px - start, axis=1)
    assert (off_px[shaded] < 0.6).all()
    assert np.median(off_px) < 0.05
    assert (fields[-1].state == MarkerState.SEEN).all()
    # The light goes, and with it the correction.
    fields = [tracker.track(frame(image, k)) for k in range(5, 10)]
    assert np.linalg.norm(fields[-1].position_px - start, axis=1).max() < 0.05
