"""Pieces at rest on inclined, stepped and domed faces: closed forms, and the hull of scipy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from touchdown.backend.config import SurfaceSettings
from touchdown.backend.core import InputError
from touchdown.backend.geometry import (
    FLAT,
    Body,
    PieceOnSurface,
    ShapeFamily,
    Surface,
    Tower,
    circle,
    feet,
    judge_tower,
    load_pieces,
    rectangle,
    ring,
    surface_heights_mm,
    surface_margins_mm,
)
from touchdown.backend.simulation.conditions import draw_surface

HEIGHT_MM = 30.0  # of the centre of mass
FACE, BELOW = circle(15.0), circle(20.0)


def over(x_mm: float, surface: Surface, com_height_mm: float = HEIGHT_MM, mu: float = math.inf):
    """Return the piece and its centre of mass, ``x_mm`` from the middle of the face below."""
    placed = PieceOnSurface.over(FACE, (x_mm, 0.0), 0.0, BELOW, surface, com_height_mm, mu)
    return placed, np.array([x_mm, 0.0])


def test_heights_follow_tilt_step_and_dome() -> None:
    at = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    surfaces = [Surface((0.02, 0.01)), Surface(step_mm=0.3, step_line=(math.pi / 2, 1.0)),
                Surface(dome_mm=200.0), FLAT]  # fmt: skip
    heights = surface_heights_mm(surfaces, np.broadcast_to(at, (4, 3, 2)))
    np.testing.assert_allclose(
        heights, [[0, -0.04, 0.08], [0, 0, 0.3], [0, -0.04, -0.04], [0, 0, 0]], atol=1e-12
    )
    assert [s.flat for s in surfaces] == [False, False, False, True]


@pytest.mark.parametrize(
    ("x_mm", "margin_mm"),
    [
        (0.0, 7.5 - 1.5),  # the face is the smaller one: its edge, less the way downhill
        (-5.0, 10.0 - 5.0 - 1.5),  # downhill of the middle: the edge below
        (8.0, 10.0 - 8.0),  # uphill: the piece tips over the edge before it turns onto the face
        (-9.0, 10.0 - 9.0 - 1.5),
    ],
)
def test_on_a_tilted_face_the_centre_of_mass_moves_downhill(x_mm: float, margin_mm: float) -> None:
    placed, centre = over(x_mm, Surface((0.0, -0.05)))
    assert placed.margin_mm(centre) == pytest.approx(margin_mm, abs=0.01)
    slope = placed.rest_slope(centre)
    assert (slope is not None) == (margin_mm > 0.0)
    if slope is not None:
        np.testing.assert_allclose(slope, [0.05, 0.0], atol=1e-9)


def test_a_piece_that_reaches_over_a_step_leans_on_its_edge_or_stays_on_top() -> None:
    step = Surface(step_mm=0.5)
    assert not over(1.0, step)[0].rest_slope(np.array([1.0, 0.0])).any()
    leaning, centre = over(-5.0, step)
    # From the edge at x = 0 to the far rim at -10, where it leans against the lower part.
    np.testing.assert_allclose(leaning.rest_slope(centre), [0.5 / 10.0, 0.0], atol=1e-9)
    assert leaning.margin_mm(centre) == pytest.approx(10.0 - 5.0 - 0.05 * HEIGHT_MM, abs=0.05)
    # A higher step turns it by more than 5 degrees.
    steep, _ = over(-5.0, Surface(step_mm=0.9))
    assert steep.rest_slope(centre) is None
    assert steep.margin_mm(centre) == pytest.approx(-5.0, abs=0.03)


@pytest.mark.parametrize("x_mm", [0.0, 2.0, -5.0, 7.5])
def test_on_a_dome_a_piece_rolls_until_the_contact_is_below_its_centre(x_mm: float) -> None:
    radius_mm = 200.0
    placed, centre = over(x_mm, Surface(dome_mm=radius_mm))
    slope = placed.rest_slope(centre)
    # Points 1 mm apart stand for the dome: their facets differ by 1 / 200 rad.
    assert slope[0] == pytest.approx(-x_mm / (radius_mm - HEIGHT_MM), abs=0.003)
    assert math.hypot(*slope) < math.tan(math.radians(5.0))
    edge_mm = min(10.0, abs(x_mm) + 7.5) * (1.0 - HEIGHT_MM / radius_mm)
    assert placed.margin_mm(centre) == pytest.approx(edge_mm - abs(x_mm), abs=0.1)


def test_without_friction_a_piece_slides_off_a_tilted_face() -> None:
    tilted = Surface((0.0, -0.05))
    assert over(0.0, tilted, mu=0.06)[0].margin_mm(np.zeros(2)) > 0.0
    assert over(0.0, tilted, mu=0.04)[0].margin_mm(np.zeros(2)) < 0.0


@pytest.mark.parametrize("seed", range(12))
def test_a_piece_rests_on_the_facet_of_the_hull_below_its_centre_of_mass(seed: int) -> None:
    rng = np.random.default_rng(seed)
    faces = [circle(18.0), rectangle(12.0, 20.0), ring(22.0, 12.0),
             feet([(9.0, 0.0), (-4.5, 7.8), (-4.5, -7.8)], 6.0)]  # fmt: skip
    face, below = (faces[int(k)] for k in rng.integers(len(faces), size=2))
    line = rng.uniform(0.0, 6.3), rng.uniform(-4.0, 4.0)
    tilt = tuple(rng.uniform(-0.03, 0.03, 2).tolist())
    surface = Surface(tilt, rng.uniform(0.05, 0.4), line, 250.0 * (seed % 2))
    at = tuple(rng.uniform(-2.0, 2.0, 2))
    placed = PieceOnSurface.over(face, at, rng.uniform(0.0, 6.3), below, surface, HEIGHT_MM)
    found = 0
    for centre in rng.uniform(-5.0, 5.0, (20, 2)):
        slope = placed.rest_slope(centre)
        if slope is None:
            continue
        found += 1
        hull = ConvexHull(np.column_stack([placed.points_mm, placed.heights_mm]))
        up = hull.equations[hull.equations[:, 2] > 1e-9]
        facets = -up[:, :2] / up[:, 2:3]
        assert np.abs(facets - slope).sum(axis=1).min() < 1e-6
        plane = placed.points_mm @ slope
        touching = placed.points_mm[
            placed.heights_mm - plane > (placed.heights_mm - plane).max() - 1e-7
        ]
        base = ConvexHull(touching)
        foot = centre - HEIGHT_MM * slope
        assert (base.equations[:, :2] @ foot + base.equations[:, 2] < 1e-6).all()
    assert found


@pytest.mark.parametrize("kind", ["tilted", "stepped", "domed"])
def test_margins_of_many_places_are_those_of_the_judge(kind: str) -> None:
    rng, family = np.random.default_rng(5), ShapeFamily.of(load_pieces(), "any")
    settings = SurfaceSettings.model_validate({f"{kind}_share": 1.0})
    stable = 0
    for _ in range(3):
        below, piece, height_mm = family.bottom(rng).lower, family.piece(rng), rng.uniform(15, 35)
        surface = draw_surface(settings, max(below.half_extents_mm), rng)
        com = np.asarray(piece.com_xy_mm)
        places = com + rng.uniform(-0.7, 0.7, (3, 2)) * below.half_extents_mm
        found = surface_margins_mm(piece.face, piece.com_xy_mm, height_mm, below, surface, places)
        for place, margin in zip(places, found, strict=True):
            at = tuple((place - com).tolist())
            judge = PieceOnSurface.over(piece.face, at, 0.0, below, surface, height_mm)
            exact = judge.margin_mm(place)
            assert margin == pytest.approx(exact, abs=0.2)
            assert (margin > 0.0) == (exact > 0.0)
            stable += exact > 0.0
    assert 0 < stable < 9


def test_only_the_held_piece_can_stand_on_a_face_that_is_not_flat() -> None:
    base = Body("base", BELOW, BELOW, 30.0, 0.0, 15.0, fixed=True, surface=Surface((0.01, 0.0)))
    lid = Body("lid", FACE, FACE, 30.0, 20.0, 15.0)
    tower = Tower((base, lid))
    assert judge_tower(tower).stands
    with pytest.raises(InputError, match="not flat"):
        tower.with_top(lid)


def test_the_turned_piece_weighs_on_lower_interfaces_where_it_comes_to_rest() -> None:
    base = Body("base", BELOW, BELOW, 30.0, 30.0, 15.0, surface=Surface((0.0, -0.05)))
    lid = Body("lid", FACE, FACE, 60.0, 30.0, 30.0)
    below, _ = judge_tower(Tower((base, lid))).margins_mm
    # Half of the mass moved by 1.5 mm.
    assert below == pytest.approx(10.0 - 0.75, abs=0.01)


def test_a_face_turned_with_its_bottom_is_judged_the_same() -> None:
    def margin(yaw_rad: float) -> float:
        base = Body("base", BELOW, BELOW, 30.0, 0.0, 15.0, (0.0, 0.0), (2.0, 1.0), yaw_rad, True,
                    Surface((0.0, -0.05)))  # fmt: skip
        x, y = -6.0 * math.cos(yaw_rad) + 2.0, -6.0 * math.sin(yaw_rad) + 1.0
        lid = Body("lid", FACE, FACE, 60.0, 30.0, 30.0, (0.0, 0.0), (x, y))
        return judge_tower(Tower((base, lid))).margin_mm

    assert margin(0.9) == pytest.approx(margin(0.0), abs=0.02)
    assert margin(0.0) == pytest.approx(10.0 - 6.0 - 1.5, abs=0.01)


FILE = """title = "Base"
roles = ["bottom"]
height_mm = 30.0
com_height_mm = 15.0
mass_g = 0.0
fixed = true
face = {{ shape = "circle", diameter_mm = 20.0 }}
{}
"""


def test_a_piece_file_gives_the_heights_of_a_bottom(tmp_path: Path) -> None:
    text = "[surface]\ntilt_deg = [1.0, -2.0]\ndome_mm = 250.0\n[surface.step]\nheight_mm = 0.4\n"
    (tmp_path / "plain.toml").write_text(FILE.format(""), "utf-8")
    (tmp_path / "bent.toml").write_text(FILE.format(text), "utf-8")
    known = load_pieces(tmp_path)
    assert known.bottom("plain").body().surface is FLAT
    bent = known.bottom("bent")
    assert bent.body().surface == Surface(
        (math.radians(1.0), math.radians(-2.0)), 0.4, (0.0, 0.0), 250.0
    )
    assert bent.sha256 != known.bottom("plain").sha256


@pytest.mark.parametrize(
    "text", ["tilt_deg = [3.0, 1.0]", "dome_mm = 150.0", "step = { height_mm = 1.5 }"]
)
def test_surfaces_beyond_the_limits_are_refused(text: str, tmp_path: Path) -> None:
    (tmp_path / "bent.toml").write_text(FILE.format(f"[surface]\n{text}"), "utf-8")
    with pytest.raises(InputError):
        load_pieces(tmp_path)
