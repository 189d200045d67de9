"""Towers: estimated stability of the lower interfaces compared with exact statics."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.config.method import TowerSettings
from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry import PieceLibrary, Tower, judge_tower, load_pieces
from touchdown.backend.placement.support_tower import DRAWS, SupportTower, normal_draws

EXACT = 1e-6


@pytest.fixture(scope="module")
def catalogue() -> PieceLibrary:
    return load_pieces()


def below_of(
    catalogue: PieceLibrary, offset_mm: tuple[float, float], sigma_mm: float
) -> SupportTower:
    bottoms = [catalogue.bottom(name) for name in ("short", "long")]
    entry = TowerSettings(offset_mm=(offset_mm,), sigma_mm=sigma_mm)
    found = SupportTower.entered(catalogue.top("pot"), bottoms, entry)
    assert found is not None
    return found


def test_what_is_known_exactly_is_judged_as_the_exact_judge_does(catalogue: PieceLibrary) -> None:
    rng = np.random.default_rng(8)
    names = ("square15", "short", "rect12x28", "ring24", "channel20", "hex20")
    bottoms = [catalogue.bottom(name) for name in names]
    inside = 0
    for _ in range(30):
        steps = rng.uniform(-4.0, 4.0, (5, 2))
        place = rng.uniform(-8.0, 8.0, 2)
        entry = TowerSettings(offset_mm=tuple(map(tuple, steps)), sigma_mm=EXACT)
        below = SupportTower.entered(catalogue.top("pot"), bottoms, entry)
        assert below is not None
        insets = below.insets_mm(place)
        at = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        bodies = [b.body((float(x), float(y))) for b, (x, y) in zip(bottoms, at, strict=True)]
        top = catalogue.top("pot").body(tuple(at[-1] + place))
        exact = min(judge_tower(Tower((*bodies, top))).margins_mm[:-1])
        assert insets.shape == (DRAWS,)
        assert np.ptp(insets) < 1e-4
        assert (insets[0] > 0) == (exact > 0)
        if exact > 0:
            inside += 1
            assert insets[0] == pytest.approx(exact, abs=0.02)
    assert 5 < inside < 30


def test_a_vague_entry_leaves_towers_that_would_fall(catalogue: PieceLibrary) -> None:
    place = np.array([2.0, 0.0])
    exact = below_of(catalogue, (4.0, 0.0), EXACT).insets_mm(place)
    vague = below_of(catalogue, (4.0, 0.0), 3.0).insets_mm(place)
    assert exact.min() > 1.0
    assert vague.min() < exact.min() - 2.0
    assert vague.mean() < exact.mean()


def test_draws_are_standard_normal_and_each_joint_has_its_own_order() -> None:
    draws = normal_draws(4)
    assert draws.mean(axis=0) == pytest.approx(0.0, abs=0.15)
    assert draws.std(axis=0) == pytest.approx(1.0, abs=0.15)
    assert abs((draws[:, 0] * draws[:, 1]).mean()) < 0.2
    lengths = np.linalg.norm(draws, axis=2)
    for joint in range(4):
        np.testing.assert_allclose(np.sort(lengths[:, joint]), np.sort(lengths[:, 0]))
        assert not any(np.allclose(draws[:, joint], draws[:, other]) for other in range(joint))


def test_an_entry_of_another_tower_is_refused(catalogue: PieceLibrary) -> None:
    short, long = (catalogue.bottom(name) for name in ("short", "long"))
    pot = catalogue.top("pot")
    assert SupportTower.entered(pot, [short], TowerSettings()) is None
    centred = SupportTower.entered(pot, [short, long], TowerSettings())
    assert centred is not None
    assert centred.offset_mm == ((0.0, 0.0),)
    with pytest.raises(InputError, match="1 bottoms above the lowest, 2 were entered"):
        SupportTower.entered(pot, [short, long], TowerSettings(offset_mm=((1.0, 0.0), (0.0, 0.0))))
