"""What the operator asks for, and how a run stands: frozen values between window and engine."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Literal

from backend.core.flow import PlaceAction

Strategy = Literal["paper", "pick-and-place"]
Mode = Literal["auto", "approve", "step"]


@dataclass(frozen=True, slots=True)
class StackRequest:
    """Stack ``piece`` on ``bottoms`` (bottom-up; the last one is touched) ``trials`` times.

    Trial k uses ``seed + k``. ``model`` is a checkpoint file, None for the shipped one.
    """

    piece: str = "pot"
    bottoms: tuple[str, ...] = ("short",)
    seed: int = 0
    trials: int = 1
    strategy: Strategy = "paper"
    mode: Mode = "auto"
    model: str | None = None


class RunState(Enum):
    """States of the engine."""

    IDLE = "idle"
    PREPARING = "preparing"
    RUNNING = "running"
    PAUSING = "pausing"
    PAUSED = "paused"
    CANCELLING = "cancelling"
    FINISHING = "finishing"


@dataclass(frozen=True, slots=True)
class RunStatus:
    """A snapshot of the engine, taken under its lock."""

    state: RunState
    run_id: str = ""
    trial: int = 0
    trials: int = 0
    probe: int = 0
    phase: str = ""
    awaiting: PlaceAction | None = None
    text: str = ""
