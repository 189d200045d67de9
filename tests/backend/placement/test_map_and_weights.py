"""Grid and prior of a new map, faces of three corners, weights, drawn candidates, signals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.config.method import BeliefSettings
from touchdown.backend.core.values import ContactPatch, Episode
from touchdown.backend.geometry.outlines import inset_mm, rectangle
from touchdown.backend.learning.fused.inference import InsetDistribution
from touchdown.backend.placement import label_review
from touchdown.backend.placement.belief import Belief, CellGrid, cover_cells
from touchdown.backend.placement.estimator import EnsembleEstimate, OffsetFit
from touchdown.backend.placement.strategies import fit_face_centre
from touchdown.backend.placement.support_tower import normal_draws

ORIGIN = (3.3, -1.7)


@pytest.mark.parametrize("pitch_mm", [0.8, 1.6, 2.0])
def test_a_new_map_has_its_first_probe_in_the_middle(pitch_mm: float) -> None:
    how = BeliefSettings(pitch_mm=pitch_mm, half_extent_mm=9.6)
    centres = Belief.unknown(how, ORIGIN).map.cell_centres_mm()
    np.testing.assert_allclose(centres.mean(axis=(0, 1)), ORIGIN)
    reach_mm = np.ceil(9.6 / pitch_mm - 1e-9) * pitch_mm
    np.testing.assert_allclose(centres[0, 0], np.subtract(ORIGIN, reach_mm))


def test_a_map_without_a_base_rate_knows_as_much_for_as_against() -> None:
    unknown = Belief.unknown(BeliefSettings(), ORIGIN)
    assert unknown.base_rate == 0.5
    assert Belief(unknown.settings, unknown.map).base_rate == 0.5
    rated = Belief.unknown(BeliefSettings(prior_correction=True), ORIGIN, 0.2)
    np.testing.assert_allclose(rated.log_odds(np.array([0.2, 0.5])), [0.0, np.log(4.0)], atol=1e-12)


def test_a_face_of_three_corners_covers_what_lies_between_its_points() -> None:
    axis = np.arange(5.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    points = points[points.sum(axis=1) <= 4.0]
    grid = CellGrid((-3.0, -3.0), 1.0, (12, 12))
    found = cover_cells(grid, points, np.full(len(points), 0.7), (0.5, 0.5))
    # Cells at half a pitch between the points: all within the slanted edge.
    assert int(found.covered.sum()) == 10
    np.testing.assert_allclose(found.log_odds[found.covered], 0.7)


def test_a_sure_inset_counts_by_its_variance_down_to_the_smallest() -> None:
    """Two halves of the points tell of two middles: the fit lies between, by the weights."""
    face = rectangle(20.0, 400.0)
    y = np.linspace(-30.0, 30.0, 41)
    points = np.concatenate([np.stack([np.full_like(y, x), y], axis=1) for x in (6.0, 6.5)])
    sure = np.arange(len(points)) < len(y)
    apart_mm = np.where(sure, 0.0, 0.8)
    mean = inset_mm(face, points - np.stack([1.2 + apart_mm, 0.0 * apart_mm], axis=1))
    sd = np.where(sure, 0.1, 0.36)
    found = fit_face_centre(
        InsetDistribution(np.ones((len(points), 1)), mean[:, None], sd[:, None]), points, face
    )
    weight = np.array([1.0 / 0.3**2, 1.0 / 0.36**2])
    assert found.at_mm[0] == pytest.approx(1.2 + 0.8 * weight[1] / weight.sum(), abs=0.02)


def test_every_joint_has_the_same_draws_in_an_order_of_its_own() -> None:
    draws = normal_draws(4)
    lengths = np.linalg.norm(draws, axis=2)
    for joint in range(4):
        np.testing.assert_allclose(np.sort(lengths[:, joint]), np.sort(lengths[:, 0]))
        for other in range(joint):
            assert not np.allclose(draws[:, joint], draws[:, other])
    np.testing.assert_allclose(draws.mean(axis=(0, 1)), 0.0, atol=0.2)


class TellsNothing:
    """Models that estimate the same of every episode."""

    weights = "ab" * 32

    def judge(self, episode: Episode, grid: object) -> EnsembleEstimate:
        patch = ContactPatch(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.3, 0.6]))
        return EnsembleEstimate(OffsetFit((1.0, -2.0), 0.4), patch, 0.1, 0.5, 0.1)


def test_labels_are_compared_by_the_wrench_of_the_settled_press(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[np.ndarray] = []

    def summarise(probability: np.ndarray, wrench: np.ndarray) -> np.ndarray:
        seen.append(wrench)
        return np.hstack([probability, wrench])

    monkeypatch.setattr(label_review, "summarise_signals", summarise)
    with Dataset.open(tmp_path / "data") as dataset:
        context, settled = replace(context_for(dataset), grip_id="grip-2"), []
        for number in range(3):
            episode = small_episode(seed=number)
            label = Label(1000 * number, -500, 0, 150)
            dataset.record(episode, label, source="commanded", context=context)
            settled.append(episode.observation[-5:, 252:].mean(axis=0))
        models = TellsNothing()
        assert label_review.score_labels(dataset, lambda _: models, lambda *_: True) == 3  # type: ignore[arg-type,return-value]
    np.testing.assert_allclose(np.sort(seen[0], axis=0), np.sort(settled, axis=0), rtol=1e-5)
