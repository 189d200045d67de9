"""The worth of a press that is not made yet, and the strategy without any belief beside it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.config.method import (
    BeliefSettings,
    LookingSettings,
    OutlineSettings,
    StackSettings,
    StrategyName,
)
from backend.core.faults import InputError
from backend.core.flow import ContactPatch
from backend.objects.shapes import circle
from backend.objects.surface import face_points
from backend.placement.coverage import CellGrid
from backend.placement.looking import Question, _alike, places, worth
from backend.placement.outline_belief import OutlineBelief
from backend.placement.outline_family import DIAMETERS_MM, family
from backend.placement.strategies import begin
from backend.placement.strategy import Conclusion, Held, Touched

FACE = face_points(circle(15.0))
SIDE = 41
RULES = OutlineSettings()


def believing(*centres_mm: tuple[float, float]) -> OutlineBelief:
    """A disc of 20 mm, equally likely at each of these places of a map about the origin."""
    weight = np.zeros((len(family()), SIDE, SIDE))
    disc = DIAMETERS_MM.index(20.0)
    for x, y in centres_mm:
        weight[disc, int(y) + SIDE // 2, int(x) + SIDE // 2] = 1.0 / len(centres_mm)
    reach = float(SIDE // 2)
    return OutlineBelief(CellGrid((-reach, -reach), 1.0, (SIDE, SIDE)), weight)


def question(target: tuple[float, float]) -> Question:
    return Question(FACE, (0.0, 0.0), 2.0, target)


def test_a_step_reaches_places_in_all_directions_and_the_greedy_one_first() -> None:
    found = places((1.0, 2.0), (9.0, 2.0), 3.0)
    assert found[0] == pytest.approx((4.0, 2.0))
    assert {round(math.dist(p, (1.0, 2.0)), 6) for p in found} == {1.5, 3.0}
    assert places((1.0, 2.0), (2.0, 2.0), 3.0)[0] == pytest.approx((2.0, 2.0))


def test_outlines_drawn_are_as_many_as_they_are_likely() -> None:
    belief = believing((-6.0, 0.0), (6.0, 0.0), (6.0, 0.0), (6.0, 1.0))
    weight = belief.weight.copy()
    centres = [centre for _, centre in OutlineBelief(belief.grid, weight).drawn(100)]
    share = sum(c == (-6.0, 0.0) for c in centres) / 100
    assert share == pytest.approx(
        weight[:, SIDE // 2, SIDE // 2 - 6].sum() / weight.sum(), abs=0.02
    )
    assert all(outline.radius_mm == 10.0 for outline, _ in belief.drawn(5))


def test_the_spread_of_the_centre_is_its_standard_deviation() -> None:
    belief = believing((-6.0, 0.0), (6.0, 0.0))
    assert belief.spread_mm() == pytest.approx(6.0 / 2**0.5)
    assert believing((3.0, 1.0)).spread_mm() == pytest.approx(0.0, abs=1e-9)


def test_what_feels_alike_stays_as_likely_and_what_does_not_is_told_apart() -> None:
    whole, left = np.ones(len(FACE), bool), FACE[:, 0] < 0
    alike = _alike(np.stack([whole, whole, left]), FACE, 10.0, RULES)
    assert alike[0, 0] == pytest.approx(alike[0, 1])
    assert alike[0, 2] < 1e-3
    assert alike.sum(axis=1) == pytest.approx(1.0)


def test_a_press_that_tells_two_supports_apart_is_worth_more_than_one_that_does_not() -> None:
    # Left or right: at (-2, 0) either touches part of the face, on different sides; at (0, -20)
    # nothing is touched either way.
    belief = believing((-9.0, 0.0), (9.0, 0.0))
    settings = LookingSettings(way=0.0)
    at = [(-2.0, 0.0), (0.0, -20.0)]
    telling, blank = worth(belief, question((-2.0, 0.0)), at, 3.0, RULES, settings)
    assert telling > blank + 1.0
    # One bit is to be had: at (-2, 0) one of them carries and the other does not.
    without = worth(
        belief, question((-2.0, 0.0)), at, 3.0, RULES, LookingSettings(way=0.0, gain=0.0)
    )
    assert telling - without[0] == pytest.approx(0.5 * 1.0, abs=0.1)


def test_where_all_is_known_the_way_decides() -> None:
    belief = believing((6.0, 0.0))
    at = [(3.0, 0.0), (0.0, 3.0), (-3.0, 0.0)]
    values = worth(belief, question((6.0, 0.0)), at, 3.0, RULES, LookingSettings(draws=16))
    assert values.argmax() == 0
    assert values[0] == pytest.approx(1.0 - 0.2)  # a release there is sure; one step is left


def press(at_mm: tuple[float, float], rise_n: float = 7.6) -> np.ndarray:
    """Observation of a force growing by ``rise_n`` at ``at_mm``, sensor 150 mm above the face."""
    fz = np.linspace(0.4, 0.4 + rise_n, 20)
    x, y = at_mm
    seen = np.zeros((20, 258), np.float32)
    seen[:, -6:] = np.stack([0 * fz, 0 * fz, fz, 1e-3 * y * fz, -1e-3 * x * fz, 0 * fz], axis=1)
    return seen


def zero_wrench(*presses: np.ndarray) -> tuple[Conclusion, bool]:
    settings = StackSettings(belief=BeliefSettings(half_extent_mm=16.0), strategy="zero-wrench")
    reasoner = begin(Held((0.0, 0.0), 30.0, sensor_height_mm=120.0), settings, (0.0, 0.0))
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.9))
    for seen in presses:
        concluded = reasoner.conclude(Touched(seen, patch, (0.0, 0.0)))
    return concluded, reasoner.stable_at((0.0, 0.0))


def test_zero_wrench_lets_go_where_the_push_turns_nothing_and_follows_it_otherwise() -> None:
    under, stable = zero_wrench(press((0.3, -0.4)))
    assert (under.action.kind, stable) == ("release", True)
    beside, stable = zero_wrench(press((-5.0, 0.0)))
    assert (beside.action.kind, stable) == ("shift", False)
    assert beside.action.step_mm == pytest.approx((-3.0, 0.0), abs=1e-3)
    assert beside.stability.margin_mm == pytest.approx(-5.0, abs=1e-3)
    assert not under.map.log_odds.any()


def test_zero_wrench_needs_a_push_and_gives_up_in_the_end() -> None:
    faint, stable = zero_wrench(press((0.0, 0.0), rise_n=1.0))
    assert (faint.action.kind, stable) == ("shift", False)
    last, _ = zero_wrench(*[press((5.0, 0.0))] * 8)
    assert last.action.kind == "give_up"


@pytest.mark.parametrize("strategy", ["zero-wrench", "pressure", "looking"])
def test_without_the_height_of_the_sensor_no_moment_can_be_read(strategy: StrategyName) -> None:
    with pytest.raises(InputError, match="height of the wrist sensor"):
        begin(Held((0.0, 0.0), 30.0), StackSettings(strategy=strategy), (0.0, 0.0))
