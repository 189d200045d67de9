""""""

import math
import struct
import tomllib
from xml.etree import ElementTree

import numpy as np
import pytest
import trimesh

from touchdown.backend.core import InputError
from touchdown.backend.geometry import cad
from touchdown.backend.geometry.cad import PieceImport, measure_piece, piece_name, save_piece
from touchdown.backend.geometry.pieces import load_pieces, pieces_folder, read_piece

PLA = PieceImport(density_g_cm3=1.24)


def prism(corners, height, hole=(), at=0.0):
    """Return the triangles (n, 3, 3) of a prism over a star-shaped polygon, or of a frame."""
    low = np.array([(*p, at) for p in corners], float)
    triangles = []
    rings = [low] if not hole else [low, np.array([(*p, at) for p in hole], float)]
    up = np.array([0.0, 0.0, height])
    for ring, sign in zip(rings, (1, -1), strict=False):
        for a, b in zip(ring, np.roll(ring, -1, axis=0), strict=True):
            wall = [(a, b, b + up), (a, b + up, a + up)]
            triangles += wall if sign > 0 else [w[::-1] for w in wall]
    if hole:
        inner, outer = rings[1], rings[0]
        lid = []
        for i in range(len(outer)):
            j = (i + 1) % len(outer)
            lid += [(outer[i], outer[j], inner[j]), (outer[i], inner[j], inner[i])]
    else:
        lid = [(low[0], low[i], low[i + 1]) for i in range(1, len(low) - 1)]
    triangles += [(a + up, b + up, c + up) for a, b, c in lid] + [(c, b, a) for a, b, c in lid]
    return np.array(triangles)


def binary_stl(triangles):
    """Return a binary STL, written by hand from the description of the format."""
    rows = b"".join(struct.pack("<12fH", 0, 0, 0, *map(float, np.ravel(t)), 0) for t in triangles)
    return bytes(80) + struct.pack("<I", len(triangles)) + rows


def ascii_stl(triangles):
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in t)
        + "endloop\nendfacet\n"
        for t in triangles
    )
    return f"solid part\n{facets}endsolid part\n".encode()


def turning(radius, count):
    angle = 2 * np.pi * np.arange(count) / count
    return [(radius * math.cos(a), radius * math.sin(a)) for a in angle]


L_BLOCK = [(0, 0), (30, 0), (30, 10), (10, 10), (10, 40), (0, 40)]


@pytest.fixture
def stl(tmp_path):
    def write(triangles, form=binary_stl, name="part.stl"):
        path = tmp_path / name
        path.write_bytes(form(triangles))
        return path

    return write


def test_a_cylinder_with_a_hole_has_the_area_volume_and_centre_of_the_closed_form(stl):
    n, height = 90, 24.0
    found = measure_piece(stl(prism(turning(12, n), height, turning(5, n))), PLA)
    # Area of a regular polygon of n corners on a circle of radius r: n r² sin(2π/n) / 2.
    area = n / 2 * math.sin(2 * math.pi / n) * (12**2 - 5**2)
    assert found.face.area == pytest.approx(area, rel=1e-4)
    assert found.volume_mm3 == pytest.approx(area * height, rel=1e-6)
    assert found.mass_g == pytest.approx(1.24e-3 * area * height, rel=1e-6)
    assert found.com_mm == pytest.approx((0, 0, height / 2), abs=1e-5)
    assert [len(part.interiors) for part in found.face.geoms] == [1]
    assert found.grip_mm == pytest.approx(0.7 * height, abs=0.05)
    assert found.width_mm == pytest.approx(24.0, abs=0.02)
    assert found.notes == ()


def test_an_l_block_has_the_centre_of_its_two_rectangles(stl):
    found = measure_piece(stl(prism(L_BLOCK, 20), ascii_stl), PieceImport(mass_g=50.0))
    # 30 x 10 about (15, 5) and 10 x 30 about (5, 25); origin in the middle (15, 20).
    x, y = (300 * 15 + 300 * 5) / 600 - 15, (300 * 5 + 300 * 25) / 600 - 20
    assert found.com_mm == pytest.approx((x, y, 10.0), abs=1e-5)
    assert (found.face.area, found.volume_mm3) == pytest.approx((600, 12000))
    assert found.mass_g == 50.0
    # Between pads at x = -10 to 10 lie the foot at y = -20 and the leg up to 20.
    assert found.grip_y_mm == pytest.approx((-20, 20), abs=1e-5)


def test_a_frustum_has_the_volume_and_centre_of_the_closed_form(stl):
    n, r, s, h = 120, 15.0, 9.0, 30.0
    low = np.array([(*p, 0.0) for p in turning(r, n)])
    high = np.array([(*p, h) for p in turning(s, n)])
    walls = []
    for i in range(n):
        j = (i + 1) % n
        walls += [(low[i], low[j], high[j]), (low[i], high[j], high[i])]
    lids = [(low[0], low[i + 1], low[i]) for i in range(1, n - 1)]
    lids += [(high[0], high[i], high[i + 1]) for i in range(1, n - 1)]
    path = stl(np.array(walls + lids))
    found = measure_piece(path, PieceImport(density_g_cm3=2.7, grip_mm=15.0))
    k = n / 2 * math.sin(2 * math.pi / n)
    volume = h / 3 * k * (r * r + r * s + s * s)
    height = h / 4 * (r * r + 2 * r * s + 3 * s * s) / (r * r + r * s + s * s)
    assert found.volume_mm3 == pytest.approx(volume, rel=1e-5)
    assert found.com_mm == pytest.approx((0, 0, height), abs=1e-4)
    assert found.width_mm == pytest.approx(r + s, abs=0.01)
    upside = measure_piece(path, PieceImport(end="top", density_g_cm3=2.7))
    assert upside.com_mm[2] == pytest.approx(h - height, abs=1e-4)
    assert upside.face.area == pytest.approx(k * s * s, rel=1e-3)
    # The same piece as a bottom: the narrow end is touched, the wide one stands on the bench.
    bottom = measure_piece(path, PieceImport(role="bottom", mass_g=40.0))
    assert bottom.face.area == pytest.approx(k * s * s, rel=1e-3)
    assert bottom.opposite.area == pytest.approx(k * r * r, rel=1e-3)
    assert bottom.com_mm[2] == pytest.approx(height, abs=1e-4)
    assert bottom.width_mm is None


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
def test_all_formats_of_trimesh_give_the_same_piece(tmp_path, suffix):
    path = tmp_path / f"part.{suffix}"
    trimesh.creation.annulus(r_min=4, r_max=11, height=30, sections=48).export(path)
    found = measure_piece(path, PLA)
    area = 24 * math.sin(2 * math.pi / 48) * (11**2 - 4**2)
    assert found.face.area == pytest.approx(area, rel=1e-3)
    assert found.com_mm == pytest.approx((0, 0, 15), abs=1e-4)


@pytest.mark.parametrize(
    ("end", "size"),
    [("bottom", (20, 30)), ("top", (20, 30)), ("+x", (40, 30)), ("-x", (40, 30)),
     ("+y", (20, 40)), ("-y", (20, 40))],
)  # fmt: skip
def test_each_side_of_a_block_can_be_the_face(stl, end, size):
    block = prism([(0, 0), (20, 0), (20, 30), (0, 30)], 40)
    found = measure_piece(stl(block), PieceImport(end=end, mass_g=10.0))
    low_x, low_y, high_x, high_y = found.face.bounds
    assert (high_x - low_x, high_y - low_y) == pytest.approx(size)
    assert found.height_mm == pytest.approx(24000 / (size[0] * size[1]))
    assert found.com_mm == pytest.approx((0, 0, found.height_mm / 2), abs=1e-6)


def test_the_turn_of_each_side_is_a_rotation_that_points_it_down():
    sides = {"bottom": (0, 0, -1), "top": (0, 0, 1), "+x": (1, 0, 0), "-x": (-1, 0, 0),
             "+y": (0, 1, 0), "-y": (0, -1, 0)}  # fmt: skip
    for end, direction in sides.items():
        turn = cad.TURNS[end]
        assert turn @ direction == pytest.approx((0, 0, -1))
        assert np.linalg.det(turn) == pytest.approx(1)
        assert turn @ turn.T == pytest.approx(np.eye(3))


def test_the_centre_of_mass_of_a_mesh_may_be_unknown(stl):
    found = measure_piece(stl(BLOCK), PieceImport(mass_g=150.0, com="unknown"))
    assert np.isnan(found.com_mm[:2]).all()
    assert found.com_mm[2] == pytest.approx(20.0)


def test_feet_are_parts_of_one_face(stl):
    feet = [prism([(x, y), (x + 6, y), (x + 6, y + 6), (x, y + 6)], 5.0)
            for x, y in ((0, 0), (24, 0), (12, 20))]  # fmt: skip
    plate = prism([(0, 0), (30, 0), (30, 26), (0, 26)], 8.0, at=5.0)
    found = measure_piece(stl(np.concatenate([*feet, plate])), PLA)
    assert len(found.face.geoms) == 3
    assert found.face.area == pytest.approx(108)
    assert found.volume_mm3 == pytest.approx(3 * 180 + 30 * 26 * 8)


def test_a_finely_divided_circle_is_written_as_a_circle_and_a_square_as_a_polygon(stl, tmp_path):
    round_ = measure_piece(stl(prism(turning(10, 200), 30)), PLA)
    written, _ = save_piece(round_, "stub", folder=tmp_path / "a")
    assert tomllib.loads(written.read_text())["face"] == {"shape": "circle", "diameter_mm": 20.0}
    square = measure_piece(stl(prism([(0, 0), (20, 0), (20, 20), (0, 20)], 30)), PLA)
    written, _ = save_piece(square, "block", folder=tmp_path / "a")
    piece = read_piece(written)
    assert piece.face.area_mm2 == pytest.approx(400)
    assert (piece.width_mm, piece.grip_height_mm, piece.mass_g) == pytest.approx((20, 21, 14.88))
    assert piece.roles == ("top",)


REFUSED = {
    "open": ("The mesh is open: 3 of its edges", "Close its holes"),
    "flipped": ("not oriented alike", "Recompute its normals"),
    "crossing": ("intersects itself", "Unite its bodies"),
    "metres": ("0.02 x 0.02 x 0.04 mm, which is unlikely", "Give --units m (20 x 20 x 40 mm)"),
    "huge": ("2e+04 x 2e+04 x 4e+04 mm", "Give --units um (20 x 20 x 40 mm)"),
    "hopeless": ("2e+13 x 2e+13 x 4e+13 mm", "Scale it"),
    "thin": ("x 0.1 mm, which is unlikely", "solid body"),
    "pointed": ("There is no flat face at the bottom end", "--face"),
    "nan": ("3 corners of the mesh are not numbers", "Export"),
    "empty": ("The file is empty", "Export"),
    "garbage": ("not a readable STL mesh", "Export"),
    "cut": ("not a readable STL mesh", "Export"),
    "none": ("The file is empty", "Export"),
}
BLOCK = prism([(0, 0), (20, 0), (20, 20), (0, 20)], 40)


def refused_content(kind):
    flipped, other, lost = BLOCK.copy(), BLOCK.copy(), BLOCK.copy()
    flipped[0] = flipped[0][::-1]
    other[:, :, 0] += 7.0
    other[:, :, 1] += 6.0
    other[:, :, 2] += 5.0
    lost[0] = np.nan
    n = len(BLOCK)
    return {
        "open": lambda: binary_stl(BLOCK[:-1]),
        "flipped": lambda: binary_stl(flipped),
        "crossing": lambda: binary_stl(np.concatenate([BLOCK, other])),
        "metres": lambda: binary_stl(BLOCK / 1000),
        "huge": lambda: binary_stl(BLOCK * 1000),
        "hopeless": lambda: binary_stl(BLOCK * 1e12),
        "thin": lambda: binary_stl(BLOCK * [1, 1, 0.0025]),
        "pointed": lambda: binary_stl(pyramid()),
        "nan": lambda: binary_stl(lost),
        "empty": lambda: b"",
        "garbage": lambda: np.random.default_rng(1).bytes(4000),
        "cut": lambda: binary_stl(BLOCK)[: 84 + 50 * n - 20],
        "none": lambda: binary_stl([]),
    }[kind]()


def pyramid():
    base, tip = np.array([(0, 0, 20), (20, 0, 20), (20, 20, 20), (0, 20, 20)]), (10, 10, 0)
    walls = [(base[i], tip, base[(i + 1) % 4]) for i in range(4)]
    return np.array([*walls, (base[0], base[1], base[2]), (base[0], base[2], base[3])], float)


@pytest.mark.parametrize("kind", REFUSED)
def test_a_mesh_that_cannot_be_used_is_refused_in_one_sentence(tmp_path, kind):
    path = tmp_path / "part.stl"
    path.write_bytes(refused_content(kind))
    with pytest.raises(InputError) as refused:
        measure_piece(path, PLA)
    what, fix = REFUSED[kind]
    assert what in refused.value.what
    assert fix in refused.value.fix
    assert refused.value.what.count(". ") == 0


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off", "svg", "dxf"])
@pytest.mark.parametrize("seed", range(4))
def test_bytes_of_any_kind_are_refused(tmp_path, suffix, seed):
    rng = np.random.default_rng(seed)
    heads = {"stl": b"solid x\n", "obj": b"v 1 2 3\nf 1 2 9\n", "ply": b"ply\nformat ascii 1.0\n",
             "off": b"OFF\n99999999 5 0\n", "svg": b"<svg>",
             "dxf": b"0\nSECTION\n2\nENTITIES\n"}  # fmt: skip
    path = tmp_path / f"part.{suffix}"
    path.write_bytes((heads[suffix] if seed % 2 else b"") + rng.bytes(600))
    with pytest.raises(InputError):
        measure_piece(path, PieceImport(mass_g=1.0, height_mm=9.0 if suffix in "svgdxf" else None))


def test_a_round_surface_is_no_flat_face(tmp_path):
    path = tmp_path / "part.stl"
    trimesh.creation.cylinder(radius=10, height=40, sections=120).export(path)
    with pytest.raises(InputError, match="no flat face"):
        measure_piece(path, PieceImport(end="+x", mass_g=1.0))


@pytest.mark.parametrize(
    ("wanted", "what"),
    [
        (PieceImport(), "either a mass or a density"),
        (PieceImport(mass_g=1.0, density_g_cm3=1.0), "either a mass or a density"),
        (PieceImport(density_g_cm3=1240.0), "--density 1240 is out of range"),
        (PieceImport(mass_g=math.nan), "--mass nan is out of range"),
        (PieceImport(mass_g=5.0, height_mm=20.0), "The height of a mesh is measured"),
        (PieceImport(mass_g=5.0, grip_mm=60.0), "lies above the piece"),
        (PieceImport(mass_g=5.0, grip_mm=10.0, role="bottom"), "A bottom is not gripped"),
    ],
)
def test_numbers_that_do_not_fit_are_refused(stl, wanted, what):
    with pytest.raises(InputError, match=what):
        measure_piece(stl(BLOCK), wanted)


def test_files_that_are_missing_too_large_or_of_another_kind_are_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="Cannot read the file"):
        measure_piece(tmp_path / "no.stl", PLA)
    (tmp_path / "part.step").write_bytes(b"ISO-10303-21;")
    with pytest.raises(InputError, match=r"cannot be read from '\.step' files"):
        measure_piece(tmp_path / "part.step", PLA)
    monkeypatch.setattr(cad, "MAX_BYTES", 100)
    (tmp_path / "part.stl").write_bytes(binary_stl(BLOCK))
    with pytest.raises(InputError, match="too large"):
        measure_piece(tmp_path / "part.stl", PLA)


def test_a_mesh_too_fine_to_be_searched_is_measured_with_a_note(stl, monkeypatch):
    monkeypatch.setattr(cad, "MAX_PAIRS", 3)
    (note,) = measure_piece(stl(BLOCK), PLA).notes
    assert "too fine to be searched" in note


def test_notes_name_a_centre_of_mass_outside_the_face_and_a_grip_beside_its_middle(stl):
    foot = prism([(0, 0), (10, 0), (10, 10), (0, 10)], 10.0)
    head = prism([(0, 0), (10, 0), (10, 60), (0, 60)], 20.0, at=10.0)
    found = measure_piece(stl(np.concatenate([foot, head])), PLA)
    outside, grip = found.notes
    assert "does not stand" in outside
    assert "+25.0 mm along y" in grip


def test_a_saved_piece_is_known_by_its_name_and_nothing_is_overwritten(stl):
    measured = measure_piece(stl(BLOCK), PLA)
    written, picture = save_piece(measured, "block", 'Bl"ock <1>')
    assert written.parent == pieces_folder()
    assert load_pieces().top("block").title == 'Bl"ock <1>'
    before = written.read_bytes()
    with pytest.raises(InputError, match="already a piece 'block'"):
        save_piece(measured, "block")
    with pytest.raises(InputError, match="already a piece 'pot'"):
        save_piece(measured, "pot")
    with pytest.raises(InputError, match="cannot be the name"):
        save_piece(measured, "../pot")
    assert written.read_bytes() == before
    root = ElementTree.fromstring(picture.read_text())
    words = "".join(root.itertext())
    assert 'Bl"ock <1>: 40.0 mm high, 19.8 g' in words
    assert "10 mm" in words


def test_a_folder_that_cannot_be_written_is_reported(stl, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        save_piece(measure_piece(stl(BLOCK), PLA), "block", folder=tmp_path / "file" / "x")


def test_an_unusable_file_of_the_data_folder_is_reported_only_for_its_piece():
    pieces_folder().mkdir(parents=True)
    (pieces_folder() / "broken.toml").write_text("title = 3\n")
    (pieces_folder() / "pot.toml").write_text("title = 3\n")
    library = load_pieces()
    assert library.top("pot").title == "Pot"
    with pytest.raises(InputError, match="Bad value for 'title'"):
        library.top("broken")


def test_names_of_files_become_names_of_pieces():
    assert [piece_name(cad.Path(p)) for p in ("a/My Part (2).STL", "2.stl", "ÄÖ.stl")] == [
        "my-part-2", "piece-2", "piece",
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["ring", "l", "feet"])
def test_faces_with_holes_and_parts_are_read_back_as_they_were_measured(stl, tmp_path, kind):
    triangles = {
        "ring": lambda: prism(turning(12, 40), 20.0, turning(5, 40)),
        "l": lambda: prism(L_BLOCK, 20.0),
        "feet": lambda: np.concatenate([
            *(prism([(x, 0), (x + 6, 0), (x + 6, 20), (x, 20)], 5.0) for x in (0, 24)),
            prism([(0, 0), (30, 0), (30, 20), (0, 20)], 20.0, at=5.0),
        ]),
    }[kind]()  # fmt: skip
    measured = measure_piece(stl(triangles), PLA)
    written, _ = save_piece(measured, "part", folder=tmp_path / "own")
    piece = load_pieces(tmp_path / "own").top("part")
    assert written.exists()
    assert piece.face.area_mm2 == pytest.approx(measured.face.area, abs=0.01)
    rng = np.random.default_rng(3)
    points = rng.uniform(-25, 25, (300, 2))
    inside = [measured.face.contains(cad.shapely.Point(p)) for p in points]
    assert piece.face.contains(points).tolist() == inside
