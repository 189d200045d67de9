"""Towers: what is believed of the interfaces below, against the exact judge of whole stacks."""

from __future__ import annotations

import re

import numpy as np
import pytest

from backend.config.method import BeliefSettings, StackSettings, TowerSettings
from backend.core.faults import InputError
from backend.core.flow import ContactPatch
from backend.objects.catalogue import Catalogue, load_catalogue
from backend.objects.shapes import circle
from backend.objects.surface import face_points
from backend.objects.tower import Tower, judge
from backend.placement.belief import Belief
from backend.placement.below import DRAWS, Below, normal_draws
from backend.placement.outline_belief import OutlineBelief
from backend.placement.steadiest import steadiest_mm
from backend.placement.strategies import begin
from backend.placement.strategy import Held, Touched

EXACT = 1e-6
FACE = face_points(circle(15.0))
SMALL = BeliefSettings(half_extent_mm=16.0)


@pytest.fixture(scope="module")
def catalogue() -> Catalogue:
    return load_catalogue()


def below_of(catalogue: Catalogue, offset_mm: tuple[float, float], sigma_mm: float) -> Below:
    bottoms = [catalogue.bottom(name) for name in ("short", "long")]
    entry = TowerSettings(offset_mm=(offset_mm,), sigma_mm=sigma_mm)
    found = Below.entered(catalogue.top("pot"), bottoms, entry)
    assert found is not None
    return found


def test_what_is_known_exactly_is_judged_as_the_exact_judge_does(catalogue: Catalogue) -> None:
    rng = np.random.default_rng(8)
    names = ("square15", "short", "rect12x28", "hex20")
    bottoms = [catalogue.bottom(name) for name in names]
    inside = 0
    for _ in range(30):
        steps = rng.uniform(-6.0, 6.0, (3, 2))
        place = rng.uniform(-8.0, 8.0, 2)
        entry = TowerSettings(offset_mm=tuple(map(tuple, steps)), sigma_mm=EXACT)
        below = Below.entered(catalogue.top("pot"), bottoms, entry)
        assert below is not None
        insets = below.insets_mm(place)
        at = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        bodies = [b.body((float(x), float(y))) for b, (x, y) in zip(bottoms, at, strict=True)]
        top = catalogue.top("pot").body(tuple(at[-1] + place))
        exact = min(judge(Tower((*bodies, top))).margins_mm[:-1])
        assert insets.shape == (DRAWS,)
        assert np.ptp(insets) < 1e-4
        assert (insets[0] > 0) == (exact > 0)
        if exact > 0:
            inside += 1
            assert insets[0] == pytest.approx(exact, abs=0.02)
    assert 5 < inside < 30


def test_a_release_says_what_the_next_entry_needs() -> None:
    settings = StackSettings(belief=SMALL, strategy="outlines")
    reasoner = begin(Held((0.0, 0.0), 30.0), settings, (3.0, 0.0))
    for at in ((3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0), (3.0, 0.0)):
        concluded = reasoner.conclude(Touched(np.zeros((20, 258), np.float32), felt(at), at))
        if concluded.action.kind == "release":
            break
    words = re.search(
        r"stands (\S+), (\S+) mm from the middle, sigma (\S+) mm", concluded.action.reason
    )
    assert words is not None
    x, y, sigma = map(float, words.groups())
    assert 0.2 < sigma < 5.0
    assert np.hypot(x - at[0], y - at[1]) < 3.0 * sigma


def test_a_vague_entry_leaves_towers_that_would_fall(catalogue: Catalogue) -> None:
    place = np.array([2.0, 0.0])
    exact = below_of(catalogue, (4.0, 0.0), EXACT).insets_mm(place)
    vague = below_of(catalogue, (4.0, 0.0), 3.0).insets_mm(place)
    assert exact.min() > 1.0
    assert vague.min() < exact.min() - 2.0
    assert vague.mean() < exact.mean()


def test_draws_are_standard_normal_and_joints_differ() -> None:
    draws = normal_draws(2)
    assert draws.mean(axis=0) == pytest.approx(0.0, abs=0.15)
    assert draws.std(axis=0) == pytest.approx(1.0, abs=0.15)
    assert abs((draws[:, 0] * draws[:, 1]).mean()) < 0.2


def test_an_entry_of_another_tower_is_refused(catalogue: Catalogue) -> None:
    short, long = (catalogue.bottom(name) for name in ("short", "long"))
    pot = catalogue.top("pot")
    assert Below.entered(pot, [short], TowerSettings()) is None
    centred = Below.entered(pot, [short, long], TowerSettings())
    assert centred is not None
    assert centred.offset_mm == ((0.0, 0.0),)
    with pytest.raises(InputError, match="1 bottoms above the lowest, 2 were entered"):
        Below.entered(pot, [short, long], TowerSettings(offset_mm=((1.0, 0.0), (0.0, 0.0))))


def felt(offset_mm: tuple[float, float]) -> ContactPatch:
    """What a sure network says of a disc of 18 mm, as Long is, at the origin of the map."""
    inside = circle(18.0).contains(FACE + np.asarray(offset_mm))
    return ContactPatch(FACE.copy(), np.where(inside, 0.98, 0.02))


def test_the_best_place_leans_against_the_tower(catalogue: Catalogue) -> None:
    map_ = Belief.unknown(SMALL, (0.0, 0.0)).updated(felt((5.0, 0.0)), (5.0, 0.0)).map
    outlines = OutlineBelief.given(map_, 0.2)
    middle = outlines.centre_mm()
    straight = steadiest_mm(outlines, below_of(catalogue, (0.0, 0.0), 0.5), 0.05)
    leaning = steadiest_mm(outlines, below_of(catalogue, (8.0, 0.0), 0.5), 0.05)
    assert np.hypot(straight[0] - middle[0], straight[1] - middle[1]) < 2.1
    assert leaning[0] < straight[0] - 1.5


def test_a_place_that_the_top_alone_carries_is_no_release_on_a_leaning_tower(
    catalogue: Catalogue,
) -> None:
    settings = StackSettings(belief=SMALL, strategy="outlines")
    here, kinds = (4.0, 0.0), []
    for below in (None, below_of(catalogue, (9.5, 0.0), 0.5)):
        reasoner = begin(Held((0.0, 0.0), 30.0, below=below), settings, here)
        for at in ((4.0, 0.0), (-4.0, 0.0), (0.0, 4.0), (0.0, -4.0), here):
            touched = Touched(np.zeros((20, 258), np.float32), felt(at), at)
            concluded = reasoner.conclude(touched)
        kinds.append((concluded.action.kind, reasoner.stable_at(here), reasoner.likely_at(here)))
    assert kinds == [("release", True, True), ("shift", False, False)]
