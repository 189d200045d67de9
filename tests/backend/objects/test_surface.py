import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import Point, Polygon

from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import (
    Outline,
    face_points,
    overlap_area_mm2,
    overlap_polygon,
    true_patch,
)

BOTTOMS = [outlines.circle(20.0), outlines.square(15.0), outlines.regular_polygon(6, 20.0)]


@pytest.mark.parametrize(("diameter", "count"), [(15.0, 177), (21.2, 349), (25.4, 505)])
def test_counts_of_the_method(diameter: float, count: int) -> None:
    points = face_points(outlines.circle(diameter))
    assert points.shape == (count, 2)
    assert (points == 0.0).all(axis=1).sum() == 1
    assert (np.hypot(*points.T) <= diameter / 2).all()
    assert points.tolist() == sorted(points.tolist(), key=lambda p: (p[1], p[0]))


def test_lattice_reaches_the_edges_and_follows_the_pitch() -> None:
    assert len(face_points(outlines.rectangle(12.0, 28.0))) == 13 * 29
    assert len(face_points(outlines.rectangle(12.0, 28.0), pitch_mm=2.0)) == 7 * 15
    assert len(face_points(outlines.square(0.3 * 10), pitch_mm=0.3)) == 11 * 11
    with pytest.raises(ValueError, match="pitch"):
        face_points(outlines.circle(15.0), pitch_mm=0.0)


@pytest.mark.parametrize(
    ("face", "bottom", "offset", "cells"),
    [
        (25.4, outlines.circle(15.0), (5, 0), 177),
        (25.4, outlines.circle(15.0), (9, 0), 133),
        (25.4, outlines.circle(15.0), (7, 7), 119),
        (25.4, outlines.circle(15.0), (-12, 4), 77),
        (15.0, outlines.circle(25.0), (9, 0), 129),
        (15.0, outlines.circle(25.0), (0, 12), 84),
        (21.2, outlines.square(15.0), (9, 0), 121),
        (21.2, outlines.square(15.0), (6, -8), 97),
    ],
)
def test_overlap_cells_of_the_verification_vectors(
    face: float, bottom: Outline, offset: tuple[float, float], cells: int
) -> None:
    assert true_patch(face_points(outlines.circle(face)), offset, bottom).sum() == cells


@given(st.sampled_from(BOTTOMS), st.floats(-20, 20), st.floats(-20, 20), st.floats(-0.2, 0.2))
def test_patch_and_area_agree_with_shapely(bottom: Outline, x: float, y: float, yaw: float) -> None:
    face = outlines.rectangle(12.0, 20.0)
    points = face_points(face)
    below = Polygon(bottom.polygon(4096))
    patch = true_patch(points, (x, y), bottom, yaw)
    for point, touches in zip(points[::7], patch[::7], strict=True):
        placed = affinity.rotate(Point(point), yaw, origin=(0, 0), use_radians=True)
        gap = below.exterior.distance(affinity.translate(placed, x, y))
        if gap > 1e-4:
            assert touches == below.contains(affinity.translate(placed, x, y))
    above = Polygon(face.placed((x, y), yaw))
    expected = above.intersection(Polygon(bottom.polygon())).area
    assert float(overlap_area_mm2(face, (x, y), bottom, yaw)) == pytest.approx(expected, abs=1e-5)


@given(st.floats(6, 30), st.floats(6, 30), st.floats(-32, 32), st.floats(-32, 32))
def test_area_of_two_circles_agrees_with_clipping(a: float, b: float, x: float, y: float) -> None:
    first, second = outlines.circle(a), outlines.circle(b)
    clipped = Polygon(first.placed((x, y), 0.0, 512)).intersection(Polygon(second.polygon(512)))
    area = float(overlap_area_mm2(first, (x, y), second))
    assert clipped.area - 1e-6 <= area <= clipped.area + 0.001 * min(a, b) ** 2


def test_area_of_two_circles_in_closed_form() -> None:
    # Two circles of radius r whose centres lie r apart overlap in (2 pi / 3 - sqrt(3) / 2) r^2.
    circle = outlines.circle(20.0)
    exact = (2 * np.pi / 3 - np.sqrt(3) / 2) * 100
    assert float(overlap_area_mm2(circle, (0.0, 10.0), circle)) == pytest.approx(exact)
    areas = overlap_area_mm2(circle, [[0, 0], [20, 0], [30, 0]], circle)
    assert areas == pytest.approx(np.array([circle.area_mm2, 0.0, 0.0]), abs=1e-9)


def test_label_is_batched_over_offsets() -> None:
    points = face_points(outlines.circle(15.0))
    offsets = np.array([[0.0, 0.0], [9.0, 0.0], [90.0, 0.0]])
    patch = true_patch(points, offsets, outlines.circle(25.0))
    assert patch.sum(axis=1).tolist() == [177, 129, 0]


def test_overlap_polygon_lies_in_the_bottom_frame() -> None:
    ring = overlap_polygon(outlines.square(10.0), (8.0, 0.0), outlines.square(10.0))
    assert Polygon(ring).bounds == pytest.approx((3.0, -5.0, 5.0, 5.0))
    assert overlap_polygon(outlines.square(10.0), (20.0, 0.0), outlines.square(10.0)).shape == (
        0,
        2,
    )
