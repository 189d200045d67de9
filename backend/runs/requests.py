"""Requests of the operator and status of a run: frozen values between window and engine."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import Enum
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args

from touchdown.backend.calibration import CalibrationName
from touchdown.backend.config import (
    RecordingPlan,
    StackSettings,
    StrategyName,
    parse_settings,
    read_settings,
)
from touchdown.backend.core import InputError, PlaceAction

StrategyChoice = Literal[
    StrategyName, "fused-any", "fused-certified", "fused-uneven", "fused-wrench"
]
# Settings of the strategy `fused` by choice; docs/learned-fusion.md says how each was chosen.
LEARNED: Mapping[str, Mapping[str, Mapping[str, Any]]] = {
    "fused": {},
    "fused-any": {
        "fused": {"weights": "any", "ensemble": "mixture", "first_risk": 0.004, "risk": 0.03,
                  "inset_mm": 0.0},
        "policy": {"max_probes": 12},
    },
    "fused-certified": {"fused": {"weights": "any", "risk": 0.02}},
    "fused-uneven": {
        "fused": {"weights": "any", "ensemble": "mixture", "first_risk": 0.01, "risk": 0.05,
                  "inset_mm": 0.25},
        "policy": {"max_probes": 12},
    },
    "fused-wrench": {
        "fused": {"weights": "wrench", "first_risk": 0.003, "risk": 0.2, "inset_mm": 1.0},
        "policy": {"max_probes": 12},
    },
}  # fmt: skip
DecisionMode = Literal["auto", "approve", "step"]
Pattern = Literal["random", "grid", "adaptive"]
GRIPS = 3  # default minimum of grips in a campaign: fewer do not show the effect of a grip
# Default minimum of mountings; each is a series, and a model is tested on unseen series
MOUNTINGS = 3
# Settings of a recording plan that a request takes over; the window and arguments set the others.
PRESS_OF_PLAN = {"stage", "rest_s", "depth_mm", "ramp_fraction", "grip_force_n", "drag_mm"}


def read_plan(name: str) -> RecordingPlan:
    """Return a shipped recording plan (rest, gel, contact, drag), or that of a TOML file."""
    shipped = Path(str(files("touchdown.resources"))) / "recordings" / f"{name}.toml"
    return read_settings(RecordingPlan, shipped if shipped.is_file() else Path(name))


def _check_request(request: Any, **choices: Any) -> None:
    """Raise ``InputError`` for a name that is none of its ``choices``, a bad seed or origin."""
    for name, kind in choices.items():
        if getattr(request, name) not in (known := get_args(kind)):
            what = f"There is no {name} '{getattr(request, name)}'."
            raise InputError(what, f"--{name}", f"Use one of: {', '.join(known)}.")
    if not (isinstance(request.seed, int) and 0 <= request.seed < 2**63):
        fix = "Give a whole number from 0 to 2**63 - 1, as an int."
        raise InputError(f"The seed is {request.seed!r}.", "--seed", fix)
    if not (len(request.origin_mm) == 2 and math.hypot(*request.origin_mm) <= 5e3):
        fix = "Give x and y in mm, in the frame of the arm."
        raise InputError(f"The origin is {request.origin_mm}.", "--origin", fix)


STAGES = 38  # steps of 0.1 mm: after 33, the pads of 10 N are free


@dataclass(frozen=True, slots=True)
class SceneChoice:
    """Scene of a bench: ``piece`` above ``bottoms`` (bottom-up; the last one is touched).

    ``model`` is a checkpoint file, None for the one in use; without ``estimates`` none is loaded.
    ``optional``: a piece without a model is served too, by a strategy with a network of its own.
    ``alone``: no move needs approval, so the model must fit the bench. With ``jig`` the piece is
    taken from its jig beside the bottom; ``mounting`` counts the fittings of bottom and gels.
    ``handed``: the operator hands the piece over there, with less precision.
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
    optional: bool = False


@dataclass(frozen=True, slots=True)
class StackRequest:
    """Stack ``piece`` on ``bottoms`` a number of times.

    Parameters
    ----------
    piece : str, default: "pot"
        Name of the grasped piece.
    bottoms : tuple of str, default: ("short",)
        Names of the support, bottom-up; the last one is touched.
    seed : int, default: 0
        Trial k = 0, 1, ... uses ``seed + k``.
    trials : int, default: 1
        Number of trials.
    strategy : str, default: "paper"
        Strategy of the decisions: "paper", "paper-calibrated", "fused", "zero-wrench", or, on
        simulated benches only, "pick-and-place". "fused-any", "fused-certified", "fused-uneven"
        and "fused-wrench" are "fused" with other networks or rules of release.
    mode : {"auto", "approve", "step"}, default: "auto"
        Moves without approval, or each after ``Session.answer(True)``.
    model : str, optional
        Checkpoint file; the model in use otherwise.
    origin_mm : tuple of float, default: (0, 0)
        On devices: centre of the bottom in the arm's frame, mm.
    weigh : bool, default: False
        Weigh the piece in six poses before the first probe, and judge by the measured centre of
        mass. Needed for a piece whose centre of mass is unknown; refused below 100 g.
    staged : bool, default: False
        Open the jaws in held steps, and close them again if the piece begins to turn.
        "pick-and-place" opens them at once.

    Examples
    --------
    >>> request = StackRequest(piece="pot", bottoms=("short", "long"), strategy="fused", trials=3)
    >>> [request.scene(trial).seed for trial in range(3)]
    [0, 1, 2]

    """

    piece: str = "pot"
    bottoms: tuple[str, ...] = ("short",)
    seed: int = 0
    trials: int = 1
    strategy: StrategyChoice = "paper"
    mode: DecisionMode = "auto"
    model: str | None = None
    origin_mm: tuple[float, float] = (0.0, 0.0)
    weigh: bool = False
    staged: bool = False

    def __post_init__(self) -> None:
        _check_request(self, strategy=StrategyChoice, mode=DecisionMode)
        if isinstance(self.bottoms, str):
            fix = f"Give a tuple of names, such as ('{self.bottoms}',)."
            raise InputError("The bottoms are a single text.", "bottoms", fix)
        if self.trials < 1:
            raise InputError(f"{self.trials} trials cannot run.", "--trials", "Give 1 or more.")

    def scene(self, trial: int = 0) -> SceneChoice:
        """Return the scene of trial 0, 1, ...; pick-and-place needs no model."""
        estimates = self.strategy != "pick-and-place" or self.model is not None
        return SceneChoice(
            self.piece, self.bottoms, self.seed + trial, self.model, estimates,
            alone=self.mode == "auto", optional=self.learned,
        )  # fmt: skip

    @property
    def learned(self) -> bool:
        """True if a network of ``fused`` decides."""
        return self.strategy in LEARNED

    def method(self, base: StackSettings) -> StackSettings:
        """Return ``base`` with the settings of this run."""
        strategy = "fused" if self.learned else self.strategy
        weigh = self.weigh or base.weigh
        given: dict[str, Any] = {"strategy": strategy, "mode": self.mode, "weigh": weigh}
        if self.staged and not base.release.stages and strategy != "pick-and-place":
            given["release"] = base.release.model_copy(update={"stages": STAGES})
        for group, values in LEARNED.get(self.strategy, {}).items():
            given[group] = getattr(base, group).model_copy(update=values)
        return base.model_copy(update=given)


@dataclass(frozen=True, slots=True)
class ProbeRequest:
    """Probe once at the present pose of the present scene; an empty gripper grips first."""


@dataclass(frozen=True, slots=True)
class SetRequest:
    """Set a new scene on a simulated bench; nothing moves."""

    choice: SceneChoice


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """Collect labelled probes of ``piece`` on ``bottom`` into the dataset of the session.

    Parameters
    ----------
    piece, bottom : str
        Names of the grasped piece and of the touched bottom.
    count : int, default: 20
        Number of probes of the campaign.
    seed : int, default: 0
        Seed of the planned displacements.
    pattern : {"random", "grid", "adaptive"}, default: "random"
        Distribution of the displacements.
    person : str
        Name of the operator; must not be empty.
    within_mm : float, optional
        Largest displacement along x and y.
    origin_mm : tuple of float, default: (0, 0)
        Centre of the bottom in the arm's frame, mm.
    origin_sigma_mm : float, optional
        Standard uncertainty of the origin; that of the settings otherwise.
    check_origin : bool, default: False
        Probe the edges of the bottom after every mounting.
    campaign : str, optional
        Identifier of a campaign to continue; its plan replaces the values above, and the press.
    ask : bool, default: False
        Wait for a decision after every probe.
    probes_per_grip : int, optional
        Most probes per grip. Without it the settings, and few enough for ``GRIPS`` grips.
    grips_per_mounting : int, optional
        Most grips per mounting. Without it the settings, and few enough for ``MOUNTINGS``.
    hand_over : bool, default: False
        The operator hands the piece to the gripper and refits each mounting, as on every bench
        without a taught jig.
    stage : str, optional
        Stage of an identification that the recording serves; stored with every episode.
    rest_s : float, default: 0
        Time at rest in air with the held piece before the first probe of each mounting, recorded
        with lossless images.
    depth_mm, ramp_fraction, grip_force_n : float, optional
        Settings of the press in place of those of the method.
    drag_mm : float, default: 0
        Travel along y during the press, to both sides in turn, up to 3 mm. Such a probe slides on
        the bottom and is kept as rejected.

    Examples
    --------
    >>> CollectRequest(piece="pot", bottom="circle15", count=30, person="ann").count
    30

    """

    piece: str = "pot"
    bottom: str = "circle15"
    count: int = 20
    seed: int = 0
    pattern: Pattern = "random"
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
    stage: str = ""
    rest_s: float = 0.0
    depth_mm: float | None = None
    ramp_fraction: float | None = None
    grip_force_n: float | None = None
    drag_mm: float = 0.0

    def __post_init__(self) -> None:
        _check_request(self, pattern=Pattern)
        # Its numbers have the names and limits of those of a recording plan.
        numbers = {n: getattr(self, n, None) for n in RecordingPlan.model_fields}
        given = {name: value for name, value in numbers.items() if value is not None}
        parse_settings(RecordingPlan, given | {"stage": self.stage or "rest"}, "arguments")
        sigma_mm = self.origin_sigma_mm
        if sigma_mm is not None and not 0 <= sigma_mm < math.inf:
            what = f"{sigma_mm} mm is no uncertainty of the origin."
            raise InputError(what, "--origin-sigma", "Give 0 or more, in mm.")

    def method(self, base: StackSettings) -> StackSettings:
        """Return ``base`` with the settings of this run."""
        probes, grips, most = self.probes_per_grip, self.grips_per_mounting, base.collect
        if probes is None:
            probes = min(most.probes_per_grip, max(1, -(-self.count // GRIPS)))
        if grips is None:
            in_all = -(-self.count // probes)
            grips = min(most.grips_per_mounting, max(1, in_all // MOUNTINGS))
        limits = {"probes_per_grip": probes, "grips_per_mounting": grips}
        names = ("depth_mm", "ramp_fraction", "grip_force_n")
        press = {n: value for n in names if (value := getattr(self, n)) is not None}
        return base.model_copy(
            update={
                "collect": most.model_copy(update=limits),
                "probe": base.probe.model_copy(update=press),
            }
        )

    def scene(self, mounting: int = 0) -> SceneChoice:
        """Return the scene of a mounting: the piece in its jig, no model."""
        return SceneChoice(
            self.piece, (self.bottom,), self.seed, estimates=False, jig=True, mounting=mounting,
            handed=self.hand_over,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class CalibrateRequest:
    """Measure calibration ``what``; board, tool and camera hold ``piece`` over ``bottom``.

    ``origin_mm`` is the centre of the bottom in the arm's frame. ``hand_over`` as in
    ``CollectRequest``. ``pitch_mm`` is the pitch of the gel markers.
    """

    what: CalibrationName
    piece: str = "pot"
    bottom: str = "square15"
    seed: int = 0
    origin_mm: tuple[float, float] = (0.0, 0.0)
    hand_over: bool = False
    pitch_mm: float = 1.9

    def __post_init__(self) -> None:
        _check_request(self)

    @property
    def takes_piece(self) -> bool:
        """True if a piece is held during the measurement."""
        return self.what not in ("payload", "wrist")

    def scene(self) -> SceneChoice:
        """Return the scene: the piece in its jig, no model."""
        return SceneChoice(
            self.piece, (self.bottom,), self.seed, estimates=False, jig=True, handed=self.hand_over
        )


Request = StackRequest | ProbeRequest | CollectRequest | SetRequest | CalibrateRequest


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
    """Snapshot of the engine, taken under its lock.

    ``probe`` is the newest probe, ``estimated`` the newest one with an estimate. ``asks`` is the
    manual step or observation that the run waits for, ``awaiting`` the action that waits for
    approval. ``step`` of ``steps``: progress of a long phase.
    """

    state: RunState
    run_id: str = ""
    trial: int = 0
    trials: int = 0
    probe: int = 0
    estimated: int = 0
    phase: str = ""
    awaiting: PlaceAction | None = None
    text: str = ""
    asks: str = ""
    step: int = 0
    steps: int = 0


def request_record(request: Request, method: StackSettings, bench: Mapping[str, object]) -> str:
    """Return request, method and ``bench`` (see ``RunContext.check_scene``) as JSON."""
    return json.dumps(
        {"request": asdict(request), "method": method.model_dump(mode="json"), **bench}
    )
