"""Settings of the method.

[P] is stated in the paper (Ota et al., arXiv 2309.14552); [U] is left open there and chosen here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Any, ClassVar, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(gt=0, lt=1)]
Travel = Annotated[float, Field(gt=0, le=100)]  # mm, of the arm near a piece
Speed = Annotated[float, Field(gt=0, le=250)]  # mm/s; standards call 250 mm/s reduced speed
Force = Annotated[float, Field(gt=0, le=500)]  # N, on a piece
Wait = Annotated[float, Field(gt=0, le=600)]  # s, with a piece in the jaws
Stiffness = Annotated[float, Field(gt=0, le=1000)]  # N/mm
Sigma = Annotated[float, Field(gt=0, le=100)]  # mm, standard uncertainty

# Largest magnitude of a number by the unit at the end of its name; the longest ending counts.
UNIT_LIMITS = {
    "": 1e9,
    "deg": 360.0,
    "g": 1e5,
    "hz": 1e6,
    "kg": 1e3,
    "mm": 5e3,
    "mm_per_px": 10.0,
    "mm_per_px_x": 10.0,
    "mm_per_px_y": 10.0,
    "mm_s": 1e4,
    "mm_s2": 1e6,
    "ms": 1e5,
    "n": 1e4,
    "n_mm": 1e5,
    "n_mm3": 1e5,
    "nm": 1e3,
    "nmm_rad": 1e6,
    "px": 2e4,
    "rad": 2 * math.pi,
    "rad_s": 100.0,
    "s": 1e5,
    "seed": 2.0**63,
    "us": 1e7,
}

# T = 2 s at 10 Hz [P]; ticks at 0.1, 0.2 ... 2.0 s after the onset (20, not 21) [U].
SAMPLES_PER_PROBE = 20

# Ticks that can be processed before the last sample of a probe arrives.
EARLY_TICKS = SAMPLES_PER_PROBE - 1

TICK_S = 0.1  # period of the ticks, 1 / 10 Hz [P]


# Choice of the next move: the paper's method, the same with calibrated probabilities, a network
# that reads all probes, release where the push causes no moment, and release without a probe.
StrategyName = Literal["paper", "paper-calibrated", "fused", "zero-wrench", "pick-and-place"]


class Settings(BaseModel):
    """A frozen group of settings.

    An unknown key, a value of another type, and a number that is not finite or implausibly large
    are errors. Integers may stand for decimal numbers.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False
    )

    @model_validator(mode="before")
    @classmethod
    def _keep_types(cls, given: Any) -> Any:
        """Accept arrays as tuples; True and 1.0 are no choice where 1 is one."""
        if not isinstance(given, dict):
            return given
        content = {key: _with_tuples(value) for key, value in given.items()}
        for name in cls.model_fields.keys() & content.keys():
            kind, value = cls.model_fields[name].annotation, content[name]
            if get_origin(kind) is Literal and type(value) not in map(type, get_args(kind)):
                content[name] = repr(value)
        return content

    @field_validator("*")
    @classmethod
    def _is_plausible(cls, value: Any, info: ValidationInfo) -> Any:
        words = str(info.field_name).split("_")
        units = ("_".join(words[k:]) for k in range(len(words) + 1))
        limit = next(UNIT_LIMITS[unit] for unit in units if unit in UNIT_LIMITS)
        for number in _numbers(value):
            if abs(number) > limit:
                raise ValueError(f"{number:g} is out of range, at most {limit:g}")
        return value


def _with_tuples(value: Any) -> Any:
    """Return ``value`` with the arrays of a TOML or JSON file as tuples."""
    if isinstance(value, list | tuple):
        return tuple(map(_with_tuples, value))
    if isinstance(value, dict):
        return {key: _with_tuples(each) for key, each in value.items()}
    return value


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        for each in value:
            yield from _numbers(each)
    elif isinstance(value, int | float):
        yield value


class ProbeSettings(Settings):
    """One press."""

    depth_mm: Travel = 1.5  # commanded travel after first contact [P]
    duration_s: Wait = 2.0  # length of a probe [P]
    ramp_fraction: Probability = 0.75  # linear ramp over this share of the probe, then hold [U]
    # Stiffness-control gains [P].
    stiffness_n_mm: tuple[Stiffness, Stiffness, Stiffness] = (30.0, 30.0, 15.0)
    grip_force_n: Force = 10.0  # grasp force per finger [P]
    approach_mm_s: Speed = 2.0  # descent until contact [U]; limits the force at detection
    # Contact: press force above the running air baseline on 3 samples [U].
    threshold_n: Force = 1.0
    # Lift-off before lateral moves, and start of the next descent [U].
    start_height_mm: Travel = 3.0
    travel_mm_s: Speed = 20.0  # speed of free moves [U]
    # Still frames averaged for the tactile reference [U].
    reference_frames: Annotated[int, Field(ge=1, le=1000)] = 10
    max_travel_mm: Travel = 8.0  # the probe ends without contact after this descent [U]
    verdict_wait_s: Wait = 3.0  # the arm holds the press at most this long for the verdict [U]


class BeliefSettings(Settings):
    """Fusion of probes in log odds."""

    pitch_mm: Annotated[float, Field(ge=0.1, le=10)] = (
        1.0  # pitch of face lattice and belief map [U]
    )
    # Half size of the square map around the first probe [U]: face 12.7 + 7 steps of 3 mm.
    half_extent_mm: Annotated[float, Field(gt=0, le=500)] = 32.0
    # Probabilities are clipped to [clip, 1 - clip] before fusion [U], so one probe never decides.
    clip: Annotated[float, Field(gt=0, lt=0.5)] = 0.02
    log_odds_limit: Annotated[float, Field(gt=0, le=1000)] = (
        20.0  # limit of the accumulated log odds [U]
    )
    temperature: Annotated[float, Field(ge=1, le=100)] = (
        1.0  # divisor of the logits [U]; the paper uses 1
    )
    # Subtract the logit of the training base rate [U]; off in the paper.
    prior_correction: bool = False
    # A probe replaces a former one within this distance: repeats are not independent [U].
    min_shift_mm: Annotated[float, Field(ge=0, le=100)] = 0.5


class StabilitySettings(Settings):
    """Stability of the piece."""

    delta: Probability = 0.9  # A cell supports if its probability exceeds this [P]
    # Required signed distance of the centre of mass to the hull's edge [U]; 0 in the paper.
    margin_mm: Annotated[float, Field(ge=-5, le=50)] = 0.0
    # The paper's text judges the latest patch, its table the belief map [U].
    judge_from: Literal["belief", "patch"] = "belief"


class PolicySettings(Settings):
    """Choice of the next probe."""

    longest_step_mm: Travel = 3.0  # longest shift [P]
    # Points whose mean is the target [U]: cells in the hull, confident cells, hull vertices.
    hull_centre: Literal["area", "cells", "vertices"] = "area"
    # Without confident support, or when stalled [U].
    fallback: Literal["best-cells", "spiral", "stop"] = "best-cells"
    max_probes: Annotated[int, Field(ge=1, le=1000)] = 8  # give up after this many probes [U]
    # Release only after this many probes at different places [U]; 1 in the paper.
    least_probes: Annotated[int, Field(ge=1, le=1000)] = 1


class ZeroWrenchSettings(Settings):
    """Strategy ``zero-wrench``: release where the push causes no moment."""

    # Release where the push acts within this distance of the centre of mass [U].
    release_mm: Travel = 1.0


class TowerSettings(Settings):
    """Offsets of the bodies of a tower below the touched bottom, entered by the operator."""

    # Centre of each upper bottom relative to the one below it; empty: centred.
    offset_mm: tuple[tuple[float, float], ...] = ()
    # Standard uncertainty of each offset in x and y; default: placed by eye.
    sigma_mm: Sigma = 2.5


SHIPPED_NETWORKS = ("any", "wrench")  # beside the default: for any outline; of the wrench alone


class FusedSettings(Settings):
    """Strategy ``fused``: a network fuses the signals of all probes."""

    # Network file; empty for the shipped one, "any" for the shipped one for any outline, "wrench"
    # for the shipped one that does not read the markers.
    weights: str = ""
    # Largest probability at release that the support misses the centre of mass [U].
    risk: Probability = 0.1
    # The same after the first probe; it grows to `risk` at `max_probes`, by the same factor with
    # each probe; 0: `risk` after every probe [U].
    first_risk: Annotated[float, Field(ge=0, lt=1)] = 0.005
    # Smallest distance of the centre of mass from the edge of the support [U].
    inset_mm: Annotated[float, Field(ge=0, le=50)] = 0.25
    # Probability of a release by several networks: that of the least confident one, or their mean.
    ensemble: Literal["minimum", "mixture"] = "minimum"
    # A probe replaces former ones within this distance; 0: the network reads all [U].
    merge_mm: Annotated[float, Field(ge=0, le=50)] = 0.0
    # Largest standard deviation of the inset at a release; 0: no limit [U].
    largest_sd_mm: Annotated[float, Field(ge=0, le=50)] = 0.0
    # Release only if the centre of mass lies within the hull of the measured centres of pressure,
    # by twice this standard deviation; for convex faces; 0: not required [U].
    pressure_sd_mm: Annotated[float, Field(ge=0, le=50)] = 0.0

    @field_validator("weights")
    @classmethod
    def _names_network(cls, weights: str) -> str:
        if weights in ("", *SHIPPED_NETWORKS) or weights.endswith(".safetensors"):
            return weights
        names = ", ".join(f"'{name}'" for name in SHIPPED_NETWORKS)
        raise ValueError(
            f"there is no network '{weights}'; give '' (the default), {names} or the path of a "
            "file that ends with .safetensors"
        )

    def accepted_risk(self, probes: int, most: int) -> float:
        """Return the accepted risk after ``probes`` of at most ``most`` probes.

        While many remain, a further probe costs little and often finds a better place.
        """
        if not 0.0 < self.first_risk < self.risk or probes >= most:
            return self.risk
        growth = (self.risk / self.first_risk) ** (1.0 / (most - 1))
        return float(self.first_risk * growth ** max(probes - 1, 0))


class ReleaseSettings(Settings):
    """Release of the piece."""

    # Press force after unloading; the interlock requires 0.3 to 2 N.
    unload_n: Annotated[float, Field(ge=0.3, le=2)] = 1.0
    settle_s: Wait = 0.2  # wait after unloading before the second slip check
    open_mm_s: Speed = 5.0  # speed of opening
    clearance_mm: Travel = 2.0  # distance of each finger from the piece before the arm rises
    rise_mm: Annotated[float, Field(gt=0, le=500)] = (
        30.0  # height by which the arm rises afterwards
    )
    # Steps of the jaws, each held for 1 s while the piece is watched; 0: they open at once [U].
    stages: Annotated[int, Field(ge=0, le=40)] = 0
    stage_mm: Annotated[float, Field(gt=0, le=0.1)] = 0.1  # step of the width
    turn_sigmas: Annotated[float, Field(gt=0, le=100)] = 12.0  # change that counts as a turn
    lean_sigmas: Annotated[float, Field(gt=0, le=100)] = 4.0  # load after the steps that does
    regrasp_sigma_mm: NonNegative = 0.3  # of the piece in a new grip, for the evidence before it


class TrainingSettings(Settings):
    """Training of a model; the paper states only network and loss."""

    modality: Literal["FT", "Tac", "FT+Tac"] = "FT+Tac"
    hidden: Annotated[int, Field(ge=1, le=4096)] = 256  # units per LSTM layer [P]
    layers: Annotated[int, Field(ge=1, le=8)] = 2  # LSTM layers [P]
    # Muon (arXiv 2502.16982) moves the matrices of the LSTM layers by orthogonal steps [U].
    optimiser: Literal["Adam", "Muon"] = "Adam"
    learning_rate: Annotated[float, Field(gt=0, le=1000)] = 1e-3
    # Learning rate over the epochs [U]. A rate falling to zero gave a lower validation loss (0.377
    # in 14 epochs) than a constant one (0.400, best of 20) on 1,500 pot probes.
    schedule: Literal["cosine", "constant"] = "cosine"
    epochs: Annotated[int, Field(ge=1, le=1_000_000)] = 16
    # Stop after this many epochs without a lower validation loss [U].
    patience: Annotated[int, Field(ge=1, le=1_000_000)] = 8
    # Weights of the epoch with the lowest validation loss, or of the last [U].
    keep: Literal["best", "last"] = "best"
    batch: Annotated[int, Field(ge=1, le=1_000_000)] = 64
    # Of the products in a training step; weights, loss and validation stay float32 [U].
    precision: Literal["float32", "bfloat16"] = "float32"
    validation_share: Probability = 0.1
    # Hold out whole grips if there are few mountings; their errors are then in both sets.
    divide_series: bool = False
    seed: Annotated[int, Field(ge=0)] = 0


class CollectSettings(Settings):
    """Collection of labelled probes: lengths of grips, and uncertainty of measured labels."""

    # Probes before the piece is put back and gripped again [U].
    probes_per_grip: Annotated[int, Field(ge=1, le=100_000)] = 50
    # Grips before bottom and gels are mounted again [U].
    grips_per_mounting: Annotated[int, Field(ge=1, le=100_000)] = 10
    # A grip ends when the contact height has changed by more than this [U].
    drift_mm: Travel = 0.3
    # Tolerance of the held weight; for nominal masses a deviation is only reported [U].
    weight_tolerance_n: Force = 0.15
    clearance_mm: Travel = 10.0  # height above the jig while the piece is carried [U]
    open_mm: Travel = 10.0  # opening of the jaws above the jig [U]
    # Rejected probes at one displacement before it is postponed, then skipped [U].
    tries: Annotated[int, Field(ge=1, le=1000)] = 2
    arm_sigma_mm: Sigma = 0.05  # standard uncertainty of the arm position [U]
    # Standard uncertainty of the piece in the grasp, taken from a jig [U].
    grip_sigma_mm: Sigma = 0.1
    handed_sigma_mm: Sigma = 0.5  # the same, handed over by the operator [U]
    # Standard uncertainty of the bottom position before a check [U].
    origin_sigma_mm: Sigma = 0.1


class RecordingPlan(Settings):
    """A recording for ``touchdown identify``: the probes of one campaign, and time at rest before.

    ``stage``: what the recording serves; ``note``: what it needs of the bench. ``rest_s``: the held
    piece hangs still in air for this long before the first probe of each mounting. ``drag_mm``: the
    arm drags the piece along y while it presses, to both sides in turn.
    """

    stage: Literal["rest", "gel", "contact"]
    note: str = ""
    count: Annotated[int, Field(ge=1, le=100_000)] = 54
    probes_per_grip: Annotated[int, Field(ge=1, le=100_000)] = 6
    grips_per_mounting: Annotated[int, Field(ge=1, le=100_000)] = 3
    within_mm: Travel | None = None
    rest_s: Annotated[float, Field(ge=0, le=3600)] = 0.0
    depth_mm: Travel | None = None  # None: as in the settings of the method
    ramp_fraction: Probability | None = None
    grip_force_n: Force | None = None
    drag_mm: Annotated[float, Field(ge=0, le=3)] = 0.0


class StackSettings(Settings):
    """Settings of the stacking loop, recorded with every run.

    Attributes
    ----------
    probe, belief, stability, policy, release : Settings
        Groups of settings, a class each; units stand in the names of the fields.
    strategy : str
        Strategy of the decisions.

    Examples
    --------
    >>> StackSettings().probe.duration_s
    2.0

    """

    probe: ProbeSettings = ProbeSettings()
    belief: BeliefSettings = BeliefSettings()
    stability: StabilitySettings = StabilitySettings()
    policy: PolicySettings = PolicySettings()
    zero_wrench: ZeroWrenchSettings = ZeroWrenchSettings()
    tower: TowerSettings = TowerSettings()
    fused: FusedSettings = FusedSettings()
    release: ReleaseSettings = ReleaseSettings()
    collect: CollectSettings = CollectSettings()
    strategy: StrategyName = "paper"
    mode: Literal["auto", "approve", "step"] = "auto"
    # Weigh the held piece first, and judge by its measured centre of mass.
    weigh: bool = False

    @property
    def required_margin_mm(self) -> float:
        """Least margin at a release; that of ``zero-wrench`` is minus the distance of the push."""
        allowed = self.zero_wrench.release_mm if self.strategy == "zero-wrench" else 0.0
        return self.stability.margin_mm - allowed
