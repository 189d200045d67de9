"""Targets of the known-truth test and of its extensions (docs/tracking.md)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from tests.backend.sensing.known_truth import (
    CASES,
    GELSIGHT,
    Case,
    Score,
    bump_field,
    known_truth,
    plain_detector,
    rest_dots,
    score,
    shear_field,
    shots,
    tracker_follower,
    upward_field,
)

LINE_FAST = np.concatenate([np.linspace(0, 30, 6), np.full(10, 30.0), np.linspace(30, 0, 6)])


@pytest.fixture(scope="module")
def scores() -> dict[Case, Score]:
    return known_truth()


def noise() -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(1))


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda c: f"{c.amplitude:.0f}-{c.fault}")
def test_known_truth_targets(scores: dict[Case, Score], case: Case) -> None:
    result = scores[case]
    clean = 0.05 if case.amplitude == 6 else 0.06
    assert result.rms_seen <= (0.10 if case.fault in ("flick", "occl") else clean)
    assert result.end_drift <= 0.05
    assert result.wrong == 0
    assert result.lost == 0


@pytest.mark.slow
def test_dropped_frames_are_no_worse_than_clean_ones(scores: dict[Case, Score]) -> None:
    for amplitude in (6.0, 14.0):
        clean, dropped = scores[Case(amplitude, "none")], scores[Case(amplitude, "drop")]
        assert dropped.rms <= clean.rms + 0.002
        assert dropped.end_drift <= clean.end_drift + 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("amplitude", "limit_px"), [(6.0, 1.0), (14.0, 2.0)])
def test_covered_dots_are_flagged_and_inferred(
    scores: dict[Case, Score], amplitude: float, limit_px: float
) -> None:
    result = scores[Case(amplitude, "occl")]
    assert result.late_flags == 0
    assert result.worst_covered <= limit_px


def test_more_than_one_pitch_keeps_identities() -> None:
    result = score(shots(Case(36.0, "none"), noise(), field=shear_field), tracker_follower())
    assert result.wrong == 0
    assert result.rms <= 0.11
    assert result.end_drift <= 0.05


@pytest.mark.parametrize("field", [bump_field, shear_field])
def test_six_px_per_frame_is_followed(field: object) -> None:
    moves = shots(Case(30.0, "none"), noise(), field=field, line=LINE_FAST)
    result = score(moves, tracker_follower())
    assert result.wrong == 0
    assert result.rms_seen <= 0.10
    assert result.end_drift <= 0.05


def test_a_row_that_leaves_the_image_comes_back_as_itself() -> None:
    line = np.concatenate([np.linspace(0, 20, 21), np.full(20, 20.0), np.linspace(20, 0, 21)])
    seen_at_top = []
    follow = tracker_follower()

    def watched(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        position, state = follow(image)
        seen_at_top.append(int((state[:9] == 0).sum()))
        return position, state

    result = score(shots(Case(20.0, "none"), noise(), field=upward_field, line=line), watched)
    assert min(seen_at_top) == 0
    assert seen_at_top[-1] == 9
    assert result.wrong == 0
    assert result.rms <= 0.10
    assert result.end_drift <= 0.05


@pytest.mark.parametrize("strength", [1.0, 4.0])
def test_printed_texture_between_the_dots_misleads_nobody(strength: float) -> None:
    rest, dots = rest_dots()
    pressed = cv2.imread(str(GELSIGHT / "cuboid_10-2-284.png"))
    texture = pressed - cv2.GaussianBlur(pressed.astype(float), (0, 0), 8)
    away = np.ones((240, 320))
    for place in (*dots, *plain_detector(pressed)):
        cv2.circle(away, (int(place[0]), int(place[1])), 11, 0, -1)
    soft = cv2.GaussianBlur(away, (0, 0), 1.5)[..., None]
    base = np.clip(rest + strength * soft * texture, 0, 255).astype(np.uint8)
    result = score(shots(Case(14.0, "none"), noise(), base=base), tracker_follower())
    assert result.wrong == 0
    assert result.rms <= 0.08


def test_dots_hidden_while_the_load_goes_are_found_again() -> None:
    line = np.concatenate([np.linspace(0, 14, 40), np.linspace(14, 0, 60), np.zeros(10)])
    moves = shots(Case(14.0, "occl"), noise(), line=line, occluded=range(40, 100))
    result = score(moves, tracker_follower())
    assert result.lost == 6 * 10  # covered for 60 frames, lost after 50
    assert result.worst_covered <= 2.0
    assert result.end_drift <= 0.05
    assert result.wrong == 0
