"""Whole outlines as hypotheses: against brute force, and against presses whose centre is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from backend.config.method import BeliefSettings, StackSettings
from backend.core.faults import InputError
from backend.core.flow import ContactPatch, FloatArray
from backend.objects.shapes import circle, regular
from backend.objects.surface import face_points
from backend.placement.belief import Belief
from backend.placement.outline_belief import OutlineBelief
from backend.placement.outline_family import family, inset_mm
from backend.placement.outlines import OutlineReasoner, pressed_at_mm
from backend.placement.strategies import begin
from backend.placement.strategy import Conclusion, Held, Touched

FACE = face_points(circle(15.0))
SMALL = BeliefSettings(half_extent_mm=16.0)
HELD = Held((0.0, 0.0), 30.0, sensor_height_mm=120.0)
SETTINGS = StackSettings(belief=SMALL, strategy="pressure")


def seen(centre_mm: tuple[float, float], offset_mm: tuple[float, float]) -> ContactPatch:
    """What a sure network says of a disc of 20 mm at ``centre_mm`` of the map."""
    inside = circle(20.0).contains(FACE + np.subtract(offset_mm, centre_mm))
    return ContactPatch(FACE.copy(), np.where(inside, 0.95, 0.05))


def press(at_mm: tuple[float, float], offset: FloatArray | float = 0.0) -> FloatArray:
    """Wrench (20, 6) at a sensor 150 mm above the face: a force growing at ``at_mm`` of the face,
    with a lateral part; ``offset`` (6,) is what the tare left.
    """
    fz = np.linspace(0.4, 8.0, 20)
    fx, fy = 0.1 * fz, -0.05 * fz
    x, y = at_mm
    tx, ty = y * fz + 150.0 * fy, -x * fz - 150.0 * fx
    zero = np.zeros_like(fz)
    return np.stack([fx, fy, fz, 1e-3 * tx, 1e-3 * ty, zero], axis=1) + offset


def touched(patch: ContactPatch, offset_mm: tuple[float, float], wrench: FloatArray) -> Touched:
    observation = np.zeros((20, 258), np.float32)
    observation[:, -6:] = wrench
    return Touched(observation, patch, offset_mm)


def test_the_weights_are_those_of_counting_cell_by_cell() -> None:
    belief = Belief.unknown(SMALL, (0.0, 0.0)).updated(seen((4.0, -2.0), (0.0, 0.0)), (0.0, 0.0))
    found = OutlineBelief.given(belief.map, 0.1)
    cells = belief.map.cell_centres_mm()
    rng = np.random.default_rng(3)
    picked = [(int(rng.integers(len(family()))), *map(int, rng.integers(12, 22, 2)))
              for _ in range(6)]  # fmt: skip
    log_odds = []
    for k, i, j in picked:
        under = family()[k].contains(cells - cells[i, j])
        log_odds.append(0.1 * belief.map.log_odds[under].sum())
    weights = [found.weight[place] for place in picked]
    assert np.diff(np.log(weights)) == pytest.approx(np.diff(log_odds), abs=1e-6)
    assert found.weight.sum() == pytest.approx(1.0)
    supported = sum(
        found.weight[k, i, j]
        for k, outline in enumerate(family())
        for i, j in zip(*np.nonzero(outline.contains(cells[16, 20] - cells)), strict=True)
    )
    assert found.support()[16, 20] == pytest.approx(supported, abs=1e-9)


def test_the_inset_is_the_distance_to_the_edge() -> None:
    points = np.array([[0.0, 0.0], [3.0, 0.0], [12.0, 0.0]])
    assert inset_mm(circle(20.0), points) == pytest.approx([10.0, 7.0, -2.0])
    hexagon = regular(6, 20.0)
    assert inset_mm(hexagon, np.zeros((1, 2))) == pytest.approx([10.0 * math.cos(math.pi / 6)])


def test_what_the_tare_left_does_not_move_the_centre_of_pressure() -> None:
    left = np.array([0.4, -0.4, 0.3, 0.02, -0.03, 0.0])
    assert pressed_at_mm(press((-3.0, 2.0)), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert pressed_at_mm(press((-3.0, 2.0), left), 150.0) == pytest.approx([-3.0, 2.0], abs=1e-9)
    assert np.isnan(pressed_at_mm(0.2 * press((0.0, 0.0)), 150.0)).all()


def conclude(strategy: str, wrench: FloatArray) -> tuple[Conclusion, OutlineReasoner]:
    settings = SETTINGS.model_copy(update={"strategy": strategy})
    reasoner = begin(HELD, settings, (0.0, 0.0))
    assert isinstance(reasoner, OutlineReasoner)
    vague = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    return reasoner.conclude(touched(vague, (0.0, 0.0), wrench)), reasoner


def test_a_press_pulls_the_support_to_where_it_acted() -> None:
    with_it, _ = conclude("pressure", press((-6.0, 0.0)))
    without, _ = conclude("outlines", press((-6.0, 0.0)))
    left, right = np.s_[16, 10], np.s_[16, 22]
    assert with_it.map.probability[left] > with_it.map.probability[right] + 0.1
    assert without.map.probability[left] == pytest.approx(without.map.probability[right], abs=0.02)
    assert with_it.action.kind == "shift"
    assert with_it.action.step_mm[0] < -1.0


@pytest.mark.parametrize("strategy", ["pressure", "looking"])
def test_it_walks_to_the_support_and_releases_only_over_it(strategy: str) -> None:
    # Nobody tells it that the disc of 20 mm lies at (9, 4).
    centre, here = (9.0, 4.0), (0.0, 0.0)
    reasoner = begin(HELD, SETTINGS.model_copy(update={"strategy": strategy}), here)
    for _ in range(8):
        middle = (
            min(max(centre[0] - here[0], -3.0), 3.0),
            min(max(centre[1] - here[1], -3.0), 3.0),
        )
        concluded = reasoner.conclude(touched(seen(centre, here), here, press(middle)))
        if concluded.action.kind == "release":
            break
        assert math.hypot(*concluded.action.step_mm) <= 3.0 + 1e-9
        here = here[0] + concluded.action.step_mm[0], here[1] + concluded.action.step_mm[1]
    assert concluded.action.kind == "release"
    assert math.dist(here, centre) < 9.5


def test_no_estimate_is_never_a_release() -> None:
    reasoner = begin(HELD, SETTINGS, (0.0, 0.0))
    lost = ContactPatch(FACE.copy(), np.full(len(FACE), np.nan))
    concluded = reasoner.conclude(touched(lost, (0.0, 0.0), press((0.0, 0.0))))
    assert concluded.action.kind == "give_up"
    assert not concluded.stability.stable


def test_letting_go_untested_concludes_nothing() -> None:
    with pytest.raises(InputError, match="does not probe"):
        begin(HELD, StackSettings(strategy="pick-and-place"), (0.0, 0.0))
