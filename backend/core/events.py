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
    """Base of every fact; ``t_s`` is the bench clock."""

    t_s: float


@dataclass(frozen=True, slots=True)
class RunStarted(Event):
    """A run began; ``settings`` is a JSON text of everything it depends on.

    ``activity`` is what was asked for: stack (with a ``strategy``), or another plan of the bench.
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
    """One trial of a run began. The bench clock starts again at zero with each trial.

    ``start_mm`` is the true start offset on a simulated bench (kept out of the method's sight).
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
    """A probe became an episode; ``path``: name of its file ("" if it is not kept).

    The episode comes without its recording: the native-rate signals are in the file.
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
    """The estimate whether the piece would stand here."""

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
    """The run waits for the operator's yes to this action; the arm is lifted."""

    action: PlaceAction
    probe: int


@dataclass(frozen=True, slots=True)
class SetUpAwaited(Event):
    """A trial waits until the operator has put ``bottom`` in its place; nothing moves before.

    ``start_mm``: where the face of ``piece`` will be over it, drawn from the offsets at which it
    would fall. ``holds``: the gripper has the piece already, else it is handed over next.
    """

    piece: str
    bottom: str
    start_mm: tuple[float, float]
    holds: bool


@dataclass(frozen=True, slots=True)
class OutcomeAwaited(Event):
    """The piece was let go where the truth is not known: the operator says what became of it.

    ``proposed`` is what wrist and gripper speak for, and ``why``.
    """

    proposed: Outcome
    why: str


@dataclass(frozen=True, slots=True)
class PhotoKept(Event):
    """A picture of trial ``trial`` was put beside the journal; ``path``: name of its file."""

    trial: int
    path: str


@dataclass(frozen=True, slots=True)
class Released(Event):
    """The gripper opened; ``fall`` is there if the piece fell on a bench that can animate it."""

    probe: int
    stands: bool
    true_margin_mm: float | None
    fall: Fall | None


@dataclass(frozen=True, slots=True)
class TrialFinished(Event):
    """How the trial ended. ``margin_mm``: true margin on a simulated bench, else the estimate.

    ``excess_probes``: probes beyond the least number that 3 mm steps need (None if unknown).
    ``contradicted``: a second judge of the release says otherwise (None if none was asked).
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
    """A campaign goes on to collect; ``done`` of ``total`` probes are there already.

    ``dataset``: its folder. ``series``: what is recorded until the run ends or the bottom is fitted
    anew.
    """

    campaign: str
    series: str
    dataset: str
    done: int
    total: int


@dataclass(frozen=True, slots=True)
class Gripped(Event):
    """The piece was taken: gripping ``grip`` (1, 2, ...) of mounting ``mounting``, and its mass."""

    grip: int
    mounting: int
    mass_g: float


@dataclass(frozen=True, slots=True)
class OriginChecked(Event):
    """The edges of the bottom were felt: its centre minus the origin, in mm.

    ``sigma_mm``: standard uncertainty per axis; ``agrees``: the residual is within three of them.
    """

    residual_mm: tuple[float, float]
    sigma_mm: float
    agrees: bool


@dataclass(frozen=True, slots=True)
class CalibrationMeasured(Event):
    """A calibration was measured; it holds once a person accepts it.

    ``values`` by ``names``, each with its standard uncertainty and unit; ``residual`` and its
    ``limit`` in ``unit``, ``residuals`` per measurement. ``obstacle``: what stands against it
    whatever the residual, "" if nothing does; ``note``: what it leaves open. ``about``: which piece
    on which bottom. ``gels_px``: of cameras the u and v of the 63 resting dots of the left picture,
    then of the right one; empty where they were not seen at rest.
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
        """Whether the residual is within its limit and nothing stands against it."""
        return self.residual <= self.limit and not self.obstacle


EpisodeDecision = Literal["keep", "discard", "redo", "flag", "skip"]


@dataclass(frozen=True, slots=True)
class DecisionAwaited(Event):
    """The campaign waits whether to keep the episode that was just recorded; nothing moves."""

    uuid: str
    item: int


@dataclass(frozen=True, slots=True)
class HandOverAwaited(Event):
    """The campaign waits for the operator's hand at the jaws; nothing moves until they confirm.

    ``gives``: they hold ``piece`` between the open jaws, which then close; else they take hold of
    it, and the jaws open. ``anew``: they fit ``piece``, the bottom, and the gels anew instead.
    """

    piece: str
    gives: bool
    anew: bool = False


@dataclass(frozen=True, slots=True)
class MountingAwaited(Event):
    """A campaign that goes on waits to be told whether it still has the mounting that it had.

    Yes: ``bottom``, or the gels, were fitted anew since ``mounting`` (1, 2, ...); no: all is as it
    was then.
    """

    bottom: str
    mounting: int


@dataclass(frozen=True, slots=True)
class ProbeCollected(Event):
    """A probe of a campaign is durable in the dataset, together with its label.

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
    """What was decided about a recorded episode, and by whom."""

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
    """The run paused by itself at a safe place and loses nothing: it goes on when it is resumed.

    ``fault``: what keeps it from going on; nothing is latched.
    """

    fault: Fault


@dataclass(frozen=True, slots=True)
class Noticed(Event):
    """Something is not as it should be; nothing is latched, and what goes on goes on."""

    fault: Fault

    @property
    def text(self) -> str:
        """What it is and what to do, as one paragraph."""
        return f"{self.fault.what} {self.fault.next_step}"


@dataclass(frozen=True, slots=True)
class FaultsReset(Event):
    """The operator reset the latched faults and the stop latch."""


@dataclass(frozen=True, slots=True)
class Progress(Event):
    """Long work goes on: ``done`` of ``total``, in words."""

    done: int
    total: int
    text: str


@dataclass(frozen=True, slots=True)
class Said(Event):
    """A sentence for the operator (the narration)."""

    text: str


@dataclass(frozen=True, slots=True)
class Refused(Event):
    """An order by hand was refused or ended: name of the condition, sentence for the operator."""

    reason: str
    text: str
