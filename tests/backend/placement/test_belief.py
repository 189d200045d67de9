""""""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.backend.annotations.conftest import context_for, small_episode
from touchdown.backend.annotations import Dataset, Label
from touchdown.backend.config.method import BeliefSettings
from touchdown.backend.core import BeliefMap, ContactPatch, Episode, InputError
from touchdown.backend.geometry.outlines import inset_mm, rectangle
from touchdown.backend.learning.calibration import PatchCalibration
from touchdown.backend.learning.fused.inference import InsetDistribution
from touchdown.backend.placement import label_review
from touchdown.backend.placement.belief import Belief, CellGrid, cover_cells
from touchdown.backend.placement.estimator import EnsembleEstimate, OffsetFit
from touchdown.backend.placement.strategies import fit_face_centre

RAW = BeliefSettings(min_shift_mm=0.0)


def lattice(radius_mm: float = 7.5, pitch_mm: float = 1.0) -> np.ndarray:
    count = int(radius_mm / pitch_mm + 1e-9)
    axis = pitch_mm * np.arange(-count, count + 1)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm + 1e-9]


def uniform(p: float, radius_mm: float = 7.5, pitch_mm: float = 1.0) -> ContactPatch:
    points = lattice(radius_mm, pitch_mm)
    return ContactPatch(points, np.full(len(points), p))


def at(belief: BeliefMap, x_mm: float, y_mm: float) -> float:
    """Probability of the cell at a place that must be a cell centre."""
    column = (x_mm - belief.origin_mm[0]) / belief.pitch_mm
    row = (y_mm - belief.origin_mm[1]) / belief.pitch_mm
    assert abs(column - round(column)) < 1e-6
    return float(belief.probability[round(row), round(column)])


def fuse(*probes: tuple[float, tuple[float, float]], how: BeliefSettings = RAW) -> Belief:
    belief = Belief.unknown(how, probes[0][1])
    for p, offset in probes:
        belief = belief.updated(uniform(p), offset)
    return belief


HERE = (3.3, -1.7)


@pytest.mark.parametrize(
    ("estimates", "log_odds", "probability"),
    [((0.7, 0.8), 2.2336, 0.9032), ((0.6, 0.6, 0.6), 1.2164, 0.7714), ((0.9, 0.2), 0.8109, 0.6923)],
)
def test_published_vectors(
    estimates: tuple[float, ...], log_odds: float, probability: float
) -> None:
    belief = fuse(*((p, HERE) for p in estimates))
    assert at(belief.map, *HERE) == pytest.approx(probability, abs=5e-5)
    covered = belief.map.log_odds[belief.map.covered]
    np.testing.assert_allclose(covered, log_odds, atol=5e-5)
    assert belief.map.probes == len(estimates)


def test_a_calibrated_map_counts_the_prior_once_and_divides_by_the_temperature() -> None:
    fitted = PatchCalibration(temperature=2.0, bias=0.1, prior=0.3)
    belief = Belief.unknown(RAW, HERE, calibration=fitted)
    before = belief.map.log_odds.copy()
    for p in (0.7, 0.8, 0.4):
        belief = belief.updated(uniform(p), HERE)
    prior = math.log(0.3 / 0.7)
    single = [math.log(p / (1 - p)) / 2 + 0.1 for p in (0.7, 0.8, 0.4)]
    np.testing.assert_allclose(
        belief.map.log_odds[belief.map.covered], sum(single) - 2 * prior, atol=1e-12
    )
    assert not before.any()
    assert not belief.map.log_odds[~belief.map.covered].any()


def test_unknown_is_one_half_everywhere() -> None:
    belief = Belief.unknown(BeliefSettings(), HERE).map
    assert (belief.probability == 0.5).all()
    assert not belief.covered.any()
    assert at(belief, *HERE) == 0.5
    centres = belief.cell_centres_mm()
    np.testing.assert_allclose(centres[0, 0], np.array(HERE) - 32.0)
    np.testing.assert_allclose(centres[-1, -1], np.array(HERE) + 32.0)


def test_only_covered_cells_change_and_each_once() -> None:
    first = fuse((0.8, HERE))
    assert int(first.map.covered.sum()) == len(lattice()) == 177
    second = first.updated(uniform(0.8), (HERE[0] + 3.0, HERE[1]))
    single, double = math.log(4.0), 2 * math.log(4.0)
    values = second.map.log_odds
    face, moved = {tuple(p) for p in lattice()}, {(x + 3.0, y) for x, y in lattice()}
    assert int(np.isclose(values, double).sum()) == len(face & moved)
    assert int(np.isclose(values, single).sum()) == len(face ^ moved)
    assert int((values == 0).sum()) == values.size - len(face | moved)


def test_absence_of_evidence_is_no_evidence() -> None:
    away = fuse((0.98, HERE)).updated(uniform(0.02), (HERE[0] + 15.0, HERE[1]))
    assert at(away.map, *HERE) == pytest.approx(0.98)
    assert at(away.map, HERE[0], HERE[1] + 20.0) == 0.5


@settings(max_examples=60, deadline=None)
@given(st.floats(-9, 9), st.floats(-9, 9), st.floats(0.05, 0.95))
def test_any_shift_keeps_a_uniform_estimate(dx: float, dy: float, p: float) -> None:
    belief = Belief.unknown(RAW, (0.0, 0.0)).updated(uniform(p), (dx, dy)).map
    expected = math.log(p / (1 - p))
    np.testing.assert_allclose(belief.log_odds[belief.covered], expected, atol=1e-9)
    assert (belief.log_odds[~belief.covered] == 0).all()
    # No cell outside the face, none missing that lies well inside it.
    distance = np.hypot(*np.moveaxis(belief.cell_centres_mm() - (dx, dy), -1, 0))
    assert distance[belief.covered].max() <= 7.5 + 1e-9
    assert belief.covered[distance <= 6.2].all()


@settings(max_examples=60, deadline=None)
@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_shifted_grids_are_resampled_bilinearly(dx: float, dy: float, a: float, b: float) -> None:
    """A plane of logits is reproduced exactly by bilinear interpolation."""
    points = lattice()
    logits = 0.2 + a * points[:, 0] + b * points[:, 1]
    patch = ContactPatch(points, 1 / (1 + np.exp(-logits)))
    belief = Belief.unknown(RAW, (0.0, 0.0)).updated(patch, (dx, dy)).map
    place = belief.cell_centres_mm() - (dx, dy)
    plane = 0.2 + a * place[..., 0] + b * place[..., 1]
    distance = np.hypot(place[..., 0], place[..., 1])
    # Next to the outline some corners are missing: there the nearest ones decide.
    inner = belief.covered & (distance <= 6.0)
    assert inner.sum() > 80
    np.testing.assert_allclose(belief.log_odds[inner], plane[inner], atol=1e-6)


@pytest.mark.parametrize("pitch_mm", [0.5, 1.5, 2.0])
def test_pitches_need_not_match(pitch_mm: float) -> None:
    belief = Belief.unknown(RAW, HERE).updated(uniform(0.8, 9.0, pitch_mm), HERE).map
    assert at(belief, *HERE) == pytest.approx(0.8)
    inner = np.hypot(*np.moveaxis(belief.cell_centres_mm() - HERE, -1, 0)) <= 9.0 - 1.5 * pitch_mm
    assert belief.covered[inner].all()
    np.testing.assert_allclose(belief.log_odds[belief.covered], math.log(4.0), atol=1e-9)


def test_clip_and_limit() -> None:
    certain = fuse((1.0, HERE))
    assert certain.map.log_odds.max() == pytest.approx(3.8918, abs=5e-5)
    assert fuse((0.0, HERE)).map.log_odds.min() == pytest.approx(-3.8918, abs=5e-5)
    many = fuse(*((1.0, HERE) for _ in range(7)))
    assert many.map.log_odds.max() == 20.0


def test_temperature_and_prior() -> None:
    cooled = fuse((0.8, HERE), how=BeliefSettings(temperature=2.0))
    assert at(cooled.map, *HERE) == pytest.approx(2 / 3)
    how = BeliefSettings(prior_correction=True)
    corrected = Belief.unknown(how, HERE, base_rate=0.2).updated(uniform(0.2), HERE)
    assert at(corrected.map, *HERE) == pytest.approx(0.5)
    with pytest.raises(InputError, match="base rate"):
        Belief.unknown(how, HERE)


def test_a_repeat_replaces() -> None:
    how = BeliefSettings()
    near, far = (HERE[0] + 0.49, HERE[1]), (HERE[0] + 0.51, HERE[1])
    assert fuse((0.8, HERE), (0.6, HERE), how=how).map.log_odds.max() == pytest.approx(
        math.log(1.5)
    )
    replaced = fuse((0.8, HERE), (0.6, near), how=how)
    assert (replaced.map.probes, len(replaced.visits)) == (1, 2)
    assert replaced.map.log_odds.max() == pytest.approx(math.log(1.5))
    added = fuse((0.8, HERE), (0.6, far), how=how)
    assert added.map.probes == 2
    assert added.map.log_odds.max() == pytest.approx(math.log(4.0) + math.log(1.5))


def test_what_is_no_probability_changes_nothing() -> None:
    belief = fuse((0.8, HERE))
    points = lattice()
    p = np.full(len(points), 0.5)
    p[40] = math.nan
    after = belief.updated(ContactPatch(points, p), (HERE[0] + 3, HERE[1]))
    assert np.array_equal(after.map.log_odds, belief.map.log_odds)
    assert len(after.visits) == 2
    nowhere = belief.updated(uniform(0.9), (math.nan, 0.0))
    assert np.array_equal(nowhere.map.log_odds, belief.map.log_odds)


def test_values_are_frozen_and_the_former_belief_is_untouched() -> None:
    belief = fuse((0.8, HERE))
    before = belief.map.log_odds.copy()
    belief.updated(uniform(0.3), (HERE[0] + 1, HERE[1]))
    assert np.array_equal(belief.map.log_odds, before)
    with pytest.raises(ValueError, match="read-only"):
        belief.map.log_odds[0, 0] = 1.0


def test_the_order_of_probes_does_not_matter() -> None:
    probes = [(0.7, (0.0, 0.0)), (0.95, (2.3, 0.4)), (0.1, (-1.1, 1.9))]
    results = []
    for order in (probes, probes[::-1]):
        belief = Belief.unknown(RAW, (0.0, 0.0))
        for p, offset in order:
            belief = belief.updated(uniform(p), offset)
        results.append(belief.map.log_odds)
    np.testing.assert_allclose(results[0], results[1], atol=1e-12)


def test_beyond_the_map_is_left_out() -> None:
    edge = Belief.unknown(RAW, (0.0, 0.0)).updated(uniform(0.8), (30.0, 0.0)).map
    assert 0 < edge.covered.sum() < 177
    outside = Belief.unknown(RAW, (0.0, 0.0)).updated(uniform(0.8), (100.0, 0.0)).map
    assert not outside.covered.any()


def test_points_that_are_no_lattice_are_refused() -> None:
    points = lattice().copy()
    points[3] += 0.3
    patch = ContactPatch(points, np.full(len(points), 0.5))
    with pytest.raises(ValueError, match="lattice"):
        Belief.unknown(RAW, (0.0, 0.0)).updated(patch, (0.0, 0.0))


@pytest.mark.parametrize("pitch_mm", [0.8, 1.6, 2.0])
def test_a_new_map_has_its_first_probe_in_the_middle(pitch_mm: float) -> None:
    how = BeliefSettings(pitch_mm=pitch_mm, half_extent_mm=9.6)
    centres = Belief.unknown(how, HERE).map.cell_centres_mm()
    np.testing.assert_allclose(centres.mean(axis=(0, 1)), HERE)
    reach_mm = np.ceil(9.6 / pitch_mm - 1e-9) * pitch_mm
    np.testing.assert_allclose(centres[0, 0], np.subtract(HERE, reach_mm))


def test_a_map_without_a_base_rate_knows_as_much_for_as_against() -> None:
    unknown = Belief.unknown(BeliefSettings(), HERE)
    assert unknown.base_rate == 0.5
    assert Belief(unknown.settings, unknown.map).base_rate == 0.5
    rated = Belief.unknown(BeliefSettings(prior_correction=True), HERE, 0.2)
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


class TellsNothing:
    """Models that estimate the same of every episode."""

    weights = "ab" * 32

    def judge(self, episode: Episode, grid: object) -> EnsembleEstimate:
        patch = ContactPatch(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.3, 0.6]))
        return EnsembleEstimate(OffsetFit((1.0, -2.0), 0.4), patch, 0.1)


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
