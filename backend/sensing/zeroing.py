"""Zero references of the sensors before a probe: tare, tactile reference, and drift since then.

The raw wrench contains the gripper (about 14.7 N), the piece and the offset of the sensor. All
three vanish only if the tare is taken with the piece held, still, in air and in the pose of the
press. The tactile reference is the rest position of the 63 markers. In still air the weight is
constant, so that a slow change is drift (reliability S8); a sudden change is a load and is ignored.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from touchdown.backend.core import (
    MARKERS,
    WRENCH_CHANNELS,
    Fault,
    FaultError,
    Finger,
    FloatArray,
    MarkerField,
    MarkerState,
    RefusedError,
    read_only,
)

STANDARD_GRAVITY_M_S2 = 9.80665


# Limits of a tare. Forces in N, moments in N·m; set from noise measured in air.
# Largest standard deviation (force, moment): 3 sigma of the air noise 0.1 N, 0.004 N·m.
TARE_NOISE = (0.3, 0.012)
# Largest change between the halves of the window: the arm moves or the load changes.
TARE_MOTION = (0.15, 0.006)
TARE_LOAD_N = 3.0  # largest force beyond the payload; more is a contact (reliability S8)
MIN_TARE_SAMPLES = 10  # 200 ms hold 200 samples at 1 kHz
MIN_TARE_SPAN_S = 0.15  # shortest time that the samples must span


@dataclass(frozen=True, slots=True)
class Tare:
    """Subtracted wrench: the calibrated ``payload`` (6,) and the measured ``offset`` (6,)."""

    payload: FloatArray
    offset: FloatArray

    def __post_init__(self) -> None:
        read_only(self.payload)
        read_only(self.offset)

    @property
    def total(self) -> FloatArray:
        """(6,) payload and offset together, N and N·m."""
        return self.payload + self.offset

    def apply(self, wrench: FloatArray) -> FloatArray:
        """Return ``wrench`` (..., 6) without payload and offset."""
        return np.asarray(wrench - self.total, dtype=np.float64)


def gripper_payload(mass_kg: float, centre_mm: tuple[float, float, float]) -> FloatArray:
    """Return the wrench (6,) of a payload hanging at ``centre_mm`` from the sensor, z up."""
    weight_n = mass_kg * STANDARD_GRAVITY_M_S2
    x_m, y_m = 1e-3 * centre_mm[0], 1e-3 * centre_mm[1]
    return np.array([0.0, 0.0, -weight_n, -y_m * weight_n, x_m * weight_n, 0.0])


def take_tare(t_s: FloatArray, wrench: FloatArray, payload: FloatArray | None = None) -> Tare:
    """Average still samples in air: ``t_s`` (n,) and raw ``wrench`` (n, 6).

    ``payload`` (6,): calibrated weight of the gripper; without it a contact is detected by motion
    and noise only. Raises ``FaultError`` "TARE-REFUSED" with the reason.
    """
    base = np.zeros(WRENCH_CHANNELS) if payload is None else np.array(payload, dtype=np.float64)
    refusal = _refusal(t_s, wrench - base, weighed=payload is not None)
    if refusal:
        raise FaultError(
            Fault(
                "TARE-REFUSED",
                f"The force sensor cannot be tared: {refusal}.",
                "No probe was started.",
                "Hold the piece still in air, free of contact, and try again.",
                "force_torque",
            )
        )
    return Tare(base, np.asarray((wrench - base).mean(axis=0), dtype=np.float64))


def _refusal(t_s: FloatArray, wrench: FloatArray, *, weighed: bool) -> str:
    """Return the reason for refusing these samples, or ""; NaN is refused."""
    if len(t_s) < MIN_TARE_SAMPLES or not float(t_s[-1] - t_s[0]) >= MIN_TARE_SPAN_S:
        return f"{len(t_s)} samples are too few or span too short a time"
    if not np.isfinite(wrench).all():
        return "a sample is not a finite number"
    half = len(wrench) // 2
    noise = _largest(wrench.std(axis=0, ddof=1))
    motion = _largest(np.abs(wrench[half:].mean(axis=0) - wrench[:half].mean(axis=0)))
    for kind, measured, allowed in (("noise", noise, TARE_NOISE), ("drift", motion, TARE_MOTION)):
        if not (measured[0] <= allowed[0] and measured[1] <= allowed[1]):
            return f"{kind} of {measured[0]:.2f} N, {measured[1]:.3f} N·m in still air"
    load_n = math.hypot(*wrench[:, :3].mean(axis=0))
    if weighed and not load_n <= TARE_LOAD_N:
        return f"{load_n:.1f} N beyond the payload: the piece touches something"
    return ""


def _largest(channels: FloatArray) -> tuple[float, float]:
    """Return the largest of the forces and of the moments in ``channels`` (6,)."""
    return float(channels[:3].max()), float(channels[3:].max())


REST_FRAMES = 10  # frames of a reference
MIN_REST_FRAMES = 3
# Noise of one marker centre on a still gel (measured on real frames, docs/tracking.md).
NOISE_FLOOR_PX = 0.06
MOTION_FACTOR = 3.0
CONTACT_PX = 0.7  # change of shape (rms, without affine part) that means contact


@dataclass(frozen=True, slots=True)
class TactileReference:
    """Mean of still frames: ``position_px`` (63, 2), ``noise_px`` (63,) sigma per marker at rest.

    ``t_s``: bench time of the newest frame; ``frames``: number of averaged frames.
    """

    finger: Finger
    t_s: float
    position_px: FloatArray
    noise_px: FloatArray
    frames: int

    def __post_init__(self) -> None:
        read_only(self.position_px)
        read_only(self.noise_px)

    @property
    def sha256(self) -> str:
        """Hash of the rest positions."""
        return sha256(np.ascontiguousarray(self.position_px, dtype="<f8").tobytes()).hexdigest()


def take_reference(
    fields: Sequence[MarkerField], template: TactileReference | None = None
) -> TactileReference:
    """Average ``fields`` of one finger, oldest first, into a reference.

    ``template``: a no-contact reference of the same gel, such as the first one in air after
    gripping; with it a gel in contact is refused. Raises ``RefusedError`` with reason
    "frames" (too few or of two fingers), "markers" (not all seen), "motion" (more than three times
    the noise floor) or "contact".
    """
    if len(fields) < MIN_REST_FRAMES or len({field.finger for field in fields}) > 1:
        raise RefusedError(
            "frames", f"A reference needs {MIN_REST_FRAMES} or more frames of one finger."
        )
    hidden = max(int((field.state != MarkerState.SEEN).sum()) for field in fields)
    if hidden:
        raise RefusedError(
            "markers", f"{hidden} of the {MARKERS} markers are not seen; clean or check the gel."
        )
    places = np.stack([field.position_px for field in fields])
    rest = places.mean(axis=0)
    motion_px = float(np.sqrt(((places - rest) ** 2).mean(axis=(1, 2)).max()))
    if motion_px > MOTION_FACTOR * NOISE_FLOOR_PX:
        raise RefusedError(
            "motion",
            f"The gel moves by {motion_px:.2f} px; wait until it is still "
            f"(at most {MOTION_FACTOR * NOISE_FLOOR_PX:.2f} px).",
        )
    if template is not None:
        refuse_contact(rest, [template.position_px])
    noise = places.std(axis=0, ddof=1).mean(axis=1)
    return TactileReference(fields[-1].finger, fields[-1].t_s, rest, noise, len(fields))


def refuse_contact(position_px: FloatArray, templates_px: Sequence[FloatArray]) -> None:
    """Raise ``RefusedError`` "contact" unless (63, 2) positions have the shape of a template."""
    change_px = min(shape_change_px(position_px, template) for template in templates_px)
    if not change_px <= CONTACT_PX:
        raise RefusedError(
            "contact",
            f"The gel is pressed {change_px:.2f} px out of its no-contact shape "
            f"(at most {CONTACT_PX:.2f} px).",
        )


def shape_change_px(position_px: FloatArray, rest_px: FloatArray) -> float:
    """Return the rms change of shape between two (63, 2) grids beyond an affine motion, in px."""
    model = np.column_stack([rest_px, np.ones(MARKERS)])
    change = position_px - rest_px
    fitted = model @ np.linalg.lstsq(model, change, rcond=None)[0]
    return float(np.sqrt(((change - fitted) ** 2).sum(axis=1).mean()))


BLOCK_S = 0.5  # length of the blocks whose means are compared
MIN_BLOCK_S = 0.15  # shorter blocks are discarded
LOAD_STEP_N = 0.15  # A larger step between two means, if beyond the noise, is a load
MAX_DRIFT_N_S = 0.1  # additional step allowed per second between two stays in air
NOISE_FACTOR = 8.0
MAX_SAMPLE_GAP_S = 0.2  # A longer gap between samples ends a stay in air
MAX_AIR_GAP_S = 60.0  # after a longer time out of the air, drift is unknown
# Drift is reported over this time, the largest age of a tare (reliability S8).
DRIFT_WINDOW_S = 300.0
# Drift at which a warning starts, well below 1 N, and at which it ends.
WARN_DRIFT_N, CLEAR_DRIFT_N = 0.5, 0.25
MIN_DRIFT_SPAN_S = 5.0  # shortest time in air for a result


@dataclass(frozen=True, slots=True)
class WrenchDrift:
    """Drift of a still wrist sensor in N within ``over_s``; ``named``: True if a warning is due."""

    moved_n: float
    over_s: float
    named: bool = False

    @property
    def rate_n_s(self) -> float:
        """Mean rate in N a second."""
        return self.moved_n / self.over_s

    def text(self) -> str:
        """Return the form stored in an episode."""
        return f"{self.moved_n:.3f} N in {self.over_s:.1f} s"

    def words(self) -> str:
        """Return the displayed form."""
        over = f"{self.over_s:.0f} s" if self.over_s < 99.5 else f"{self.over_s / 60.0:.0f} min"
        return f"drift {self.moved_n:.2f} N in {over}"


@dataclass(frozen=True, slots=True)
class _AirMean:
    """Mean force (3,) of a block in still air, its end, and its standard deviation, N."""

    until_s: float
    mean_n: FloatArray
    sigma_n: float


class WrenchDriftEstimator:
    """Accumulates the drift of the wrench in still air."""

    def __init__(self) -> None:
        self._blocks: list[tuple[FloatArray, FloatArray]] = []
        self._last: _AirMean | None = None
        self._contiguous = False
        self._sum_n = np.zeros(3)
        self._step_n: FloatArray | None = None
        self._loaded = False
        self._told: deque[tuple[float, FloatArray]] = deque()
        self._named = False

    def feed(self, t_s: FloatArray, force_n: FloatArray) -> None:
        """Add untared samples (n,), (n, 3) in still air, with the same load as before."""
        finite = np.isfinite(force_n).all(axis=1)
        t_s, force_n = t_s[finite], force_n[finite]
        if not len(t_s):
            return
        if self._blocks and t_s[0] - self._blocks[-1][0][-1] > MAX_SAMPLE_GAP_S:
            self.leave()
        self._blocks.append((t_s, force_n))
        if t_s[-1] - self._blocks[0][0][0] >= BLOCK_S:
            self._close()

    def leave(self) -> None:
        """End a stay in still air; larger changes are allowed until the next one."""
        if self._blocks and self._blocks[-1][0][-1] - self._blocks[0][0][0] >= MIN_BLOCK_S:
            self._close()
        self._blocks.clear()
        self._contiguous = False

    def reload(self) -> None:
        """Restart with another load: a piece was gripped or released, or the hand rotated."""
        self.leave()
        self._last = None

    def drift(self) -> WrenchDrift | None:
        """Return the drift, None while there is too little data."""
        if not self._told or self._told[-1][0] - self._told[0][0] < MIN_DRIFT_SPAN_S:
            return None
        (first_s, first_n), (last_s, last_n) = self._told[0], self._told[-1]
        moved_n = float(np.linalg.norm(last_n - first_n))
        self._named = moved_n >= (CLEAR_DRIFT_N if self._named else WARN_DRIFT_N)
        return WrenchDrift(moved_n, last_s - first_s, self._named)

    def _close(self) -> None:
        """Average the collected samples and compare them with the block before."""
        t_s, force_n = (np.concatenate(part) for part in zip(*self._blocks, strict=True))
        self._blocks.clear()
        sigma_n = float(force_n.std(axis=0).max()) / math.sqrt(len(t_s))
        air = _AirMean(float(t_s[-1]), force_n.mean(axis=0), sigma_n)
        before, self._last = self._last, air
        if before is None:
            self._count(None)
        elif self._is_load(before, air):
            # The neighbouring means may contain a part of the load.
            self._step_n, self._loaded = None, True
        else:
            self._count(None if self._loaded else air.mean_n - before.mean_n)
        self._contiguous = True
        self._told.append((air.until_s if before is None else before.until_s, self._sum_n))
        while self._told[0][0] < air.until_s - DRIFT_WINDOW_S:
            self._told.popleft()

    def _count(self, step_n: FloatArray | None) -> None:
        """Add the former step, which no load followed, and keep this one."""
        if self._step_n is not None:
            self._sum_n = self._sum_n + self._step_n
        self._step_n, self._loaded = step_n, False

    def _is_load(self, before: _AirMean, air: _AirMean) -> bool:
        gap_s = 0.0 if self._contiguous else air.until_s - before.until_s
        noise_n = NOISE_FACTOR * math.hypot(air.sigma_n, before.sigma_n)
        moved_n = float(np.linalg.norm(air.mean_n - before.mean_n))
        return gap_s > MAX_AIR_GAP_S or moved_n > max(LOAD_STEP_N, noise_n) + MAX_DRIFT_N_S * gap_s
