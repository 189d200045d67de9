"""Random outlines: what training never sees, and what is fresh in every trial."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from touchdown.backend.geometry.families import (
    FRESH_CLASSES,
    FRESH_SEED,
    SIMILAR_IOU,
    UNSEEN_BOTTOMS,
    UNSEEN_PIECES,
    UNTRAINED_CLASSES,
    ShapeFamily,
    draw_region,
    fresh_bottom,
    is_similar,
    similarity,
)
from touchdown.backend.geometry.outlines import (
    Outline,
    circle,
    contact_margins_mm,
    geometry_of,
    rectangle,
    square,
)
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Body, Tower, judge_tower


def covered_alike(first: Outline, second: Outline) -> float:
    """Intersection over union on a fine grid, the best of all turns by 3 degrees."""
    steps = np.arange(-20.0, 20.0, 0.4)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1)
    inside = first.contains(grid)
    best = 0.0
    for angle in np.radians(np.arange(0.0, 180.0, 5.0)):
        c, s = np.cos(angle), np.sin(angle)
        other = second.contains(grid @ np.array([[c, -s], [s, c]]))
        best = max(best, float((inside & other).sum() / (inside | other).sum()))
    return best


def test_likeness_is_the_common_share_at_the_best_turn() -> None:
    assert similarity(circle(20.0), circle(19.0)) == pytest.approx((19.0 / 20.0) ** 2, abs=2e-3)
    turned = rectangle(12.0, 20.0)
    assert similarity(rectangle(20.0, 12.0), turned) == pytest.approx(1.0, abs=1e-3)
    assert similarity(square(18.0), circle(20.0)) == pytest.approx(
        covered_alike(square(18.0), circle(20.0)), abs=0.01
    )


def test_nothing_drawn_resembles_what_is_called_unseen() -> None:
    catalogue = load_pieces()
    family, rng = ShapeFamily.of(catalogue), np.random.default_rng(1)
    bottoms = [family.bottom(rng) for _ in range(12)]
    unseen = [catalogue.bottom(name).face for name in UNSEEN_BOTTOMS]
    assert max(covered_alike(b.lower, u) for b in bottoms[:4] for u in unseen) <= SIMILAR_IOU + 0.01
    assert not any(is_similar(b.lower, u) for b in bottoms for u in unseen)
    faces = [family.piece(rng).face for _ in range(12)]
    held = [catalogue.top(name).face for name in UNSEEN_PIECES]
    assert not any(is_similar(face, u) for face in faces for u in held)
    # Without the rule the same draws do come near them.
    careless = ShapeFamily((), ())
    anything = [careless.bottom(rng).lower for _ in range(20)]
    assert any(is_similar(o, u) for o in anything for u in unseen)
    assert {o.kind for o in faces} == {"circle", "polygon"}


def test_wide_bottoms_are_of_all_classes_and_their_margins_are_exact() -> None:
    catalogue = load_pieces()
    rng = np.random.default_rng(7)
    drawn = [draw_region(rng, size) for size in rng.uniform(14.0, 32.0, 60)]
    assert {len(outline.parts) for outline in drawn} >= {0, 1, 2, 3, 4}
    assert {len(outline.vertices_mm) for outline in drawn} == {0, 3, 4}
    assert any(outline.parts[0][1] for outline in drawn if outline.parts)
    mug = catalogue.top("mug")
    places = rng.uniform(-14.0, 14.0, (12, 2))
    for bottom in drawn[:8]:
        found = contact_margins_mm(mug.face, mug.com_xy_mm, bottom, places)
        for place, margin in zip(places, found, strict=True):
            x, y = (place - mug.com_xy_mm).tolist()
            base = Body("bottom", bottom, bottom, 20.0, 0.0, 10.0, fixed=True)
            exact = judge_tower(Tower((base, mug.body((x, y))))).margins_mm[1]
            if np.isfinite(exact):
                assert margin == pytest.approx(exact, abs=1e-6)
            else:
                assert margin < 0.0


def class_of(outline: Outline) -> str:
    """One of the classes of test outlines, or "other", from corners and topology alone."""
    if outline.kind != "region":
        names = {0: "disc", 3: "triangle", 4: "rectangle"}
        return names.get(len(outline.vertices_mm), "polygon")
    corners = [len(exterior) for exterior, _ in outline.parts]
    holes = [len(hole) for _, parts in outline.parts for hole in parts]
    if holes:
        return {(4, 4): "frame", (64, 64): "ring"}.get((corners[0], holes[0]), "other")
    if len(corners) > 1:
        return {4: "bars", 64: "feet"}.get(corners[0], "other")
    if corners[0] != 8:
        return "ell" if corners[0] == 6 else "other"
    ring = np.array(outline.parts[0][0])
    along = np.roll(ring, -1, axis=0) - ring
    before = np.roll(along, 1, axis=0)
    notches = np.flatnonzero(before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0] < 0.0)
    # The two notches of a U are neighbours, those of a T are not, a star has four.
    return "tee" if len(notches) == 2 and notches[1] - notches[0] in (3, 5) else "other"


def test_ten_classes_in_turn_and_three_are_never_trained_on() -> None:
    bottoms = [fresh_bottom(FRESH_SEED, number) for number in range(60)]
    assert [b.title for b in bottoms[:20]] == [*FRESH_CLASSES, *FRESH_CLASSES]
    assert all(class_of(b.face) == b.title for b in bottoms)
    faces = dict(zip(FRESH_CLASSES, (b.face for b in bottoms), strict=False))
    assert sum(face.kind == "region" for face in faces.values()) == 6
    assert sum(any(holes for _, holes in face.parts) for face in faces.values()) == 2
    assert sum(len(face.parts) > 1 for face in faces.values()) == 2
    rng, family = np.random.default_rng(3), ShapeFamily.of(load_pieces(), "any")
    trained = [family.bottom(rng).lower for _ in range(300)]
    assert not {class_of(face) for face in trained} & set(UNTRAINED_CLASSES)
    assert {class_of(face) for face in trained} >= set(FRESH_CLASSES) - set(UNTRAINED_CLASSES)
    areas = np.array([face.area_mm2 for face in trained])
    assert min(np.abs(areas - b.face.area_mm2).min() for b in bottoms) > 1e-6


def test_fresh_outlines_keep_their_sizes() -> None:
    bottoms = [fresh_bottom("0123456789abcdef", number) for number in range(80)]
    for bottom in bottoms:
        whole = geometry_of(bottom.face)
        box = shapely.get_coordinates(shapely.minimum_rotated_rectangle(whole))
        short, long = sorted(np.hypot(*np.diff(box[:3], axis=0).T).tolist())
        assert 6.0 < short <= long < 30.0 + 1e-6
        parts = shapely.get_parts(whole)
        assert not any(part.buffer(-1.99).is_empty for part in parts)
        gaps = [a.distance(b) for i, a in enumerate(parts) for b in parts[:i]]
        assert min(gaps, default=2.0) > 1.99
        assert not bottom.fixed
    assert len({b.face for b in bottoms} | {fresh_bottom(FRESH_SEED, 0).face}) == 81
    assert fresh_bottom(FRESH_SEED, 7) == fresh_bottom(FRESH_SEED, 7)
    with pytest.raises(ValueError, match="invalid literal"):
        fresh_bottom("pot", 0)
