from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchdown.backend.config.method import BeliefSettings, StabilitySettings
from touchdown.backend.core.values import ContactPatch, Stability, SupportKind
from touchdown.backend.placement.belief import Belief
from touchdown.backend.placement.policy import judge_stability, log_odds_threshold

PAPER = StabilitySettings()
HERE = (4.0, -2.5)


def lattice(radius_mm: float = 7.5) -> np.ndarray:
    axis = np.arange(-20.0, 21.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm + 1e-9]


def patch_of(touching: set[tuple[float, float]], high: float = 0.95) -> ContactPatch:
    points = lattice()
    p = np.array([high if (x, y) in touching else 0.05 for x, y in points])
    return ContactPatch(points, p)


def judged(
    touching: set[tuple[float, float]],
    how: StabilitySettings = PAPER,
    com: tuple[float, float] = (0.0, 0.0),
) -> Stability:
    patch = patch_of(touching)
    belief = Belief.unknown(BeliefSettings(), HERE).updated(patch, HERE)
    return judge_stability(belief, patch, com, HERE, how)


def test_threshold_of_the_paper() -> None:
    assert log_odds_threshold(0.9) == pytest.approx(2.1972, abs=5e-5)


@pytest.mark.parametrize("source", ["belief", "patch"])
def test_named_outcomes_of_degenerate_supports(source: str) -> None:
    how = StabilitySettings(judge_from=source)
    none = judged(set(), how)
    assert (none.support, none.margin_mm) == (SupportKind.NONE, -math.inf)
    one = judged({(3.0, 4.0)}, how)
    assert (one.support, one.margin_mm) == (SupportKind.POINT, pytest.approx(-5.0))
    two = judged({(-3.0, 2.0), (3.0, 2.0)}, how)
    assert (two.support, two.margin_mm) == (SupportKind.LINE, pytest.approx(-2.0))
    line = judged({(float(i), float(i)) for i in range(-4, 5)}, how)
    assert line.support is SupportKind.LINE
    assert line.margin_mm == pytest.approx(0.0, abs=1e-9)
    for stability, corners in ((none, 0), (one, 1), (two, 2), (line, 2)):
        assert not stability.stable
        assert len(stability.hull_mm) == corners
        assert stability.source == source


@pytest.mark.parametrize("source", ["belief", "patch"])
def test_area_by_hand(source: str) -> None:
    how = StabilitySettings(judge_from=source)
    square = {(float(x), float(y)) for x in range(-3, 4) for y in range(-2, 5)}
    stands = judged(square, how)
    assert stands.stable
    assert stands.margin_mm == pytest.approx(2.0)
    assert stands.support is SupportKind.AREA
    expected = {(HERE[0] + x, HERE[1] + y) for x in (-3, 3) for y in (-2, 4)}
    assert {(x, y) for x, y in stands.hull_mm} == expected
    falls = judged(square, how, com=(5.0, 1.0))
    assert not falls.stable
    assert falls.margin_mm == pytest.approx(-2.0)
    assert falls.centre_mm == (9.0, -1.5)


def test_required_margin() -> None:
    square = {(float(x), float(y)) for x in range(-3, 4) for y in range(-2, 5)}
    assert judged(square, StabilitySettings(margin_mm=2.0)).stable
    assert not judged(square, StabilitySettings(margin_mm=2.001)).stable


def test_three_cells_are_an_area_and_exactly_delta_is_not_support() -> None:
    assert judged({(-1.0, -1.0), (1.0, -1.0), (0.0, 2.0)}).stable
    patch = patch_of({(-1.0, -1.0), (1.0, -1.0), (0.0, 2.0)}, high=0.9)
    belief = Belief.unknown(BeliefSettings(), HERE).updated(patch, HERE)
    assert judge_stability(belief, patch, (0.0, 0.0), HERE, PAPER).support is SupportKind.NONE


def test_support_beside_the_piece_does_not_count() -> None:
    """Trap 3: a hull over the whole map would hold the centre of mass between two supports."""
    points = lattice()
    left = ContactPatch(points, np.where(points[:, 0] < -3, 0.95, 0.05))
    belief = Belief.unknown(BeliefSettings(), (0.0, 0.0)).updated(left, (0.0, 0.0))
    right = ContactPatch(points.copy(), np.where(points[:, 0] > 3, 0.95, 0.05))
    belief = belief.updated(right, (9.0, 0.0))
    stability = judge_stability(belief, right, (0.0, 0.0), (9.0, 0.0), PAPER)
    assert not stability.stable
    assert stability.hull_mm[:, 0].min() > 9.0
    assert stability.margin_mm == pytest.approx(-4.0)


@pytest.mark.parametrize("source", ["belief", "patch"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -0.5])
def test_no_number_is_no_estimate_and_never_stable(source: str, bad: float) -> None:
    good = patch_of({(x, y) for x, y in lattice()})
    p = good.probability.copy()
    p[7] = bad
    broken = ContactPatch(good.points_mm, p)
    belief = Belief.unknown(BeliefSettings(), HERE).updated(good, HERE).updated(broken, HERE)
    how = StabilitySettings(judge_from=source)
    for stability in (
        judge_stability(belief, broken, (0.0, 0.0), HERE, how),
        judge_stability(belief, good, (math.nan, 0.0), HERE, how),
        judge_stability(belief, good, (0.0, 0.0), (HERE[0], math.nan), how),
        judge_stability(belief, ContactPatch(np.zeros((0, 2)), np.zeros(0)), (0.0, 0.0), HERE, how),
    ):
        assert stability.support is SupportKind.NO_ESTIMATE
        assert math.isnan(stability.margin_mm)
        assert not stability.stable


@settings(max_examples=50, deadline=None)
@given(
    st.sets(st.sampled_from([tuple(p) for p in lattice()]), max_size=40),
    st.floats(-5, 5),
    st.floats(-5, 5),
)
def test_single_shot_and_first_map_agree(
    touching: set[tuple[float, float]], com_x: float, com_y: float
) -> None:
    """With one probe the map equals the network's output on the face (method 9)."""
    by_map = judged(touching, PAPER, (com_x, com_y))
    by_patch = judged(touching, StabilitySettings(judge_from="patch"), (com_x, com_y))
    assert by_map.support is by_patch.support
    assert by_map.stable == by_patch.stable
    assert by_map.margin_mm == pytest.approx(by_patch.margin_mm, abs=1e-9)
