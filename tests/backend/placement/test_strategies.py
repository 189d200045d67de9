"""With a perfect estimator the loop of belief, stability and policy must nearly always place.

The truth is shapely's, not the product's: a failure here is a bug in the logic, not in a model.
"""

from __future__ import annotations

import math
from dataclasses import replace
from math import erf, sqrt
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm
from shapely import contains_xy
from shapely.affinity import translate
from shapely.geometry import Point, Polygon, box

from tests.rule_study import inset_at
from touchdown.backend.config.bench_description import bench_sha256
from touchdown.backend.config.method import (
    BeliefSettings,
    FusedSettings,
    PolicySettings,
    StackSettings,
    TowerSettings,
)
from touchdown.backend.config.simulation import load_simulation
from touchdown.backend.core import ContactPatch, FloatArray, InputError
from touchdown.backend.geometry.outlines import Outline, circle, face_points, inset_mm, rectangle
from touchdown.backend.geometry.pieces import PieceLibrary, load_pieces
from touchdown.backend.geometry.tower import Body, Tower, judge_tower
from touchdown.backend.learning.calibration import PatchCalibration
from touchdown.backend.learning.fused.checkpoint import shipped_fused
from touchdown.backend.learning.fused.features import GraspedFace, wrench_at_sensor
from touchdown.backend.learning.fused.inference import InsetDistribution
from touchdown.backend.placement import strategies
from touchdown.backend.placement.strategies import (
    FARTHEST_MM,
    FaceCentre,
    FusedStrategy,
    GraspedPiece,
    LowerSupport,
    PaperStrategy,
    PlaceDecision,
    ProbeObservation,
    SearchingStrategy,
    best_shift,
    equivalent_disc,
    fit_face_centre,
    holding_probability,
    load_network_of,
    make_strategy,
)
from touchdown.backend.placement.support_tower import XY, SupportTower
from touchdown.backend.simulation import BatchedTrials, Scene, TrialPresses

FACE_RADIUS_MM = {"mushroom": 12.7, "barrel": 10.6, "pot": 7.5, "mug": 10.0}
COM_MM = {"mug": (1.7, -0.9)}
"""Of the others the centre of mass is over the middle of the face."""
BOTTOMS = {
    "short": Point(0, 0).buffer(10.0, 64),
    "long": Point(0, 0).buffer(9.0, 64),
    "circle15": Point(0, 0).buffer(7.5, 64),
    "circle25": Point(0, 0).buffer(12.5, 64),
    "square15": box(-7.5, -7.5, 7.5, 7.5),
    "hex20": Polygon(
        [(10 * math.cos(a * math.pi / 3), 10 * math.sin(a * math.pi / 3)) for a in range(6)]
    ),
    "rect12x28": box(-6, -14, 6, 14),
}


def lattice(radius_mm: float) -> np.ndarray:
    axis = np.arange(-20.0, 21.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm + 1e-9]


def exact_margin_mm(piece: str, bottom: Polygon, at: XY) -> float:
    face = translate(Point(0, 0).buffer(FACE_RADIUS_MM[piece], 64), *at)
    support = face.intersection(bottom)
    if support.area < 1e-6:
        return -math.inf
    com = COM_MM.get(piece, (0.0, 0.0))
    hull, centre = support.convex_hull, Point(at[0] + com[0], at[1] + com[1])
    distance = hull.exterior.distance(centre)
    return distance if hull.contains(centre) else -distance


def random_start(rng: np.random.Generator, piece: str, bottom: Polygon) -> XY:
    """A start as the issue draws it: overlap at least 6 mm², margin at most -0.2 mm."""
    radius_mm = FACE_RADIUS_MM[piece]
    reach = radius_mm + 14.0
    while True:
        x, y = rng.uniform(-reach, reach, 2)
        face = translate(Point(0, 0).buffer(radius_mm, 64), x, y)
        overlap = face.intersection(bottom).area
        if overlap >= 6.0 and exact_margin_mm(piece, bottom, (x, y)) <= -0.2:
            return float(x), float(y)


def run_once(
    piece: str, bottom: str, rng: np.random.Generator, settings: StackSettings
) -> tuple[str, int, float]:
    """Return how the loop ended, its probes, and the exact margin at the end."""
    shape = BOTTOMS[bottom]
    here = random_start(rng, piece, shape)
    face = lattice(FACE_RADIUS_MM[piece])
    reasoner = PaperStrategy(GraspedPiece(COM_MM.get(piece, (0.0, 0.0)), 30.0), settings, here)
    unread = np.zeros((20, 258), np.float32)
    for probe in range(1, settings.policy.max_probes + 2):
        truth = contains_xy(shape, face[:, 0] + here[0], face[:, 1] + here[1])
        patch = ContactPatch(face.copy(), truth.astype(np.float64))
        action = reasoner.conclude(ProbeObservation(unread, patch, here)).action
        if action.kind != "shift":
            return action.kind, probe, exact_margin_mm(piece, shape, here)
        assert math.hypot(*action.step_mm) <= settings.policy.longest_step_mm + 1e-9
        here = (here[0] + action.step_mm[0], here[1] + action.step_mm[1])
    raise AssertionError("the loop does not end")


@pytest.mark.parametrize("piece", FACE_RADIUS_MM)
def test_perfect_estimates_place(piece: str) -> None:
    rng = np.random.default_rng(7)
    starts = 15
    endings = [
        run_once(piece, bottom, rng, StackSettings()) for bottom in BOTTOMS for _ in range(starts)
    ]
    placed = [e for e in endings if e[0] == "release"]
    assert all(margin >= -0.5 for _, _, margin in placed)
    assert len(placed) >= 0.99 * len(endings), [e for e in endings if e[0] != "release"]


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


def inset_and_centre(strategy: FusedStrategy, at: XY) -> tuple[InsetDistribution, XY]:
    """Return the inset of the centre of mass with the face there, and its place."""
    inset, com = inset_at(strategy, at), strategy._held.com_xy_mm
    assert inset is not None
    return inset, (at[0] + com[0], at[1] + com[1])


def stable_at(strategy: FusedStrategy, at: XY) -> bool:
    """Return whether it would release there."""
    inset, centre = inset_and_centre(strategy, at)
    reached = strategy._margin_mm(inset, centre) >= strategy._settings.fused.inset_mm
    return reached and not strategy._weak_evidence(inset, centre)


def likely_at(strategy: FusedStrategy, at: XY) -> bool:
    """Return whether all supports rather hold there than not."""
    inset, centre = inset_and_centre(strategy, at)
    return bool(holding_probability(inset, strategy._lower, centre, np.zeros(1))[0] > 0.5)


def test_three_presses_say_where_the_support_is(presses: list[TrialPresses]) -> None:
    right = wrong = 0
    parted: list[float] = []
    for trial in range(MOUNTINGS):
        reasoner, found = concluded(presses, trial)
        true = presses[-1].truth.offset_mm[trial] - PLACES[-1]
        middle: XY = (-float(true[0]), -float(true[1]))
        outside: XY = (middle[0] + 17.0, middle[1])
        right += likely_at(reasoner, middle)
        wrong += likely_at(reasoner, outside)
        assert not stable_at(reasoner, outside)
        cells = found[-1].map.cell_centres_mm() - np.asarray(middle)
        support, p = circle(24.0).contains(cells), found[-1].map.probability
        # Cells that are far away and were never under the face stay unknown.
        far = np.hypot(*np.moveaxis(cells + middle - PLACES[-1], -1, 0)) > 14.0
        seen = found[-1].map.covered | ~far
        assert (p[~seen] == 0.5).all()
        parted.append(p[support & seen].mean() - p[~support & seen].mean())
    assert np.mean(parted) > 0.15
    assert right >= 3
    assert wrong <= 1


def test_a_release_needs_the_accepted_risk(presses: list[TrialPresses]) -> None:
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.9, first_risk=0.0, inset_mm=0.0))
    shy = StackSettings(
        belief=SMALL,
        fused=FusedSettings(risk=1e-6, inset_mm=6.0),
        policy=PolicySettings(max_probes=3),
    )
    assert concluded(presses, 0, bold)[1][-1].action.kind == "release"
    _, found = concluded(presses, 0, shy)
    assert [c.action.kind for c in found] == ["shift", "shift", "ask"]
    for conclusion in found[:2]:
        assert 0.0 < np.hypot(*conclusion.action.step_mm) <= 3.0 + 1e-9
        assert not conclusion.stability.stable


def test_where_it_stays_unsure_it_probes_elsewhere_then_asks_whether_to_go_on(
    presses: list[TrialPresses],
) -> None:
    shy = StackSettings(
        belief=SMALL,
        fused=FusedSettings(risk=1e-6, inset_mm=6.0),
        policy=PolicySettings(max_probes=2),
    )
    reasoner, found = concluded(presses[:2], 0, shy, places=PLACES[:2])
    assert isinstance(reasoner, SearchingStrategy)
    assert not isinstance(PaperStrategy(HELD, SETTINGS, (0.0, 0.0)), SearchingStrategy)
    first, second = (each.action for each in found)
    assert (first.kind, second.kind) == ("shift", "ask")
    assert second.step_mm == (0.0, 0.0)
    shift = reasoner.go_on()
    step_mm = float(np.hypot(*shift.step_mm))
    assert shift.kind == "shift"
    assert second.reason.endswith(f"after 2 probes: go on probing {step_mm:.1f} mm away?")
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    observation = presses[2].observation[0]
    kinds = [
        reasoner.conclude(ProbeObservation(observation, patch, (0.0, 3.0 * k))).action.kind
        for k in range(2)
    ]
    assert kinds == ["shift", "ask"], "as many probes again"


def test_signals_outside_the_typical_marker_fields_are_far_from_the_training_data(
    presses: list[TrialPresses],
) -> None:
    usual, _ = concluded(presses, 0)
    inputs, unseen = usual.signal_distances()
    assert 0.1 < inputs < 4.0
    assert unseen < 0.002
    rng = np.random.default_rng(3)
    torn = []
    for felt in presses:
        observation = felt.observation.copy()
        observation[..., :252] += rng.normal(scale=8.0, size=252)
        torn.append(replace(felt, observation=observation))
    strange, _ = concluded(torn, 0)
    assert strange.signal_distances()[1] > 0.02


@pytest.mark.parametrize(
    ("policy", "fused", "why"),
    [
        ({"least_probes": 4}, {}, "4 probes are required"),
        ({}, {"largest_sd_mm": 0.01}, "0.01 mm allowed"),
        ({}, {"pressure_sd_mm": 0.01}, "centres of pressure do not enclose it"),
    ],
)
def test_weak_evidence_is_not_released_on(
    presses: list[TrialPresses], policy: dict[str, int], fused: dict[str, float], why: str
) -> None:
    bold = FusedSettings.model_validate({"risk": 0.9, "first_risk": 0.0, "inset_mm": 0.0, **fused})
    settings = StackSettings(belief=SMALL, fused=bold, policy=PolicySettings(**policy))
    reasoner, found = concluded(presses, 0, settings)
    assert found[-1].action.kind == "shift"
    assert why in found[-1].action.reason
    assert stable_at(reasoner, PLACES[-1]) is not bool(fused)
    last = settings.model_copy(update={"policy": PolicySettings(**policy, max_probes=3)})
    assert concluded(presses, 0, last)[1][-1].action.kind == "ask"


@pytest.mark.parametrize(("sd_mm", "kind"), [(1.4, "release"), (1.6, "shift")])
def test_the_hull_of_the_centres_of_pressure_is_shrunk_by_two_deviations(
    presses: list[TrialPresses], monkeypatch: pytest.MonkeyPatch, sd_mm: float, kind: str
) -> None:
    """They are the corners of a triangle around the centre of mass, its edges 3 mm away."""
    corners = 6.0 * np.array([[np.cos(a), np.sin(a)] for a in (0.0, 2 * np.pi / 3, -2 * np.pi / 3)])
    centres = iter(np.array(PLACES[-1]) + corners - np.array(PLACES))
    monkeypatch.setattr(strategies, "pressed_at_mm", lambda wrench, lever_mm: next(centres))
    bold = FusedSettings(risk=0.9, first_risk=0.0, inset_mm=0.0, pressure_sd_mm=sd_mm)
    assert concluded(presses, 0, StackSettings(belief=SMALL, fused=bold))[1][-1].action.kind == kind


def test_a_press_replaces_one_at_the_same_place(presses: list[TrialPresses]) -> None:
    either, merging = (
        SETTINGS.model_copy(update={"fused": FusedSettings(first_risk=0.0, merge_mm=mm)})
        for mm in (0.0, 0.5)
    )
    there = ((2.0, 0.3), (2.3, 0.5), (2.0, 0.5))
    merged = concluded(presses, 0, merging, places=there)[1][-1]
    alone = concluded(presses[-1:], 0, either, places=there[-1:])[1][-1]
    every = concluded(presses, 0, either, places=there)[1][-1]
    assert merged.stability.margin_mm == alone.stability.margin_mm
    assert merged.stability.margin_mm != every.stability.margin_mm


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
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.999, first_risk=0.0))
    reasoner, found = concluded(presses[:1], 0, bold, places=PLACES[:1])
    assert found[-1].action.kind == "release"
    observation = presses[1].observation[0].copy()
    observation[where] = value
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    conclusion = reasoner.conclude(ProbeObservation(observation, patch, PLACES[1]))
    assert conclusion.action.kind == "give_up"
    assert not conclusion.stability.stable


def test_before_a_probe_nothing_is_known() -> None:
    assert inset_at(FusedStrategy(HELD, SETTINGS, (0.0, 0.0)), (0.0, 0.0)) is None


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
    assert begun.missed(here).kind == "ask"
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
    disc, narrow = circle(24.0), circle(15.0)
    low = Body("low", narrow, narrow, 20.0, 30.0, 10.0)
    touched = Body("disc", disc, disc, 20.0, 10.0, 10.0)
    tower = SupportTower((low, touched), ((5.0, 0.0),), 0.5, piece_g=15.0)
    bold = StackSettings(belief=SMALL, fused=FusedSettings(risk=0.4, first_risk=0.0, inset_mm=0.0))
    alone, found = concluded(presses, 0, bold)
    assert found[-1].action.kind == "release"
    wary, leaning = concluded(presses, 0, bold, replace(HELD, below=tower))
    assert leaning[-1].action.kind == "shift"
    assert leaning[-1].action.target_mm is not None
    true = presses[-1].truth.offset_mm[0] - PLACES[-1]
    middle: XY = (-float(true[0]), -float(true[1]))
    for at_mm, falls in ((6.0, True), (-4.0, False)):
        at = middle[0] + at_mm, middle[1]
        # The exact judge of the tower that was entered, with the piece there.
        bodies = (low, replace(touched, at_mm=(5.0, 0.0)))
        piece = load_pieces().top("pot").body((5.0 + at_mm, 0.0))
        assert judge_tower(Tower((*bodies, piece))).stands is not falls
        assert likely_at(alone, at)
        assert likely_at(wary, at) is not falls
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
        return np.asarray(offset_mm)[None]

    def inset(here_mm: Any, points_mm: Any, from_first_mm: Any) -> InsetDistribution:
        deep = DISC_MM - np.hypot(*(here_mm[0] + points_mm - middle_mm).T)[:, None]
        return InsetDistribution(np.ones_like(deep), deep, np.full_like(deep, 0.2))

    reasoner = FusedStrategy(held, settings, (6.0, 4.0))
    reasoner._forward = SimpleNamespace(known_by_mirror=known, inset=inset)  # type: ignore[assignment]
    return reasoner, faces


def touch(reasoner: FusedStrategy, at: XY) -> PlaceDecision:
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.5))
    return reasoner.conclude(ProbeObservation(np.zeros((20, 258), np.float32), patch, at))


def test_the_centre_of_mass_of_a_mug_is_judged_and_brought_over_the_middle() -> None:
    deep = FusedSettings(risk=0.5, first_risk=0.0, inset_mm=8.0)
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
    over = inset_at(reasoner, there)
    assert over is not None
    assert over.expected_mm() == pytest.approx(DISC_MM)
    assert touch(reasoner, there).action.kind == "release"


def test_the_uncertainty_of_a_weighed_centre_of_mass_enters_the_release() -> None:
    sure, _ = one_who_knows(HELD)
    weighed, _ = one_who_knows(replace(HELD, com_sigma_mm=0.7))
    risk = SETTINGS.fused.first_risk
    for reasoner, sd_mm in ((sure, 0.2), (weighed, math.hypot(0.2, 0.7))):
        found = touch(reasoner, MIDDLE_MM).stability.margin_mm
        assert found == pytest.approx(DISC_MM + sd_mm * float(norm.ppf(risk)), abs=0.06)
    # The paper's rule knows no probability: its margin grows by two standard uncertainties.
    paper = StackSettings(belief=SMALL)
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.98))
    seen = ProbeObservation(np.zeros((20, 258), np.float32), patch, (0.0, 0.0))
    margin_mm = PaperStrategy(HELD, paper, (0.0, 0.0)).conclude(seen).stability.margin_mm
    for sigma_mm, stable in ((0.0, True), (0.49 * margin_mm, True), (0.51 * margin_mm, False)):
        held = replace(HELD, com_sigma_mm=sigma_mm)
        assert PaperStrategy(held, paper, (0.0, 0.0)).conclude(seen).stability.stable is stable


@pytest.mark.parametrize(
    ("first_risk", "accepted"),
    [(0.01, (0.01, 0.02, 0.04, 0.04)), (0.0, (0.04,) * 4), (0.2, (0.04,) * 4)],
)
def test_the_accepted_risk_grows_with_each_probe_to_the_last(
    first_risk: float, accepted: tuple[float, ...]
) -> None:
    fused = FusedSettings(risk=0.04, first_risk=first_risk, inset_mm=8.9)  # never released
    policy = PolicySettings(max_probes=3)
    settings = StackSettings(strategy="fused", belief=SMALL, fused=fused, policy=policy)
    # The margin is told in steps of 0.05 mm; this deviation moves it by 0.3 mm or more a probe.
    reasoner, _ = one_who_knows(replace(HELD, com_sigma_mm=1.5), settings)
    for risk in accepted:
        margin_mm = touch(reasoner, MIDDLE_MM).stability.margin_mm
        expected_mm = DISC_MM + math.hypot(0.2, 1.5) * float(norm.ppf(risk))
        assert margin_mm == pytest.approx(expected_mm, abs=0.051)


@pytest.mark.parametrize("strategy", ["paper", "fused", "zero-wrench"])
def test_an_unknown_centre_of_mass_is_never_released(strategy: Any) -> None:
    held = replace(HELD, com_xy_mm=(math.nan, math.nan))
    settings = StackSettings(strategy=strategy, belief=SMALL)
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.98))
    seen = ProbeObservation(press((0.0, 0.0)), patch, (0.0, 0.0))
    assert not make_strategy(held, settings, (0.0, 0.0)).conclude(seen).stability.stable


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
        assert likely_at(mug, at) == likely_at(centred, (x, y))
        assert stable_at(mug, at) == stable_at(centred, (x, y))
        likely += likely_at(mug, at)
    assert 20 < likely < 150


def test_it_goes_where_the_centre_of_mass_lies_deepest() -> None:
    cells = np.stack(np.meshgrid(np.arange(-3.0, 4.0), np.arange(-3.0, 4.0)), axis=-1)
    cells = cells.reshape(-1, 2)
    inset = 5.0 - np.hypot(*(cells - (2.0, -1.0)).T)
    assert best_shift(inset, cells) == (2.0, -1.0)
    assert best_shift(inset, cells - (1.0, 0.0)) == (1.0, -1.0)


def test_a_sure_place_is_preferred_to_a_deeper_one_that_is_unsure() -> None:
    reasoner, _ = one_who_knows(HELD)
    mean, sd = np.array([[3.0], [1.5], [-90.0], [-80.0]]), np.array([[6.0], [0.3], [0.1], [0.1]])
    over = InsetDistribution(np.ones((4, 1)), mean, sd)
    promise = reasoner._promise(over, np.zeros((4, 2)))
    assert promise.argmax() == 1
    assert promise[3] > promise[2]


def test_the_network_that_ships_says_what_it_was_made_from() -> None:
    card = shipped_fused().card
    assert card.bench_sha256.startswith("03b08d28746d9339")
    assert {"pot", "barrel", "mushroom", "short", "long", "hex20", "rect12x28"} <= set(
        card.left_out
    )


def test_the_network_for_any_outline_is_named_by_a_setting() -> None:
    found = load_network_of(FusedSettings(weights="any")).card
    assert (found.bench_sha256, found.outlines) == (
        bench_sha256(load_simulation(preset="bench-v2")),
        "any",
    )
    assert found.hyper.networks == 2
    assert load_network_of(FusedSettings()).card.outlines == "convex"


def test_the_network_of_the_wrench_alone_is_named_by_a_setting() -> None:
    card = load_network_of(FusedSettings(weights="wrench")).card
    assert (card.outlines, card.training["wrench_alone"]) == ("convex", True)
    assert "wrench_alone" not in shipped_fused().card.training


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
    assert np.cov(found.samples().T) == pytest.approx(found.sigma_mm**2 * np.eye(2), abs=0.3)


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
    assert f"stands {x:+.1f}, {y:+.1f} mm from the middle" in found.describe((3.0, -1.0))


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


def press(at_mm: tuple[float, float], rise_n: float = 7.6) -> np.ndarray:
    """Observation of a force growing by ``rise_n`` at ``at_mm``, sensor 150 mm above the face."""
    fz = np.linspace(0.4, 0.4 + rise_n, 20)
    x, y = at_mm
    seen = np.zeros((20, 258), np.float32)
    seen[:, -6:] = np.stack([0 * fz, 0 * fz, fz, 1e-3 * y * fz, -1e-3 * x * fz, 0 * fz], axis=1)
    return seen


def zero_wrench(
    *presses: np.ndarray, com: tuple[float, float] = (0.0, 0.0)
) -> tuple[PlaceDecision, bool]:
    settings = StackSettings(belief=BeliefSettings(half_extent_mm=16.0), strategy="zero-wrench")
    reasoner = make_strategy(GraspedPiece(com, 30.0, sensor_height_mm=120.0), settings, (0.0, 0.0))
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.9))
    for seen in presses:
        concluded = reasoner.conclude(ProbeObservation(seen, patch, (0.0, 0.0)))
    return concluded, concluded.stability.stable


def test_zero_wrench_lets_go_where_the_push_turns_nothing_and_follows_it_otherwise() -> None:
    under, stable = zero_wrench(press((0.3, -0.4)))
    assert (under.action.kind, stable) == ("release", True)
    beside, stable = zero_wrench(press((-5.0, 0.0)))
    assert (beside.action.kind, stable) == ("shift", False)
    assert beside.action.step_mm == pytest.approx((-3.0, 0.0), abs=1e-3)
    assert beside.stability.margin_mm == pytest.approx(-5.0, abs=1e-3)
    assert not under.map.log_odds.any()


def test_zero_wrench_lets_a_mug_go_where_the_push_acts_under_its_centre_of_mass() -> None:
    mug = load_pieces().top("mug").com_xy_mm
    under, stable = zero_wrench(press((1.8, -1.0)), com=mug)
    assert (under.action.kind, stable) == ("release", True)
    assert under.stability.centre_mm == pytest.approx(mug)
    beside, _ = zero_wrench(press((3.5, 1.5)), com=mug)
    # From the centre of mass to the push: 1.8 and 2.4 mm.
    assert beside.stability.margin_mm == pytest.approx(-3.0, abs=1e-3)
    assert beside.action.step_mm == pytest.approx((1.8, 2.4), abs=1e-3)


def test_zero_wrench_needs_a_push_and_gives_up_in_the_end() -> None:
    faint, stable = zero_wrench(press((0.0, 0.0), rise_n=1.0))
    assert (faint.action.kind, stable) == ("shift", False)
    last, _ = zero_wrench(*[press((5.0, 0.0))] * 8)
    assert last.action.kind == "give_up"


@pytest.mark.parametrize(("away_mm", "more_mm", "releases"), [(0.9, 0.0, True), (0.9, 0.3, False)])
def test_the_interlock_accepts_every_release_of_zero_wrench(away_mm, more_mm, releases) -> None:
    """Its margin is negative: the distance of the push from the centre of mass."""
    settings = StackSettings.model_validate(
        {"strategy": "zero-wrench", "stability": {"margin_mm": more_mm}}
    )
    held = GraspedPiece((0.0, 0.0), 30.0, sensor_height_mm=120.0)
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.9))
    seen = ProbeObservation(press((away_mm, 0.0)), patch, (0.0, 0.0))
    concluded = make_strategy(held, settings, (0.0, 0.0)).conclude(seen)
    assert (concluded.action.kind == "release") is releases
    assert (concluded.stability.margin_mm >= settings.required_margin_mm) is releases


def test_without_the_height_of_the_sensor_no_moment_can_be_read() -> None:
    with pytest.raises(InputError, match="height of the wrist sensor"):
        make_strategy(
            GraspedPiece((0.0, 0.0), 30.0), StackSettings(strategy="zero-wrench"), (0.0, 0.0)
        )


def test_calibrated_fusion_needs_a_calibration_and_names_the_command() -> None:
    held = GraspedPiece((0.0, 0.0), 30.0, base_rate=0.3)
    with pytest.raises(InputError, match="no calibration") as error:
        make_strategy(held, StackSettings(strategy="paper-calibrated"), (0.0, 0.0))
    assert "evaluate MODEL DATA --calibrate" in error.value.fix
    assert make_strategy(held, StackSettings(), (0.0, 0.0))  # the paper's needs none


def test_calibrated_fusion_releases_by_the_paper_s_threshold() -> None:
    held = GraspedPiece(
        (0.0, 0.0), 30.0, calibration=PatchCalibration(temperature=3.0, bias=0.0, prior=0.5)
    )
    patch = ContactPatch(FACE.copy(), np.full(len(FACE), 0.95))
    seen = ProbeObservation(press((0.0, 0.0)), patch, (0.0, 0.0))
    calibrated, paper = (
        make_strategy(held, StackSettings(strategy=name), (0.0, 0.0))
        for name in ("paper-calibrated", "paper")
    )
    # 0.95 is above 0.9; calibrated it is 0.73.
    assert paper.conclude(seen).action.kind == "release"
    decision = calibrated.conclude(seen)
    assert decision.action.kind == "shift"
    assert not decision.stability.stable
    assert decision.map.probability.max() == pytest.approx(0.73, abs=0.01)


def test_letting_go_untested_concludes_nothing() -> None:
    with pytest.raises(InputError, match="does not probe"):
        make_strategy(
            GraspedPiece((0.0, 0.0), 30.0), StackSettings(strategy="pick-and-place"), (0.0, 0.0)
        )


def test_a_new_grip_adds_its_uncertainty_to_that_of_the_centre_of_mass() -> None:
    held = GraspedPiece((0.0, 0.0), 30.0, com_sigma_mm=0.4)
    strategy = make_strategy(held, StackSettings(), (0.0, 0.0))
    strategy.regrasped(0.3)
    assert strategy._held.com_sigma_mm == pytest.approx(0.5)
    strategy.regrasped(1.2)
    assert strategy._held.com_sigma_mm == pytest.approx(1.3)
