import math

import numpy as np
import pytest
from shapely.geometry import Point, Polygon

from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import Outline

ALL = [
    outlines.circle(20.0),
    outlines.square(15.0),
    outlines.rectangle(12.0, 28.0),
    outlines.regular_polygon(6, 20.0),
    outlines.regular_polygon(5, 18.0, 0.3),
    outlines.convex_polygon(((-3.0, -5.0), (12.0, -2.0), (-3.0, 9.0))),
]


@pytest.mark.parametrize("outline", ALL)
def test_contains_agrees_with_shapely(outline: Outline) -> None:
    points = np.random.default_rng(1).uniform(-16, 16, size=(2000, 2))
    if outline.kind == "circle":
        expected = [Point(0, 0).distance(Point(p)) <= outline.radius_mm for p in points]
    else:
        polygon = Polygon(outline.vertices_mm)
        expected = [polygon.covers(Point(p)) for p in points]
    assert 50 < sum(expected) < 1950
    assert outline.contains(points).tolist() == expected


@pytest.mark.parametrize("outline", ALL)
def test_edge_and_corners_count_as_inside(outline: Outline) -> None:
    assert outline.contains(outline.polygon()).all()
    assert not outline.contains(outline.polygon() * 1.0001).any()


@pytest.mark.parametrize("outline", ALL[1:])
def test_area_and_extents_of_polygons(outline: Outline) -> None:
    polygon = Polygon(outline.vertices_mm)
    assert outline.area_mm2 == pytest.approx(polygon.area)
    low_x, low_y, high_x, high_y = polygon.bounds
    assert outline.half_extents_mm == pytest.approx((max(-low_x, high_x), max(-low_y, high_y)))


def test_closed_forms() -> None:
    assert outlines.circle(15.0).area_mm2 == pytest.approx(176.7146)
    assert outlines.regular_polygon(6, 20.0).area_mm2 == pytest.approx(3 * math.sqrt(3) / 2 * 100)
    assert outlines.regular_polygon(6, 20.0).half_extents_mm == pytest.approx(
        (10.0, 5 * math.sqrt(3))
    )
    assert outlines.circle(20.0).half_extents_mm == (10.0, 10.0)


def test_circle_polygon_is_inscribed_within_4_um() -> None:
    polygon = Polygon(outlines.circle(25.0).polygon())
    assert polygon.exterior.is_ccw
    inradius = polygon.exterior.distance(Point(0, 0))
    assert 12.5 - 0.004 < inradius < 12.5


def test_placed_turns_then_moves() -> None:
    corners = outlines.rectangle(4.0, 2.0).placed((10.0, 5.0), math.pi / 2)
    assert corners == pytest.approx(np.array([[11, 3], [11, 7], [9, 7], [9, 3]]))


def test_the_inset_is_the_distance_to_the_edge() -> None:
    points = np.array([[0.0, 0.0], [3.0, 0.0], [12.0, 0.0]])
    assert outlines.inset_mm(outlines.circle(20.0), points) == pytest.approx([10.0, 7.0, -2.0])
    hexagon = outlines.regular_polygon(6, 20.0)
    expected = [10.0 * math.cos(math.pi / 6)]
    assert outlines.inset_mm(hexagon, np.zeros((1, 2))) == pytest.approx(expected)


def test_outlines_are_values() -> None:
    assert outlines.circle(15.0) == outlines.circle(15.0)
    assert hash(outlines.square(15.0)) == hash(outlines.rectangle(15.0, 15.0))
    with pytest.raises(ValueError, match="read-only"):
        outlines.square(15.0).polygon()[0, 0] = 1.0


@pytest.mark.parametrize(
    ("vertices", "reason"),
    [
        (((0, 0), (1, 0)), "at least 3"),
        (((-1, -1), (-1, 1), (1, 1), (1, -1)), "counter-clockwise"),
        (((-9, -9), (9, -9), (0, 1), (0, 9)), "counter-clockwise"),
        (((-1, -1), (1, -1), (1, -1), (0, 1)), "counter-clockwise"),
        (((1, 1), (3, 1), (2, 3)), "face centre"),
        (tuple((math.cos(a), math.sin(a)) for a in np.arange(5) * 0.8 * math.pi), "only once"),
    ],
)
def test_bad_polygons_are_refused(vertices: tuple[tuple[float, float], ...], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        outlines.convex_polygon(vertices)


@pytest.mark.parametrize("diameter", [0.0, -1.0, math.nan, math.inf])
def test_bad_circles_are_refused(diameter: float) -> None:
    with pytest.raises(ValueError, match="diameter"):
        outlines.circle(diameter)
