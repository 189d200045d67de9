import math

import numpy as np
import pytest
from shapely.geometry import Point, Polygon

from backend.objects import shapes
from backend.objects.shapes import Outline

ALL = [
    shapes.circle(20.0),
    shapes.square(15.0),
    shapes.rectangle(12.0, 28.0),
    shapes.regular(6, 20.0),
    shapes.regular(5, 18.0, 0.3),
    shapes.convex(((-3.0, -5.0), (12.0, -2.0), (-3.0, 9.0))),
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
    assert shapes.circle(15.0).area_mm2 == pytest.approx(176.7146)
    assert shapes.regular(6, 20.0).area_mm2 == pytest.approx(3 * math.sqrt(3) / 2 * 100)
    assert shapes.regular(6, 20.0).half_extents_mm == pytest.approx((10.0, 5 * math.sqrt(3)))
    assert shapes.circle(20.0).half_extents_mm == (10.0, 10.0)


def test_circle_polygon_is_inscribed_within_4_um() -> None:
    polygon = Polygon(shapes.circle(25.0).polygon())
    assert polygon.exterior.is_ccw
    inradius = polygon.exterior.distance(Point(0, 0))
    assert 12.5 - 0.004 < inradius < 12.5


def test_placed_turns_then_moves() -> None:
    corners = shapes.rectangle(4.0, 2.0).placed((10.0, 5.0), math.pi / 2)
    assert corners == pytest.approx(np.array([[11, 3], [11, 7], [9, 7], [9, 3]]))


def test_the_inset_is_the_distance_to_the_edge() -> None:
    points = np.array([[0.0, 0.0], [3.0, 0.0], [12.0, 0.0]])
    assert shapes.inset_mm(shapes.circle(20.0), points) == pytest.approx([10.0, 7.0, -2.0])
    hexagon = shapes.regular(6, 20.0)
    expected = [10.0 * math.cos(math.pi / 6)]
    assert shapes.inset_mm(hexagon, np.zeros((1, 2))) == pytest.approx(expected)


def test_outlines_are_values() -> None:
    assert shapes.circle(15.0) == shapes.circle(15.0)
    assert hash(shapes.square(15.0)) == hash(shapes.rectangle(15.0, 15.0))
    with pytest.raises(ValueError, match="read-only"):
        shapes.square(15.0).polygon()[0, 0] = 1.0


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
        shapes.convex(vertices)


@pytest.mark.parametrize("diameter", [0.0, -1.0, math.nan, math.inf])
def test_bad_circles_are_refused(diameter: float) -> None:
    with pytest.raises(ValueError, match="diameter"):
        shapes.circle(diameter)
