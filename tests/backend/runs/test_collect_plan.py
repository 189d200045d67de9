"""Patterns of a campaign: overlap, reproducibility, evenness, filling of gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.quality import count_coverage
from touchdown.backend.geometry.outlines import circle, overlap_area_mm2, rectangle
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.runs.campaign import (
    PATTERNS,
    Campaign,
    ProbeTarget,
    grid_displacements_mm,
    new_campaign,
    newest_campaign,
    pair_coverage,
    planned_displacement_mm,
    read_campaign,
)
from touchdown.backend.runs.requests import GRIPS, MOUNTINGS, CollectRequest

TARGET = ProbeTarget(circle(15.0), rectangle(12.0, 28.0))
EMPTY = count_coverage(np.empty((0, 2)), TARGET.face, TARGET.bottom)


@pytest.fixture
def dataset(tmp_path):
    with Dataset.open(tmp_path / "data", person="cleo") as opened:
        yield opened


def places(pattern, count, target=TARGET, seed=3):
    return np.array(
        [planned_displacement_mm(pattern, target, seed, k, count, EMPTY) for k in range(count)]
    )


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("within", [None, 6.0], ids=str)
def test_every_pattern_stays_where_the_faces_overlap(pattern, within) -> None:
    target = ProbeTarget(TARGET.face, TARGET.bottom, within)
    found = places(pattern, 40, target)
    assert (overlap_area_mm2(target.face, found, target.bottom) >= 6.0).all()
    assert np.abs(found).max() <= (within or 99.0)
    np.testing.assert_array_equal(found, places(pattern, 40, target))


def test_random_places_are_uniform() -> None:
    found = places("random", 400, ProbeTarget(circle(15.0), circle(15.0), 5.0), seed=0)
    for axis in range(2):
        assert kstest(found[:, axis], "uniform", args=(-5.0, 10.0)).pvalue > 0.01
    assert not np.allclose(
        found, places("random", 400, ProbeTarget(*[circle(15.0)] * 2, 5.0), seed=4)
    )


@pytest.mark.parametrize("count", [1, 7, 50, 200])
def test_a_grid_has_the_wanted_number_of_even_places(count) -> None:
    found = grid_displacements_mm(TARGET, count)
    assert len(np.unique(found, axis=0)) == count
    if count >= 50:
        apart = np.hypot(*(found[:, None] - found).transpose(2, 0, 1))
        nearest = np.where(apart > 0, apart, np.inf).min(axis=1)
        assert nearest.max() <= 1.5 * nearest.min()


def test_adaptive_places_leave_no_hole_before_they_repeat() -> None:
    seen, holes = EMPTY, EMPTY.holes
    for k in range(holes):
        seen = seen.with_offset(planned_displacement_mm("adaptive", TARGET, 5, k, holes, seen))
    assert seen.counts[seen.possible].max() <= 2
    assert seen.covered > 0.97


def test_a_range_that_holds_no_grid_is_refused() -> None:
    with pytest.raises(InputError, match="Not enough displacements"):
        grid_displacements_mm(ProbeTarget(circle(15.0), circle(15.0), 0.1), 400)


def test_a_campaign_survives_a_restart(tmp_path) -> None:
    campaign = new_campaign("pot", "short", "grid", 7, 12, 5.0).with_mounting().without(4)
    campaign.save(tmp_path)
    assert read_campaign(tmp_path, campaign.uuid) == campaign
    assert newest_campaign(tmp_path) == campaign.uuid
    later = new_campaign("pot", "short", "grid", 8, 12, None)
    later.save(tmp_path)
    assert newest_campaign(tmp_path) == later.uuid
    assert campaign.todo([]) == [k for k in range(12) if k != 4]


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"format": 2}', '{"format": 1, "pattern": "spiral", "skipped": []}']
)
def test_a_damaged_campaign_is_named(tmp_path, text) -> None:
    path = tmp_path / "campaigns" / "c.json"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(InputError, match=r"c\.json"):
        read_campaign(tmp_path, "c")


@pytest.mark.parametrize("wrong", [{"count": 0}, {"seed": -1}, {"within_mm": 0.0}])
def test_senseless_campaigns_are_refused(wrong) -> None:
    given = {"piece": "pot", "bottom": "short", "pattern": "random", "seed": 0, "count": 5,
             "within_mm": None}  # fmt: skip
    with pytest.raises(InputError):
        new_campaign(**{**given, **wrong})


def test_a_campaign_is_hashable_as_a_value() -> None:
    assert Campaign("u", "a", "b", "grid", 1, 2) == Campaign("u", "a", "b", "grid", 1, 2)


def test_holes_are_those_of_all_campaigns_that_somebody_stands_for(dataset: Dataset) -> None:
    mine = new_campaign("pot", "circle15", "adaptive", 0, 5, None)
    context = replace(context_for(dataset), campaign=mine.uuid)
    others = replace(context, campaign="another")
    rejected = small_episode(accepted=False)
    made = [
        dataset.record(episode, Label(4000 * k, 0, 0, 9), source="measured", context=where).uuid
        for k, (episode, where) in enumerate(
            [(small_episode(), context), (small_episode(), others), (small_episode(), others),
             (small_episode(), others), (rejected, context)]
        )
    ]  # fmt: skip
    for uuid in made[1:3]:
        dataset.labels.accept("ann", uuid)
    dataset.labels.approve("bea", made[1])
    pieces = load_pieces()
    seen = pair_coverage(
        dataset, mine, ProbeTarget(pieces.piece("pot").face, pieces.piece("circle15").face)
    )
    # Mine as a draft, theirs approved and submitted; not their draft, nor what is no observation.
    found = [seen.centre_mm(i, j) for i, j in zip(*np.nonzero(seen.counts), strict=True)]
    assert sorted(found) == [(0.0, 0.0), (4.0, 0.0), (8.0, 0.0)]


@pytest.mark.parametrize(
    ("count", "asked", "most", "grips"),
    [(20, None, 7, 1), (2, None, 1, 1), (200, None, 50, 1), (2000, None, 50, 10), (20, 9, 9, 1)],
)
def test_a_campaign_makes_three_grips_and_mountings_or_more_unless_told_otherwise(
    count: int, asked: int | None, most: int, grips: int
) -> None:
    method = CollectRequest(count=count, probes_per_grip=asked).method(StackSettings())
    assert method.collect.probes_per_grip == most
    assert method.collect.grips_per_mounting == grips
    if asked is None and count >= GRIPS:
        in_all = -(-count // most)
        assert in_all >= GRIPS
        assert -(-in_all // grips) >= MOUNTINGS
    told = CollectRequest(count=count, grips_per_mounting=7).method(StackSettings())
    assert told.collect.grips_per_mounting == 7
