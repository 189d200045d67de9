import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import overlap_area_mm2
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.sampling import draw_offset, draw_start
from touchdown.backend.geometry.tower import Tower, judge_tower


def test_data_offsets_fill_the_region_evenly() -> None:
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
def test_starts_are_unstable_and_still_touch(bottom: str) -> None:
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


def test_starts_of_a_leaning_tower_may_lie_inside_the_top_face() -> None:
    catalogue = load_pieces()
    bottoms = Tower((catalogue.piece("short").body(), catalogue.piece("long").body((8.0, 0.0))))
    rng = np.random.default_rng(2)
    starts = [draw_start(rng, catalogue.piece("pot").body(), bottoms) for _ in range(60)]
    assert any(math.hypot(x, y) < 9.0 for x, y in starts)


def test_the_same_seed_gives_the_same_start() -> None:
    catalogue = load_pieces()
    piece, bottoms = catalogue.piece("pot").body(), Tower((catalogue.piece("hex20").body(),))
    first, second = (draw_start(np.random.default_rng(7), piece, bottoms) for _ in range(2))
    assert first == second


def test_impossible_starts_are_refused() -> None:
    catalogue = load_pieces()
    pot, short = catalogue.piece("pot").body(), catalogue.piece("short").body()
    rng = np.random.default_rng(0)
    with pytest.raises(InputError, match="by themselves"):
        draw_start(rng, pot, Tower((short, replace(short, at_mm=(12.0, 0.0)))))
    with pytest.raises(InputError, match="carries nothing"):
        draw_start(rng, pot, Tower((pot,)))
    with pytest.raises(InputError, match="hardly overlap"):
        draw_offset(rng, pot.lower, short.lower, 1, min_overlap_mm2=200.0)
    with pytest.raises(InputError, match="No unstable start"):
        draw_start(rng, pot, Tower((short,)), min_overlap_mm2=170.0)
