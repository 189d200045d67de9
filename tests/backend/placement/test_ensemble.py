"""Ensembles of models of one piece: means, spread, names."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from touchdown.backend.core.values import ContactPatch
from touchdown.backend.geometry.outlines import circle, face_points, true_patch
from touchdown.backend.placement.estimator import Ensemble, OffsetFit, OffsetGrid, mix_fits

FACE, BOTTOM = circle(20.0), circle(15.0)
POINTS = face_points(FACE)


class Member:
    """Feels the true patch of one displacement, with a certainty of its own."""

    def __init__(self, name, offset_mm, sure=0.9, piece="pot"):
        self.card = SimpleNamespace(piece=piece, weights_sha256=name)
        touching = true_patch(POINTS, np.array([offset_mm]), BOTTOM)[0]
        self._p = np.where(touching, sure, 1 - sure)

    def estimate(self, _episode):
        return ContactPatch(POINTS.copy(), self._p)


@pytest.fixture(scope="module")
def grid():
    return OffsetGrid.of(POINTS, BOTTOM)


def test_the_mixture_by_hand():
    fit, spread_mm = mix_fits([OffsetFit((1.0, 0.0), 0.3), OffsetFit((3.0, 0.0), 0.5)])
    # Variance between, per axis: (1 + 0) / 2; own: (0.09 + 0.25) / 2.
    assert fit.offset_mm == (2.0, 0.0)
    assert spread_mm == pytest.approx(math.sqrt(0.5))
    assert fit.sigma_mm == pytest.approx(math.sqrt(0.5 + 0.17))


def test_one_member_is_what_it_says_alone(grid):
    member = Member("aa", (6.0, 2.0))
    alone, says = grid.fit(member.estimate(None)), Ensemble([member]).judge(None, grid)
    assert says.fit.offset_mm == pytest.approx(alone.offset_mm)
    assert says.fit.sigma_mm == pytest.approx(alone.sigma_mm)
    assert (says.spread_mm, says.knowledge) == (0.0, pytest.approx(0.0, abs=1e-9))


def test_members_who_differ_know_less(grid):
    members = [Member("bb", (7.0, 0.0)), Member("aa", (5.0, 0.0))]
    says = Ensemble(members).judge(None, grid)
    fits = [grid.fit(member.estimate(None)) for member in members]
    assert says.fit.offset_mm[0] == pytest.approx(np.mean([f.offset_mm[0] for f in fits]))
    assert says.fit.sigma_mm > max(f.sigma_mm for f in fits) * 0.99
    assert says.knowledge > 0.0
    p = np.mean([member.estimate(None).probability for member in members], axis=0)
    np.testing.assert_allclose(says.patch.probability, p)
    assert Ensemble(members).weights == Ensemble(members[::-1]).weights == "aa+bb"


def test_an_ensemble_is_of_one_piece():
    for members in ([], [Member("a", (0, 0)), Member("b", (0, 0), piece="barrel")]):
        with pytest.raises(ValueError, match="one piece"):
            Ensemble(members)
