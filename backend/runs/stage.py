"""The scene of one trial as its devices, whoever provides them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from backend.core.clock import Clock
from backend.core.flow import FloatArray, Pose
from backend.devices.protocols import Arm, Device, Gripper
from backend.objects.catalogue import Piece
from backend.objects.shapes import Outline
from backend.runs.bench import Estimate, SceneView, Scoring
from backend.runs.requests import SceneChoice
from backend.sensing.live import RawStreams

SET_S = 120.0
"""Setting a scene takes so long at most: emulated devices are made and connected anew."""
Check = Callable[[SceneChoice], Mapping[str, object]]
"""Raises ``InputError`` before anything is written or moved; else returns what a run on the scene
depends on beside request and method, JSON-ready: bench settings, model, program."""


@dataclass(frozen=True, slots=True)
class Stage:
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
    scoring: Scoring | None
    estimator: Estimate
    payload: FloatArray
    outline: Outline
    jig: Pose | None = None
    scene_view: SceneView | None = None
    wrench_late_s: float = 0.0
    real_time: bool = False


class MakeStage(Protocol):
    """Builds a scene on the streams of a session."""

    def __call__(self, choice: SceneChoice, raw: RawStreams) -> Stage:
        """Return the stage; raises ``InputError`` for an unknown piece, bottom or model."""
