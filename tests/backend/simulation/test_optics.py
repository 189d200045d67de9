"""Rendered frames against their definition: colours, positions of dots, noise, mirroring."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from touchdown.backend.core.values import MARKERS
from touchdown.backend.simulation.finger_camera import (
    TactileRenderer,
    load_gel_appearance,
    mirror_appearance,
)

NOBODY = np.zeros(MARKERS, dtype=bool)
STILL = np.zeros((MARKERS, 2))


def darkness(image):
    """How much darker than the surroundings, independent of the renderer: blurred minus image."""
    grey = image.max(axis=2).astype(np.float64)
    return cv2.GaussianBlur(grey, (0, 0), 14.0) - grey


def centroid_px(image, around):
    """Centroid of the darkness within 11 px of ``around``."""
    v, u = np.mgrid[0:240, 0:320]
    near = np.hypot(u - around[0], v - around[1]) < 11.0
    weight = np.clip(darkness(image), 6.0, None)[near] - 6.0
    return np.array([(weight * u[near]).sum(), (weight * v[near]).sum()]) / weight.sum()


@pytest.fixture(scope="module")
def look():
    return load_gel_appearance()


def test_rest_grid_is_that_of_the_real_sensor(look):
    grid = look.rest_px.reshape(7, 9, 2)
    assert grid[0, 0].tolist() == [21.2, 21.4]
    assert grid[6, 8].tolist() == [287.2, 214.7]
    assert np.diff(grid[..., 0], axis=1).mean() == pytest.approx(32.9, abs=0.4)
    assert np.diff(grid[..., 1], axis=0).mean() == pytest.approx(31.6, abs=0.4)


def test_dots_are_drawn_where_the_markers_are(look):
    shift = np.tile([2.3, -4.6], (MARKERS, 1))
    optics = TactileRenderer(look, 1)
    still, image = optics.render(STILL, NOBODY), optics.render(shift, NOBODY)
    for rest in look.rest_px:
        # Flecks and coloured shadows pull a centroid by a constant.
        before, after = centroid_px(still, rest), centroid_px(image, rest + shift[0])
        assert before == pytest.approx(rest, abs=0.9)
        assert after - before == pytest.approx(shift[0], abs=0.35)


def test_sub_pixel_motion_is_visible(look):
    optics = TactileRenderer(look, 1)
    inner = [10, 31, 52]
    first = optics.render(STILL, NOBODY)
    second = optics.render(np.tile([0.30, -0.20], (MARKERS, 1)), NOBODY)
    for marker in inner:
        at = look.rest_px[marker]
        moved = centroid_px(second, at) - centroid_px(first, at)
        assert moved == pytest.approx([0.30, -0.20], abs=0.08)


def test_colours_are_those_of_the_real_frame(look):
    image = TactileRenderer(look, 1).render(STILL, NOBODY).astype(float)
    between = image[100:103, 136:140].reshape(-1, 3).mean(axis=0)
    cores = np.array([image[round(v), round(u)] for u, v in look.rest_px]).mean(axis=0)
    assert cores == pytest.approx([37, 40, 30], abs=6)
    assert image.reshape(-1, 3).mean(axis=0) == pytest.approx([103, 90, 66], abs=10)
    assert between[0] > between[1] > between[2]
    violet, teal = image[110:130, 165:175].mean(axis=(0, 1)), image[5:12, 165:175].mean(axis=(0, 1))
    assert violet[2] - violet[1] > teal[2] - teal[1] + 20


def test_dot_width_follows_radius_and_edge(look):
    for variant, radius in ((look, 7.6), (replace(look, radius_px=6.1, edge_px=0.55), 6.1)):
        optics = TactileRenderer(variant, 3)
        mean = np.mean([optics.render(STILL, NOBODY).astype(float) for _ in range(8)], axis=0)
        area = []
        for u, v in variant.rest_px[[20, 31, 40]]:
            patch = mean[round(v) - 14 : round(v) + 15, round(u) - 14 : round(u) + 15].mean(axis=2)
            half = 0.5 * (patch.min() + np.median(patch[0]))
            area.append((patch < half).sum())
        assert np.sqrt(np.mean(area) / np.pi) == pytest.approx(radius, abs=0.4)


def test_noise_and_grain_have_their_sizes(look):
    optics = TactileRenderer(look, 5)
    far = np.full((MARKERS, 2), 1e4)
    frames = np.array([optics.render(far, NOBODY)[::2, ::2].astype(float) for _ in range(30)])
    # Rounding adds 1/12 to the variance.
    assert frames.std(axis=0, ddof=1).mean() == pytest.approx(np.hypot(1.5, 0.29), rel=0.1)
    still = frames.mean(axis=0)
    flat = still - cv2.GaussianBlur(still, (0, 0), 6.0)
    assert flat.std() == pytest.approx(2.0, rel=0.1)


def test_noise_differs_between_frames_and_repeats_with_the_seed(look):
    first, again = TactileRenderer(look, 9), TactileRenderer(look, 9)
    frames = [first.render(STILL, NOBODY) for _ in range(2)]
    assert np.array_equal(frames[0], again.render(STILL, NOBODY))
    assert not np.array_equal(frames[0], frames[1])
    a, b = (frame.astype(float) - np.mean(frames, axis=0) for frame in frames)
    assert np.abs(a - b).max() > 3.0
    assert not np.array_equal(frames[0], TactileRenderer(look, 10).render(STILL, NOBODY))


def test_a_smear_hides_its_dot_only(look):
    hidden = NOBODY.copy()
    hidden[31] = True
    image = TactileRenderer(look, 1).render(STILL, hidden)
    shade = darkness(image)
    depth = np.array([shade[round(v), round(u)] for u, v in look.rest_px])
    assert depth[31] < 0.5 * np.delete(depth, 31).min()


def test_what_did_not_move_is_not_drawn_again_and_looks_as_if_it_were(look):
    moved, hidden = np.tile([1.5, 2.0], (MARKERS, 1)), NOBODY.copy()
    hidden[31] = True
    course = [(STILL, NOBODY), (STILL, NOBODY), (STILL, hidden), (STILL, NOBODY),
              (moved, NOBODY), (moved, NOBODY), (STILL, NOBODY)]  # fmt: skip
    optics = TactileRenderer(look, 4)
    for number, shown in enumerate(course):
        image, other = optics.render(*shown), TactileRenderer(look, 4)
        for before in range(number):
            other.render(STILL + 5.0 + before, NOBODY)
        assert np.array_equal(image, other.render(*shown)), number


def test_dots_stretch_with_the_gel(look):
    strain = np.zeros((MARKERS, 2))
    strain[:, 0] = 0.2 * (look.rest_px[:, 0] - 160.0)
    optics = TactileRenderer(look, 1)
    image = optics.render(strain, NOBODY)
    u, v = look.rest_px[31] + strain[31]
    dark = darkness(image) > 20.0
    width = dark[round(v), round(u) - 15 : round(u) + 16].sum()
    height = dark[round(v) - 15 : round(v) + 16, round(u)].sum()
    assert width / height == pytest.approx(1.2, abs=0.1)


def test_dots_beyond_the_border_are_cut_and_nothing_fails(look):
    for shift in ((0.0, -30.0), (0.0, 400.0), (-25.0, 0.0), (1e4, -1e4)):
        image = TactileRenderer(look, 1).render(np.tile(shift, (MARKERS, 1)), NOBODY)
        assert image.shape == (240, 320, 3)
    gone = TactileRenderer(look, 1).render(np.full((MARKERS, 2), 1e4), np.ones(MARKERS, dtype=bool))
    assert darkness(gone).max() < 20.0


def test_the_other_finger_is_mirrored(look):
    other = mirror_appearance(look)
    assert np.all(np.diff(other.rest_px.reshape(7, 9, 2)[..., 0], axis=1) > 0.0)
    assert other.rest_px[0].tolist() == [319 - 285.9, 20.4]
    assert mirror_appearance(other).rest_px == pytest.approx(look.rest_px)
    left = TactileRenderer(look, 1).render(np.full((MARKERS, 2), 1e4), NOBODY).astype(float)
    right = TactileRenderer(other, 2).render(np.full((MARKERS, 2), 1e4), NOBODY).astype(float)
    smooth = [cv2.GaussianBlur(image, (0, 0), 5.0) for image in (left, right[:, ::-1])]
    assert np.abs(smooth[0] - smooth[1]).max() < 3.0
