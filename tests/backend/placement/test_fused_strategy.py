"""The strategy of learned fusion on presses of bench-v1: what it knows after three of them, and
what it does where it knows nothing.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from touchdown.backend.config.method import (
    BeliefSettings,
    FusedSettings,
    PolicySettings,
    StackSettings,
)
from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.values import ContactPatch
from touchdown.backend.geometry.outlines import circle, face_points
from touchdown.backend.geometry.pieces import load_pieces
from touchdown.backend.geometry.tower import Body, Tower, judge_tower
from touchdown.backend.learning.fused.checkpoint import shipped_fused
from touchdown.backend.learning.fused.features import GraspedFace, wrench_at_sensor
from touchdown.backend.learning.fused.inference import InsetDistribution
from touchdown.backend.placement.strategies import (
    FARTHEST_MM,
    FusedStrategy,
    GraspedPiece,
    PaperStrategy,
    PlaceDecision,
    ProbeObservation,
    SearchingStrategy,
    deepest_shift,
    make_strategy,
)
from touchdown.backend.placement.support_tower import XY, SupportTower
from touchdown.backend.simulation.batch import BatchedTrials, TrialPresses
from touchdown.backend.simulation.scene import Scene

PLACES = ((7.0, 2.0), (4.5, 1.0), (2.0, 0.5))
FACE = face_points(circle(15.0))
HELD = GraspedPiece((0.0, 0.0), 30.0, sensor_height_mm=120.0)
SMALL = BeliefSettings(half_extent_mm=20.0)
SETTINGS = StackSettings(strategy="fused", belief=SMALL)
MOUNTINGS = 5


@pytest.fixture(scope="module")
def presses() -> list[TrialPresses]:
    """The pot on a disc of 24 mm, five mountings, pressed at three places in turn."""
    piece, face = load_pieces().top("pot"), circle(24.0)
    tower = Tower((Body("disc", face, face, 20.0, 0.0, 10.0, fixed=True),))
    bench = load_simulation(preset="bench-v1")
    scenes = [Scene(piece, tower, (0.0, 0.0), 700 + k, bench) for k in range(MOUNTINGS)]
    lockstep = BatchedTrials(scenes)
    return [lockstep.press(range(MOUNTINGS), np.tile(place, (MOUNTINGS, 1))) for place in PLACES]


def concluded(
    presses: list[TrialPresses],
    trial: int,
    settings: StackSettings = SETTINGS,
    held: GraspedPiece = HELD,
    places: tuple[XY, ...] = PLACES,
) -> tuple[FusedStrategy, list[PlaceDecision]]:
    reasoner = FusedStrategy(held, settings, places[0])
    found = []
    for felt, place in zip(presses, places, strict=True):
        patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
        found.append(reasoner.conclude(ProbeObservation(felt.observation[trial], patch, place)))
    return reasoner, found


def test_three_presses_say_where_the_support_is(presses: list[TrialPresses]) -> None:
    right = wrong = 0
    parted: list[float] = []
    for trial in range(MOUNTINGS):
        reasoner, found = concluded(presses, trial)
        true = presses[-1].true_mm[trial] - PLACES[-1]
        middle: XY = (-float(true[0]), -float(true[1]))
        outside: XY = (middle[0] + 17.0, middle[1])
        right += reasoner.likely_at(middle)
        wrong += reasoner.likely_at(outside)
        assert not reasoner.stable_at(outside)
        cells = found[-1].map.cell_centres_mm() - np.asarray(middle)
        support = circle(24.0).contains(cells)
        p = found[-1].map.probability
        parted.append(p[support].mean() - p[~support].mean())
    assert np.mean(parted) > 0.25
    assert right >= 3
    assert wrong <= 1


def test_a_release_needs_the_accepted_risk(presses: list[TrialPresses]) -> None:
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.9, inset_mm=0.0))
    shy = StackSettings(
        belief=SMALL,
        fused=FusedSettings(risk=1e-6, inset_mm=6.0),
        policy=PolicySettings(max_probes=3),
    )
    assert concluded(presses, 0, bold)[1][-1].action.kind == "release"
    _, found = concluded(presses, 0, shy)
    assert [c.action.kind for c in found] == ["shift", "shift", "give_up"]
    for conclusion in found[:2]:
        assert 0.0 < np.hypot(*conclusion.action.step_mm) <= 3.0 + 1e-9
        assert not conclusion.stability.stable


def test_another_height_of_the_sensor_is_made_up_for(presses: list[TrialPresses]) -> None:
    seen = presses[0].observation[:1].copy()
    # A sensor 30 mm higher has a lever longer by that, so a lateral force turns more.
    seen[..., -3] += 0.03 * seen[..., -5]
    seen[..., -2] -= 0.03 * seen[..., -6]
    np.testing.assert_allclose(
        wrench_at_sensor(seen[..., -6:], 150.0), presses[0].observation[:1, :, -6:], atol=1e-5
    )
    with pytest.raises(InputError, match="height of the wrist sensor"):
        FusedStrategy(replace(HELD, sensor_height_mm=None), SETTINGS, (0.0, 0.0))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
@pytest.mark.parametrize("where", [(0, 0), (19, 257), (7, 252), np.s_[:, 126:150], np.s_[:, 252:]])
def test_signals_that_are_no_numbers_end_the_trial_without_a_release(
    presses: list[TrialPresses], value: float, where: Any
) -> None:
    """One value, a finger or the wrist, after a good probe; ready to let go at any other."""
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.999))
    reasoner, found = concluded(presses[:1], 0, bold, places=PLACES[:1])
    assert found[-1].action.kind == "release"
    observation = presses[1].observation[0].copy()
    observation[where] = value
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    conclusion = reasoner.conclude(ProbeObservation(observation, patch, PLACES[1]))
    assert conclusion.action.kind == "give_up"
    assert not conclusion.stability.stable


def test_before_a_probe_nothing_is_known() -> None:
    reasoner = make_strategy(HELD, SETTINGS, (0.0, 0.0))
    assert not reasoner.likely_at((0.0, 0.0))
    assert not reasoner.stable_at((0.0, 0.0))


def test_a_place_without_contact_sends_it_half_way_back(presses: list[TrialPresses]) -> None:
    begun = make_strategy(HELD, StackSettings(strategy="fused", belief=SMALL), (0.0, 0.0))
    assert isinstance(begun, SearchingStrategy)
    assert not isinstance(PaperStrategy(HELD, SETTINGS, (0.0, 0.0)), SearchingStrategy)
    # Nothing was felt yet: other places, each 3 mm from the last at most, none of them twice.
    here, been = (0.0, 0.0), [(0.0, 0.0)]
    for _ in range(6):
        action = begun.missed(here)
        assert 0.0 < np.hypot(*action.step_mm) <= 3.0 + 1e-9
        here = here[0] + action.step_mm[0], here[1] + action.step_mm[1]
        assert min(np.hypot(here[0] - x, here[1] - y) for x, y in been) > 1.0
        been.append(here)
    assert begun.missed(here).kind == "shift"
    assert begun.missed(here).kind == "give_up"
    reasoner, _ = concluded(presses[:1], 0, places=PLACES[:1])
    last = PLACES[0]
    for way in (1.5, 0.75):
        action = reasoner.missed((last[0] + 2.0 * way, last[1]))
        assert action.step_mm == pytest.approx((-way, 0.0))


def test_a_step_after_a_missed_contact_is_3_mm_at_most(presses: list[TrialPresses]) -> None:
    reasoner, _ = concluded(presses[:1], 0, places=PLACES[:1])
    x, y = PLACES[0]
    action = reasoner.missed((x + 8.0, y - 6.0))
    assert action.clipped
    assert action.step_mm == pytest.approx((-2.4, 1.8))
    assert action.target_mm == pytest.approx((x + 4.0, y - 3.0))


def test_on_a_leaning_tower_it_neither_lets_go_nor_aims_where_the_lower_bottom_tips(
    presses: list[TrialPresses],
) -> None:
    """The same presses; under the disc of 24 mm a narrow one stands far to its left."""
    disc, narrow = circle(24.0), circle(14.0)
    low = Body("low", narrow, narrow, 20.0, 30.0, 10.0)
    touched = Body("disc", disc, disc, 20.0, 10.0, 10.0)
    tower = SupportTower((low, touched), ((5.0, 0.0),), 0.5, piece_g=15.0)
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.4, inset_mm=0.0))
    alone, found = concluded(presses, 0, bold)
    assert found[-1].action.kind == "release"
    wary, leaning = concluded(presses, 0, bold, replace(HELD, below=tower))
    assert leaning[-1].action.kind == "shift"
    assert leaning[-1].action.target_mm is not None
    true = presses[-1].true_mm[0] - PLACES[-1]
    middle: XY = (-float(true[0]), -float(true[1]))
    for at_mm, falls in ((4.0, True), (-4.0, False)):
        at = middle[0] + at_mm, middle[1]
        # The exact judge of the tower that was entered, with the piece there.
        bodies = (low, replace(touched, at_mm=(5.0, 0.0)))
        piece = load_pieces().top("pot").body((5.0 + at_mm, 0.0))
        assert judge_tower(Tower((*bodies, piece))).stands is not falls
        assert alone.likely_at(at)
        assert wary.likely_at(at) is not falls
    assert leaning[-1].action.target_mm[0] < middle[0]


MUG = load_pieces().top("mug").com_xy_mm
DISC_MM, MIDDLE_MM = 9.0, (3.0, -2.0)


def one_who_knows(
    held: GraspedPiece, settings: StackSettings = SETTINGS, middle_mm: XY = MIDDLE_MM
) -> tuple[FusedStrategy, list[GraspedFace]]:
    """A reasoner whose network knows the disc that it stands over; and what faces it was told."""
    faces: list[GraspedFace] = []

    def known(wrench: Any, fields: Any, offset_mm: Any, face: GraspedFace) -> Any:
        faces.append(face)
        return offset_mm

    def inset(here_mm: Any, points_mm: Any, from_first_mm: Any) -> InsetDistribution:
        deep = DISC_MM - np.hypot(*(here_mm + points_mm - middle_mm).T)[:, None]
        return InsetDistribution(np.ones_like(deep), deep, np.full_like(deep, 0.2))

    reasoner = FusedStrategy(held, settings, (6.0, 4.0))
    reasoner._forward = SimpleNamespace(known=known, inset=inset)  # type: ignore[assignment]
    return reasoner, faces


def touch(reasoner: FusedStrategy, at: XY) -> PlaceDecision:
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    return reasoner.conclude(ProbeObservation(np.zeros((20, 258), np.float32), patch, at))


def test_the_centre_of_mass_of_a_mug_is_judged_and_brought_over_the_middle() -> None:
    deep = FusedSettings(risk=0.5, inset_mm=8.0)
    reasoner, faces = one_who_knows(
        replace(HELD, com_xy_mm=MUG), StackSettings(strategy="fused", belief=SMALL, fused=deep)
    )
    first = touch(reasoner, (6.0, 4.0))
    np.testing.assert_allclose(faces[-1].com_mm, MUG)
    assert first.stability.centre_mm == pytest.approx((7.7, 3.1))
    # The middle is 6.94 mm away from there: 2.06 mm within the disc.
    assert first.stability.margin_mm == pytest.approx(DISC_MM - np.hypot(4.7, 5.1), abs=0.06)
    there = (MIDDLE_MM[0] - MUG[0], MIDDLE_MM[1] - MUG[1])
    assert first.action.kind == "shift"
    assert first.action.target_mm == pytest.approx(there, abs=1e-6)
    over = reasoner.inset_at(there)
    assert over is not None
    assert over.expected_mm() == pytest.approx(DISC_MM)
    assert touch(reasoner, there).action.kind == "release"


def test_no_place_is_aimed_at_that_is_farther_than_it_was_asked_in_training() -> None:
    """The middle lies 22 mm from the centre of mass, against the way that the mug is off."""
    reasoner, _ = one_who_knows(replace(HELD, com_xy_mm=MUG), middle_mm=(-14.0, 9.0))
    here = (4.0, 0.0)
    action = touch(reasoner, here).action
    assert action.target_mm is not None
    assert FARTHEST_MM - 1.0 < np.hypot(*np.subtract(action.target_mm, here)) <= FARTHEST_MM


def test_on_a_tower_a_mug_stands_where_a_centred_piece_would_under_the_same_load() -> None:
    """The lower bottom is narrow and stands aside, so that both its sides matter."""
    disc, narrow = circle(2.0 * DISC_MM), circle(10.0)
    low = Body("low", narrow, narrow, 20.0, 30.0, 10.0)
    tower = SupportTower(
        (low, Body("disc", disc, disc, 20.0, 10.0, 10.0)), ((-2.0, 3.0),), 0.3, 25.0
    )
    mug, _ = one_who_knows(replace(HELD, com_xy_mm=MUG, below=tower))
    centred, _ = one_who_knows(replace(HELD, below=tower))
    for reasoner in (mug, centred):
        touch(reasoner, (3.0, -2.0))
    likely = 0
    for x, y in ((float(x), float(y)) for x in range(-6, 13) for y in range(-11, 8)):
        at = x - MUG[0], y - MUG[1]
        assert mug.likely_at(at) == centred.likely_at((x, y))
        assert mug.stable_at(at) == centred.stable_at((x, y))
        likely += mug.likely_at(at)
    assert 20 < likely < 150


def test_it_goes_where_the_centre_of_mass_lies_deepest() -> None:
    cells = np.stack(np.meshgrid(np.arange(-3.0, 4.0), np.arange(-3.0, 4.0)), axis=-1)
    cells = cells.reshape(-1, 2)
    inset = 5.0 - np.hypot(*(cells - (2.0, -1.0)).T)
    assert deepest_shift(inset, cells) == (2.0, -1.0)
    assert deepest_shift(inset, cells - (1.0, 0.0)) == (1.0, -1.0)


def test_the_network_that_ships_says_what_it_was_made_from() -> None:
    card = shipped_fused().card
    assert card.bench_sha256.startswith("03b08d28746d9339")
    assert {"pot", "barrel", "mushroom", "short", "long", "hex20", "rect12x28"} <= set(
        card.left_out
    )
