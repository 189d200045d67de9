"""Events published by a bench.

Events are the run log: the event log writes them, the window shows them, tests assert on them,
replay publishes them again. Class and field names are recorded on disk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from touchdown.backend.core.faults import Fault
from touchdown.backend.core.values import (
    BeliefMap,
    ContactPatch,
    Episode,
    Fall,
    Outcome,
    PlaceAction,
    Stability,
)


@dataclass(frozen=True, slots=True)
class Event:
    """Base of all events; ``t_s`` is the bench clock."""

    t_s: float


@dataclass(frozen=True, slots=True)
class RunStarted(Event):
    """A run began; ``settings`` is a JSON text of everything it depends on.

    ``activity``: "stack" (with a ``strategy``), or the name of another plan.
    """

    run_id: str
    piece: str
    bottom: str
    strategy: str
    seed: int
    trials: int
    simulated: bool
    settings: str
    activity: str = "stack"


@dataclass(frozen=True, slots=True)
class TrialStarted(Event):
    """One trial of a run began. The bench clock restarts at zero with each trial.

    ``start_mm``: true start offset on a simulated bench, not available to the method.
    """

    trial: int
    seed: int
    start_mm: tuple[float, float] | None


ProbePhase = Literal[
    "grip", "reference", "approach", "press", "hold", "lift", "shift", "unload", "release", "rise"
]


@dataclass(frozen=True, slots=True)
class PhaseEntered(Event):
    """The arm or gripper entered a named phase of probe ``probe`` (1, 2, ...)."""

    phase: ProbePhase
    probe: int


@dataclass(frozen=True, slots=True)
class EpisodeRecorded(Event):
    """A probe was assembled into an episode; ``path``: name of its file ("" if not kept).

    The episode has no recording here; the native-rate signals are in the file.
    """

    episode: Episode
    probe: int
    path: str


@dataclass(frozen=True, slots=True)
class PatchEstimated(Event):
    """The model estimated the contact patch of this probe."""

    patch: ContactPatch
    offset_mm: tuple[float, float]
    probe: int


@dataclass(frozen=True, slots=True)
class BeliefUpdated(Event):
    """The belief map after fusing this probe."""

    belief: BeliefMap
    probe: int


@dataclass(frozen=True, slots=True)
class StabilityJudged(Event):
    """Estimated stability of the piece at this position."""

    stability: Stability
    probe: int


@dataclass(frozen=True, slots=True)
class ActionChosen(Event):
    """The next action and the decision latency (last sample of the probe to action)."""

    action: PlaceAction
    probe: int
    latency_ms: float


@dataclass(frozen=True, slots=True)
class ApprovalAwaited(Event):
    """The run waits for approval of this action; the arm is lifted."""

    action: PlaceAction
    probe: int


@dataclass(frozen=True, slots=True)
class SetUpAwaited(Event):
    """A trial waits until the operator has placed ``bottom``; nothing moves before.

    ``start_mm``: start offset of the face of ``piece``, drawn from those at which it would fall.
    ``holds``: True if the gripper already holds the piece; else it is handed over next.
    """

    piece: str
    bottom: str
    start_mm: tuple[float, float]
    holds: bool


@dataclass(frozen=True, slots=True)
class OutcomeAwaited(Event):
    """The piece was released on a bench without ground truth; the operator enters the outcome.

    ``proposed``: outcome suggested by wrist sensor and gripper; ``why``: the reason.
    """

    proposed: Outcome
    why: str


@dataclass(frozen=True, slots=True)
class PhotoKept(Event):
    """An image of trial ``trial`` was saved beside the event log; ``path``: name of its file."""

    trial: int
    path: str


@dataclass(frozen=True, slots=True)
class Released(Event):
    """The gripper opened; ``fall``: motion of a fallen piece if the bench can animate it."""

    probe: int
    stands: bool
    true_margin_mm: float | None
    fall: Fall | None


@dataclass(frozen=True, slots=True)
class TrialFinished(Event):
    """End of a trial. ``margin_mm``: true margin on a simulated bench, else the estimate.

    ``excess_probes``: probes beyond the minimum for steps of 3 mm (None if unknown).
    ``contradicted``: True if a second simulation disagrees (None if there was none).
    """

    trial: int
    seed: int
    outcome: Outcome
    reason: str
    probes: int
    excess_probes: int | None
    margin_mm: float | None
    contradicted: bool | None = None


@dataclass(frozen=True, slots=True)
class RunFinished(Event):
    """The run ended: finished, cancelled, stopped or failed (with the reason)."""

    run_id: str
    ending: Literal["finished", "cancelled", "stopped", "failed"]
    reason: str


@dataclass(frozen=True, slots=True)
class CampaignBegan(Event):
    """A campaign starts or resumes; ``done`` of ``total`` probes exist already.

    ``dataset``: its folder. ``series``: recordings until the run ends or the bottom is mounted
    again.
    """

    campaign: str
    series: str
    dataset: str
    done: int
    total: int


@dataclass(frozen=True, slots=True)
class Gripped(Event):
    """The piece was gripped: ``grip`` (1, 2, ...) of mounting ``mounting``, and its mass."""

    grip: int
    mounting: int
    mass_g: float


@dataclass(frozen=True, slots=True)
class OriginChecked(Event):
    """The edges of the bottom were measured; ``residual_mm``: its centre minus the origin.

    ``sigma_mm``: standard uncertainty per axis; ``agrees``: the residual is within three sigma.
    """

    residual_mm: tuple[float, float]
    sigma_mm: float
    agrees: bool


@dataclass(frozen=True, slots=True)
class PieceWeighed(Event):
    """The held piece was weighed: mass, and centre of mass from the face centre along x and y.

    The standard uncertainties of both enter the decisions of the trial.
    """

    mass_g: float
    mass_sigma_g: float
    com_xy_mm: tuple[float, float]
    sigma_mm: tuple[float, float]


@dataclass(frozen=True, slots=True)
class CalibrationMeasured(Event):
    """A calibration was measured; it becomes valid when a person accepts it.

    ``values`` by ``names``, each with its standard uncertainty and unit; ``residual`` and its
    ``limit`` in ``unit``, ``residuals`` per measurement. ``obstacle``: reason for
    refusal independent of the residual, or ""; ``note``: limitations. ``about``: piece and bottom.
    ``gels_px``: for cameras, u and v of the 63 dots at rest, left image then right; empty if not
    seen at rest.
    """

    what: str
    names: tuple[str, ...]
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    units: tuple[str, ...]
    residuals: tuple[float, ...]
    residual: float
    limit: float
    unit: str
    note: str
    obstacle: str
    about: str = ""
    gels_px: tuple[float, ...] = ()

    @property
    def acceptable(self) -> bool:
        """True if the residual is within its limit and there is no obstacle."""
        return self.residual <= self.limit and not self.obstacle


EpisodeDecision = Literal["keep", "discard", "redo", "flag", "skip"]


@dataclass(frozen=True, slots=True)
class DecisionAwaited(Event):
    """The campaign waits for a decision on the last episode; nothing moves."""

    uuid: str
    item: int


@dataclass(frozen=True, slots=True)
class HandOverAwaited(Event):
    """The campaign waits for the operator at the jaws; nothing moves until they confirm.

    ``gives``: True if they hold ``piece`` between the open jaws, which then close; else they take
    it, and the jaws open. ``anew``: they mount ``piece`` (the bottom) and the gels again instead.
    """

    piece: str
    gives: bool
    anew: bool = False


@dataclass(frozen=True, slots=True)
class MountingAwaited(Event):
    """A resumed campaign waits for the operator to confirm its mounting.

    Yes: ``bottom`` or the gels were mounted again since ``mounting`` (1, 2, ...); no: unchanged.
    """

    bottom: str
    mounting: int


@dataclass(frozen=True, slots=True)
class ProbeCollected(Event):
    """A probe of a campaign and its label were stored in the dataset.

    ``item`` of the plan; ``done`` of ``total`` after it. ``commanded_mm`` and ``measured_mm``
    displacement, and the standard uncertainty ``sigma_mm`` of the measured one. ``signals`` (5,) at
    the last tick, for the distribution: largest marker shift u and v in px, Tx and Ty in N·m, Fz
    in N. ``reasons``: why it is no observation ("" if it is one).
    """

    uuid: str
    item: int
    probe: int
    done: int
    total: int
    commanded_mm: tuple[float, float]
    measured_mm: tuple[float, float]
    sigma_mm: float
    signals: tuple[float, float, float, float, float]
    slip_mm: float
    drift_mm: float
    reasons: str


@dataclass(frozen=True, slots=True)
class EpisodeDecided(Event):
    """A decision on a recorded episode, and the person."""

    uuid: str
    item: int
    decision: EpisodeDecision
    person: str


@dataclass(frozen=True, slots=True)
class FaultRaised(Event):
    """A fault was latched."""

    fault: Fault


@dataclass(frozen=True, slots=True)
class Paused(Event):
    """The run paused at a safe position and can be resumed without loss.

    ``fault``: reason of the pause; nothing is latched.
    """

    fault: Fault


@dataclass(frozen=True, slots=True)
class Noticed(Event):
    """A warning: nothing is latched and the activity continues."""

    fault: Fault

    @property
    def text(self) -> str:
        """Problem and next step as one paragraph."""
        return f"{self.fault.what} {self.fault.next_step}"


@dataclass(frozen=True, slots=True)
class FaultsReset(Event):
    """The operator reset the latched faults and the stop latch."""


@dataclass(frozen=True, slots=True)
class Progress(Event):
    """Progress of a long task: ``done`` of ``total``, and a text."""

    done: int
    total: int
    text: str


@dataclass(frozen=True, slots=True)
class Said(Event):
    """A sentence for the operator (the narration)."""

    text: str


@dataclass(frozen=True, slots=True)
class Refused(Event):
    """A manual command was refused or ended: name of the condition, sentence for the operator."""

    reason: str
    text: str
