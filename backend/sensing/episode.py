"""A recorded probe becomes an episode: common clock, quality verdict, identity."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

from backend.config.method import SAMPLES_PER_PROBE, TICK_S
from backend.core.flow import FINGERS, MARKERS, Episode, EpisodeQuality, FloatArray, Recording
from backend.sensing.press_slip import press_slip_mm
from backend.sensing.synchroniser import (
    ROUNDING_S,
    FingerTicks,
    Synchronised,
    SyncLimits,
    synchronise,
)


@dataclass(frozen=True, slots=True)
class EpisodeLimits:
    """When a probe is an observation. Every limit is a positive comparison: NaN refuses."""

    least_ticks: int = SAMPLES_PER_PROBE - 1
    """Ticks per finger with a frame within 60 ms (reliability C5)."""
    longest_hole_s: float = 0.200
    """Longest time without a frame (reliability C5)."""
    inferred_share: float = 0.25
    """Upward shear moves one row of seven out of the image: 14 % inferred is normal."""
    lost_markers: int = 6
    """Six covered dots are what the tracker is tested to bridge (marker-tracking, occlusion)."""
    contact_n: float = 1.0
    """Least press force at the last tick: the contact threshold of the press."""
    slip_mm: float = 0.3
    """Largest slip in the grasp, as in the release interlock."""
    sync: SyncLimits = field(default_factory=SyncLimits)


def assemble(
    recording: Recording,
    *,
    onset_s: float,
    offset_mm: FloatArray,
    piece: str,
    limits: EpisodeLimits | None = None,
    metadata: tuple[tuple[str, str], ...] = (),
) -> Episode:
    """Return the episode of one probe, accepted or not.

    ``onset_s`` is the back-dated contact; ``offset_mm`` (2,) the commanded displacement. An
    episode with a missing or non-finite value is never accepted, and its observation holds NaN.
    The identity is a digest of the content: equal runs give equal episodes.
    """
    limits = limits or EpisodeLimits()
    ticks = synchronise(recording, onset_s, limits.sync)
    observation = ticks.observation()
    slip_mm = press_slip_mm(recording, onset_s, onset_s + SAMPLES_PER_PROBE * TICK_S)
    offset = np.array(offset_mm, dtype=np.float64)
    quality = judge_quality(ticks, slip_mm, limits)
    if quality.accepted and not (np.isfinite(offset).all() and np.isfinite(observation).all()):
        quality = _refused(quality, "A value of the observation is not a finite number")
    bridged = _bridged(ticks)
    return Episode(
        episode_id=_digest(observation, offset, onset_s, piece, recording),
        piece=piece,
        observation=observation,
        offset_mm=offset,
        onset_s=onset_s,
        quality=quality,
        recording=recording,
        metadata=(*metadata, ("bridged_ticks", bridged)) if bridged else metadata,
    )


def judge_quality(ticks: Synchronised, slip_mm: float, limits: EpisodeLimits) -> EpisodeQuality:
    """Say whether a probe on the common clock is an observation, with the reasons in words."""
    inferred = float(np.mean([finger.inferred for finger in ticks.fingers]))
    lost = sum(int(finger.lost.any(axis=0).sum()) for finger in ticks.fingers)
    reasons: list[str] = []
    for name, finger in zip(FINGERS, ticks.fingers, strict=True):
        reasons += _frame_reasons(name, finger, limits)
    if not inferred <= limits.inferred_share:
        reasons.append(f"{100 * inferred:.0f} % of the markers were not seen")
    if not lost <= limits.lost_markers:
        reasons.append(f"{lost} of {2 * MARKERS} markers were lost")
    reasons += _wrench_reasons(ticks.wrench, limits)
    if not 0 <= slip_mm <= limits.slip_mm:
        known = np.isfinite(slip_mm)
        reasons.append(
            f"The piece slipped by {slip_mm:.2f} mm in the grasp"
            if known
            else "Slip in the grasp cannot be judged"
        )
    return EpisodeQuality(
        accepted=not reasons,
        reasons=tuple(reasons),
        dropped_frames=sum(finger.dropped for finger in ticks.fingers),
        inferred_share=inferred,
        lost_markers=lost,
        skew_ms=1e3 * ticks.skew_s,
        slip_mm=slip_mm,
    )


def _frame_reasons(name: str, finger: FingerTicks, limits: EpisodeLimits) -> list[str]:
    reasons = []
    near = int(finger.near.sum())
    if not near >= limits.least_ticks:
        reasons.append(f"The {name} camera has a frame at {near} of {SAMPLES_PER_PROBE} ticks only")
    if not finger.hole_s <= limits.longest_hole_s + ROUNDING_S:
        reasons.append(f"The {name} camera gave no frame for {1e3 * finger.hole_s:.0f} ms")
    missing = int((~np.isfinite(finger.displacement_px).all(axis=(1, 2))).sum())
    if missing and not reasons:
        reasons.append(f"The {name} camera has no frame on both sides of {missing} tick(s)")
    return reasons


def _wrench_reasons(wrench: FloatArray, limits: EpisodeLimits) -> list[str]:
    missing = int((~np.isfinite(wrench).all(axis=1)).sum())
    if missing:
        return [f"The force sensor has no whole reading at {missing} of {len(wrench)} ticks"]
    press_n = float(wrench[-1, 2])
    if not press_n >= limits.contact_n:
        return [f"No contact: {press_n:.2f} N at the end of the press"]
    return []


def _refused(quality: EpisodeQuality, reason: str) -> EpisodeQuality:
    return EpisodeQuality(
        accepted=False,
        reasons=(*quality.reasons, reason),
        dropped_frames=quality.dropped_frames,
        inferred_share=quality.inferred_share,
        lost_markers=quality.lost_markers,
        skew_ms=quality.skew_ms,
        slip_mm=quality.slip_mm,
    )


def _bridged(ticks: Synchronised) -> str:
    """Name the ticks that lie in a hole and were interpolated across it: nothing in silence."""
    return " ".join(
        f"{name}:{number + 1}"
        for name, finger in zip(FINGERS, ticks.fingers, strict=True)
        for number in np.flatnonzero(~finger.near)
        if np.isfinite(finger.displacement_px[number, 0, 0])
    )


def _digest(
    observation: np.ndarray[tuple[int, ...], np.dtype[np.float32]],
    offset_mm: FloatArray,
    onset_s: float,
    piece: str,
    recording: Recording,
) -> str:
    arrays = (np.float64(onset_s), observation, offset_mm, recording.wrench_t_s, recording.wrench)
    content = (piece.encode(), *(np.ascontiguousarray(array).tobytes() for array in arrays))
    return hashlib.sha256(b"".join(content)).hexdigest()[:32]
