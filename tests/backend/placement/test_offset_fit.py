"""Offsets fitted to patches, with a correct uncertainty."""

import math
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.core.values import ContactPatch, Episode, EpisodeQuality
from touchdown.backend.geometry.outlines import circle, face_points, square, true_patch
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.placement.estimator import (
    Estimator,
    OffsetFit,
    OffsetGrid,
    mean_entropy,
    sigmas_apart,
)
from touchdown.backend.simulation.batch import BatchPlan, simulate_episodes

POT = face_points(circle(15.0))


def sure(offset_mm, bottom):
    """Return the patch of a model that is right and sure."""
    return ContactPatch(POT.copy(), np.where(true_patch(POT, offset_mm, bottom), 0.98, 0.02))


@pytest.mark.parametrize("bottom", [circle(15.0), square(15.0)])
@pytest.mark.parametrize("offset_mm", [(5.0, 0.0), (-3.2, 4.7), (0.4, -8.1), (7.0, 7.0)])
def test_a_perfect_patch_gives_its_displacement_back(bottom, offset_mm):
    found = OffsetGrid.of(POT, bottom).fit(sure(offset_mm, bottom))
    # Points 1 mm apart leave half of that open along each axis.
    assert np.abs(np.subtract(found.offset_mm, offset_mm)).max() <= 0.56
    assert found.sigma_mm < 0.8


def test_a_face_wholly_inside_the_bottom_does_not_say_where():
    wide = circle(25.0)
    grid = OffsetGrid.of(POT, wide)
    inside, over_edge = grid.fit(sure((0.5, 0.5), wide)), grid.fit(sure((9.0, 0.0), wide))
    assert inside.sigma_mm > 1.5 > 2 * over_edge.sigma_mm


def test_an_ignorant_patch_gives_the_spread_of_the_prior():
    grid = OffsetGrid.of(POT, circle(15.0))
    found = grid.fit(ContactPatch(POT.copy(), np.full(len(POT), 0.5)))
    assert found.offset_mm == pytest.approx((0.0, 0.0), abs=1e-6)
    radii = np.hypot(*grid.offsets_mm.T)
    assert found.sigma_mm == pytest.approx(math.sqrt((radii**2).mean() / 2), rel=0.01)


def test_what_is_no_patch_of_this_face_is_refused():
    grid = OffsetGrid.of(POT, circle(15.0))
    with pytest.raises(ValueError, match="points"):
        grid.fit(ContactPatch(np.zeros((3, 2)), np.zeros(3)))
    with pytest.raises(ValueError, match="probabilities"):
        grid.fit(ContactPatch(POT.copy(), np.full(len(POT), np.nan)))


def test_distance_in_joint_uncertainties():
    assert sigmas_apart((3.0, 4.0), 0.6, OffsetFit((0.0, 0.0), 0.8)) == pytest.approx(5.0)


def test_entropy_is_greatest_where_the_model_is_unsure():
    assert mean_entropy(np.full(9, 0.5)) == pytest.approx(math.log(2))
    assert mean_entropy(np.array([0.0, 1.0])) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_displacements_of_simulated_episodes_are_found_within_their_uncertainty():
    """The shipped model on fresh probes of a bottom it was trained on."""
    catalogue = load_pieces()
    pot, bottom = catalogue.top("pot"), catalogue.bottom("circle15")
    plan = BatchPlan("pot", "circle15", pot.face, bottom.face, POT, 30.0, 30.0, 120, 99,
                probes_per_grip=1, grips_per_mounting=1)  # fmt: skip
    batches = list(simulate_episodes(plan))
    offset = np.concatenate([b.offset_mm for b in batches])
    observation = np.concatenate([b.observation for b in batches])
    model = Estimator.load(
        Path(str(files("touchdown.resources"))) / "models" / "pot.safetensors", pot
    )
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
    grid = OffsetGrid.of(POT, bottom.face)
    fits = [
        grid.fit(model.estimate(Episode("e", "pot", seen, at, 0.0, quality)))
        for seen, at in zip(observation, offset, strict=True)
    ]
    error = np.array([f.offset_mm for f in fits]) - offset
    prior = float(np.sqrt((offset**2).mean()))
    assert np.sqrt((error**2).mean()) < 0.4 * prior
    relative = error / np.array([[f.sigma_mm] for f in fits])
    assert 0.6 < np.sqrt((relative**2).mean()) < 1.7
