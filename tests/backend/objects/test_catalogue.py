import re
from pathlib import Path

import pytest

from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.pieces import load_pieces

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


def test_shipped_pieces_have_the_nominal_sizes() -> None:
    catalogue = load_pieces()
    assert catalogue.tops == ("barrel", "mug", "mushroom", "pot")
    assert set(catalogue.bottoms) == {
        "short", "long", "hex20", "rect12x28", "circle15", "circle25", "square15", "barrel",
    }  # fmt: skip
    tops = {
        name: (p.face.radius_mm * 2, p.height_mm, p.com_height_mm, p.mass_g, p.grip_height_mm)
        for name in catalogue.tops
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


def test_the_centre_of_mass_of_the_mug_alone_is_off_its_middle() -> None:
    pieces = load_pieces().pieces
    off = {name: p.com_xy_mm for name, p in pieces.items() if p.com_xy_mm != (0.0, 0.0)}
    assert off == {"mug": (1.7, -0.9)}
    assert pieces["mug"].body((3.0, 4.0)).com_xy_mm == (1.7, -0.9)


def test_only_the_board_is_fixed_and_measured() -> None:
    pieces = load_pieces().pieces.values()
    board = {"circle15", "circle25", "square15"}
    assert {p.name for p in pieces if p.fixed} == board
    assert {p.name for p in pieces if not p.nominal} == board
    assert len({p.sha256 for p in pieces}) == len(pieces)
    assert all(re.fullmatch("[0-9a-f]{64}", p.sha256) for p in pieces)


def test_roles_are_kept_apart() -> None:
    catalogue = load_pieces()
    assert catalogue.bottom("short").name == "short"
    with pytest.raises(InputError, match=r"cannot be grasped.*barrel, mug, mushroom, pot"):
        catalogue.top("short")
    with pytest.raises(InputError, match="cannot carry another piece"):
        catalogue.bottom("pot")
    assert catalogue.piece("mushroom").body().upper is None


def test_unknown_piece_names_file_and_known_ones() -> None:
    with pytest.raises(InputError) as caught:
        load_pieces().piece("teapot")
    assert "teapot.toml" in caught.value.where
    assert "barrel" in caught.value.fix


def test_an_operator_adds_and_replaces_pieces(tmp_path: Path) -> None:
    (tmp_path / "cup.toml").write_text(CUP)
    (tmp_path / "pot.toml").write_text(CUP)
    catalogue = load_pieces(tmp_path)
    cup = catalogue.piece("cup")
    assert (cup.lower, cup.upper) == (outlines.circle(18.0), outlines.regular_polygon(8, 30.0))
    assert cup.face == cup.lower
    assert catalogue.piece("pot").height_mm == 50.0
    body = cup.body((3.0, 4.0), 0.1)
    assert (body.at_mm, body.yaw_rad, body.mass_g) == ((3.0, 4.0), 0.1, 12.5)


def test_a_bottom_meets_the_piece_with_its_upper_face(tmp_path: Path) -> None:
    text = CUP.replace('"top", ', "").replace("grip_height_mm = 25.0", "")
    (tmp_path / "foot.toml").write_text(text)
    foot = load_pieces(tmp_path).piece("foot")
    assert (foot.upper, foot.lower) == (outlines.circle(18.0), outlines.regular_polygon(8, 30.0))
    assert foot.grip_height_mm is None


def test_the_hash_follows_the_content_not_the_text(tmp_path: Path) -> None:
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
        ("mass_g = 12.5", 'mass_g = "heavy"', "mass_g"),
        ("mass_g = 12.5", "mass_g = nan", "mass_g"),
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
def test_a_bad_file_gives_one_error_with_file_key_and_reason(
    tmp_path: Path, old: str, new: str, key: str
) -> None:
    path = tmp_path / "cup.toml"
    assert old in CUP
    path.write_text(CUP.replace(old, new, 1))
    with pytest.raises(InputError) as caught:
        load_pieces(tmp_path)
    assert caught.value.where == str(path)
    assert key in caught.value.what
    assert key in caught.value.fix


def test_a_polygon_must_be_convex(tmp_path: Path) -> None:
    head, tail = CUP.split("[face]")[0], "vertices_mm = [[-5, -5], [5, -5], [-4, -4], [-5, 5]]\n"
    (tmp_path / "cup.toml").write_text(f'{head}[face]\nshape = "polygon"\n{tail}')
    with pytest.raises(InputError, match=r"face.*counter-clockwise"):
        load_pieces(tmp_path)


def test_broken_toml_bad_name_and_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_pieces(tmp_path / "none")
    (tmp_path / "My Cup.toml").write_text(CUP)
    with pytest.raises(InputError, match="Rename the file"):
        load_pieces(tmp_path)
    (tmp_path / "My Cup.toml").rename(tmp_path / "cup.toml")
    (tmp_path / "cup.toml").write_text("mass_g = = 3")
    with pytest.raises(InputError, match="not valid TOML"):
        load_pieces(tmp_path)
