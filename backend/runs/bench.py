"""Bench of a trial as seen by a plan: devices, sensing, estimator, operator prompt, store."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core
from touchdown.backend.annotations import Dataset
from touchdown.backend.calibration import UNCALIBRATED, CalibratedPositions, DayChecks
from touchdown.backend.config import BenchDescription, BenchIdentity, StackSettings
from touchdown.backend.devices import Arm, Device, Gripper, GuardedArm, GuardedGripper, Interlock
from touchdown.backend.geometry import Outline, Piece, PieceLibrary
from touchdown.backend.learning import PatchCalibration
from touchdown.backend.learning.fused import Guard
from touchdown.backend.placement import SupportTower
from touchdown.backend.runs.recorder import RunStore
from touchdown.backend.runs.requests import RunStatus, SceneChoice
from touchdown.backend.sensing import Homography, LiveSensing


class OperatorPrompt:
    """One open question to the operator. The plan polls; the answer comes from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = False
        # A window or a terminal shows questions of a run that was to need none
        self.attended = False
        self.number: int = 0  # of the last question
        # Reply to the last question, None before it
        self.reply: bool | None = None
        self.seen: tuple[core.Outcome, str] | None = None  # observed outcome and its reason

    def ask(self) -> None:
        """Open a question and clear the previous answer."""
        with self._lock:
            self._asked, self.reply, self.seen = True, None, None
            self.number += 1

    def answer(self, yes: bool, number: int | None = None) -> None:
        """Answer the open question, or the question ``number``; ignored if it is not open."""
        with self._lock:
            if self._asked and number in (None, self.number):
                self._asked, self.reply = False, yes

    def withdraw(self) -> bool | None:
        """Close the open question; return its reply, None without one."""
        with self._lock:
            self._asked = False
            return self.reply

    def see(self, outcome: core.Outcome, reason: str) -> None:
        """Answer the open question with the observed outcome; ignored without one."""
        with self._lock:
            if self._asked:
                self._asked, self.seen = False, (outcome, reason)


@dataclass(frozen=True, slots=True)
class PressedProbe:
    """Pressed probe with its episode.

    ``ended_s`` is the bench time of the last sample. ``sampled_s`` is the wall clock at that
    moment, used for the decision latency only.
    """

    episode: core.Episode
    probe: int
    ended_s: float
    sampled_s: float


@dataclass(frozen=True, slots=True)
class JudgedProbe:
    """Pressed probe with the decision on it, made at bench time ``at_s`` while still pressed."""

    pressed: PressedProbe
    stability: core.Stability
    action: core.PlaceAction
    at_s: float


class PatchEstimator(Protocol):
    """Contact patch estimator as used by a run."""

    @property
    def base_rate(self) -> float | None:
        """Share of contact points in its training data, for the prior correction."""

    @property
    def calibration(self) -> PatchCalibration | None:
        """Calibration of its probabilities, None if none was fitted."""

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Process the first ticks of the probe in progress to shorten its estimate."""

    def estimate(self, episode: core.Episode) -> core.ContactPatch:
        """Return the contact patch of one episode."""


class NoEstimator:
    """Placeholder for runs that need no model, such as data collection.

    ``points_mm`` (N, 2): lattice of the face. With it every point of a patch is as likely in
    contact as not, for strategies that read the signals themselves.
    """

    base_rate: float | None = None
    calibration: PatchCalibration | None = None

    def __init__(self, points_mm: core.FloatArray | None = None) -> None:
        self._points_mm = points_mm

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Do nothing."""

    def estimate(self, episode: core.Episode) -> core.ContactPatch:
        """Return the unknown patch; raises ``InputError`` without a face."""
        if self._points_mm is None:
            raise core.InputError(
                f"No model of '{episode.piece}' is loaded.", "model", "Train one, or name one."
            )
        return core.ContactPatch(self._points_mm.copy(), np.full(len(self._points_mm), 0.5))


@dataclass(frozen=True, slots=True)
class SceneView:
    """Scene camera: ``picture`` returns (h, w, 3); ``homography`` maps the board to the picture."""

    picture: Callable[[], core.ImageArray]
    homography: Homography


@dataclass(frozen=True, slots=True)
class ReleaseVerdict:
    """Ground truth after the gripper opened.

    ``contradicted``: a second judge disagrees beyond its own error (None if there was none).
    ``kick_mm``: distance by which the opening fingers shifted the centre of mass.
    """

    stands: bool
    knocked_over: bool
    margin_mm: float
    fall: core.Fall | None
    contradicted: bool | None = None
    kick_mm: float = 0.0


class GroundTruth(Protocol):
    """Ground truth of a simulated bench, for scoring only."""

    def start_mm(self) -> tuple[float, float]:
        """Return the true offset at the start of the trial."""

    def least_probes(self) -> int:
        """Return the least number of probes that any policy needs."""

    def verdict(self) -> ReleaseVerdict:
        """Judge the scene in its present state."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneFacts:
    """Properties of one scene, for its devices and for the bench of a run on it.

    ``scoring`` is None where the truth is unknown. ``outline`` is the touched surface. ``jig`` is
    the pose of ``G`` with the piece in its jig, None without a taught one. ``wrench_late_s`` is the
    age of a wrench sample on arrival. ``real_time``: time passes by itself, so waits must let the
    sensors be read.
    """

    estimator: PatchEstimator
    piece: Piece
    bottom: str
    scoring: GroundTruth | None
    outline: Outline
    jig: core.Pose | None = None
    scene_view: SceneView | None = None
    wrench_late_s: float = 0.0
    real_time: bool = False

    def facts(self) -> dict[str, Any]:
        """Return these properties by name."""
        return {field.name: getattr(self, field.name) for field in fields(SceneFacts)}


@dataclass(frozen=True, slots=True, kw_only=True)
class Bench(SceneFacts):
    """Bench of one run on one scene.

    Attributes beyond their types: ``now_s`` returns the bench time, ``wall_s`` the wall clock (for
    the decision latency only), ``status`` the progress of the run. ``jig`` is the pose at the
    hand-over when ``handed`` is set. ``calibrations`` are metadata of every episode.
    ``com_sigma_mm`` is the standard uncertainty of a weighed centre of mass. ``sensor_height_mm``
    is the wrist sensor above the grasp pivot, None if unknown. ``below`` is the tower under the
    touched surface as entered, None for a single bottom. ``placed`` holds the calibrated positions
    of board and tool. ``started_ns`` is the wall clock at bench time zero, ns since 1970.
    ``guard``: comparison of the signals with a calibration. ``withheld``: ``DayChecks.obstacle``.
    """

    now_s: Callable[[], float]
    arm: GuardedArm
    gripper: GuardedGripper
    interlock: Interlock
    sensing: LiveSensing
    store: RunStore
    prompt: OperatorPrompt
    settings: StackSettings
    wall_s: Callable[[], float]
    status: Callable[[], RunStatus]
    repaint_hold: core.RepaintHold
    handed: bool = False
    calibrations: tuple[tuple[str, str], ...] = ()
    sensor_height_mm: float | None = None
    com_sigma_mm: float = 0.0
    below: SupportTower | None = None
    placed: CalibratedPositions = UNCALIBRATED
    started_ns: int = 0
    guard: Guard | None = None
    withheld: str = ""


SCENE_TIMEOUT_S = 120.0  # longest time to set a scene, with emulated devices to start
# Returns the settings a run on the scene depends on, JSON-ready: bench, model, program. Raises
# ``InputError`` before anything is written or moved.
SceneCheck = Callable[[SceneChoice], Mapping[str, object]]


@dataclass(frozen=True, slots=True, kw_only=True)
class SceneDevices(SceneFacts):
    """Unguarded devices of one scene, made by a kind of bench.

    ``devices`` has all five by name. ``advance`` moves the bench time by a number of microseconds.
    ``payload`` (6,) is the calibrated weight below the wrist sensor, N and N·m. ``rests`` returns
    True if the next samples can be predicted: only of a simulation.
    """

    clock: core.Clock
    devices: Mapping[str, Device]
    arm: Arm
    gripper: Gripper
    advance: Callable[[int], None]
    payload: core.FloatArray
    rests: Callable[[], bool] = lambda: False


# Builds the devices of a scene on the streams of a session. Raises ``InputError`` for an unknown
# piece, bottom or model.
SceneFactory = Callable[[SceneChoice, core.RawStreams], SceneDevices]


class RunContext(Protocol):
    """Part of a session that a plan uses. Plans call it on the thread of the bench."""

    run_id: str  # UTC start time of the run, also the name of its folder
    simulated: bool
    mode: str  # recorded with episodes: stepped, live simulation, emulated or lab
    description: BenchDescription  # recorded with episodes
    identity: BenchIdentity  # the one that a certificate must name
    dataset: Dataset | None  # takes collected episodes
    decisions: deque[core.EpisodeDecision]  # newest decision on the newest episode, if pending
    catalogue: PieceLibrary
    method: StackSettings  # before the settings of the request

    @property
    def day_checks(self) -> DayChecks:
        """Return the daily checks of the bench."""

    def check_scene(self, choice: SceneChoice) -> Mapping[str, object]:
        """Return the settings a run on ``choice`` depends on, JSON-ready; raises ``InputError``."""

    def open_record(self) -> None:
        """Open event log and episode store of the run; raises ``InputError``."""

    def guard_of(self, method: StackSettings) -> Guard | None:
        """Return the guard of the network of ``method`` here, None without a calibration."""

    def set_scene(self, choice: SceneChoice, method: StackSettings) -> Bench:
        """Build a new scene, whose clock starts at zero, and return its bench."""

    def present_scene(self, method: StackSettings) -> Bench:
        """Return the bench of the present scene; raises ``RefusedError`` if there is none."""
