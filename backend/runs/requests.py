"""Requests of the operator and status of a run: frozen values between window and engine."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from typing import Literal

from touchdown.backend.calibration import CalibrationName
from touchdown.backend.config import StackSettings, StrategyName
from touchdown.backend.core import PlaceAction

StrategyChoice = StrategyName
DecisionMode = Literal["auto", "approve", "step"]
GRIPS = 3
"""So many grips at least does a campaign make by default: fewer do not show what a grip does."""
MOUNTINGS = 3
"""On so many mountings at least, each a series: a model is measured on series it never saw."""


@dataclass(frozen=True, slots=True)
class SceneChoice:
    """What stands on the bench: ``piece`` above ``bottoms`` (bottom-up; the last one is touched).

    ``model`` is a checkpoint file, None for the one in use; without ``estimates`` none is loaded.
    ``alone``: nobody is asked before a move, so the model has to fit the bench.
    With ``jig`` the piece is taken from its jig beside the bottom; ``mounting`` counts the fittings
    of bottom and gels. ``handed``: from a hand at that place, which holds it less well.
    """

    piece: str = "pot"
    bottoms: tuple[str, ...] = ("short",)
    seed: int = 0
    model: str | None = None
    estimates: bool = True
    alone: bool = False
    jig: bool = False
    mounting: int = 0
    handed: bool = False


@dataclass(frozen=True, slots=True)
class StackRequest:
    """Stack ``piece`` on ``bottoms`` (bottom-up; the last one is touched) ``trials`` times.

    Trial k uses ``seed + k``. ``model`` is a checkpoint file, None for the one in use.
    ``origin_mm``: on devices, where the centre of the bottom is for the arm.
    """

    piece: str = "pot"
    bottoms: tuple[str, ...] = ("short",)
    seed: int = 0
    trials: int = 1
    strategy: StrategyChoice = "paper"
    mode: DecisionMode = "auto"
    model: str | None = None
    origin_mm: tuple[float, float] = (0.0, 0.0)

    def scene(self, trial: int = 0) -> SceneChoice:
        """Return the scene of trial 0, 1, ...; pick-and-place needs no model."""
        estimates = self.strategy != "pick-and-place" or self.model is not None
        return SceneChoice(
            self.piece, self.bottoms, self.seed + trial, self.model, estimates,
            alone=self.mode == "auto",
        )  # fmt: skip

    def method(self, base: StackSettings) -> StackSettings:
        """Return the settings of this run, laid over those of the bench."""
        return base.model_copy(update={"strategy": self.strategy, "mode": self.mode})


@dataclass(frozen=True, slots=True)
class ProbeRequest:
    """Probe once at the present place of the present scene; an empty gripper grips first."""


@dataclass(frozen=True, slots=True)
class SetRequest:
    """Set the simulated bench anew; nothing moves."""

    choice: SceneChoice


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """Collect ``count`` labelled probes of ``piece`` on ``bottom`` into the session's dataset.

    ``within_mm`` limits displacements along x and y. ``origin_mm``: where the centre of the bottom
    is for the arm, with its standard uncertainty (None: that of the settings). ``campaign`` goes on
    with a former one, whose plan then holds instead. With ``ask`` the run waits for a decision
    after every probe. ``check_origin``: probe at known displacements after every mounting.
    ``probes_per_grip``: at most so many (None: as the settings say, and so few that the campaign
    has ``GRIPS`` grips). ``grips_per_mounting``: alike (None: so few that it has ``MOUNTINGS``
    mountings, where it has so many grips). ``hand_over``: the operator hands the piece to the
    gripper where it is, as on every bench without a taught jig, and fits each mounting anew.
    """

    piece: str = "pot"
    bottom: str = "circle15"
    count: int = 20
    seed: int = 0
    pattern: Literal["random", "grid", "adaptive"] = "random"
    person: str = ""
    within_mm: float | None = None
    origin_mm: tuple[float, float] = (0.0, 0.0)
    origin_sigma_mm: float | None = None
    check_origin: bool = False
    campaign: str = ""
    ask: bool = False
    probes_per_grip: int | None = None
    grips_per_mounting: int | None = None
    hand_over: bool = False

    def method(self, base: StackSettings) -> StackSettings:
        """Return the settings of this run, laid over those of the bench."""
        probes, grips, most = self.probes_per_grip, self.grips_per_mounting, base.collect
        if probes is None:
            probes = min(most.probes_per_grip, max(1, -(-self.count // GRIPS)))
        if grips is None:
            in_all = -(-self.count // probes)
            grips = min(most.grips_per_mounting, max(1, in_all // MOUNTINGS))
        limits = {"probes_per_grip": probes, "grips_per_mounting": grips}
        return base.model_copy(update={"collect": most.model_copy(update=limits)})

    def scene(self, mounting: int = 0) -> SceneChoice:
        """Return the scene of a mounting: the piece in its jig, no model."""
        return SceneChoice(
            self.piece, (self.bottom,), self.seed, estimates=False, jig=True, mounting=mounting,
            handed=self.hand_over,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class CalibrateRequest:
    """Measure calibration ``what``; board, tool and camera hold ``piece`` over ``bottom``.

    ``origin_mm``: where the centre of the bottom is for the arm. ``hand_over`` as in
    ``CollectRequest``. ``pitch_mm`` of the dots of the gel.
    """

    what: CalibrationName
    piece: str = "pot"
    bottom: str = "square15"
    seed: int = 0
    origin_mm: tuple[float, float] = (0.0, 0.0)
    hand_over: bool = False
    pitch_mm: float = 1.9

    @property
    def takes_piece(self) -> bool:
        """Whether a piece is held meanwhile."""
        return self.what not in ("payload", "wrist")

    def scene(self) -> SceneChoice:
        """Return the scene: the piece in its jig, no model."""
        return SceneChoice(
            self.piece, (self.bottom,), self.seed, estimates=False, jig=True, handed=self.hand_over
        )


Request = StackRequest | ProbeRequest | CollectRequest | SetRequest | CalibrateRequest
"""Everything that a session can run; ``touchdown.backend.runs.plans`` knows the plan of each."""


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
    """A snapshot of the engine, taken under its lock.

    ``probe`` is the one begun last, ``felt`` the last one that gave an estimate. ``asks``: what the
    run waits for at the operator's hand or eye; ``awaiting``: for a yes to this action.
    """

    state: RunState
    run_id: str = ""
    trial: int = 0
    trials: int = 0
    probe: int = 0
    felt: int = 0
    phase: str = ""
    awaiting: PlaceAction | None = None
    text: str = ""
    asks: str = ""


def request_record(request: Request, method: StackSettings, bench: Mapping[str, object]) -> str:
    """Return request, method and ``bench`` (what the host's check told) as JSON."""
    return json.dumps(
        {"request": asdict(request), "method": method.model_dump(mode="json"), **bench}
    )
