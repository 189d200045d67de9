""""""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.backend.placement.test_belief import lattice
from touchdown.backend.config.method import BeliefSettings, PolicySettings, StabilitySettings
from touchdown.backend.core.values import ContactPatch, PlaceAction, Stability, SupportKind
from touchdown.backend.placement.belief import Belief
from touchdown.backend.placement.policy import choose_action, judge_stability, log_odds_threshold

XY = tuple[float, float]
HERE = (10.0, 20.0)


def probed(
    p: np.ndarray, here: XY = HERE, before: Belief | None = None
) -> tuple[Belief, ContactPatch]:
    belief = before or Belief.unknown(BeliefSettings(), here)
    patch = ContactPatch(lattice(), p)
    return belief.updated(patch, here), patch


def act(
    belief: Belief,
    patch: ContactPatch,
    here: XY = HERE,
    policy: PolicySettings | None = None,
    com: XY = (0.0, 0.0),
    margin_mm: float = 0.0,
) -> tuple[Stability, PlaceAction]:
    how = StabilitySettings(margin_mm=margin_mm)
    stability = judge_stability(belief, patch, com, here, how)
    return stability, choose_action(stability, belief, here, policy or PolicySettings(), how)


def block(x: tuple[int, int], y: tuple[int, int]) -> np.ndarray:
    points = lattice()
    inside = (points[:, 0] >= x[0]) & (points[:, 0] <= x[1])
    inside &= (points[:, 1] >= y[0]) & (points[:, 1] <= y[1])
    return np.where(inside, 0.97, 0.03)


def test_stable_is_released_with_its_margin() -> None:
    stability, action = act(*probed(block((-3, 3), (-3, 3))))
    assert stability.stable
    assert action == PlaceAction(
        "release", (0.0, 0.0), None, False, "Centre of mass 3.0 mm inside the hull: release."
    )


def test_shift_is_clipped_and_explained() -> None:
    _, action = act(*probed(block((3, 7), (-2, 2))))
    assert action.kind == "shift"
    assert action.clipped
    assert action.step_mm == pytest.approx((3.0, 0.0), abs=1e-9)
    assert action.target_mm is not None
    assert action.target_mm[1] == pytest.approx(HERE[1])
    assert action.target_mm[0] - HERE[0] == pytest.approx(5.0)
    assert action.reason == (
        "Centre of mass 3.0 mm outside the hull: "
        "move 3.0 mm (x +3.0, y +0.0), the longest step; the target is 5.0 mm away."
    )


def test_a_short_step_is_taken_whole() -> None:
    _, action = act(*probed(block((1, 3), (-2, -1))))
    assert not action.clipped
    assert action.step_mm == pytest.approx((2.0, -1.5))
    assert action.target_mm == pytest.approx((12.0, 18.5))
    assert (
        action.reason
        == "Centre of mass 1.4 mm outside the hull: move 2.5 mm (x +2.0, y \N{MINUS SIGN}1.5)."
    )


def test_the_longest_step_is_a_setting() -> None:
    far = PolicySettings(longest_step_mm=1.25)
    _, action = act(*probed(block((3, 7), (-2, 2))), policy=far)
    assert math.hypot(*action.step_mm) == pytest.approx(1.25)


@pytest.mark.parametrize(
    ("what", "expected"),
    # An L of two bars: x 2..6 at y 0 and y 1..5 at x 2. Area: cells of the triangle.
    [("cells", (2 + 10 / 10, 15 / 10)), ("vertices", ((2 + 6 + 2) / 3, 5 / 3)), ("area", None)],
)
def test_hull_centre_modes(what: str, expected: XY | None) -> None:
    points = lattice()
    bar = (points[:, 1] == 0) & (points[:, 0] >= 2) & (points[:, 0] <= 6)
    bar |= (points[:, 0] == 2) & (points[:, 1] >= 1) & (points[:, 1] <= 5)
    belief, patch = probed(np.where(bar, 0.97, 0.03))
    policy = PolicySettings(hull_centre=what, longest_step_mm=20.0)
    _, action = act(belief, patch, policy=policy)
    if expected is None:
        triangle = [(x, y) for x in range(2, 7) for y in range(6) if 5 * (x - 2) + 4 * y <= 20]
        expected = tuple(np.mean(triangle, axis=0))
    assert action.step_mm == pytest.approx(expected, abs=1e-9)


def test_the_centre_of_mass_goes_over_the_support() -> None:
    _, action = act(*probed(block((-2, 2), (-2, 2))), com=(4.0, -3.0))
    assert action.kind == "shift"
    assert action.step_mm == pytest.approx((-2.4, 1.8))
    assert action.target_mm == pytest.approx((HERE[0] - 4.0, HERE[1] + 3.0))


def test_the_centre_of_mass_goes_over_the_most_probable_cells() -> None:
    points = lattice()
    likely = probed(np.where(np.hypot(*points.T) < 2.5, 0.7, 0.1))
    _, action = act(*likely, com=(1.7, -0.9))
    assert "towards the most probable cells" in action.reason
    assert action.target_mm == pytest.approx((HERE[0] - 1.7, HERE[1] + 0.9))


def test_the_whole_map_gives_the_target() -> None:
    """Support found by a former probe beside the piece counts for the target (method 10)."""
    belief, _ = probed(block((-7, -5), (-1, 1)))
    there = (HERE[0] + 9.0, HERE[1])
    belief, patch = probed(np.full(177, 0.03), there, belief)
    stability, action = act(belief, patch, there)
    assert stability.hull_mm.shape == (0, 2)
    assert action.step_mm == pytest.approx((-3.0, 0.0))
    assert action.reason.startswith("No confident support under the piece")


def test_best_cells_without_confident_support() -> None:
    points = lattice()
    p = np.where(points[:, 0] + points[:, 1] > 6, 0.7, 0.1)
    stability, action = act(*probed(p))
    assert stability.support.value == "no confident support"
    assert action.kind == "shift"
    assert action.step_mm[0] == pytest.approx(action.step_mm[1])
    assert action.step_mm[0] > 0
    assert "towards the most probable cells" in action.reason


def test_without_any_hint_it_looks_around() -> None:
    belief, patch = probed(np.full(177, 0.3))
    _, action = act(belief, patch)
    assert action.step_mm == pytest.approx((3.0, 0.0))
    assert "looking around" in action.reason


def test_spiral_visits_new_places_only() -> None:
    policy = PolicySettings(fallback="spiral", max_probes=30)
    here, belief = HERE, None
    places = [here]
    for _ in range(12):
        belief, patch = probed(np.full(177, 0.3), here, belief)
        _, action = act(belief, patch, here, policy)
        here = (here[0] + action.step_mm[0], here[1] + action.step_mm[1])
        assert min(math.dist(here, place) for place in places) >= 3.0 - 1e-9
        assert math.hypot(*action.step_mm) <= 3.0 + 1e-9
        places.append(here)
    assert max(math.dist(HERE, place) for place in places) < 3.0 * 3


def test_fallback_stop_gives_up() -> None:
    _, action = act(*probed(np.full(177, 0.3)), policy=PolicySettings(fallback="stop"))
    assert action.kind == "give_up"
    assert "no better place" in action.reason


def test_a_stalled_greedy_rule_looks_around() -> None:
    belief, patch = probed(block((-1, 1), (-1, 1)))
    stability, action = act(belief, patch, margin_mm=2.0)
    assert not stability.stable
    assert action.kind == "shift"
    assert math.hypot(*action.step_mm) >= 0.5
    assert "1.0 mm inside the hull, 2.0 mm required" in action.reason
    assert "already over the middle of the support" in action.reason


def test_gives_up_after_the_most_probes() -> None:
    belief, patch = probed(block((3, 7), (-2, 2)))
    assert act(belief, patch, policy=PolicySettings(max_probes=2))[1].kind == "shift"
    _, action = act(belief, patch, policy=PolicySettings(max_probes=1))
    assert action.kind == "give_up"
    assert action.reason == (
        "Centre of mass 3.0 mm outside the hull after 1 probes, the most allowed: giving up."
    )


def test_the_last_probe_may_still_release() -> None:
    belief, patch = probed(block((-3, 3), (-3, 3)))
    assert act(belief, patch, policy=PolicySettings(max_probes=1))[1].kind == "release"


def test_a_release_may_need_more_than_one_place() -> None:
    belief, patch = probed(block((-3, 3), (-3, 3)))
    two = PolicySettings(least_probes=2)
    stability, action = act(belief, patch, policy=two)
    assert stability.stable
    assert action.kind == "shift"
    assert "2 probes are required" in action.reason
    # A repeat within belief.min_shift_mm is not a second place.
    near = belief.updated(patch, (HERE[0] + 0.4, HERE[1]))
    assert act(near, patch, policy=two)[1].kind == "shift"
    far = belief.updated(patch, (HERE[0] + 1.0, HERE[1]))
    assert act(far, patch, policy=two)[1].kind == "release"
    last = PolicySettings(least_probes=2, max_probes=1)
    assert act(belief, patch, policy=last)[1].kind == "give_up"


def test_no_estimate_is_never_acted_on() -> None:
    belief, good = probed(block((-3, 3), (-3, 3)))
    p = good.probability.copy()
    p[0] = math.nan
    broken = ContactPatch(good.points_mm, p)
    _, action = act(belief.updated(broken, HERE), broken)
    assert action.kind == "give_up"
    assert "no usable estimate" in action.reason


PAPER = StabilitySettings()
STABILITY_HERE = (4.0, -2.5)


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
    belief = Belief.unknown(BeliefSettings(), STABILITY_HERE).updated(patch, STABILITY_HERE)
    return judge_stability(belief, patch, com, STABILITY_HERE, how)


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
    expected = {(STABILITY_HERE[0] + x, STABILITY_HERE[1] + y) for x in (-3, 3) for y in (-2, 4)}
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
    belief = Belief.unknown(BeliefSettings(), STABILITY_HERE).updated(patch, STABILITY_HERE)
    assert (
        judge_stability(belief, patch, (0.0, 0.0), STABILITY_HERE, PAPER).support
        is SupportKind.NONE
    )


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
def test_no_number_is_no_estimate_and_never_stable(source: str) -> None:
    good = patch_of({(x, y) for x, y in lattice()})
    p = good.probability.copy()
    p[7] = math.nan
    broken = ContactPatch(good.points_mm, p)
    here, centred, how = STABILITY_HERE, (0.0, 0.0), StabilitySettings(judge_from=source)
    belief = Belief.unknown(BeliefSettings(), here).updated(good, here).updated(broken, here)
    empty = ContactPatch(np.zeros((0, 2)), np.zeros(0))
    for patch, com, place in (
        (broken, centred, here),
        (good, (math.nan, 0.0), here),
        (good, centred, (here[0], math.nan)),
        (empty, centred, here),
    ):
        stability = judge_stability(belief, patch, com, place, how)
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
