""""""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely import affinity, union_all
from shapely.geometry import Point, Polygon

from touchdown.backend.core.values import FloatArray
from touchdown.backend.geometry import outlines, regions
from touchdown.backend.geometry.outlines import (
    contact_edges,
    face_points,
    overlap_area_mm2,
    overlap_polygon,
    rings_of,
    signed_distances_mm,
    true_patch,
)

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
def test_area_margin_and_ring_agree_with_shapely(a, b, at, turn, point):
    first, second = a.placed(at, turn), b.polygon()
    expected = oracle(first, second)
    cut = outlines.overlap_edges(first, second)
    assert float(outlines.enclosed_area_mm2(cut)) == pytest.approx(expected.area, abs=1e-5)
    if expected.area < 1e-3:
        return
    ring = Polygon(outlines.edges_to_polygon(cut))
    assert ring.exterior.is_ccw
    assert ring.symmetric_difference(expected).area < 1e-5
    distance = expected.exterior.distance(Point(point))
    signed = distance if expected.covers(Point(point)) else -distance
    assert float(outlines.signed_distances_mm(np.array(point), cut)) == pytest.approx(
        signed, abs=1e-6
    )


@given(outline, yaw)
def test_equal_outlines_keep_shared_edges_once(a, turn):
    corners = a.placed((3.0, -2.0), turn)
    assert float(
        outlines.enclosed_area_mm2(outlines.overlap_edges(corners, corners))
    ) == pytest.approx(Polygon(corners).area)


def test_squares_that_share_a_side():
    square = outlines.square(10.0)
    shifted = square.placed((4.0, 0.0))
    assert float(
        outlines.enclosed_area_mm2(outlines.overlap_edges(square.polygon(), shifted))
    ) == pytest.approx(60)


def test_batches_equal_single_overlaps():
    a, b = outlines.circle(15.0).polygon(), outlines.rectangle(12.0, 28.0).polygon()
    offsets = np.random.default_rng(3).uniform(-22, 22, size=(40, 2))
    batch = outlines.enclosed_area_mm2(outlines.overlap_edges(a + offsets[:, None, :], b))
    single = [float(outlines.enclosed_area_mm2(outlines.overlap_edges(a + o, b))) for o in offsets]
    assert batch == pytest.approx(np.array(single))
    assert (batch == 0.0).any()
    assert (batch > 100.0).any()


def test_without_overlap_there_is_no_support():
    cut = outlines.overlap_edges(
        outlines.circle(15.0).placed((40.0, 0.0)), outlines.circle(25.0).polygon()
    )
    assert outlines.signed_distances_mm(np.zeros((2, 2)), cut).tolist() == [-math.inf, -math.inf]
    assert outlines.edges_to_polygon(cut).shape == (0, 2)
    assert float(outlines.enclosed_area_mm2(cut)) == 0.0


def test_margin_by_hand():
    edges = outlines.polygon_edges(outlines.square(10.0).polygon())
    points = np.array([[0.0, 0.0], [4.0, 1.0], [7.0, 1.0], [8.0, 9.0]])
    assert outlines.signed_distances_mm(points, edges) == pytest.approx([5.0, 1.0, -2.0, -5.0])


@pytest.mark.parametrize(
    "at", [(10.0, 0.0), (10.0, 4.0), (-10.0, 0.0), (10.0, 10.0), (10 - 5e-10, 0.0)]
)
def test_outlines_that_only_touch_hold_nothing(at):
    square = outlines.square(10.0)
    for first, second in (
        (square.polygon(), square.placed(at)),
        (square.placed(at), square.polygon()),
    ):
        cut = outlines.overlap_edges(first, second)
        assert float(outlines.enclosed_area_mm2(cut)) < 1e-6
        assert float(outlines.signed_distances_mm(np.zeros(2), cut)) < -4.9


@given(st.floats(-1e-8, 1e-8), st.floats(-1e-8, 1e-8))
def test_nearly_equal_outlines_still_overlap(turn, shift):
    square = outlines.square(10.0)
    cut = outlines.overlap_edges(square.placed((shift, 0.0), turn), square.polygon())
    assert float(outlines.enclosed_area_mm2(cut)) == pytest.approx(100.0, abs=1e-5)
    assert float(outlines.signed_distances_mm(np.zeros(2), cut)) == pytest.approx(5.0, abs=1e-6)


ALL = [
    outlines.circle(20.0),
    outlines.square(15.0),
    outlines.rectangle(12.0, 28.0),
    outlines.regular_polygon(6, 20.0),
    outlines.regular_polygon(5, 18.0, 0.3),
    outlines.convex_polygon(((-3.0, -5.0), (12.0, -2.0), (-3.0, 9.0))),
]


@pytest.mark.parametrize("outline", ALL)
def test_contains_agrees_with_shapely(outline):
    points = np.random.default_rng(1).uniform(-16, 16, size=(2000, 2))
    if outline.kind == "circle":
        expected = [Point(0, 0).distance(Point(p)) <= outline.radius_mm for p in points]
    else:
        polygon = Polygon(outline.vertices_mm)
        expected = [polygon.covers(Point(p)) for p in points]
    assert 50 < sum(expected) < 1950
    assert outline.contains(points).tolist() == expected


@pytest.mark.parametrize("outline", ALL)
def test_edge_and_corners_count_as_inside(outline):
    assert outline.contains(outline.polygon()).all()
    assert not outline.contains(outline.polygon() * 1.0001).any()


@pytest.mark.parametrize("outline", ALL[1:])
def test_area_and_extents_of_polygons(outline):
    polygon = Polygon(outline.vertices_mm)
    assert outline.area_mm2 == pytest.approx(polygon.area)
    low_x, low_y, high_x, high_y = polygon.bounds
    assert outline.half_extents_mm == pytest.approx((max(-low_x, high_x), max(-low_y, high_y)))


def test_closed_forms():
    assert outlines.circle(15.0).area_mm2 == pytest.approx(176.7146)
    assert outlines.regular_polygon(6, 20.0).area_mm2 == pytest.approx(3 * math.sqrt(3) / 2 * 100)
    assert outlines.regular_polygon(6, 20.0).half_extents_mm == pytest.approx(
        (10.0, 5 * math.sqrt(3))
    )
    assert outlines.circle(20.0).half_extents_mm == (10.0, 10.0)


def test_circle_polygon_is_inscribed_within_4_um():
    polygon = Polygon(outlines.circle(25.0).polygon())
    assert polygon.exterior.is_ccw
    inradius = polygon.exterior.distance(Point(0, 0))
    assert 12.5 - 0.004 < inradius < 12.5


def test_placed_turns_then_moves():
    corners = outlines.rectangle(4.0, 2.0).placed((10.0, 5.0), math.pi / 2)
    assert corners == pytest.approx(np.array([[11, 3], [11, 7], [9, 7], [9, 3]]))


def test_the_inset_is_the_distance_to_the_edge():
    points = np.array([[0.0, 0.0], [3.0, 0.0], [12.0, 0.0]])
    assert outlines.inset_mm(outlines.circle(20.0), points) == pytest.approx([10.0, 7.0, -2.0])
    hexagon = outlines.regular_polygon(6, 20.0)
    expected = [10.0 * math.cos(math.pi / 6)]
    assert outlines.inset_mm(hexagon, np.zeros((1, 2))) == pytest.approx(expected)


def test_outlines_are_values():
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
def test_bad_polygons_are_refused(vertices, reason):
    with pytest.raises(ValueError, match=reason):
        outlines.convex_polygon(vertices)


@pytest.mark.parametrize("diameter", [0.0, -1.0, math.nan, math.inf])
def test_bad_circles_are_refused(diameter):
    with pytest.raises(ValueError, match="diameter"):
        outlines.circle(diameter)


BOTTOMS = [outlines.circle(20.0), outlines.square(15.0), outlines.regular_polygon(6, 20.0)]


@pytest.mark.parametrize(("diameter", "count"), [(15.0, 177), (21.2, 349), (25.4, 505)])
def test_counts_of_the_method(diameter, count):
    points = face_points(outlines.circle(diameter))
    assert points.shape == (count, 2)
    assert (points == 0.0).all(axis=1).sum() == 1
    assert (np.hypot(*points.T) <= diameter / 2).all()
    assert points.tolist() == sorted(points.tolist(), key=lambda p: (p[1], p[0]))


def test_lattice_reaches_the_edges_and_follows_the_pitch():
    assert len(face_points(outlines.rectangle(12.0, 28.0))) == 13 * 29
    assert len(face_points(outlines.rectangle(12.0, 28.0), pitch_mm=2.0)) == 7 * 15
    assert len(face_points(outlines.square(0.3 * 10), pitch_mm=0.3)) == 11 * 11
    with pytest.raises(ValueError, match="pitch"):
        face_points(outlines.circle(15.0), pitch_mm=0.0)


@pytest.mark.parametrize(
    ("face", "bottom", "cells"),
    [
        (25.4, outlines.circle(15.0), {(5, 0): 177, (9, 0): 133, (7, 7): 119, (-12, 4): 77}),
        (15.0, outlines.circle(25.0), {(0, 0): 177, (9, 0): 129, (0, 12): 84, (90, 0): 0}),
        (21.2, outlines.square(15.0), {(9, 0): 121, (6, -8): 97}),
    ],
)
def test_overlap_cells_of_the_verification_vectors(face, bottom, cells):
    patch = true_patch(face_points(outlines.circle(face)), list(cells), bottom)
    assert patch.sum(axis=1).tolist() == list(cells.values())


@given(st.sampled_from(BOTTOMS), st.floats(-20, 20), st.floats(-20, 20), st.floats(-0.2, 0.2))
def test_patch_and_area_agree_with_shapely(bottom, x, y, yaw):
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
def test_area_of_two_circles_agrees_with_clipping(a, b, x, y):
    first, second = outlines.circle(a), outlines.circle(b)
    clipped = Polygon(first.placed((x, y), 0.0, 512)).intersection(Polygon(second.polygon(512)))
    area = float(overlap_area_mm2(first, (x, y), second))
    assert clipped.area - 1e-6 <= area <= clipped.area + 0.001 * min(a, b) ** 2


def test_area_of_two_circles_in_closed_form():
    # Two circles of radius r whose centres lie r apart overlap in (2 pi / 3 - sqrt(3) / 2) r^2.
    circle = outlines.circle(20.0)
    exact = (2 * np.pi / 3 - np.sqrt(3) / 2) * 100
    assert float(overlap_area_mm2(circle, (0.0, 10.0), circle)) == pytest.approx(exact)
    areas = overlap_area_mm2(circle, [[0, 0], [20, 0], [30, 0]], circle)
    assert areas == pytest.approx(np.array([circle.area_mm2, 0.0, 0.0]), abs=1e-9)


def test_overlap_polygon_lies_in_the_bottom_frame():
    ring = overlap_polygon(outlines.square(10.0), (8.0, 0.0), outlines.square(10.0))
    assert Polygon(ring).bounds == pytest.approx((3.0, -5.0, 5.0, 5.0))
    assert overlap_polygon(outlines.square(10.0), (20.0, 0.0), outlines.square(10.0)).shape == (
        0,
        2,
    )


REGIONS = {
    "ring": regions.ring(24.0, 12.0),
    "frame": regions.region(
        [
            (
                [(-9, -6), (9, -6), (9, 6), (-9, 6)],
                [[(1, -3), (6, -3), (6, 3), (1, 3)], [(-6, -3), (-3, -3), (-3, 3), (-6, 3)]],
            )
        ]
    ),
    "crescent": regions.crescent(24.0, 18.0, 7.0),
    "ell": regions.ell(20.0, 16.0, 6.0),
    "tee": regions.tee(20.0, 18.0, 6.0),
    "channel": regions.channel(20.0, 16.0, 5.0),
    "star": regions.star(5, 26.0, 13.0),
    "feet": regions.feet([(9.0, 0.0), (-4.5, 7.8), (-4.5, -7.8)], 6.0),
}
a_region = st.sampled_from(list(REGIONS.values()))


def oracle_of(outline):
    """Return the outline as built by shapely from its rings by the odd-even rule."""
    shape = Polygon()
    for ring in rings_of(outline.path()):
        shape = shape.symmetric_difference(Polygon(ring))
    return shape


@pytest.mark.parametrize("outline", REGIONS.values(), ids=REGIONS)
def test_regions_agree_with_shapely(outline):
    oracle = oracle_of(outline)
    assert outline.kind == "region"
    assert outline.area_mm2 == pytest.approx(oracle.area)
    low_x, low_y, high_x, high_y = oracle.bounds
    assert outline.half_extents_mm == pytest.approx((max(-low_x, high_x), max(-low_y, high_y)))
    points = np.random.default_rng(1).uniform(-14, 14, size=(2000, 2))
    expected = [oracle.covers(Point(p)) for p in points]
    assert 100 < sum(expected) < 1900
    assert outline.contains(points).tolist() == expected
    hull = oracle.convex_hull
    assert Polygon(outline.polygon()).symmetric_difference(hull).area < 1e-9
    inset = outlines.inset_mm(outline, points)
    for point, at in zip(points[:200], inset[:200], strict=True):
        if hull.covers(Point(point)):
            assert at == pytest.approx(hull.exterior.distance(Point(point)))
        else:
            assert at < 1e-9


@pytest.mark.parametrize("outline", REGIONS.values(), ids=REGIONS)
def test_all_edges_of_a_region_count_as_inside(outline):
    for ring in rings_of(outline.path()):
        middle = 0.5 * (ring + np.roll(ring, 1, axis=0))
        assert outline.contains(np.concatenate([ring, middle])).all()
        turned = outlines.rotated(outlines.rotated(middle, 0.7), -0.7)
        assert outline.contains(turned).all()
    points = face_points(outline)
    assert outline.contains(points).all()


@given(a_region, st.one_of(a_region, outline), place, yaw, place)
def test_overlap_and_contact_of_regions_agree_with_shapely(a, b, at, turn, point):
    placed = affinity.translate(
        affinity.rotate(oracle_of(a), turn, origin=(0, 0), use_radians=True), *at
    )
    common = placed.intersection(oracle_of(b))
    assert float(overlap_area_mm2(a, at, b, turn)) == pytest.approx(common.area, abs=1e-6)
    assert float(overlap_area_mm2(a, np.array([[at]] * 2), b, turn)[1, 0]) == pytest.approx(
        common.area, abs=1e-6
    )
    drawn = Polygon()
    for ring in rings_of(overlap_polygon(a, at, b, turn)):
        drawn = drawn.symmetric_difference(Polygon(ring))
    assert drawn.symmetric_difference(common).area < 1e-4
    edges = contact_edges(a, at, turn, b)
    margin = float(signed_distances_mm(np.array(point), edges))
    parts = [p for p in getattr(common, "geoms", [common]) if p.area > 1e-5]
    if not parts:
        assert margin == -math.inf or common.area > 1e-6
        return
    if any(1e-7 < p.area <= 1e-5 for p in getattr(common, "geoms", [common])):
        return
    hull = union_all(parts).convex_hull
    distance = hull.exterior.distance(Point(point))
    assert margin == pytest.approx(distance if hull.covers(Point(point)) else -distance, abs=1e-6)


def test_contact_of_convex_outlines_is_their_overlap():
    hexagon, disc = outlines.regular_polygon(6, 20.0), outlines.circle(18.0)
    edges = contact_edges(hexagon, (3.0, 1.0), 0.2, disc, (-1.0, 0.5), 0.1)
    expected = outlines.overlap_edges(
        hexagon.placed((3.0, 1.0), 0.2), disc.placed((-1.0, 0.5), 0.1)
    )
    assert np.array_equal(edges.start_mm, expected.start_mm)
    assert np.array_equal(edges.kept, expected.kept)


@pytest.mark.parametrize("outline", [*REGIONS.values(), *ALL])
def test_convex_cells_fill_the_outline(outline):
    cells = [Polygon(cell) for cell in regions.convex_cells(outline)]
    assert all(cell.is_valid and cell.exterior.is_ccw for cell in cells)
    assert all(cell.convex_hull.area == pytest.approx(cell.area) for cell in cells)
    assert sum(cell.area for cell in cells) == pytest.approx(union_all(cells).area)
    whole = oracle_of(outline)
    assert union_all(cells).symmetric_difference(whole).area < 1e-6
    assert len(cells) <= 2 * len(outline.path())


def test_a_convex_region_is_a_polygon():
    square = [(-5, -5), (-5, 5), (5, 5), (5, -5), (-5, -5)]
    assert regions.region([(square, [])]) == outlines.convex_polygon(
        ((5.0, -5.0), (5.0, 5.0), (-5.0, 5.0), (-5.0, -5.0))
    )


def test_the_rings_of_a_region_are_turned():
    hole = [(1, -1), (-1, -1), (-1, 1), (1, 1)]
    outer = [(4 * x, 4 * y) for x, y in hole]
    outlines_of = [
        regions.region([(a, [b])]) for a in (outer, outer[::-1]) for b in (hole, hole[::-1])
    ]
    for outline in outlines_of:
        (exterior, (inner,)) = outline.parts[0]
        assert Polygon(exterior).exterior.is_ccw
        assert not Polygon(inner).exterior.is_ccw
        assert outline.area_mm2 == 60.0


def box(half, x=0.0, y=0.0):
    return [(x - half, y - half), (x + half, y - half), (x + half, y + half), (x - half, y + half)]


@pytest.mark.parametrize(
    ("parts", "reason"),
    [
        ([], "at least one part"),
        ([([(0, 0), (1, 0)], [])], "part 1 needs at least 3 corners"),
        ([(box(5), [box(6)])], "part 1 is not a simple outline: hole lies outside shell"),
        ([([(0, 0), (5, 5), (5, 0), (0, 5)], [])], r"self-intersection near \(2.5, 2.5\)"),
        ([(box(5), []), (box(5, 9), [])], "two parts touch or overlap"),
        ([(box(5), []), (box(5, 10), [])], "two parts touch or overlap"),
        ([(box(5), []), (box(5, 10.1), [])], r"gap is narrower than 0.2 mm near \(5.0, "),
        ([(box(5, 20), [box(2, 20)])], "inside the convex hull"),
        ([(box(5), [box(4.95)])], "material is narrower than 0.2 mm"),
        ([(box(5), [box(0.05)])], r"gap is narrower than 0.2 mm near \(0.0, 0.0\)"),
        (
            [([*box(5), (-5, 0.05), (-8, 0.05), (-8, -0.05), (-5, -0.05)], [])],
            r"material .* near \(-7.0",
        ),
        ([([(-5, -5), (-0.2, -0.2), (5, -5), (5, 5), (-0.1, -0.15), (-5, 5)], [])], "material"),
        ([([(0, 0), (math.nan, 1), (2, 2)], [])], r"part 1: \(nan, 1\) is not within 500 mm"),
        ([(box(501), [])], "not within 500 mm"),
    ],
)
def test_bad_regions_are_refused(parts, reason):
    with pytest.raises(ValueError, match=reason):
        regions.region(parts)


@given(st.lists(place, min_size=3, max_size=7))
def test_any_accepted_region_is_valid(corners):
    try:
        outline = regions.region([(corners, [])])
    except ValueError:
        return
    assert Polygon(outline.rings[0]).is_valid
    assert outline.area_mm2 > 0.0


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: regions.ring(10.0, 12.0), "inner diameter"),
        (lambda: regions.crescent(20.0, 10.0, 1.0), "must cross"),
        (lambda: regions.star(2, 20.0, 10.0), "at least 3 points"),
    ],
)
def test_impossible_shapes_are_refused(build, reason):
    with pytest.raises(ValueError, match=reason):
        build()


def test_the_closed_forms_of_regions():
    n = 64
    disc = 0.5 * n * math.sin(2 * math.pi / n)
    assert regions.ring(24.0, 12.0).area_mm2 == pytest.approx(disc * (144 - 36))
    assert regions.ell(20.0, 16.0, 6.0).area_mm2 == pytest.approx(20 * 6 + 10 * 6)
    lens = float(overlap_area_mm2(outlines.circle(24.0), (7.0, 0.0), outlines.circle(18.0)))
    crescent = regions.crescent(24.0, 18.0, 7.0)
    assert crescent.area_mm2 == pytest.approx(math.pi * 144 - lens, rel=5e-3)
    for name in ("ell", "tee", "channel", "crescent"):
        centre = oracle_of(REGIONS[name]).centroid
        assert (centre.x, centre.y) == pytest.approx((0.0, 0.0), abs=1e-9)
