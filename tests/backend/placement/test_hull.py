from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, QhullError
from shapely.geometry import MultiPoint, Point

from touchdown.backend.placement.equilibrium import convex_hull, inside_hull, signed_margin_mm

cells = st.lists(st.tuples(st.integers(-12, 12), st.integers(-12, 12)), max_size=60)
lengths = st.floats(-30, 30, allow_nan=False, width=32)


def cross(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


@settings(max_examples=300, deadline=None)
@given(cells)
def test_corners_are_those_of_qhull_or_named_degenerate(points: list[tuple[int, int]]) -> None:
    array = np.array(points, dtype=np.int64).reshape(-1, 2)
    hull = convex_hull(array)
    distinct = np.unique(array, axis=0)
    if len(hull) < 3:
        assert len(hull) == min(len(distinct), 2)
        if len(distinct) > 2:
            assert np.linalg.matrix_rank(distinct - distinct[0]) < 2
        return
    try:
        oracle = ConvexHull(array)
    except QhullError as cause:
        raise AssertionError("qhull finds no area where we do") from cause
    expected = {(x, y) for x, y in array[oracle.vertices].astype(float)}
    assert {(x, y) for x, y in hull} == expected
    turns = [cross(hull[i - 2], hull[i - 1], hull[i]) for i in range(len(hull))]
    assert min(turns) > 0


@settings(max_examples=300, deadline=None)
@given(cells, lengths, lengths)
def test_margin_is_shapelys_signed_distance(
    points: list[tuple[int, int]], x: float, y: float
) -> None:
    array = np.array(points, dtype=np.float64).reshape(-1, 2)
    margin = signed_margin_mm(convex_hull(array), (x, y))
    if not len(array):
        assert margin == -math.inf
        return
    shape = MultiPoint([tuple(p) for p in array]).convex_hull
    place = Point(x, y)
    if shape.geom_type == "Polygon" and shape.covers(place):
        expected = shape.exterior.distance(place)
    else:
        expected = -shape.distance(place)
    assert margin == pytest.approx(expected, abs=1e-9)


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(lengths, lengths), min_size=3, max_size=30),
    st.tuples(lengths, lengths),
    st.floats(0, 2 * math.pi),
    st.tuples(lengths, lengths),
)
def test_margin_does_not_depend_on_the_frame(
    points: list[tuple[float, float]],
    place: tuple[float, float],
    angle: float,
    shift: tuple[float, float],
) -> None:
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    array = np.array(points)
    shape = MultiPoint(points).convex_hull
    # A hull thinner than rounding is a line in one frame and an area in another.
    assume(shape.area > 1e-3)
    before = signed_margin_mm(convex_hull(array), place)
    moved = turn @ np.array(place) + shift
    after = signed_margin_mm(convex_hull(array @ turn.T + shift), (moved[0], moved[1]))
    assert after == pytest.approx(before, abs=1e-4)


def test_a_square_by_hand() -> None:
    square = convex_hull(np.array([[0, 0], [4, 0], [4, 4], [0, 4], [2, 2], [2, 0], [4, 4]]))
    assert square.tolist() == [[0, 0], [4, 0], [4, 4], [0, 4]]
    assert signed_margin_mm(square, (2.0, 1.0)) == 1.0
    assert signed_margin_mm(square, (4.0, 2.0)) == 0.0
    assert signed_margin_mm(square, (7.0, 8.0)) == -5.0


def test_inside_agrees_with_the_margin() -> None:
    rng = np.random.default_rng(2)
    hull = convex_hull(rng.integers(-9, 10, (12, 2)))
    places = rng.uniform(-12, 12, (500, 2))
    by_margin = [signed_margin_mm(hull, (x, y)) >= 0 for x, y in places]
    assert inside_hull(hull, places).tolist() == by_margin
    assert inside_hull(hull, hull).all()
    assert not inside_hull(hull[:2], places).any()
