"""Simulated stacking trials that run side by side, from a seeded scene to the outcome.

The strategies are those of ``touchdown.backend.runs.stack``. Tare, reference, tracker and interlock
of that plan are left out. Presses are accepted by the same rules on measured force and measured
slip. The truth of a press is noted for the outcome and decides nothing else: a trial goes on after
a press that topples the bottom, as long as its signals are accepted, and ends as knocked over.
``start_scene`` builds the same scene as the device loop for a given seed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core, geometry, simulation
from touchdown.backend.config import SimulationSettings, StackSettings, parse_settings
from touchdown.backend.learning import PatchCalibration
from touchdown.backend.placement import (
    GraspedPiece,
    ProbeObservation,
    SearchingStrategy,
    Strategy,
    SupportTower,
    make_strategy,
)
from touchdown.backend.sensing import EpisodeLimits, refuse_observation
from touchdown.backend.simulation.second_world import FiniteGelTrials, SecondWorldTrials

_DISPLACEMENT = 78
FRESH = "fresh"  # stands for one test outline per trial
FRESH_TRIAL_SEED = 47_000_000  # of the trial on outline 0
# Simulated worlds by name
WORLDS: dict[str, type[simulation.BatchedTrials]] = {
    "bench": simulation.BatchedTrials,
    "elsewhere": SecondWorldTrials,
    "elsewhere-finite-elements": FiniteGelTrials,
}


@dataclass(frozen=True, slots=True)
class SceneSetup:
    """A piece over one bottom, or over a tower of bottoms (bottom-up), on a bench."""

    piece: geometry.Piece
    bottoms: tuple[geometry.Piece, ...]
    settings: SimulationSettings

    @classmethod
    def of(
        cls,
        catalogue: geometry.PieceLibrary,
        piece: str,
        bottoms: tuple[str, ...],
        settings: SimulationSettings,
    ) -> SceneSetup:
        """Return the set-up of the named pieces; raises ``InputError``."""
        top = geometry.with_true_com(catalogue.top(piece), 0)
        return cls(top, tuple(map(catalogue.bottom, bottoms)), settings)

    @classmethod
    def of_job(cls, params: Mapping[str, Any], *bottoms: str) -> SceneSetup:
        """Return the set-up of a job with ``piece`` and ``bench`` in its parameters."""
        bench = parse_settings(SimulationSettings, params["bench"], "job")
        return cls.of(geometry.load_pieces(), params["piece"], bottoms, bench)

    @classmethod
    def of_trial(cls, params: Mapping[str, Any], seed: int) -> SceneSetup:
        """Return the set-up of the trial ``seed`` of a job whose ``bottom`` may be ``FRESH``.

        Its outline is then number ``seed`` - ``FRESH_TRIAL_SEED`` of ``outline_seed``.
        """
        if params["bottom"] != FRESH:
            return cls.of_job(params, *params["bottom"].split("+"))
        bottom = geometry.fresh_bottom(params["outline_seed"], seed - FRESH_TRIAL_SEED)
        return replace(cls.of_job(params), bottoms=(bottom,))


def start_scene(case: SceneSetup, seed: int) -> simulation.Scene | None:
    """Return the unstable scene of one trial; None if no place is stable.

    The device loop builds the same scene from the same seed.
    """
    rng = geometry.start_generator(seed, case.piece.name, *(bottom.name for bottom in case.bottoms))
    tower = geometry.draw_tower(rng, case.bottoms)
    if len(case.bottoms) > 1 and not geometry.can_be_placed(case.piece, tower):
        return None
    start = geometry.draw_start(rng, case.piece.body(), tower)
    return simulation.Scene(case.piece, tower, start, seed, case.settings)


def bottom_facts(bottom: str, case: SceneSetup, scene: simulation.Scene) -> dict[str, Any]:
    """Return the facts about the bottom of a trial by which trials are counted.

    The class of a fresh outline; on a face that is not flat also its kind, and ``best_margin_mm``.
    """
    surface = scene.bottoms.bodies[-1].surface
    outline = {"outline": case.bottoms[0].title if bottom == FRESH else bottom}
    if not surface.flat:
        return {**outline, "surface": surface.kind, "best_mm": best_margin_mm(scene)}
    return outline if bottom == FRESH else {}


def best_margin_mm(scene: simulation.Scene) -> float:
    """Return the margin that the exact judge finds at the best place of a grid of 1 mm."""
    piece, top = scene.piece, scene.bottoms.bodies[-1]
    reach = np.ceil(max(scene.surface.half_extents_mm))
    line = np.arange(-reach, reach + 1.0)
    com = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    true_com = simulation.true_com_xy_mm(scene)
    margins = simulation.touched_margins_mm(scene, true_com, com)
    if not top.fixed:
        # The bottom must not tip either.
        load = piece.mass_g * com + top.mass_g * np.asarray(top.com_xy_mm)
        margins = np.minimum(
            margins, geometry.inset_mm(top.lower, load / (piece.mass_g + top.mass_g))
        )
    place = pair_of(com[margins.argmax()] - true_com)
    return round(simulation.true_margin_mm(scene, place, 0.0), 2)


def probing_scene(case: SceneSetup, seed: int) -> simulation.Scene:
    """Return a scene for single presses, with its own mounting and gripping."""
    return simulation.Scene(
        case.piece, geometry.Tower((case.bottoms[0].body(),)), (0.0, 0.0), seed, case.settings
    )


def balanced_offset(case: SceneSetup, seed: int, attempt: int, *, stable: bool) -> core.FloatArray:
    """Return a random displacement (2,) at which the piece stands, or does not, as ``stable``
    requires.

    The overlap is at least that of the data collection. Raises ``InputError`` if no such place
    exists.
    """
    rng = displacement_rng(seed, 0, attempt)
    bottom = case.bottoms[0].body()
    for _ in range(100):
        for offset in geometry.draw_offset(rng, case.piece.face, case.bottoms[0].face, 16):
            body = case.piece.body(pair_of(offset))
            if geometry.judge_tower(geometry.Tower((bottom, body))).stands is stable:
                return np.asarray(offset, dtype=np.float64)
    what = f"'{case.piece.name}' never {'stands' if stable else 'falls'} there."
    fix = "Choose another bottom."
    raise core.InputError(what, case.bottoms[0].name, fix)


def uniform_offset(case: SceneSetup, seed: int, probe: int, attempt: int) -> core.FloatArray:
    """Return a random displacement (2,) with enough overlap."""
    rng = displacement_rng(seed, probe, attempt)
    return np.asarray(geometry.draw_offset(rng, case.piece.face, case.bottoms[0].face, 1)[0])


def displacement_rng(seed: int, probe: int, attempt: int) -> np.random.Generator:
    """Return the random generator of the displacement of one probe of a trial."""
    return np.random.default_rng([seed, _DISPLACEMENT, probe + 1, attempt + 1])


# contact probabilities (k, N) of observations (k, 20, 258)
BatchPredict = Callable[[NDArray[np.float32]], core.FloatArray]
MAX_ATTEMPTS = 2  # a refused press is repeated once, as on the bench
NO_CONTACT = "No contact was found."
UNRELEASED = {
    "ask": core.Outcome.ASKED,
    "give_up": core.Outcome.GAVE_UP,
}  # nobody answers in a batch
TOPPLED_REASON = "The press tipped the bottom over its edge."
XY = tuple[float, float]


@dataclass(frozen=True, slots=True)
class BatchModel:
    """Interface of a trained model: ``points_mm`` (N, 2) of the face, and predictions."""

    predict: BatchPredict
    points_mm: core.FloatArray
    base_rate: float | None
    calibration: PatchCalibration | None = None


@dataclass(frozen=True, slots=True)
class ProbeStep:
    """One probe of a trial: commanded place, true place ``true_mm``, belief and decision.

    ``toppled``: a press so far toppled the bottom; like the true place for scores only.
    """

    offset_mm: XY
    true_mm: XY
    map: core.BeliefMap
    stability: core.Stability
    action: core.PlaceAction
    toppled: bool = False


@dataclass(frozen=True, slots=True)
class BatchTrialResult:
    """Result of a trial. ``verdict``: exact judge at the release, None without a release and after
    a press that toppled the bottom.

    ``true_mm``: final displacement of the piece, None if it was never pressed. ``unsolved``: number
    of presses in which the simulation found no equilibrium at some instant.
    """

    seed: int
    outcome: core.Outcome
    reason: str
    probes: int
    verdict: geometry.TowerVerdict | None
    true_mm: XY | None
    steps: tuple[ProbeStep, ...] = field(default=(), repr=False)
    unsolved: int = 0

    def as_json(self) -> dict[str, Any]:
        """Return the stored form; a margin without support is None."""
        return {
            "seed": self.seed,
            "outcome": self.outcome.value,
            "reason": self.reason,
            "probes": self.probes,
            "unsolved": self.unsolved,
            "margins_mm": self.verdict and rounded_margins(self.verdict.margins_mm),
        }


def rounded_margins(margins_mm: Iterable[float]) -> list[float | None]:
    """Return margins for JSON; one without support is None."""
    return [round(float(m), 4) if np.isfinite(m) else None for m in margins_mm]


@dataclass
class _RunningTrial:
    number: int
    scene: simulation.Scene
    here: XY
    strategy: Strategy | None = None
    steps: list[ProbeStep] = field(default_factory=list)
    tries: int = 0
    true_mm: XY | None = None
    end: BatchTrialResult | None = None
    unsolved: int = 0
    toppled: bool = False

    def note(self, truth: simulation.PressTruth, k: int) -> None:
        self.true_mm = pair_of(truth.offset_mm[k])
        self.unsolved += not truth.solved[k]
        self.toppled |= bool(truth.toppled[k])

    def close(
        self, outcome: core.Outcome, reason: str, verdict: geometry.TowerVerdict | None = None
    ) -> None:
        if self.toppled:
            outcome, reason, verdict = core.Outcome.KNOCKED_OVER, f"{TOPPLED_REASON} {reason}", None
        steps = tuple(self.steps)
        self.end = BatchTrialResult(
            self.scene.seed,
            outcome,
            reason,
            len(steps),
            verdict,
            self.true_mm,
            steps,
            self.unsolved,
        )


def stack_in_lockstep(
    scenes: Sequence[simulation.Scene],
    model: BatchModel,
    settings: StackSettings,
    limits: EpisodeLimits,
    create: Callable[[simulation.Scene, XY], Strategy] | None = None,
    world: type[simulation.BatchedTrials] = simulation.BatchedTrials,
) -> list[BatchTrialResult]:
    """Run one stacking trial per scene to its end, all side by side.

    Parameters
    ----------
    scenes : sequence of Scene
        Seeded scenes that share piece, touched surface and bench.
    model : BatchModel
        Contact model of the piece.
    settings : StackSettings
        Method, with the name of the strategy.
    limits : EpisodeLimits
        Limits on press force (N) and slip (mm) of a valid press.
    create : callable, optional
        Returns the strategy of a trial from its scene and its commanded place (x, y) in mm.
        Default: the strategy of ``settings``.
    world : type, optional
        Class of the simulation.

    Returns
    -------
    list of BatchTrialResult
        One result per scene, in order.
    """
    bench = world(scenes, settings.probe)
    if create is None:

        def create(scene: simulation.Scene, at: XY) -> Strategy:
            return make_strategy(grasped_piece_in(scene, model), settings, at)

    starts = zip(scenes, map(pair_of, bench.start_commands_mm()), strict=True)
    trials = [
        _RunningTrial(k, scene, at, create(scene, at)) for k, (scene, at) in enumerate(starts)
    ]
    while active := [trial for trial in trials if trial.end is None]:
        press = bench.press([t.number for t in active], np.array([t.here for t in active]))
        kept = _accepted_presses(active, press, limits)
        if not kept:
            continue
        probability = model.predict(press.observation[kept])
        for k, p in zip(kept, probability, strict=True):
            patch = core.ContactPatch(model.points_mm.copy(), p)
            _decide(active[k], ProbeObservation(press.observation[k], patch, active[k].here), bench)
    return [trial.end for trial in trials if trial.end is not None]


def grasped_piece_in(
    scene: simulation.Scene, model: BatchModel | None, below: SupportTower | None = None
) -> GraspedPiece:
    """Return the properties of the grasped piece that a strategy may know."""
    height_mm, com = scene.settings.wrist.height_mm, scene.piece.com_xy_mm
    base_rate, calibration = (model.base_rate, model.calibration) if model else (None, None)
    return GraspedPiece(com, scene.grip_height_mm, base_rate, height_mm, below, calibration)


def pick_and_place_in_lockstep(
    scenes: Sequence[simulation.Scene],
    settings: StackSettings,
    world: type[simulation.BatchedTrials] = simulation.BatchedTrials,
) -> list[BatchTrialResult]:
    """Press once and release in any case: the paper's baseline."""
    bench = world(scenes, settings.probe)
    commands = bench.start_commands_mm()
    press = bench.press(range(len(scenes)), commands)
    ends = []
    for k, scene in enumerate(scenes):
        trial = _RunningTrial(k, scene, pair_of(commands[k]))
        trial.note(press.truth, k)
        if press.detected[k]:
            _release(trial, bench)
        else:
            trial.close(core.Outcome.ABORTED, NO_CONTACT)
        assert trial.end is not None
        ends.append(trial.end)
    return ends


def refused_presses(press: simulation.TrialPresses, limits: EpisodeLimits) -> list[list[str]]:
    """Return for each press the reasons for which a bench refuses it; from measurements alone."""
    return [
        refuse_observation(seen, travel_mm, limits) if found else [NO_CONTACT]
        for seen, travel_mm, found in zip(
            press.observation, press.travel_mm, press.detected, strict=True
        )
    ]


def _accepted_presses(
    active: list[_RunningTrial], press: simulation.TrialPresses, limits: EpisodeLimits
) -> list[int]:
    """Return the accepted presses. As on the bench, a trial is aborted after two refused presses,
    and after one without contact unless its strategy can recover from it.
    """
    kept = []
    for k, (trial, reasons) in enumerate(zip(active, refused_presses(press, limits), strict=True)):
        trial.note(press.truth, k)
        if not reasons:
            trial.tries = 0
            kept.append(k)
        elif press.detected[k]:
            trial.tries += 1
            if trial.tries == MAX_ATTEMPTS:
                probe, why = len(trial.steps) + 1, "; ".join(reasons)
                trial.close(
                    core.Outcome.ABORTED, f"Probe {probe} was rejected {MAX_ATTEMPTS} times: {why}."
                )
        elif isinstance(trial.strategy, SearchingStrategy):
            action = trial.strategy.missed(trial.here)
            if action.kind in UNRELEASED:
                trial.close(UNRELEASED[action.kind], action.reason)
            else:
                trial.here = (trial.here[0] + action.step_mm[0], trial.here[1] + action.step_mm[1])
                trial.tries = 0
        else:
            trial.close(core.Outcome.ABORTED, NO_CONTACT)
    return kept


def _decide(
    trial: _RunningTrial, touched: ProbeObservation, bench: simulation.BatchedTrials
) -> None:
    here = trial.here
    assert trial.strategy is not None
    assert trial.true_mm is not None
    concluded = trial.strategy.conclude(touched)
    action = concluded.action
    found = (concluded.map, concluded.stability, action, trial.toppled)
    trial.steps.append(ProbeStep(here, trial.true_mm, *found))
    if action.kind == "release":
        _release(trial, bench)
    elif action.kind in UNRELEASED:
        trial.close(UNRELEASED[action.kind], action.reason)
    else:
        trial.here = (here[0] + action.step_mm[0], here[1] + action.step_mm[1])


def _release(trial: _RunningTrial, bench: simulation.BatchedTrials) -> None:
    """Judge the whole tower, as the simulated bench does."""
    assert trial.true_mm is not None
    kick = simulation.release_kick_mm(trial.scene, 1)
    yaw = bench.grippings[trial.number].yaw_rad
    scene = replace(trial.scene, bottoms=bench.bottoms[trial.number])
    verdict = simulation.judge_release(scene, trial.true_mm, yaw, kick)
    outcome = core.Outcome.PLACED if verdict.stands else core.Outcome.FELL
    trial.close(outcome, f"Margin {verdict.margin_mm:+.2f} mm.", verdict)


def pair_of(values: core.FloatArray) -> XY:
    """Return (2,) as a pair."""
    return float(values[0]), float(values[1])
