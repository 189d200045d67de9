"""The record of everything a plan works with: guarded devices, sensing, model, store."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from backend.calibration.applied import NOWHERE, Placed
from backend.config.method import StackSettings
from backend.core.faults import Fault, InputError
from backend.core.flow import ContactPatch, Episode, Fall, ImageArray, Pose
from backend.core.hush import Hush
from backend.devices.guarded import GuardedArm, GuardedGripper
from backend.devices.interlock import Interlock
from backend.objects.catalogue import Piece
from backend.objects.shapes import Outline
from backend.placement.below import Below
from backend.runs.gate import Gate
from backend.sensing.board import Homography
from backend.sensing.live import LiveSensing


class Estimate(Protocol):
    """What the method needs of a trained model."""

    @property
    def base_rate(self) -> float | None:
        """Share of contact points in its training data, for the prior correction."""

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Take the first ticks of the probe in progress, so that its estimate is quick."""

    def estimate(self, episode: Episode) -> ContactPatch:
        """Return the contact patch of one episode."""


class NoModel:
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


class Scoring(Protocol):
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

    ``wall_s`` measures decision latency only; ``probe_count`` says how far the trial has come,
    ``felt_count`` how many of its probes gave an estimate; ``hush`` keeps decisions undisturbed;
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
    estimator: Estimate
    piece: Piece
    bottom: str
    store: EpisodeStore
    gate: Gate
    settings: StackSettings
    scoring: Scoring | None
    wall_s: Callable[[], float]
    probe_count: Callable[[], int]
    felt_count: Callable[[], int]
    hush: Hush
    outline: Outline
    jig: Pose | None
    scene_view: SceneView | None = None
    handed: bool = False
    wrench_late_s: float = 0.0
    calibrations: tuple[tuple[str, str], ...] = ()
    sensor_height_mm: float | None = None
    below: Below | None = None
    placed: Placed = NOWHERE
    """What board and tool say of places."""
    real_time: bool = False
    """Time passes by itself: who waits for something else must let the sensors be read."""
