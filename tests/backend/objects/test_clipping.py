import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Point, Polygon

from touchdown.backend.core.values import FloatArray
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import Outline

OUTLINES = [
    outlines.circle(25.4),
    outlines.circle(15.0),
    outlines.square(15.0),
    outlines.rectangle(12.0, 28.0),
    outlines.regular_polygon(6, 20.0),
    outlines.regular_polygon(3, 22.0),
]
outline = st.sampled_from(OUTLINES)
place = st.tuples(st.floats(-25, 25), st.floats(-25, 25))
yaw = st.floats(-math.pi, math.pi)


def oracle(first: FloatArray, second: FloatArray) -> Polygon:
    common = Polygon(first).intersection(Polygon(second))
    return common if isinstance(common, Polygon) else Polygon()


@given(outline, outline, place, yaw, place)
def test_area_and_margin_agree_with_shapely(
    a: Outline, b: Outline, at: tuple[float, float], turn: float, point: tuple[float, float]
) -> None:
    first, second = a.placed(at, turn), b.polygon()
    expected = oracle(first, second)
    cut = outlines.overlap_edges(first, second)
    assert float(outlines.enclosed_area_mm2(cut)) == pytest.approx(expected.area, abs=1e-5)
    if expected.area < 1e-3:
        return
    distance = expected.exterior.distance(Point(point))
    signed = distance if expected.covers(Point(point)) else -distance
    assert float(outlines.signed_distances_mm(np.array(point), cut)) == pytest.approx(
        signed, abs=1e-6
    )


@given(outline, outline, place, yaw)
def test_ring_is_the_overlap(a: Outline, b: Outline, at: tuple[float, float], turn: float) -> None:
    first, second = a.placed(at, turn), b.polygon()
    expected = oracle(first, second)
    ring = outlines.edges_to_polygon(outlines.overlap_edges(first, second))
    if expected.area < 1e-3:
        return
    assert Polygon(ring).exterior.is_ccw
    assert Polygon(ring).symmetric_difference(expected).area < 1e-5


@given(outline, yaw)
def test_equal_outlines_keep_shared_edges_once(a: Outline, turn: float) -> None:
    corners = a.placed((3.0, -2.0), turn)
    assert float(
        outlines.enclosed_area_mm2(outlines.overlap_edges(corners, corners))
    ) == pytest.approx(Polygon(corners).area)


def test_squares_that_share_a_side() -> None:
    square = outlines.square(10.0)
    shifted = square.placed((4.0, 0.0))
    assert float(
        outlines.enclosed_area_mm2(outlines.overlap_edges(square.polygon(), shifted))
    ) == pytest.approx(60)


def test_batches_equal_single_overlaps() -> None:
    a, b = outlines.circle(15.0).polygon(), outlines.rectangle(12.0, 28.0).polygon()
    offsets = np.random.default_rng(3).uniform(-22, 22, size=(40, 2))
    batch = outlines.enclosed_area_mm2(outlines.overlap_edges(a + offsets[:, None, :], b))
    single = [float(outlines.enclosed_area_mm2(outlines.overlap_edges(a + o, b))) for o in offsets]
    assert batch == pytest.approx(np.array(single))
    assert (batch == 0.0).any()
    assert (batch > 100.0).any()


def test_without_overlap_there_is_no_support() -> None:
    cut = outlines.overlap_edges(
        outlines.circle(15.0).placed((40.0, 0.0)), outlines.circle(25.0).polygon()
    )
    assert outlines.signed_distances_mm(np.zeros((2, 2)), cut).tolist() == [-math.inf, -math.inf]
    assert outlines.edges_to_polygon(cut).shape == (0, 2)
    assert float(outlines.enclosed_area_mm2(cut)) == 0.0


def test_margin_by_hand() -> None:
    edges = outlines.polygon_edges(outlines.square(10.0).polygon())
    points = np.array([[0.0, 0.0], [4.0, 1.0], [7.0, 1.0], [8.0, 9.0]])
    assert outlines.signed_distances_mm(points, edges) == pytest.approx([5.0, 1.0, -2.0, -5.0])


@pytest.mark.parametrize(
    "at", [(10.0, 0.0), (10.0, 4.0), (-10.0, 0.0), (10.0, 10.0), (10 - 5e-10, 0.0)]
)
def test_outlines_that_only_touch_hold_nothing(at: tuple[float, float]) -> None:
    square = outlines.square(10.0)
    for first, second in (
        (square.polygon(), square.placed(at)),
        (square.placed(at), square.polygon()),
    ):
        cut = outlines.overlap_edges(first, second)
        assert float(outlines.enclosed_area_mm2(cut)) < 1e-6
        assert float(outlines.signed_distances_mm(np.zeros(2), cut)) < -4.9


@given(st.floats(-1e-8, 1e-8), st.floats(-1e-8, 1e-8))
def test_nearly_equal_outlines_still_overlap(turn: float, shift: float) -> None:
    square = outlines.square(10.0)
    cut = outlines.overlap_edges(square.placed((shift, 0.0), turn), square.polygon())
    assert float(outlines.enclosed_area_mm2(cut)) == pytest.approx(100.0, abs=1e-5)
    assert float(outlines.signed_distances_mm(np.zeros(2), cut)) == pytest.approx(5.0, abs=1e-6)
