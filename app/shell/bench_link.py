"""Link between the window and a bench session."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from touchdown.backend.annotations import Dataset
from touchdown.backend.calibration import CalibrationStore
from touchdown.backend.config import BenchDescription
from touchdown.backend.core import (
    EpisodeDecision,
    EventBus,
    Finger,
    MarkerField,
    RepaintHold,
    SampleStream,
    Stream,
    TactileFrame,
)
from touchdown.backend.devices import DegradedDevice, Device, Interlock, Limits
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.learning import ModelCard
from touchdown.backend.rig import BenchConnection
from touchdown.backend.runs import ManualControl, OperatorPrompt, Request, RunStatus, SceneChoice
from touchdown.backend.sensing import WrenchDrift


class RunControl(Protocol):
    """The orders that change a run in progress."""

    def pause(self) -> None:
        """Pause at the next safe place."""

    def resume(self) -> None:
        """Go on."""

    def cancel(self) -> None:
        """End in an orderly way."""


class BenchLink(Protocol):
    """A live bench. Every call returns at once, except ``close`` (bounded)."""

    simulated: bool
    facts: BenchDescription
    """What its recordings say of it; the window calls it by the same mode."""
    name: str
    """Name of the lab; "" for a simulated bench."""
    limits_source: str
    usual: SceneChoice
    """What is on the bench as far as nobody says otherwise: of a lab what its file says."""
    connection: BenchConnection | None
    """How the devices are connected, where that is done by hand."""
    events: EventBus
    interlock: Interlock
    hush: RepaintHold
    """While it is on nothing is drawn: a decision is due."""
    frames: Mapping[Finger, Stream[TactileFrame]]
    fields: Mapping[Finger, Stream[MarkerField]]
    wrench: SampleStream
    catalogue: PieceLibrary
    dataset: Dataset | None
    """Takes what is collected; set while no run goes on."""
    calibrations: CalibrationStore | None
    """What the bench knows about itself."""
    gate: OperatorPrompt
    """Takes what the operator saw of a released piece."""

    @property
    def run_folder(self) -> Path | None:
        """Folder of the last run, None if it is not kept."""

    @property
    def pace(self) -> float:
        """Bench seconds per wall second."""

    @property
    def still_s(self) -> float:
        """For how long the bench has made no step."""

    @property
    def engine(self) -> RunControl:
        """The run in progress."""

    @property
    def devices(self) -> Mapping[str, Device]:
        """The devices of the present scene by name."""

    @property
    def hand(self) -> ManualControl | None:
        """What the operator may do by hand on the present scene."""

    @property
    def model(self) -> ModelCard | None:
        """What reads the probes of the present scene; None where no model does."""

    @property
    def degraded(self) -> tuple[DegradedDevice, ...]:
        """Sensors that are late or slow now."""

    @property
    def drift(self) -> WrenchDrift | None:
        """By how much the wrist sensor drifted in air, None while that is not known."""

    def clock_s(self) -> float:
        """Return the bench clock."""

    def status(self) -> RunStatus:
        """Return how the run stands."""

    def start(self, request: Request) -> None:
        """Begin a run; raises ``RefusedError`` with the reason."""

    def stop(self) -> None:
        """Software stop."""

    def reset(self) -> None:
        """Clear the stop latch and the faults."""

    def answer(self, yes: bool) -> None:
        """Approve or decline the action that waits."""

    def decide(self, decision: EpisodeDecision) -> None:
        """Keep, discard, redo, flag or skip the newest collected episode; never waits."""

    def leave_scene(self) -> None:
        """Let nothing move until a scene is set again; raises ``RefusedError``."""

    def home_gripper(self) -> None:
        """Home the gripper, whose jaws must be empty; raises ``RefusedError``."""

    def change_limits(self, limits: Limits, person: str) -> None:
        """Take other limits; raises ``RefusedError`` or ``InputError``."""

    def open(self) -> None:
        """Start the live thread."""

    def close(self) -> None:
        """Stop and end it."""
