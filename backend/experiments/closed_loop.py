"""The stacking loop for many trials at once, by any strategy.

All trials press side by side; each then concludes by the same strategy as ``backend.runs.stack``.
What that plan adds on real devices (tare, reference, tracker, interlock) does not happen here;
episodes are accepted by the same limits on press force and slip.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from backend.config.method import StackSettings
from backend.core.flow import BeliefMap, ContactPatch, FloatArray, Outcome, PlaceAction, Stability
from backend.objects.tower import Verdict, judge
from backend.placement.below import Below
from backend.placement.strategies import begin
from backend.placement.strategy import Held, Reasoner, SeekingReasoner, Touched
from backend.sensing.episode import EpisodeLimits
from backend.simulation.lockstep import Lockstep, Presses
from backend.simulation.scene import Scene
from backend.simulation.scoring import release_kick_mm, stacked

Predict = Callable[[NDArray[np.float32]], FloatArray]
"""Contact probabilities (k, N) of observations (k, 20, 258)."""
TRIES = 2
"""A press that is no observation is repeated once, as on the bench."""
TOPPLED = "The press tipped the bottom over its edge."
XY = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Model:
    """What the loop needs of a trained model: ``points_mm`` (N, 2) of the face."""

    predict: Predict
    points_mm: FloatArray
    base_rate: float | None


@dataclass(frozen=True, slots=True)
class Concluded:
    """One probe of a trial: where the command was, where the piece really stood on the bottom
    (``true_mm``), what was believed and chosen.
    """

    offset_mm: XY
    true_mm: XY
    map: BeliefMap
    stability: Stability
    action: PlaceAction


@dataclass(frozen=True, slots=True)
class TrialEnd:
    """How a trial ended. ``verdict``: the exact judge at the release, None without one.

    ``true_mm``: displacement of the piece at the end, where it was ever pressed.
    """

    seed: int
    outcome: Outcome
    reason: str
    probes: int
    verdict: Verdict | None
    true_mm: XY | None
    steps: tuple[Concluded, ...] = field(default=(), repr=False)

    def as_json(self) -> dict[str, Any]:
        """Return what a result keeps of it; a margin without any support is None."""
        verdict = self.verdict
        finite = (
            None
            if verdict is None
            else [round(float(m), 4) if np.isfinite(m) else None for m in verdict.margins_mm]
        )
        return {
            "seed": self.seed,
            "outcome": self.outcome.value,
            "reason": self.reason,
            "probes": self.probes,
            "margins_mm": finite,
        }


@dataclass
class _Trial:
    """A trial under way."""

    number: int
    scene: Scene
    here: XY
    reasoner: Reasoner | None = None
    steps: list[Concluded] = field(default_factory=list)
    tries: int = 0
    true_mm: XY | None = None
    end: TrialEnd | None = None

    def close(self, outcome: Outcome, reason: str, verdict: Verdict | None = None) -> None:
        """End the trial."""
        self.end = TrialEnd(
            self.scene.seed,
            outcome,
            reason,
            len(self.steps),
            verdict,
            self.true_mm,
            tuple(self.steps),
        )


def stack_in_lockstep(
    scenes: Sequence[Scene],
    model: Model,
    settings: StackSettings,
    limits: EpisodeLimits,
    reasoner: Callable[[Scene, XY], Reasoner] | None = None,
    world: type[Lockstep] = Lockstep,
) -> list[TrialEnd]:
    """Run one trial per scene to its end; the scenes share piece, touched surface and bench.

    ``reasoner`` begins a trial of a scene at a commanded place; None: the strategy of the settings.
    ``world``: in which to press.
    """
    bench = world(scenes, settings.probe)
    trials = []
    for number, (scene, at) in enumerate(zip(scenes, bench.start_commands_mm(), strict=True)):
        here = _pair(at)
        if reasoner is None:
            held = held_in(scene, model.base_rate)
            trials.append(_Trial(number, scene, here, begin(held, settings, here)))
        else:
            trials.append(_Trial(number, scene, here, reasoner(scene, here)))
    while active := [trial for trial in trials if trial.end is None]:
        felt = bench.press([t.number for t in active], np.array([t.here for t in active]))
        kept = _observed(active, felt, limits)
        if not kept:
            continue
        probability = model.predict(felt.observation[kept])
        for k, p in zip(kept, probability, strict=True):
            patch = ContactPatch(model.points_mm.copy(), p)
            _conclude(active[k], Touched(felt.observation[k], patch, active[k].here), bench)
    return [trial.end for trial in trials if trial.end is not None]


def held_in(scene: Scene, base_rate: float | None, below: Below | None = None) -> Held:
    """Return what a strategy may know of the piece in the hand."""
    height_mm, com = scene.settings.wrist.height_mm, scene.piece.com_xy_mm
    return Held(com, scene.grip_height_mm, base_rate, height_mm, below)


def pick_and_place_in_lockstep(
    scenes: Sequence[Scene], settings: StackSettings, limits: EpisodeLimits
) -> list[TrialEnd]:
    """Press once and let go, whatever was felt: what the paper compares with."""
    bench = Lockstep(scenes, settings.probe)
    commands = bench.start_commands_mm()
    felt = bench.press(range(len(scenes)), commands)
    ends = []
    for k, scene in enumerate(scenes):
        at = (float(commands[k, 0]), float(commands[k, 1]))
        trial = _Trial(k, scene, at)
        trial.true_mm = _pair(felt.true_mm[k])
        if felt.toppled[k]:
            trial.close(Outcome.KNOCKED_OVER, TOPPLED)
        elif felt.valid[k] and felt.press_n[k] >= limits.contact_n:
            _release(trial, bench)
        else:
            trial.close(Outcome.ABORTED, "The press ended without a contact.")
        assert trial.end is not None
        ends.append(trial.end)
    return ends


def _observed(active: list[_Trial], felt: Presses, limits: EpisodeLimits) -> list[int]:
    """Return which presses are observations; a trial whose press is none twice is aborted, unless
    its strategy can go on without a contact.
    """
    kept = []
    for k, trial in enumerate(active):
        trial.true_mm = _pair(felt.true_mm[k])
        if felt.toppled[k]:
            trial.close(Outcome.KNOCKED_OVER, TOPPLED)
            continue
        reasons = []
        if not felt.valid[k]:
            reasons.append("no contact was found")
        if not felt.press_n[k] >= limits.contact_n:
            reasons.append(f"press force {felt.press_n[k]:.1f} N")
        touchless = bool(reasons)
        if not felt.slip_mm[k] <= limits.slip_mm:
            reasons.append(f"slip {felt.slip_mm[k]:.2f} mm")
        if not reasons:
            trial.tries = 0
            kept.append(k)
            continue
        trial.tries += 1
        if trial.tries < TRIES:
            continue
        why = f"Probe {len(trial.steps) + 1} was rejected {TRIES} times: {'; '.join(reasons)}."
        if isinstance(trial.reasoner, SeekingReasoner) and touchless:
            _turn_away(trial, trial.reasoner)
        else:
            trial.close(Outcome.ABORTED, why)
    return kept


def _turn_away(trial: _Trial, reasoner: SeekingReasoner) -> None:
    """Let a strategy that asks for it go on elsewhere."""
    action = reasoner.missed(trial.here)
    if action.kind == "give_up":
        trial.close(Outcome.GAVE_UP, action.reason)
    else:
        trial.here = (trial.here[0] + action.step_mm[0], trial.here[1] + action.step_mm[1])
        trial.tries = 0


def _conclude(trial: _Trial, touched: Touched, bench: Lockstep) -> None:
    here = trial.here
    assert trial.reasoner is not None
    assert trial.true_mm is not None
    concluded = trial.reasoner.conclude(touched)
    action = concluded.action
    step = Concluded(here, trial.true_mm, concluded.map, concluded.stability, action)
    trial.steps.append(step)
    if action.kind == "release":
        _release(trial, bench)
    elif action.kind == "give_up":
        trial.close(Outcome.GAVE_UP, action.reason)
    else:
        trial.here = (here[0] + action.step_mm[0], here[1] + action.step_mm[1])


def _release(trial: _Trial, bench: Lockstep) -> None:
    """Let the exact judge of the whole tower decide, as the simulated bench does."""
    assert trial.true_mm is not None
    kick = release_kick_mm(trial.scene, 1)
    yaw = bench.grippings[trial.number].yaw_rad
    scene = replace(trial.scene, bottoms=bench.bottoms[trial.number])
    verdict = judge(stacked(scene, trial.true_mm, yaw), kick)
    outcome = Outcome.PLACED if verdict.stands else Outcome.FELL
    trial.close(outcome, f"Margin {verdict.margin_mm:+.2f} mm.", verdict)


def _pair(values: FloatArray) -> XY:
    return float(values[0]), float(values[1])
