"""Patch of an offset compared with independently computed counts and distances."""

import math

import numpy as np
import pytest
from shapely.geometry import MultiPoint, Point

from touchdown.backend.core.values import SupportKind
from touchdown.backend.geometry.outlines import circle, face_points, rectangle, square
from touchdown.backend.placement.equilibrium import resting_contact

POT = face_points(circle(15.0))


@pytest.mark.parametrize(("x_mm", "points"), [(0.0, 177), (5.0, 102), (8.0, 63)])
def test_published_counts_of_circle_15_on_circle_15(x_mm, points):
    assert resting_contact(POT, (0.0, 0.0), circle(15.0), (x_mm, 0.0)).touching.sum() == points


@pytest.mark.parametrize("offset", [(0.0, 0.0), (3.1, -2.2), (6.7, 4.0), (-9.9, 1.3)])
@pytest.mark.parametrize("bottom", [circle(18.0), square(15.0), rectangle(12.0, 28.0)])
def test_hull_and_margin_agree_with_shapely(offset, bottom):
    found = resting_contact(POT, (0.5, -0.25), bottom, offset)
    hull = MultiPoint(found.points_mm[found.touching]).convex_hull
    centre = Point(*found.centre_mm)
    assert found.centre_mm == pytest.approx((offset[0] + 0.5, offset[1] - 0.25))
    distance = hull.exterior.distance(centre)
    expected = distance if hull.covers(centre) else -distance
    assert found.margin_mm == pytest.approx(expected, abs=1e-9)
    assert found.stable == hull.covers(centre)


def test_a_quarter_turn_turns_everything():
    flat = resting_contact(POT, (0.5, 0.0), rectangle(12.0, 28.0), (5.0, 1.0))
    turned = resting_contact(POT, (0.5, 0.0), rectangle(28.0, 12.0), (-1.0, 5.0), math.pi / 2)
    quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
    assert np.allclose(flat.points_mm @ quarter, turned.points_mm)
    assert (flat.touching == turned.touching).all()
    assert turned.margin_mm == pytest.approx(flat.margin_mm)


def test_without_contact_there_is_no_hull():
    apart = resting_contact(POT, (0.0, 0.0), circle(15.0), (40.0, 0.0))
    assert (apart.support, apart.margin_mm, apart.stable) == (SupportKind.NONE, -math.inf, False)
    assert apart.share == 0.0


def test_near_the_edge_nobody_can_say():
    square_face = face_points(square(10.0))
    near = resting_contact(square_face, (0.9, 0.0), square(10.0), (4.0, 0.0))
    assert near.margin_mm == pytest.approx(0.1)
    assert near.too_close
    assert not resting_contact(square_face, (0.0, 0.0), square(10.0), (3.0, 0.0)).too_close


def test_a_displacement_must_be_a_number():
    with pytest.raises(ValueError, match="finite"):
        resting_contact(POT, (0.0, 0.0), circle(15.0), (math.nan, 0.0))
