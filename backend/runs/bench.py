"""Bench of a trial as seen by a plan: devices, sensing, estimator, operator prompt, store."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.annotations import Dataset
from touchdown.backend.calibration import UNCALIBRATED, CalibratedPositions
from touchdown.backend.config import BenchDescription, StackSettings
from touchdown.backend.core import (
    Clock,
    ContactPatch,
    Episode,
    EpisodeDecision,
    Fall,
    Fault,
    FloatArray,
    ImageArray,
    InputError,
    Outcome,
    PlaceAction,
    Pose,
    RepaintHold,
    Stability,
)
from touchdown.backend.devices import Arm, Device, Gripper, GuardedArm, GuardedGripper, Interlock
from touchdown.backend.geometry import Outline, Piece, PieceLibrary
from touchdown.backend.placement import SupportTower
from touchdown.backend.runs.requests import RunStatus, SceneChoice
from touchdown.backend.sensing import Homography, LiveSensing, RawStreams


class PendingDecision:
    """Holds the latest decision about the latest episode, whether it was asked for or not."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._decision: EpisodeDecision | None = None

    @property
    def given(self) -> bool:
        """Whether a decision waits to be carried out."""
        return self._decision is not None

    def give(self, decision: EpisodeDecision) -> None:
        """Decide; a later word replaces an earlier one that was not carried out yet."""
        with self._lock:
            self._decision = decision

    def take(self) -> EpisodeDecision | None:
        """Return the decision, if there is one, and forget it."""
        with self._lock:
            decision, self._decision = self._decision, None
            return decision


class OperatorPrompt:
    """Holds one answer. The plan asks and looks; the operator answers from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = False
        self._answer: bool | None = None
        self._seen: tuple[Outcome, str] | None = None

    def ask(self) -> None:
        """Forget an old answer and wait for a new one."""
        with self._lock:
            self._asked, self._answer, self._seen = True, None, None

    def answer(self, yes: bool) -> None:
        """Answer the open question; without one this does nothing."""
        with self._lock:
            if self._asked:
                self._asked, self._answer = False, yes

    def see(self, outcome: Outcome, reason: str) -> None:
        """Say what became of a piece; without an open question this does nothing."""
        with self._lock:
            if self._asked:
                self._asked, self._seen = False, (outcome, reason)

    @property
    def seen(self) -> tuple[Outcome, str] | None:
        """What the operator saw, and the reason they gave; None before they said it."""
        return self._seen

    @property
    def answered(self) -> bool:
        """Whether the last question has an answer."""
        return self._answer is not None

    @property
    def yes(self) -> bool:
        """Whether the answer was yes."""
        return self._answer is True


@dataclass(frozen=True, slots=True)
class PressedProbe:
    """A probe as felt: ``ended_s`` bench time of its last sample, ``sampled_s`` the wall clock then
    (for the decision latency only).
    """

    episode: Episode
    probe: int
    ended_s: float
    sampled_s: float


@dataclass(frozen=True, slots=True)
class JudgedProbe:
    """A felt probe with the conclusion, reached at bench time ``at_s`` while still pressed."""

    felt: PressedProbe
    stability: Stability
    action: PlaceAction
    at_s: float


class PatchEstimator(Protocol):
    """What the method needs of a trained model."""

    @property
    def base_rate(self) -> float | None:
        """Share of contact points in its training data, for the prior correction."""

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Take the first ticks of the probe in progress, so that its estimate is quick."""

    def estimate(self, episode: Episode) -> ContactPatch:
        """Return the contact patch of one episode."""


class NoEstimator:
    """Stands in where a run needs no model, such as collecting the data that trains one."""

    base_rate: float | None = None

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Nothing to prepare."""

    def estimate(self, episode: Episode) -> ContactPatch:
        """Raise ``InputError``: there is nothing to estimate with."""
        raise InputError(
            f"No model of '{episode.piece}' is loaded.", "model", "Train one, or name one."
        )


class EpisodeStore(Protocol):
    """Where episodes go; ``keep`` returns at once, ``settle`` when the file is durable.

    ``written``: whether ``settle`` would return, or raise, at once.
    """

    def keep(self, episode: Episode) -> None:
        """Begin to write ``episode``."""

    @property
    def written(self) -> bool:
        """Whether nothing is on its way to the disk."""

    def settle(self) -> Path | None:
        """Wait for the last write; return the path of its file, None if files are not kept.

        Raises ``FaultError`` where the disk refused; asked again it writes once more.
        """

    def obstacle(self) -> Fault | None:
        """Return what keeps the run from recording another probe, None if nothing does."""


@dataclass(frozen=True, slots=True)
class SceneView:
    """The scene camera: ``picture`` (h, w, 3) of the bench now, and where the board is in it."""

    picture: Callable[[], ImageArray]
    homography: Homography


@dataclass(frozen=True, slots=True)
class ReleaseVerdict:
    """What a bench with known truth says after the jaws opened.

    ``contradicted``: a second judge says otherwise beyond its own error (None if not asked).
    """

    stands: bool
    knocked_over: bool
    margin_mm: float
    fall: Fall | None
    contradicted: bool | None = None


class GroundTruth(Protocol):
    """The truth of a simulated bench, for scoring only: the method never sees it."""

    def start_mm(self) -> tuple[float, float]:
        """Return the true offset at the start of the trial."""

    def least_probes(self) -> int:
        """Return the least number of probes that any policy would need."""

    def verdict(self) -> ReleaseVerdict:
        """Judge the scene as it is now."""


@dataclass(frozen=True, slots=True)
class Bench:
    """One trial's bench. ``now_s`` is its clock; ``scoring`` is None where truth is unknown.

    ``wall_s`` measures decision latency only; ``status`` returns the progress of the run; ``hush``
    keeps decisions undisturbed;
    ``outline`` of the surface that is touched; ``jig``: pose of ``G`` with the piece in its jig, or
    where the piece is ``handed`` over by the operator. ``wrench_late_s``: age of a wrench sample
    when it comes. ``calibrations``: pairs that every episode keeps. ``sensor_height_mm``: wrist
    sensor above the grasp pivot, None where nobody told. ``below``: the tower under the touched
    surface as it was entered, None for a single bottom.
    """

    now_s: Callable[[], float]
    arm: GuardedArm
    gripper: GuardedGripper
    interlock: Interlock
    sensing: LiveSensing
    estimator: PatchEstimator
    piece: Piece
    bottom: str
    store: EpisodeStore
    gate: OperatorPrompt
    settings: StackSettings
    scoring: GroundTruth | None
    wall_s: Callable[[], float]
    status: Callable[[], RunStatus]
    hush: RepaintHold
    outline: Outline
    jig: Pose | None
    scene_view: SceneView | None = None
    handed: bool = False
    wrench_late_s: float = 0.0
    calibrations: tuple[tuple[str, str], ...] = ()
    sensor_height_mm: float | None = None
    below: SupportTower | None = None
    placed: CalibratedPositions = UNCALIBRATED
    """What board and tool say of places."""
    real_time: bool = False
    """Time passes by itself: who waits for something else must let the sensors be read."""


SET_S = 120.0
"""Setting a scene takes so long at most: emulated devices are made and connected anew."""
SceneCheck = Callable[[SceneChoice], Mapping[str, object]]
"""Raises ``InputError`` before anything is written or moved; else returns what a run on the scene
depends on beside request and method, JSON-ready: bench settings, model, program."""


@dataclass(frozen=True, slots=True)
class SceneDevices:
    """Unguarded devices of one scene. ``advance`` moves the bench's time by so many microseconds.

    ``devices`` names all five for the chips; ``scoring`` is None where the truth is unknown;
    ``payload`` (6,) is the calibrated weight below the sensor, N and N·m. ``jig``: taught pose of
    ``G`` with the piece in its jig, None where there is no jig. ``outline`` of the touched face.
    ``wrench_late_s``: age of a wrench sample when it comes. ``real_time``: time passes by itself.
    """

    clock: Clock
    devices: Mapping[str, Device]
    arm: Arm
    gripper: Gripper
    piece: Piece
    bottom: str
    advance: Callable[[int], None]
    scoring: GroundTruth | None
    estimator: PatchEstimator
    payload: FloatArray
    outline: Outline
    jig: Pose | None = None
    scene_view: SceneView | None = None
    wrench_late_s: float = 0.0
    real_time: bool = False


class SceneFactory(Protocol):
    """Builds a scene on the streams of a session."""

    def __call__(self, choice: SceneChoice, raw: RawStreams) -> SceneDevices:
        """Return the stage; raises ``InputError`` for an unknown piece, bottom or model."""


class RunContext(Protocol):
    """Part of a session that a plan uses. All calls come from the plan, on the bench's own time."""

    @property
    def run_id(self) -> str:
        """Identifier of the run: UTC start time, also the name of its folder."""

    @property
    def simulated(self) -> bool:
        """Whether the bench is simulated."""

    @property
    def mode(self) -> str:
        """Kind of bench that episodes record: stepped, live simulation, emulated or lab."""

    @property
    def facts(self) -> BenchDescription:
        """Description of the bench that episodes record."""

    @property
    def dataset(self) -> Dataset | None:
        """Dataset that takes collected episodes, None if none is open."""

    @property
    def decisions(self) -> PendingDecision:
        """Decision of the operator on the newest collected episode."""

    @property
    def catalogue(self) -> PieceLibrary:
        """Pieces and bottoms by name."""

    @property
    def method(self) -> StackSettings:
        """Settings of the method before those of the request."""

    def check_scene(self, choice: SceneChoice) -> Mapping[str, object]:
        """Return the settings a run on ``choice`` depends on, JSON-ready; raises ``InputError``."""

    def open_record(self) -> None:
        """Open event log and episode store of the run; raises ``InputError``."""

    def set_scene(self, choice: SceneChoice, method: StackSettings) -> Bench:
        """Build a new scene, whose clock starts at zero, and return its bench."""

    def present_scene(self, method: StackSettings) -> Bench:
        """Return the bench of the present scene; raises ``RefusedError`` if there is none."""
