import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from shapely.geometry import Point, Polygon

from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.tower import Body, Tower, judge_tower


def cylinder(
    name: str, diameter: float, height: float, mass: float, at: tuple[float, float] = (0.0, 0.0)
) -> Body:
    face = outlines.circle(diameter)
    return Body(name, face, face, height, mass, height / 2, at_mm=at)


def leaning(long_mm: float, mushroom_mm: float) -> Tower:
    """The tower of bench-physics, section 8.2; the mushroom's offset is relative to long."""
    return Tower(
        (
            cylinder("short", 25.0, 30.0, 30.0),
            cylinder("long", 15.0, 60.0, 35.0, (long_mm, 0.0)),
            cylinder("mushroom", 25.0, 45.0, 40.0, (long_mm + mushroom_mm, 0.0)),
        )
    )


def test_pair_by_hand() -> None:
    base = replace(cylinder("board", 15.0, 20.0, 0.0), fixed=True)
    verdict = judge_tower(Tower((base, cylinder("pot", 25.0, 40.0, 40.0, (5.0, 0.0)))))
    # The centre of mass is 2.5 mm inside the edge of the smaller circle.
    assert verdict.margins_mm == (math.inf, pytest.approx(2.5, abs=0.004))
    assert verdict.interfaces == ("board on table", "pot on board")
    assert verdict.weakest == "pot on board"
    assert verdict.stands
    assert not verdict.too_close


@pytest.mark.parametrize(
    ("long_mm", "threshold_mm"), [(0.0, 7.5), (9.0, 6.5625), (11.0, 2.8125), (11.0, -7.5)]
)
def test_tower_thresholds(long_mm: float, threshold_mm: float) -> None:
    # Inward and centred the top face decides at 7.5 mm; outward the load of long and mushroom
    # leaves short's edge: (35 * 11 + 40 * (11 + e)) / 75 = 12.5 gives e = 2.8125.
    outward = math.copysign(0.02, threshold_mm)
    assert judge_tower(leaning(long_mm, threshold_mm - outward)).stands
    assert not judge_tower(leaning(long_mm, threshold_mm + outward)).stands


def test_tower_that_the_top_face_alone_would_pass() -> None:
    verdict = judge_tower(leaning(11.0, 5.0))
    assert verdict.margins_mm[2] == pytest.approx(2.5, abs=0.004)
    assert verdict.margin_mm == pytest.approx(12.5 - (11 + 40 * 5 / 75), abs=0.004)
    assert verdict.weakest == "long on short"


def test_free_base_tips_over_its_own_edge() -> None:
    # Board of 10 mm width, load 3 mm beyond its edge on a wide cap: tips over the table.
    wide = Body("cap", outlines.square(10.0), outlines.square(60.0), 20.0, 10.0, 10.0)
    tower = Tower((wide, cylinder("load", 10.0, 20.0, 90.0, (8.0, 0.0))))
    verdict = judge_tower(tower)
    assert verdict.margins_mm[0] == pytest.approx(5.0 - 7.2)
    assert verdict.weakest == "cap on table"
    assert verdict.margins_mm[1] == pytest.approx(5.0, abs=0.01)


def test_centre_of_mass_turns_with_the_body() -> None:
    base = replace(cylinder("board", 40.0, 20.0, 0.0), fixed=True)
    top = Body(
        "top", outlines.square(10.0), None, 20.0, 10.0, 10.0, (4.0, 0.0), yaw_rad=math.pi / 2
    )
    assert top.centre_mm == pytest.approx([0.0, 4.0])
    assert judge_tower(Tower((base, top))).margin_mm == pytest.approx(1.0)
    heavy = replace(top, com_xy_mm=(5.1, 0.0), at_mm=(2.0, 3.0))
    assert judge_tower(Tower((base, heavy))).margin_mm == pytest.approx(-0.1)


def test_disturbance_shifts_the_centre_of_mass_of_the_released_piece() -> None:
    tower = leaning(11.0, 2.5)
    assert judge_tower(tower).stands
    kicked = judge_tower(tower, disturbance_mm=(0.6, 0.0))
    assert not kicked.stands
    assert kicked.margins_mm == pytest.approx(judge_tower(leaning(11.0, 3.1)).margins_mm, abs=0.6)
    assert kicked.margins_mm[1] == pytest.approx(
        judge_tower(leaning(11.0, 3.1)).margins_mm[1], abs=1e-9
    )


def test_too_close_to_call() -> None:
    assert judge_tower(leaning(0.0, 7.4)).too_close
    assert judge_tower(leaning(0.0, 7.6)).too_close
    assert not judge_tower(leaning(0.0, 7.2)).too_close


def test_no_overlap_never_stands() -> None:
    verdict = judge_tower(leaning(0.0, 30.0))
    assert verdict.margin_mm == -math.inf
    assert not verdict.stands


OUTLINES = [
    outlines.circle(20.0),
    outlines.rectangle(12.0, 28.0),
    outlines.regular_polygon(6, 20.0),
]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(OUTLINES), st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3),
            st.floats(5, 60),
        ),
        min_size=1,
        max_size=4,
    )
)  # fmt: skip
def test_margins_agree_with_shapely(
    rows: list[tuple[outlines.Outline, float, float, float, float]],
) -> None:
    bodies = tuple(
        Body(f"b{i}", o, o, 30.0, mass, 15.0, at_mm=(x, y), yaw_rad=yaw)
        for i, (o, x, y, yaw, mass) in enumerate(rows)
    )
    placed = [Polygon(b.lower.placed(b.at_mm, b.yaw_rad)) for b in bodies]
    for k, margin in enumerate(judge_tower(Tower(bodies)).margins_mm):
        hull = placed[k] if k == 0 else placed[k - 1].intersection(placed[k])
        if hull.area < 1e-3:
            continue
        mass = np.array([b.mass_g for b in bodies[k:]])
        load = Point(mass @ np.array([b.at_mm for b in bodies[k:]]) / mass.sum())
        distance = hull.exterior.distance(load)
        assert margin == pytest.approx(distance if hull.covers(load) else -distance, abs=1e-6)


def test_impossible_towers_are_refused() -> None:
    body = cylinder("a", 20.0, 30.0, 30.0)
    with pytest.raises(ValueError, match="needs a body"):
        Tower(())
    with pytest.raises(InputError, match="fixed"):
        Tower((body, replace(body, fixed=True)))
    with pytest.raises(InputError, match="carries nothing"):
        Tower((replace(body, upper=None),)).with_top(body)
