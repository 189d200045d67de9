""""""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from shapely.geometry import Point, Polygon

from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import outlines, sampling
from touchdown.backend.geometry.outlines import overlap_area_mm2
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.sampling import draw_offset, draw_start
from touchdown.backend.geometry.tower import TOO_CLOSE_MM, Body, Tower, judge_tower

CUP = """
title = "Cup"
roles = ["top", "bottom"]
height_mm = 50.0
com_height_mm = 20.0
mass_g = 12.5
grip_height_mm = 25.0

[face]
shape = "circle"
diameter_mm = 18.0

[opposite]
shape = "regular"
sides = 8
across_corners_mm = 30.0
"""


def test_shipped_pieces_have_the_nominal_sizes():
    catalogue = load_pieces()
    assert catalogue.tops == ("barrel", "brick", "mug", "mushroom", "pot")
    assert set(catalogue.bottoms) == {
        "short", "long", "hex20", "rect12x28", "circle15", "circle25", "square15", "barrel",
        "ring24", "ell20", "channel20", "star26", "feet3",
    }  # fmt: skip
    tops = {
        name: (p.face.radius_mm * 2, p.height_mm, p.com_height_mm, p.mass_g, p.grip_height_mm)
        for name in catalogue.tops
        if name != "brick"
        for p in [catalogue.piece(name)]
    }
    assert tops == {
        "mushroom": (25.4, 67, 33, 21, 33),
        "barrel": (21.2, 46, 23, 30, 40),
        "pot": (15.0, 38, 20, 15, 30),
        "mug": (20.0, 45, 21, 24, 32),
    }
    assert catalogue.piece("short").face == outlines.circle(20.0)
    assert catalogue.piece("long").face == outlines.circle(18.0)
    assert catalogue.piece("hex20").face == outlines.regular_polygon(6, 20.0)
    assert catalogue.piece("rect12x28").face == outlines.rectangle(12.0, 28.0)
    assert catalogue.piece("square15").face == outlines.square(15.0)


def test_the_centre_of_mass_of_mug_and_brick_is_off_their_middle():
    pieces = load_pieces().pieces
    off = {name: p.com_xy_mm for name, p in pieces.items() if p.com_xy_mm != (0.0, 0.0)}
    assert off == {"mug": (1.7, -0.9), "brick": (2.4, -1.6)}
    assert pieces["mug"].body((3.0, 4.0)).com_xy_mm == (1.7, -0.9)


def test_an_unknown_centre_of_mass_is_no_number_and_drawn_for_the_simulated_bench(tmp_path):
    top = CUP.replace('["top", "bottom"]', '["top"]').replace(
        "mass_g", 'com_xy_mm = "unknown"\nmass_g'
    )
    (tmp_path / "cup.toml").write_text(top)
    cup = load_pieces(tmp_path).top("cup")
    assert not cup.com_known
    assert cup.body().com_xy_mm == (0.0, 0.0)
    drawn = np.array([sampling.with_true_com(cup, seed).com_xy_mm for seed in range(200)])
    assert np.abs(drawn).max() <= sampling.COM_SHARE * 9.0
    assert np.std(drawn, axis=0) == pytest.approx(0.3 * 9.0 / math.sqrt(3), rel=0.1)
    assert sampling.with_true_com(cup, 3) == sampling.with_true_com(cup, 3)
    pot = load_pieces().top("pot")
    assert sampling.with_true_com(pot, 3) is pot


@pytest.mark.parametrize(
    ("value", "what"),
    [('"unknown"', "role bottom cannot be weighed"), ('"unknwn"', r"give \[x, y\] in mm, or"),
     ("[1.0]", r"give \[x, y\] in mm, or")],
)  # fmt: skip
def test_a_wrong_centre_of_mass_is_refused_by_its_key(tmp_path, value, what):
    (tmp_path / "cup.toml").write_text(CUP.replace("mass_g", f"com_xy_mm = {value}\nmass_g"))
    with pytest.raises(InputError, match=f"Bad value for 'com_xy_mm': .*{what}"):
        load_pieces(tmp_path)


def test_only_the_board_is_fixed_and_measured():
    pieces = load_pieces().pieces.values()
    board = {"circle15", "circle25", "square15"}
    assert {p.name for p in pieces if p.fixed} == board
    assert {p.name for p in pieces if not p.nominal} == board
    assert len({p.sha256 for p in pieces}) == len(pieces)
    assert all(re.fullmatch("[0-9a-f]{64}", p.sha256) for p in pieces)


def test_roles_are_kept_apart():
    catalogue = load_pieces()
    assert catalogue.bottom("short").name == "short"
    with pytest.raises(InputError, match=r"cannot be grasped.*barrel, brick, mug, mushroom, pot"):
        catalogue.top("short")
    with pytest.raises(InputError, match="cannot carry another piece"):
        catalogue.bottom("pot")
    assert catalogue.piece("mushroom").body().upper is None


def test_unknown_piece_names_file_and_known_ones():
    with pytest.raises(InputError) as caught:
        load_pieces().piece("teapot")
    assert "teapot.toml" in caught.value.where
    assert "barrel" in caught.value.fix


def test_an_operator_adds_and_replaces_pieces(tmp_path):
    (tmp_path / "cup.toml").write_text(CUP)
    (tmp_path / "pot.toml").write_text(CUP)
    catalogue = load_pieces(tmp_path)
    cup = catalogue.piece("cup")
    assert (cup.lower, cup.upper) == (outlines.circle(18.0), outlines.regular_polygon(8, 30.0))
    assert cup.face == cup.lower
    assert catalogue.piece("pot").height_mm == 50.0
    body = cup.body((3.0, 4.0), 0.1)
    assert (body.at_mm, body.yaw_rad, body.mass_g) == ((3.0, 4.0), 0.1, 12.5)


def test_a_bottom_meets_the_piece_with_its_upper_face(tmp_path):
    text = CUP.replace('"top", ', "").replace("grip_height_mm = 25.0", "")
    (tmp_path / "foot.toml").write_text(text)
    foot = load_pieces(tmp_path).piece("foot")
    assert (foot.upper, foot.lower) == (outlines.circle(18.0), outlines.regular_polygon(8, 30.0))
    assert foot.grip_height_mm is None


def test_the_hash_follows_the_content_not_the_text(tmp_path):
    (tmp_path / "cup.toml").write_text(CUP)
    first = load_pieces(tmp_path).piece("cup").sha256
    (tmp_path / "cup.toml").write_text("# measured\n" + CUP.replace("50.0", "50"))
    assert load_pieces(tmp_path).piece("cup").sha256 == first
    (tmp_path / "cup.toml").write_text(CUP.replace("diameter_mm = 18.0", "diameter_mm = 18.1"))
    assert load_pieces(tmp_path).piece("cup").sha256 != first


@pytest.mark.promise("D8")
@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("mass_g = 12.5", "mass_g = -1", "mass_g"),
        ("mass_g = 12.5", "mass_g = 0", "fixed"),
        ("mass_g = 12.5", "", "mass_g"),
        ("mass_g = 12.5", "mass_g = 12.5\nfixed = true", "fixed"),
        ("com_height_mm = 20.0", "com_height_mm = 60.0", "com_height_mm"),
        ("grip_height_mm = 25.0", "grip_height_mm = 55.0", "grip_height_mm"),
        ("grip_height_mm = 25.0", "", "grip_height_mm"),
        ("height_mm = 50.0", "height_mm = 50.0\ncolour = 'red'", "colour"),
        ('"top", "bottom"', '"hat"', "roles"),
        ("diameter_mm = 18.0", "diameter_mm = 0", "diameter_mm"),
        ('shape = "circle"', 'shape = "star"', "face"),
        ("sides = 8", "sides = 2", "sides"),
    ],
)
def test_a_bad_file_gives_one_error_with_file_key_and_reason(tmp_path, old, new, key):
    path = tmp_path / "cup.toml"
    assert old in CUP
    path.write_text(CUP.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_pieces(tmp_path)
    assert caught.value.where == str(path)
    assert key in caught.value.what
    assert key in caught.value.fix


def test_a_polygon_must_be_convex(tmp_path):
    head, tail = CUP.split("[face]")[0], "vertices_mm = [[-5, -5], [5, -5], [-4, -4], [-5, 5]]\n"
    (tmp_path / "cup.toml").write_text(f'{head}[face]\nshape = "polygon"\n{tail}')
    with pytest.raises(InputError, match=r"face.*counter-clockwise"):
        load_pieces(tmp_path)


FRAME = """
shape = "region"
[[face.parts]]
exterior = [[-8, -8], [8, -8], [8, 8], [-8, 8]]
holes = [[[-4, -4], [4, -4], [4, 4], [-4, 4]]]
"""


def test_a_face_with_a_hole(tmp_path):
    (tmp_path / "cup.toml").write_text(
        CUP.replace('shape = "circle"\ndiameter_mm = 18.0', FRAME), encoding="utf-8"
    )
    face = load_pieces(tmp_path).piece("cup").face
    assert face.area_mm2 == 192.0
    assert not face.contains((0.0, 0.0))


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("-4, -4], [4, -4", "-9, -4], [4, -4", "part 1 is not a simple outline"),
        ("-4, -4], [4, -4", "-7.9, -4], [4, -4", r"material is narrower .* near \(-7.9, -3.9\)"),
        ("[8, 8]", "[inf, 8]", "parts.0.exterior.2.0': Input should be a finite"),
    ],
)
def test_a_bad_region_is_refused_with_the_place(tmp_path, old, new, reason):
    text = CUP.replace('shape = "circle"\ndiameter_mm = 18.0', FRAME.replace(old, new))
    (tmp_path / "cup.toml").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=reason) as caught:
        load_pieces(tmp_path)
    assert "cup.toml" in caught.value.where


def test_a_ring_carries_what_stands_over_its_hole():
    catalogue = load_pieces()
    ring = catalogue.piece("ring24")
    assert ring.face.area_mm2 == pytest.approx(math.pi * 108.0, rel=2e-3)
    tower = Tower((ring.body(), catalogue.piece("pot").body((1.0, 0.0))))
    # The hull of the contact is the pot's face cut by the outer circle: all of it.
    assert judge_tower(tower).margins_mm[1] == pytest.approx(7.5, abs=0.02)
    alone = Tower((ring.body(), catalogue.piece("pot").body((9.0, 0.0))))
    half = outlines.overlap_polygon(outlines.circle(15.0), (9.0, 0.0), ring.face)
    expected = Polygon(half).convex_hull
    assert not expected.equals(Polygon(half))
    distance = expected.exterior.distance(Point(9.0, 0.0))
    assert judge_tower(alone).margins_mm[1] == pytest.approx(distance, abs=1e-9)


def test_broken_toml_bad_name_and_missing_folder(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        load_pieces(tmp_path / "none")
    (tmp_path / "My Cup.toml").write_text(CUP)
    with pytest.raises(InputError, match="Rename the file"):
        load_pieces(tmp_path)
    (tmp_path / "My Cup.toml").rename(tmp_path / "cup.toml")
    (tmp_path / "cup.toml").write_text("mass_g = = 3")
    with pytest.raises(InputError, match="not valid TOML"):
        load_pieces(tmp_path)


def test_data_offsets_fill_the_region_evenly():
    face, bottom = outlines.circle(15.0), outlines.circle(25.0)
    offsets = draw_offset(np.random.default_rng(4), face, bottom, 1500)
    assert offsets.shape == (1500, 2)
    assert (overlap_area_mm2(face, offsets, bottom) >= 6.0).all()
    # The region is a disc: its squared radius is uniform, and it ends where 6 mm² remain.
    radius = np.hypot(*offsets.T)
    edges = np.linspace(15.0, 20.0, 2001)
    rim = edges[overlap_area_mm2(face, np.stack([edges, 0 * edges], 1), bottom) >= 6.0].max()
    assert radius.max() == pytest.approx(rim, abs=0.1)
    assert stats.kstest((radius / rim) ** 2, "uniform").pvalue > 0.01
    assert stats.kstest(np.arctan2(*offsets.T) / (2 * math.pi) + 0.5, "uniform").pvalue > 0.01


@pytest.mark.parametrize("bottom", ["short", "rect12x28", "square15"])
def test_starts_are_unstable_and_still_touch(bottom):
    catalogue = load_pieces()
    piece = catalogue.piece("mushroom").body()
    below = catalogue.piece(bottom).body((40.0, -10.0))
    rng = np.random.default_rng(7)
    starts = [draw_start(rng, piece, Tower((below,))) for _ in range(40)]
    for x, y in starts:
        assert float(overlap_area_mm2(piece.lower, (x, y), below.lower)) >= 6.0
        tower = Tower((below, replace(piece, at_mm=(40.0 + x, -10.0 + y))))
        assert judge_tower(tower).margin_mm <= -0.2
    assert len(set(starts)) == 40


def test_starts_of_a_leaning_tower_may_lie_inside_the_top_face():
    catalogue = load_pieces()
    bottoms = Tower((catalogue.piece("short").body(), catalogue.piece("long").body((8.0, 0.0))))
    rng = np.random.default_rng(2)
    starts = [draw_start(rng, catalogue.piece("pot").body(), bottoms) for _ in range(60)]
    assert any(math.hypot(x, y) < 9.0 for x, y in starts)


def test_the_same_seed_gives_the_same_start():
    catalogue = load_pieces()
    piece, bottoms = catalogue.piece("pot").body(), Tower((catalogue.piece("hex20").body(),))
    first, second = (draw_start(np.random.default_rng(7), piece, bottoms) for _ in range(2))
    assert first == second


def test_impossible_starts_are_refused(monkeypatch):
    catalogue = load_pieces()
    pot, short = catalogue.piece("pot").body(), catalogue.piece("short").body()
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="by themselves"):
        draw_start(rng, pot, Tower((short, replace(short, at_mm=(12.0, 0.0)))))
    with pytest.raises(InputError, match="carries nothing"):
        draw_start(rng, pot, Tower((pot,)))
    with pytest.raises(InputError, match="hardly overlap"):
        draw_offset(rng, pot.lower, outlines.circle(2.0), 1)
    monkeypatch.setattr(sampling, "MIN_OVERLAP_MM2", 170.0)
    with pytest.raises(InputError, match="No unstable start"):
        draw_start(rng, pot, Tower((short,)))


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


def test_pair_by_hand():
    base = replace(cylinder("board", 15.0, 20.0, 0.0), fixed=True)
    verdict = judge_tower(Tower((base, cylinder("pot", 25.0, 40.0, 40.0, (5.0, 0.0)))))
    # The centre of mass is 2.5 mm inside the edge of the smaller circle.
    assert verdict.margins_mm == (math.inf, pytest.approx(2.5, abs=0.004))
    assert verdict.stands
    assert abs(verdict.margin_mm) >= TOO_CLOSE_MM


@pytest.mark.parametrize(
    ("long_mm", "threshold_mm"), [(0.0, 7.5), (9.0, 6.5625), (11.0, 2.8125), (11.0, -7.5)]
)
def test_tower_thresholds(long_mm, threshold_mm):
    # Inward and centred the top face decides at 7.5 mm; outward the load of long and mushroom
    # leaves short's edge: (35 * 11 + 40 * (11 + e)) / 75 = 12.5 gives e = 2.8125.
    outward = math.copysign(0.02, threshold_mm)
    assert judge_tower(leaning(long_mm, threshold_mm - outward)).stands
    assert not judge_tower(leaning(long_mm, threshold_mm + outward)).stands


def test_tower_that_the_top_face_alone_would_pass():
    verdict = judge_tower(leaning(11.0, 5.0))
    assert verdict.margins_mm[2] == pytest.approx(2.5, abs=0.004)
    assert verdict.margin_mm == pytest.approx(12.5 - (11 + 40 * 5 / 75), abs=0.004)
    assert verdict.margins_mm.index(verdict.margin_mm) == 1


def test_free_base_tips_over_its_own_edge():
    # Board of 10 mm width, load 3 mm beyond its edge on a wide cap: tips over the table.
    wide = Body("cap", outlines.square(10.0), outlines.square(60.0), 20.0, 10.0, 10.0)
    tower = Tower((wide, cylinder("load", 10.0, 20.0, 90.0, (8.0, 0.0))))
    verdict = judge_tower(tower)
    assert verdict.margins_mm[0] == pytest.approx(5.0 - 7.2)
    assert verdict.margin_mm == verdict.margins_mm[0]
    assert verdict.margins_mm[1] == pytest.approx(5.0, abs=0.01)


def test_centre_of_mass_turns_with_the_body():
    base = replace(cylinder("board", 40.0, 20.0, 0.0), fixed=True)
    top = Body(
        "top", outlines.square(10.0), None, 20.0, 10.0, 10.0, (4.0, 0.0), yaw_rad=math.pi / 2
    )
    assert top.centre_mm == pytest.approx([0.0, 4.0])
    assert judge_tower(Tower((base, top))).margin_mm == pytest.approx(1.0)
    heavy = replace(top, com_xy_mm=(5.1, 0.0), at_mm=(2.0, 3.0))
    assert judge_tower(Tower((base, heavy))).margin_mm == pytest.approx(-0.1)


def test_disturbance_shifts_the_centre_of_mass_of_the_released_piece():
    tower = leaning(11.0, 2.5)
    assert judge_tower(tower).stands
    kicked = judge_tower(tower, disturbance_mm=(0.6, 0.0))
    assert not kicked.stands
    assert kicked.margins_mm == pytest.approx(judge_tower(leaning(11.0, 3.1)).margins_mm, abs=0.6)
    assert kicked.margins_mm[1] == pytest.approx(
        judge_tower(leaning(11.0, 3.1)).margins_mm[1], abs=1e-9
    )


def test_too_close_to_call():
    close = [abs(judge_tower(leaning(0.0, mm)).margin_mm) < TOO_CLOSE_MM for mm in (7.4, 7.6, 7.2)]
    assert close == [True, True, False]


def test_no_overlap_never_stands():
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
def test_margins_agree_with_shapely(rows):
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


def test_impossible_towers_are_refused():
    body = cylinder("a", 20.0, 30.0, 30.0)
    with pytest.raises(ValueError, match="needs a body"):
        Tower(())
    with pytest.raises(InputError, match="fixed"):
        Tower((body, replace(body, fixed=True)))
    with pytest.raises(InputError, match="carries nothing"):
        Tower((replace(body, upper=None),)).with_top(body)
