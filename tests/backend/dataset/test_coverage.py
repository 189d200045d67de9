"""Coverage: bins are counted where they are, and only reachable ones can be holes."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry.outlines import circle, overlap_area_mm2

FACE, BOTTOM = circle(15.0), circle(25.0)


def test_every_displacement_counts_in_its_own_bin() -> None:
    rng = np.random.default_rng(4)
    offsets = rng.uniform(-19, 19, (300, 2))
    seen = count_coverage(offsets, FACE, BOTTOM)
    assert seen.counts.sum() == 300
    for row, column in np.argwhere(seen.counts > 0):
        centre = np.array(seen.centre_mm(row, column))
        inside = (np.abs(offsets - centre) <= 1.0).all(axis=1)
        assert inside.sum() == seen.counts[row, column]


def test_reachable_bins_are_those_with_overlap() -> None:
    seen = count_coverage(np.empty((0, 2)), FACE, BOTTOM)
    for row, column in np.ndindex(seen.possible.shape):
        area = overlap_area_mm2(FACE, seen.centre_mm(row, column), BOTTOM)
        assert seen.possible[row, column] == (area >= 6.0)
    assert seen.holes == seen.possible.sum()
    assert seen.covered == 0.0


@pytest.mark.promise("W13")
def test_one_more_displacement_fills_one_hole() -> None:
    seen = count_coverage(np.empty((0, 2)), FACE, BOTTOM)
    more = seen.with_offset((3.9, -6.2))
    assert more.holes == seen.holes - 1
    assert np.argwhere(more.counts).tolist() == [
        [more.counts.shape[0] // 2 - 3, more.counts.shape[1] // 2 + 2]
    ]
    assert more.with_offset((90.0, 0.0)).counts.sum() == 1
    assert more.with_offset((np.nan, 0.0)).counts.sum() == 1
