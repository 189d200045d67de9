"""Lower interfaces in learned fusion, compared with closed forms and exact statics."""

from __future__ import annotations

from math import erf, sqrt

import numpy as np
import pytest

from touchdown.backend.config.method import TowerSettings
from touchdown.backend.core.values import FloatArray
from touchdown.backend.geometry.outlines import Outline, circle, inset_mm, rectangle
from touchdown.backend.geometry.pieces import PieceLibrary, load_pieces
from touchdown.backend.geometry.tower import Body, Tower, judge_tower
from touchdown.backend.learning.fused.inference import InsetDistribution
from touchdown.backend.placement.strategies import (
    FaceCentre,
    LowerSupport,
    equivalent_disc,
    fit_face_centre,
    holding_probability,
)
from touchdown.backend.placement.support_tower import SupportTower

EXACT = 1e-6
STEPS = np.arange(-13.0, 14.0)
AROUND = np.stack(np.meshgrid(STEPS, STEPS), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def catalogue() -> PieceLibrary:
    return load_pieces()


def normal(mean_mm: FloatArray, sd_mm: FloatArray | float) -> InsetDistribution:
    """A network's answer with one part."""
    mean = np.reshape(mean_mm, (-1, 1))
    return InsetDistribution(
        np.ones_like(mean), mean, np.broadcast_to(np.reshape(sd_mm, (-1, 1)), mean.shape)
    )


def below_of(catalogue: PieceLibrary, names: tuple[str, ...], steps: FloatArray) -> SupportTower:
    bottoms = [catalogue.bottom(name) for name in names]
    entry = TowerSettings(offset_mm=tuple(map(tuple, steps.tolist())), sigma_mm=EXACT)
    found = SupportTower.entered(catalogue.top("pot"), bottoms, entry)
    assert found is not None
    return found


@pytest.mark.parametrize("face", [circle(18.0), rectangle(12.0, 28.0), rectangle(20.0, 20.0)])
def test_the_middle_is_found_with_what_is_not_known_of_it(face: Outline) -> None:
    """The insets that a network would tell if the middle were normally distributed."""
    rng = np.random.default_rng(3)
    middle, covariance = np.array([3.3, -1.6]), np.array([[1.1, 0.3], [0.3, 0.5]])
    drawn = rng.multivariate_normal(middle, covariance, 800)
    insets = np.stack([inset_mm(face, AROUND - at) for at in drawn])
    found = fit_face_centre(normal(insets.mean(axis=0), insets.std(axis=0)), AROUND, face)
    assert found.at_mm == pytest.approx(middle, abs=0.3)
    assert found.sigma_mm == pytest.approx(sqrt(np.trace(covariance) / 2.0), rel=0.35)
    assert np.cov(found.drawn().T) == pytest.approx(found.sigma_mm**2 * np.eye(2), abs=0.3)


def test_a_face_of_unknown_outline_is_taken_for_a_disc_of_its_size() -> None:
    insets = inset_mm(rectangle(16.0, 20.0), AROUND - (2.0, 1.0))
    disc = equivalent_disc(normal(insets, 0.5), 1.0)
    assert disc.area_mm2 == pytest.approx(16.0 * 20.0, rel=0.15)
    found = fit_face_centre(normal(insets, 0.5), AROUND, disc)
    assert found.at_mm == pytest.approx((2.0, 1.0), abs=0.3)
    # That it is no disc makes its middle less certain.
    assert (
        found.sigma_mm
        > fit_face_centre(normal(insets, 0.5), AROUND, rectangle(16.0, 20.0)).sigma_mm
    )
    x, y = 3.0 - found.at_mm[0], -1.0 - found.at_mm[1]
    assert f"stands {x:+.1f}, {y:+.1f} mm from the middle" in found.standing((3.0, -1.0))


def test_what_is_known_exactly_is_held_as_the_exact_judge_says(catalogue: PieceLibrary) -> None:
    rng = np.random.default_rng(11)
    names = ("short", "rect12x28", "hex20")
    bottoms = [catalogue.bottom(name) for name in names]
    kinds = []
    for _ in range(40):
        steps, place = rng.uniform(-5.0, 5.0, (2, 2)), rng.uniform(-9.0, 9.0, 2)
        at = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        bodies = [b.body((float(x), float(y))) for b, (x, y) in zip(bottoms, at, strict=True)]
        exact = judge_tower(Tower((*bodies, catalogue.top("pot").body(tuple(at[-1] + place)))))
        touched = bodies[-1].upper
        assert touched is not None
        # In the frame of the map the uppermost bottom has its middle anywhere.
        middle = FaceCentre((2.5, -4.0), EXACT)
        lower = LowerSupport(below_of(catalogue, names, steps), middle)
        top = normal(inset_mm(touched, place), EXACT)
        there = (float(place[0] + 2.5), float(place[1] - 4.0))
        holds = holding_probability(top, lower, there, np.zeros(1))[0]
        assert holds == pytest.approx(float(exact.stands), abs=1e-6)
        kinds.append((exact.stands, exact.margins_mm[-1] > 0.0))
    # Some stand, some fall at the touched face, and some only below it.
    assert {(True, True), (False, False), (False, True)} <= set(kinds)


@pytest.mark.parametrize("sigma_mm", [0.5, 1.5])
def test_the_chance_of_standing_is_that_of_the_closed_form(sigma_mm: float) -> None:
    """Slabs wide in y: the load moves along x alone, by all of the entry, a part of the place."""
    slab = rectangle(16.0, 400.0)
    low = Body("low", slab, slab, 10.0, 40.0, 5.0)
    high = Body("high", rectangle(60.0, 400.0), rectangle(60.0, 400.0), 10.0, 30.0, 5.0)
    lower = LowerSupport(
        SupportTower((low, high), ((5.0, 0.0),), sigma_mm, piece_g=20.0),
        FaceCentre((1.0, 2.0), 0.8),
    )
    # 20 of 50 g stand 4 mm from the middle: 1.6 mm of load besides the 5 mm that were entered.
    share = 20.0 / 50.0
    sd_mm = sqrt(sigma_mm**2 + (share * 0.8) ** 2)
    least_mm = np.linspace(-1.0, 1.4, 7)
    below = np.array([_within(x, 8.0 - 5.0 - share * 4.0, sd_mm) for x in least_mm])
    top = np.array([_within(x, 3.0, 1.2) for x in least_mm])
    found = holding_probability(normal(np.array(3.0), 1.2), lower, (5.0, 2.0), least_mm)
    np.testing.assert_allclose(found, np.maximum(top + below - 1.0, 0.0), atol=0.06)
    alone = holding_probability(normal(np.array(3.0), 1.2), None, (5.0, 2.0), least_mm)
    np.testing.assert_allclose(alone, top, atol=1e-4)


def _within(least_mm: float, mean_mm: float, sd_mm: float) -> float:
    return 0.5 * (1.0 + erf((mean_mm - least_mm) / (sd_mm * sqrt(2.0))))
