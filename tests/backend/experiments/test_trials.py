"""The batched closed loop is the device loop: same seeds, same course, same end.

Sensor noise is off; the mechanical nuisances are those of the hard preset. What differs is the
device path: rendered images, the tracker, cycles of 10 ms, unloading before the release.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.bench.brisk import RATE_HZ
from touchdown.backend.bench.assembly import (
    SimulatedBenchChoice,
    make_scene,
    shipped_model,
    simulated_session,
)
from touchdown.backend.config.method import (
    BeliefSettings,
    PolicySettings,
    ProbeSettings,
    StackSettings,
)
from touchdown.backend.config.simulation import PRESETS, SimulationSettings, load_simulation
from touchdown.backend.core.events import ActionChosen, EpisodeRecorded, Event, TrialFinished
from touchdown.backend.core.values import TACTILE_CHANNELS, FloatArray, Outcome
from touchdown.backend.experiments.models import batch_model
from touchdown.backend.experiments.statics import probe_groups
from touchdown.backend.experiments.trials import (
    BatchModel,
    BatchTrialResult,
    SceneSetup,
    pick_and_place_in_lockstep,
    refused_presses,
    stack_in_lockstep,
    start_scene,
)
from touchdown.backend.geometry import Tower, face_points, judge_tower, load_pieces
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.runs import RecordingOptions
from touchdown.backend.runs.requests import SceneChoice, StackRequest
from touchdown.backend.sensing.episode import EpisodeLimits
from touchdown.backend.sensing.slip import shortfall_mm
from touchdown.backend.simulation import BatchedTrials, Scene, TrialPresses, judge_release
from touchdown.backend.simulation.gripper import HeldPiece
from touchdown.backend.simulation.ground_truth import scene_mounting

MECHANICAL = {
    **PRESETS["off"],
    "tactile": {**PRESETS["off"]["tactile"], "rate_hz": RATE_HZ},
    "mu_grip": 0.6,
    "grasp": {"hysteresis": True},
    "spread": {"grasp_offset_mm": 0.5, "tilt_rad": 0.004, "mu": 0.15, "gel": 0.1, "gain": 0.05},
}
SEEDS = (11, 12, 13)


def run_on_devices(settings: SimulationSettings, request: StackRequest) -> list[Event]:
    """Return the facts of the run on the bench ``settings``."""
    facts: list[Event] = []
    session = simulated_session(SimulatedBenchChoice(given=settings), keep=RecordingOptions(None))
    session.events.subscribe(facts.append)
    try:
        session.run(request)
    finally:
        session.close()
    return facts


@pytest.fixture(scope="module")
def settings() -> SimulationSettings:
    return SimulationSettings.model_validate({"preset": "off", **MECHANICAL})


def three_scenes(settings: SimulationSettings) -> list[Scene]:
    catalogue = load_pieces()
    return [make_scene(catalogue, SceneChoice(seed=seed), settings) for seed in SEEDS]


@pytest.mark.slow
def test_the_batch_takes_the_course_of_the_devices(settings: SimulationSettings) -> None:
    catalogue, request = load_pieces(), StackRequest()
    scenes = three_scenes(settings)
    model = batch_model(load_checkpoint(shipped_model("pot")), catalogue.top("pot"))
    ends = stack_in_lockstep(scenes, model, StackSettings(), EpisodeLimits())
    for end in ends[:2]:
        facts = run_on_devices(settings, replace(request, seed=end.seed))
        felt = [fact for fact in facts if isinstance(fact, EpisodeRecorded)]
        chosen = [fact for fact in facts if isinstance(fact, ActionChosen)]
        finished = next(fact for fact in facts if isinstance(fact, TrialFinished))
        assert felt[0].episode.offset_mm == pytest.approx(end.steps[0].offset_mm, abs=1e-6)
        first, theirs = end.steps[0].action, chosen[0].action
        # The tracker's 0.03 px move single probabilities across 0.9, and with them the target.
        assert first.kind == theirs.kind
        assert first.step_mm == pytest.approx(theirs.step_mm, abs=0.5)
        assert finished.outcome is end.outcome
        assert abs(finished.probes - end.probes) <= 1


def test_a_lone_trial_ends_as_it_does_in_a_crowd(settings: SimulationSettings) -> None:
    scenes = three_scenes(settings)
    together, alone = BatchedTrials(scenes), BatchedTrials(scenes[1:2])
    commands = together.start_commands_mm()
    crowd = together.press([0, 1, 2], commands)
    lone = alone.press([0], commands[1:2])
    assert lone.observation[0] == pytest.approx(crowd.observation[1], abs=1e-4)
    assert lone.truth.offset_mm[0] == pytest.approx(crowd.truth.offset_mm[1], abs=1e-6)
    assert lone.travel_mm[0] == pytest.approx(crowd.travel_mm[1], abs=1e-6)


def test_the_start_of_a_scene_is_where_the_piece_is_pressed(settings: SimulationSettings) -> None:
    scene = three_scenes(settings)[0]
    bench = BatchedTrials([scene])
    felt = bench.press([0], bench.start_commands_mm())
    assert felt.detected.all()
    assert felt.truth.offset_mm[0] == pytest.approx(scene.start_mm, abs=0.3)
    assert felt.observation[0, -1, TACTILE_CHANNELS + 2] > 1.0


def test_a_release_is_judged_on_the_face_of_the_scene() -> None:
    bench = SimulationSettings.model_validate({"preset": "off", "surface": {"tilted_share": 1.0}})
    catalogue = load_pieces()
    tower = Tower((catalogue.bottom("short").body(),))
    scene = Scene(catalogue.top("pot"), tower, (3.0, 1.0), 5, bench)
    (end,) = pick_and_place_in_lockstep([scene], StackSettings())
    assert end.verdict is not None
    assert end.true_mm is not None
    assert end.verdict == judge_release(scene, end.true_mm, 0.0)
    flat = judge_tower(tower.with_top(scene.piece.body(end.true_mm)))
    # The piece turns onto the face and weighs on the table elsewhere.
    assert abs(end.verdict.margins_mm[0] - flat.margins_mm[0]) > 0.1


PAIRS = (("pot", "short"), ("pot", "long"), ("mushroom", "short"), ("barrel", "hex20"))


def nuisances(piece: str, bottom: str, seeds: Sequence[int]) -> list[list[float]]:
    """Return what each trial draws once: tilt, stiffness, grasp, gains."""
    catalogue, bench = load_pieces(), load_simulation(preset="bench-v1")
    tower = Tower((catalogue.bottom(bottom).body(),))
    scenes = [Scene(catalogue.top(piece), tower, (0.0, 0.0), seed, bench) for seed in seeds]
    drawn = []
    for scene, grip in zip(scenes, BatchedTrials(scenes).grippings, strict=True):
        mounting = scene_mounting(scene)
        fixed = [*mounting.tilt_rad, float(np.log(mounting.foundation_n_mm3)), grip.gel_factor]
        drawn.append([*fixed, grip.mu_grip, *grip.grasp_offset_mm, grip.yaw_rad, *grip.gain])
    on_devices = HeldPiece(scenes[-1], 0, ProbeSettings().grip_force_n)
    assert (on_devices.mounting, on_devices.gripping) == (mounting, grip)
    return drawn


def test_trials_of_one_seed_are_independent() -> None:
    """Each piece, bottom and seed has draws of its own; the same three have the same draws."""
    drawn = np.array([nuisances(*pair, range(150)) for pair in PAIRS])
    assert len(np.unique(drawn[..., 2])) == drawn[..., 2].size
    assert nuisances(*PAIRS[2], [149]) == drawn[2, 149:].tolist()
    columns = [drawn[k, :, q] for q in range(drawn.shape[2]) for k in range(len(PAIRS))]
    sideways = np.corrcoef(columns) - np.eye(len(columns))
    # 780 coefficients with a standard deviation of 0.08
    assert np.abs(sideways).max() < 0.36
    following = [float(np.corrcoef(one[1:], one[:-1])[0, 1]) for one in columns]
    assert np.abs(following).max() < 0.32


@pytest.mark.parametrize("bottoms", [("short",), ("short", "long")])
def test_batch_and_devices_build_the_same_scene(bottoms: tuple[str, ...]) -> None:
    catalogue, bench = load_pieces(), load_simulation(preset="bench-v1")
    case = SceneSetup.of(catalogue, "pot", bottoms, bench)
    choices = [SceneChoice("pot", bottoms, seed=seed) for seed in (3, 4)]
    made = [make_scene(catalogue, choice, bench) for choice in choices]
    assert made == [start_scene(case, seed) for seed in (3, 4)]
    other = make_scene(catalogue, SceneChoice("barrel", bottoms, seed=3), bench)
    assert other.start_mm != made[0].start_mm


def _constant(probability: float, piece: str = "pot") -> BatchModel:
    points = face_points(load_pieces().top(piece).face)
    return BatchModel(lambda seen: np.full((len(seen), len(points)), probability), points, None)


def test_one_who_is_always_sure_lets_it_fall(settings: SimulationSettings) -> None:
    scenes = three_scenes(settings)
    for end in stack_in_lockstep(scenes, _constant(0.99), StackSettings(), EpisodeLimits()):
        assert (end.outcome, end.probes) == (Outcome.FELL, 1)
        assert end.verdict is not None
        assert end.verdict.margin_mm < 0
    for end in pick_and_place_in_lockstep(scenes, StackSettings()):
        assert end.outcome is Outcome.FELL


def test_one_who_never_knows_gives_up(settings: SimulationSettings) -> None:
    scenes = three_scenes(settings)[:1]
    (end,) = stack_in_lockstep(scenes, _constant(0.4), StackSettings(), EpisodeLimits())
    # Looking around, the piece may leave the support: then the press finds nothing.
    assert end.outcome in (Outcome.GAVE_UP, Outcome.ABORTED)
    assert end.verdict is None


def test_fusion_places_a_mug_over_its_centre_of_mass() -> None:
    """Told a mirrored centre it lets some of these fall, or ends within 0.1 mm of the edge."""
    case = SceneSetup.of(load_pieces(), "mug", ("short",), load_simulation(preset="bench-v1"))
    scenes = [scene for seed in (900, 901, 902) if (scene := start_scene(case, seed))]
    fused = StackSettings(strategy="fused")
    for end in stack_in_lockstep(scenes, _constant(0.5, "mug"), fused, EpisodeLimits()):
        assert end.outcome is Outcome.PLACED
        assert end.verdict is not None
        assert end.verdict.margin_mm > 0.5


BESIDE_MM = -18.5  # a pot of 15 mm and a bottom of 20 mm part at 17.5 mm


class Beside(BatchedTrials):
    """Trials whose first press meets nothing; the first place of a spiral lies 3 mm nearer."""

    def start_commands_mm(self) -> FloatArray:
        return np.tile([BESIDE_MM, 0.0], (len(self.scenes), 1))


def ended(strategy: str, most: int) -> BatchTrialResult:
    settings = StackSettings.model_validate(
        {
            "strategy": strategy,
            "policy": PolicySettings(max_probes=most),
            "belief": BeliefSettings(half_extent_mm=24.0),
        }
    )
    scene = make_scene(load_pieces(), SceneChoice(seed=5), SimulationSettings(preset="off"))
    return stack_in_lockstep([scene], _constant(0.5), settings, EpisodeLimits(), world=Beside)[0]


@pytest.mark.parametrize("strategy", ["paper", "zero-wrench"])
def test_a_press_without_contact_ends_the_run(strategy: str) -> None:
    end = ended(strategy, 2)
    assert (end.outcome, end.reason) == (Outcome.ABORTED, "No contact was found.")
    assert end.probes == 0


class FalseTruth(BatchedTrials):
    """Trials with a true place only: all slipped and toppled, none has a solution."""

    def press(self, trials: Sequence[int], commands_mm: FloatArray) -> TrialPresses:
        felt = super().press(trials, commands_mm)
        k = len(felt.detected)
        no = np.zeros(k, np.bool_)
        lie = replace(felt.truth, slip_mm=np.full(k, 9.0), solved=no, toppled=~no)
        return replace(felt, truth=lie)


@pytest.mark.parametrize("strategy", ["paper", "fused", "zero-wrench"])
def test_no_truth_decides_a_trial(settings: SimulationSettings, strategy: str) -> None:
    """Presses are accepted by measured force and slip; the truth gives the outcome only."""
    scenes, chosen = three_scenes(settings), StackSettings.model_validate({"strategy": strategy})
    honest, lied = (
        stack_in_lockstep(scenes, _constant(0.6), chosen, EpisodeLimits(), world=world)
        for world in (BatchedTrials, FalseTruth)
    )
    courses = [
        [(e.true_mm, [(step.offset_mm, step.action) for step in e.steps]) for e in ends]
        for ends in (honest, lied)
    ]
    assert courses[0] == courses[1]
    # Only the judge knows that the bottom was toppled.
    assert {end.outcome for end in lied} == {Outcome.KNOCKED_OVER}
    assert all(b.reason.endswith(a.reason) for a, b in zip(honest, lied, strict=True))
    assert all(step.toppled for end in lied for step in end.steps)
    assert all(end.unsolved >= end.probes > 0 for end in lied)


def test_no_truth_chooses_the_probes_of_a_group() -> None:
    case = SceneSetup.of(load_pieces(), "pot", ("short",), load_simulation(preset="bench-v1"))
    honest, lied = (probe_groups(case, [70, 71], 2, w) for w in (BatchedTrials, FalseTruth))
    assert lied.rejected == honest.rejected
    assert (honest.toppled, honest.unsolved) == (0, 0)
    assert (lied.toppled, lied.unsolved) == (4, 4)
    np.testing.assert_array_equal(lied.observation, honest.observation)


def test_slip_is_measured_in_the_batch_as_on_the_devices() -> None:
    """Slip from the markers at the ticks, against the true slip; a weak grip slips."""
    slips = {"grasp": {"slip": True}, "mu_grip": 0.33, "spread": {"mu_grip": 0.0}}
    bench = load_simulation(preset="bench-v1").model_dump(mode="json")
    for key, value in slips.items():
        bench[key] = {**bench[key], **value} if isinstance(value, dict) else value
    weak = SimulationSettings.model_validate(bench)
    tower = Tower((load_pieces().bottom("short").body(),))
    scenes = [Scene(load_pieces().top("pot"), tower, (0.0, 0.0), k, weak) for k in range(12)]
    felt = BatchedTrials(scenes).press(range(12), np.zeros((12, 2)))
    true_mm, measured_mm = felt.truth.slip_mm, measured_slips_mm(felt)
    assert true_mm.max() > 0.3
    np.testing.assert_allclose(measured_mm, true_mm, atol=0.08)
    refused = [bool(why) for why in refused_presses(felt, EpisodeLimits())]
    assert refused == [bool(slip > EpisodeLimits().slip_mm) for slip in measured_mm]


def measured_slips_mm(felt: TrialPresses) -> FloatArray:
    shear = felt.observation[:, :, :TACTILE_CHANNELS].reshape(len(felt.detected), 20, 2, 2, 63)
    return np.array([
        max(shortfall_mm(travel, one.astype(np.float64)) for one in shears[:, :, 1].mean(-1).T)
        for travel, shears in zip(felt.travel_mm, shear, strict=True)
    ])  # fmt: skip


def test_learned_fusion_presses_elsewhere() -> None:
    end = ended("fused", 2)
    assert end.outcome is Outcome.ASKED
    assert end.probes == 1
    assert end.steps[0].offset_mm == pytest.approx((BESIDE_MM + 3.0, 0.0))
    assert (
        ended("fused", 1).reason == "No contact was found after 1 probe: go on probing 3.0 mm away?"
    )
