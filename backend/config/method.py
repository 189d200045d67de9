"""Constants of the method, each a named setting with its default and reason.

[P] is stated in the paper (Ota et al., arXiv 2309.14552); [U] is left open there and chosen here.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(gt=0, lt=1)]

SAMPLES_PER_PROBE = 20
"""T = 2 s at 10 Hz [P]; ticks at 0.1, 0.2 ... 2.0 s after the onset (20, not 21) [U]."""

EARLY_TICKS = SAMPLES_PER_PROBE - 1
"""Ticks that can be worked through before the last sample of a probe arrives."""

TICK_S = 0.1
"""Distance of the ticks, 1 / 10 Hz [P]."""


StrategyName = Literal["paper", "fused", "zero-wrench", "pick-and-place"]
"""How a trial goes from a probe to its next move: the paper's way, a network that reads all probes
at once, letting go where the push turns nothing, and letting go without a test."""


class Settings(BaseModel):
    """A frozen group of settings; an unknown key is an error, not a silent default."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class ProbeSettings(Settings):
    """One press."""

    depth_mm: Positive = 1.5
    """Commanded travel after first contact [P]."""
    duration_s: Positive = 2.0
    """Length of a probe [P]."""
    ramp_fraction: Probability = 0.75
    """Linear ramp over this share of the probe, then hold [U]."""
    stiffness_n_mm: tuple[Positive, Positive, Positive] = (30.0, 30.0, 15.0)
    """Stiffness-control gains [P]."""
    grip_force_n: Positive = 10.0
    """Grasp force per finger [P]."""
    approach_mm_s: Positive = 2.0
    """Descent until contact [U]; limits the force at detection."""
    threshold_n: Positive = 1.0
    """Contact: press force over the running air baseline on 3 samples [U]."""
    start_height_mm: Positive = 3.0
    """Lift-off before any lateral move, and start of the next descent [U]."""
    travel_mm_s: Positive = 20.0
    """Speed of free moves [U]."""
    reference_frames: Annotated[int, Field(ge=1)] = 10
    """Still frames averaged for the tactile reference [U]."""
    max_travel_mm: Positive = 8.0
    """No contact on this way below the start height ends the probe [U]."""
    verdict_wait_s: Positive = 3.0
    """The arm holds the press at most this long for the verdict [U]."""


class BeliefSettings(Settings):
    """Fusion of probes in log odds."""

    pitch_mm: Positive = 1.0
    """Pitch of face lattice and belief map [U]."""
    half_extent_mm: Positive = 32.0
    """The square map reaches this far from the first probe [U]: face 12.7 + 7 steps of 3 mm."""
    clip: Annotated[float, Field(gt=0, lt=0.5)] = 0.02
    """Probabilities are limited to [clip, 1 - clip] before fusing [U]: one probe never decides."""
    log_odds_limit: Positive = 20.0
    """Limit of the accumulated log odds [U]."""
    temperature: Annotated[float, Field(ge=1)] = 1.0
    """Logits are divided by it [U]; 1 is the paper."""
    prior_correction: bool = False
    """Subtract the training base rate's logit [U]; off is the paper."""
    min_shift_mm: NonNegative = 0.5
    """A probe nearer than this to a former one replaces it: repeats are not independent [U]."""


class StabilitySettings(Settings):
    """Would the piece stand?"""

    delta: Probability = 0.9
    """A cell supports if its probability exceeds this [P]."""
    margin_mm: float = 0.0
    """Required signed distance of the centre of mass to the hull's edge; 0 is the paper [U]."""
    judge_from: Literal["belief", "patch"] = "belief"
    """The paper's text judges the latest patch, its table the aggregated map [U]."""


class PolicySettings(Settings):
    """Where to probe next."""

    longest_step_mm: Positive = 3.0
    """Longest shift [P]."""
    hull_centre: Literal["area", "cells", "vertices"] = "area"
    """Mean of what is the target [U]: cells inside the hull, confident cells, hull vertices."""
    fallback: Literal["best-cells", "spiral", "stop"] = "best-cells"
    """What to do without confident support or when stalled [U]."""
    max_probes: Annotated[int, Field(ge=1)] = 8
    """Give up after this many probes [U]."""


class ZeroWrenchSettings(Settings):
    """When the push turns nothing."""

    release_mm: Positive = 1.0
    """Release where the push acts within this of the centre of mass [U]."""


class TowerSettings(Settings):
    """What the operator enters of a tower below the touched bottom."""

    offset_mm: tuple[tuple[float, float], ...] = ()
    """Centre of each bottom above the lowest from that of the one below it; none: centred."""
    sigma_mm: Positive = 2.5
    """Standard uncertainty of each along x and along y; by default that of one put there by eye."""


class FusedSettings(Settings):
    """Support as a network fuses it from the signals of all probes."""

    weights: str = ""
    """File of the network; empty for the one that ships."""
    risk: Probability = 0.07
    """Release only where the centre of mass lies in the support in all but this share [U]."""
    inset_mm: NonNegative = 0.25
    """The centre of mass must lie this far within the support to count as carried [U]."""


class ReleaseSettings(Settings):
    """Letting go, as a lab would do it."""

    unload_n: Positive = 1.0
    """Press force to unload to, within 0.3 to 2 N."""
    settle_s: Positive = 0.2
    """Wait after unloading before the second slip check."""
    open_mm_s: Positive = 5.0
    """Speed of opening."""
    clearance_mm: Positive = 2.0
    """Each finger clears the piece by this much before the arm rises."""
    rise_mm: Positive = 30.0
    """The arm rises by this much afterwards."""


class TrainingSettings(Settings):
    """How a model is trained; the paper names only network and loss."""

    modality: Literal["FT", "Tac", "FT+Tac"] = "FT+Tac"
    hidden: Annotated[int, Field(ge=1)] = 256
    """Units per LSTM layer [P]."""
    layers: Annotated[int, Field(ge=1)] = 2
    """LSTM layers [P]."""
    learning_rate: Positive = 1e-3
    schedule: Literal["cosine", "constant"] = "cosine"
    """Rate over the epochs [U]: falling to zero gave a lower validation loss (0.377 in 14 epochs)
    than a constant one (0.400, best of 20) on 1,500 pot probes."""
    epochs: Annotated[int, Field(ge=1)] = 16
    patience: Annotated[int, Field(ge=1)] = 8
    """Stop after this many epochs without a lower validation loss [U]."""
    keep: Literal["best", "last"] = "best"
    """Which epoch's weights [U]: of the lowest validation loss, or the last ones."""
    batch: Annotated[int, Field(ge=1)] = 64
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the products in a training step; weights, loss and validation stay float32 [U]."""
    validation_share: Probability = 0.1
    divide_series: bool = False
    """Hold out whole grips where there are few mountings: validation knows the errors of theirs."""
    seed: Annotated[int, Field(ge=0)] = 0


class CollectSettings(Settings):
    """Collecting labelled probes: how long one grip lasts, and what a measured label is worth."""

    probes_per_grip: Annotated[int, Field(ge=1)] = 50
    """At most so many probes before the piece is put back and gripped anew [U]."""
    grips_per_mounting: Annotated[int, Field(ge=1)] = 10
    """At most so many grips before bottom and gels are fitted anew [U]."""
    drift_mm: Positive = 0.3
    """A grip ends when the height of contact has changed by more than this [U]."""
    weight_tolerance_n: Positive = 0.15
    """The held piece weighs what its file says within this; nominal masses are only told [U]."""
    clearance_mm: Positive = 10.0
    """The piece is carried between jig and bottom at this height above the jig [U]."""
    open_mm: Positive = 10.0
    """The jaws open by so much over the jig [U]."""
    tries: Annotated[int, Field(ge=1)] = 2
    """A displacement whose probes are rejected so many times is put off, then left out [U]."""
    arm_sigma_mm: Positive = 0.05
    """Standard uncertainty of the arm's position [U]."""
    grip_sigma_mm: Positive = 0.1
    """Standard uncertainty of the piece in the grasp when it comes from a jig [U]."""
    handed_sigma_mm: Positive = 0.5
    """The same where the operator hands the piece over [U]."""
    origin_sigma_mm: Positive = 0.1
    """Standard uncertainty of the bottom's place before a check [U]."""


class StackSettings(Settings):
    """Everything the stacking loop depends on; recorded with every run."""

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
