""""""

import math
import sys

import pytest
import shapely
import shapely.affinity

from touchdown.backend.core import InputError
from touchdown.backend.geometry.cad import PieceImport, measure_piece, save_piece
from touchdown.backend.geometry.drawings import read_drawing
from touchdown.backend.geometry.pieces import load_pieces

SVG = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="{w}mm" height="{h}mm" viewBox="{box}">'
    "{body}</svg>"
)


@pytest.fixture
def area(tmp_path):
    def read(content, suffix="svg", unit_mm=None):
        return read_drawing(tmp_path / f"part.{suffix}", content.encode(), unit_mm)

    return read


def svg(body, w=100, h=100, box="0 0 100 100"):
    return SVG.format(w=w, h=h, box=box, body=body)


# Subclass markers that the reference of the format requires.
CLASSES = {"LWPOLYLINE": "AcDbPolyline", "SPLINE": "AcDbSpline", "CIRCLE": "AcDbCircle",
           "LINE": "AcDbLine", "ARC": "AcDbCircle", "POLYLINE": "AcDb2dPolyline",
           "VERTEX": "AcDbVertex", "INSERT": "AcDbBlockReference", "RAY": "AcDbRay"}  # fmt: skip


def dxf(*entities, insunits=4):
    head = "0\nSECTION\n2\nHEADER\n9\n$ACADVER\n1\nAC1015\n"
    head += f"9\n$INSUNITS\n70\n{insunits}\n0\nENDSEC\n"
    rows = "".join(
        f"0\n{kind}\n100\nAcDbEntity\n100\n{CLASSES.get(kind)}\n"
        + "".join(f"{c}\n{v}\n" for c, v in pairs)
        for kind, *pairs in entities
    )
    return f"{head}0\nSECTION\n2\nENTITIES\n{rows}0\nENDSEC\n0\nEOF\n"


SHAPES = {
    "rect": ('<rect x="10" y="20" width="30" height="20"/>', 600.0, (25, -30)),
    "rounded": ('<rect width="30" height="20" rx="5"/>', 600 - (4 - math.pi) * 25, (15, -10)),
    "circle": ('<circle cx="20" cy="20" r="10"/>', math.pi * 100, (20, -20)),
    "ellipse": ('<ellipse cx="20" cy="20" rx="10" ry="5"/>', math.pi * 50, (20, -20)),
    "polygon": ('<polygon points="0,0 30,0 0,30"/>', 450.0, (10, -10)),
    "path": ('<path d="M0 0H30V10H10v30h-10z"/>', 600.0, None),
    "relative": ('<path d="m 10,10 20,0 0,20 -20,0 z m 5,5 0,10 10,0 0,-10 z"/>', 300.0, (20, -20)),
    "arcs": ('<path d="M10 20A10 10 0 0 1 30 20A10 10 0 0 1 10 20Z"/>', math.pi * 100, (20, -20)),
    "flags": ('<path d="M10 20a10 10 0 0120 0a10 10 0 01-20 0z"/>', math.pi * 100, (20, -20)),
    # Area under the parabola of a quadratic with ends 30 apart and control 20 high: 2/3 * 30 * 10.
    "quadratic": ('<path d="M0 0Q15 20 30 0Z"/>', 200.0, None),
    # The integral of y dx = 60 t (1 - t) * 180 t (1 - t) dt.
    "cubic": ('<path d="M0 0C0 20 30 20 30 0Z"/>', 360.0, None),
    "smooth": ('<path d="M0 0Q5 10 10 0T20 0V-20H0Z"/>', 400.0, None),
    "ring": ('<g><circle cx="20" cy="20" r="10"/><circle cx="20" cy="20" r="4"/></g>',
             math.pi * 84, (20, -20)),
    "feet": ('<g transform="translate(5 5) scale(2)"><rect width="5" height="5"/>'
             '<rect x="10" width="5" height="5" transform="rotate(90 12.5 2.5)"/></g>',
             200.0, (20, -10)),
    "matrix": ('<rect width="10" height="10" transform="matrix(0 2 -3 0 1 1)"/>',
               600.0, (-14, -11)),
    "skew": ('<rect width="10" height="10" transform="skewX(45)"/>', 100.0, (10, -5)),
    "hidden": ('<defs><circle r="40"/></defs><circle r="30" style="display:none"/>'
               '<rect width="10" height="10"/>', 100.0, (5, -5)),
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_svg_shapes_have_the_areas_of_their_closed_forms(area, name):
    body, expected, centre = SHAPES[name]
    found = area(svg(body))
    assert found.area == pytest.approx(expected, rel=2e-3)
    if centre is not None:
        assert found.centroid.coords[0] == pytest.approx(centre, abs=0.01)


def test_transforms_agree_with_those_of_shapely(area):
    disc = shapely.Point(3.0, -4.0).buffer(8.0, 200)
    moves = {
        "skewX(40)": (1.0, math.tan(math.radians(40)), 0.0, 1.0, 0.0, 0.0),
        "matrix(0.6 -0.4 1.1 0.9 5 -2)": (0.6, 1.1, -0.4, 0.9, 5.0, -2.0),
        "translate(7,2) rotate(-30) scale(2 0.5)": (
            2 * math.cos(math.radians(30)), 0.5 * math.sin(math.radians(30)),
            -2 * math.sin(math.radians(30)), 0.5 * math.cos(math.radians(30)), 7.0, 2.0,
        ),
    }  # fmt: skip
    for text, matrix in moves.items():
        found = area(svg(f'<g transform="{text}"><circle cx="3" cy="-4" r="8"/></g>'))
        mirrored = shapely.affinity.scale(found, 1.0, -1.0, origin=(0, 0))
        expected = shapely.affinity.affine_transform(disc, matrix)
        assert shapely.hausdorff_distance(mirrored, expected) < 0.01


def test_the_size_of_the_root_gives_the_unit_and_y_points_up(area):
    body = '<path d="M0 0H10V10H0Z"/>'
    assert area(svg(body, 20, 20, "0 0 10 10")).bounds == pytest.approx((0, -20, 20, 0))
    assert area(f"<svg>{body}</svg>").area == pytest.approx((10 * 25.4 / 96) ** 2)
    assert area(f"<svg>{body}</svg>", unit_mm=10.0).area == pytest.approx(1e4)
    assert area(svg(body, 20, 20, "0 0 10 10"), unit_mm=1.0).area == pytest.approx(100)
    assert area(f'<svg width="2in" viewBox="0 0 10 10">{body}</svg>').area == pytest.approx(50.8**2)
    # Fitted into its window: the smaller scale holds for both axes.
    assert area(svg(body, 20, 40, "0 0 10 10")).bounds == pytest.approx((0, -20, 20, 0))


def test_dxf_entities_have_the_areas_of_their_closed_forms(area):
    circle = dxf(("CIRCLE", (10, 5), (20, 5), (40, 10)), ("CIRCLE", (10, 5), (20, 5), (40, 3)))
    assert area(circle, "dxf").area == pytest.approx(math.pi * 91, rel=1e-3)
    # A slot: two semicircles of bulge 1 at the ends of a 20 x 10 rectangle.
    slot = dxf(("LWPOLYLINE", (90, 4), (70, 1), (10, 0), (20, 0), (10, 20), (20, 0), (42, 1),
                (10, 20), (20, 10), (10, 0), (20, 10), (42, 1)))  # fmt: skip
    assert area(slot, "dxf").area == pytest.approx(200 + math.pi * 25, rel=1e-3)
    vertices = [("VERTEX", (10, x), (20, y)) for x, y in ((0, 0), (30, 0), (0, 30))]
    old = dxf(("POLYLINE", (70, 1)), *vertices, ("SEQEND",))
    assert area(old, "dxf").area == pytest.approx(450)
    # Drawn from below: x is mirrored.
    below = area(dxf(("CIRCLE", (10, 3), (20, 1), (40, 5), (210, 0), (220, 0),
                       (230, -1))), "dxf")  # fmt: skip
    assert below.centroid.coords[0] == pytest.approx((-3, 1), abs=1e-6)
    # The parabola of the SVG shapes, as a spline of one segment.
    knots = tuple((40, k) for k in (0, 0, 0, 1, 1, 1))
    curve = ("SPLINE", (70, 8), (71, 2), (72, 6), (73, 3), *knots, (10, 0), (20, 0), (10, 15),
             (20, 20), (10, 30), (20, 0))  # fmt: skip
    chord = ("LINE", (10, 0), (20, 0), (11, 30), (21, 0))
    assert area(dxf(curve, chord), "dxf").area == pytest.approx(200, rel=1e-3)
    # A half disc: an arc and the line that closes it, in inches.
    half = (("LINE", (10, 1), (20, 0), (11, -1), (21, 0)),
            ("ARC", (10, 0), (20, 0), (40, 1), (50, 0), (51, 180)))  # fmt: skip
    assert area(dxf(*half, insunits=1), "dxf").area == pytest.approx(
        math.pi / 2 * 25.4**2, rel=1e-3
    )
    assert area(dxf(*half, insunits=4), "dxf", 10.0).area == pytest.approx(50 * math.pi, rel=1e-3)


REFUSED = {
    "open": ('<path d="M0 0H10V10"/>', "The outline is open"),
    "bow": ('<path d="M0 0L10 10H0L10 0Z"/>', "intersects itself near 5.00, -5.00"),
    "crossing": ('<circle cx="0" cy="0" r="9"/><circle cx="9" cy="0" r="9"/>', "intersects itself"),
    "twice": ('<rect width="9" height="9"/><rect width="9" height="9"/>', "enclose nothing"),
    "empty": ("", "no closed curve"),
    "text": ("<text>a</text>", "'text' elements are not supported"),
    "letters": ('<path d="M0 0B3 4"/>', "unknown"),
    "values": ('<path d="M0 0C3 4Z"/>', "has 2 values"),
    "infinite": ('<path d="M0 0H1e999V3Z"/>', "out of range"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_drawing_that_cannot_be_used_is_refused_in_one_sentence(area, name):
    body, what = REFUSED[name]
    with pytest.raises(InputError, match=what):
        area(svg(body))


@pytest.mark.parametrize(
    ("content", "what"),
    [
        ("AutoCAD Binary DXF\r\n", "it is binary"),
        ("0\nEOF\n", "holds no closed curve"),
        (dxf(("INSERT", (2, "A"), (10, 0), (20, 0))), "Deleted entity INSERT"),
        (dxf(("RAY", (10, 0), (20, 0), (11, 1), (21, 0))), "RAY entities are not supported"),
        (dxf(("CIRCLE", (10, 0), (20, 0), (40, "1e400"))), "out of range|not a readable"),
        (
            dxf(("CIRCLE", (10, 0), (20, 0), (40, 5), (210, 1), (220, 0), (230, 1))),
            "plane of the drawing",
        ),
        (dxf(("LINE", (10, 0), (20, 0), (11, 5), (21, 0))), "The outline is open"),
    ],
)
def test_a_dxf_file_that_cannot_be_used_is_refused_in_one_sentence(area, content, what):
    with pytest.raises(InputError, match=what):
        area(content, "dxf")


def test_entities_of_xml_are_not_expanded(area):
    bomb = '<!DOCTYPE svg [<!ENTITY a "aaaa">]><svg>&a;</svg>'
    with pytest.raises(InputError, match="declares entities"):
        area(bomb)


def test_a_drawing_is_the_prism_over_its_outline(tmp_path):
    path = tmp_path / "part.svg"
    path.write_text(svg('<rect x="10" y="10" width="20" height="30"/>'))
    with pytest.raises(InputError, match="holds no height"):
        measure_piece(path, PieceImport(mass_g=20.0))
    found = measure_piece(path, PieceImport(density_g_cm3=1.0, height_mm=40.0))
    assert found.volume_mm3 == pytest.approx(24000)
    assert found.mass_g == pytest.approx(24.0)
    assert found.com_mm == pytest.approx((0, 0, 20))
    assert found.width_mm == pytest.approx(30)
    assert found.face.equals(shapely.MultiPolygon([shapely.box(-10, -15, 10, 15)]))
    # A mass says nothing about its distribution.
    heavy = measure_piece(path, PieceImport(mass_g=120.0, height_mm=40.0))
    assert heavy.notes == (
        "The centre of mass is unknown: a run weighs the piece first (--weigh).",
    )
    light = measure_piece(path, PieceImport(mass_g=20.0, height_mm=40.0)).notes
    assert "cannot be weighed: enter com_xy_mm" in light[0]
    written, picture = save_piece(heavy, "heavy", folder=tmp_path / "own")
    assert not load_pieces(tmp_path / "own").top("heavy").com_known
    assert "centre of mass unknown" in picture.read_text()
    assert 'com_xy_mm = "unknown"' in written.read_text()
    uniform = PieceImport(mass_g=20.0, height_mm=40.0, com="uniform")
    assert measure_piece(path, uniform).com_mm == pytest.approx((0, 0, 20))
    for role in ("bottom", "both"):
        with pytest.raises(InputError, match="cannot be weighed"):
            measure_piece(path, PieceImport(role=role, mass_g=9.0, height_mm=4.0, com="unknown"))
    path.write_text('<svg><rect width="0.02" height="0.03"/></svg>')
    with pytest.raises(InputError, match=r"0\.00529 x 0\.00794 mm, which is unlikely") as refused:
        measure_piece(path, PieceImport(mass_g=9.0, height_mm=40.0))
    assert "--units m (20 x 30 mm)" in refused.value.fix


@pytest.mark.parametrize(("name", "package"), [("a.stl", "trimesh"), ("a.svg", "svgelements"),
                                               ("a.dxf", "ezdxf")])  # fmt: skip
def test_without_the_extra_the_package_is_named(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_text("solid")
    with pytest.raises(InputError, match=f"'{package}' is not installed") as caught:
        measure_piece(
            tmp_path / name, PieceImport(mass_g=10.0, height_mm=None if name == "a.stl" else 5.0)
        )
    assert "touchdown[cad]" in caught.value.fix
