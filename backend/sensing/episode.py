"""Assembly of an episode from a recorded probe: common clock, quality verdict, identity.

Ticks are at 0.1, 0.2 ... 2.0 s after the onset on one 10 Hz clock. The wrench of a tick is the mean
of the 100 ms before it; the markers are linearly interpolated between the two frames around it.
Values that were not measured are NaN: nothing is extrapolated, repeated or filled in.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S
from touchdown.backend.core import (
    CHANNELS,
    FINGERS,
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    TACTILE_CHANNELS,
    WRENCH_CHANNELS,
    Episode,
    EpisodeQuality,
    Finger,
    FloatArray,
    MarkerField,
    MarkerState,
    Recording,
    read_only,
)
from touchdown.backend.sensing.slip import press_slip_mm, shortfall_mm

ROUNDING_S = 1e-7  # time stamps are whole microseconds; closer times are equal


NEAREST_FRAME_S = 0.060  # ticks farther from any frame are marked (reliability C5)
LONGEST_HOLE_S = 0.200  # no interpolation between frames farther apart (reliability C5)
DRAGGED = "The arm dragged the piece over the bottom"  # reason of a refusal
WRENCH_SHARE = 0.8  # smallest share of the samples expected in the 100 ms before a tick


@dataclass(frozen=True, slots=True)
class FingerTicks:
    """One finger on the ticks.

    ``displacement_px``: (20, 63, 2), NaN where not measured. ``near``: (20,) a frame is within
    60 ms. ``inferred``, ``lost``: (20, 63) marker not seen, or given up, in a frame used.
    ``skew_s``: (20,) distance of the nearest frame, inf without frames. ``hole_s``: longest time
    without a frame in the probe. ``dropped``: frames missing by sequence number.
    """

    displacement_px: FloatArray
    near: NDArray[np.bool_]
    inferred: NDArray[np.bool_]
    lost: NDArray[np.bool_]
    skew_s: FloatArray
    hole_s: float
    dropped: int

    def __post_init__(self) -> None:
        for array in (self.displacement_px, self.near, self.inferred, self.lost, self.skew_s):
            read_only(array)


@dataclass(frozen=True, slots=True)
class SynchronisedProbe:
    """A probe on the common clock: ``tick_s`` (20,), ``wrench`` (20, 6) with NaN where missing."""

    tick_s: FloatArray
    wrench: FloatArray
    left: FingerTicks
    right: FingerTicks

    def __post_init__(self) -> None:
        read_only(self.tick_s)
        read_only(self.wrench)

    @property
    def fingers(self) -> tuple[FingerTicks, FingerTicks]:
        """Left and right finger."""
        return self.left, self.right

    @property
    def skew_s(self) -> float:
        """Largest distance between a tick and the nearest frame of either finger."""
        return float(max(finger.skew_s.max() for finger in self.fingers))

    def observation(self) -> NDArray[np.float32]:
        """Return (20, 258): [finger][axis][row][col] in px, then the wrench; NaN where missing."""
        both = np.stack([finger.displacement_px for finger in self.fingers], axis=1)
        tactile = both.reshape(SAMPLES_PER_PROBE, 2, GRID_ROWS, GRID_COLS, 2)
        flat = np.moveaxis(tactile, -1, 2).reshape(SAMPLES_PER_PROBE, -1)
        rows = np.concatenate((flat, self.wrench), axis=1).astype(np.float32)
        assert rows.shape == (SAMPLES_PER_PROBE, CHANNELS)
        return rows


def synchronise(recording: Recording, onset_s: float) -> SynchronisedProbe:
    """Resample ``recording`` at the ticks after ``onset_s``; never raises on missing data."""
    steps = np.arange(1, SAMPLES_PER_PROBE + 1, dtype=np.float64)
    tick_s = np.asarray(onset_s + TICK_S * steps, dtype=np.float64)
    left, right = (_finger_on_ticks(recording.fields, finger, tick_s) for finger in FINGERS)
    wrench = wrench_on_ticks(recording.wrench_t_s, recording.wrench, tick_s)
    return SynchronisedProbe(tick_s, wrench, left, right)


def wrench_on_ticks(t_s: FloatArray, wrench: FloatArray, tick_s: FloatArray) -> FloatArray:
    """Return (20, 6): the mean over (tick - 100 ms, tick] of ``wrench`` (n, 6) at ``t_s`` (n,).

    NaN for a tick with fewer than 80 % of the expected samples, or with one that is not
    finite. The expected number follows from the median distance of the samples.
    """
    means = np.full((len(tick_s), WRENCH_CHANNELS), np.nan)
    if len(t_s) < 2:
        return means
    expected = TICK_S / max(float(np.median(np.diff(t_s))), ROUNDING_S)
    first = np.searchsorted(t_s, tick_s - TICK_S + ROUNDING_S, side="right")
    last = np.searchsorted(t_s, tick_s + ROUNDING_S, side="right")
    # Every other sum is between two ticks and is discarded. The row of zeros keeps all start
    # indices valid.
    padded = np.concatenate((wrench, np.zeros((1, WRENCH_CHANNELS))))
    sums = np.add.reduceat(padded, np.stack((first, last), axis=1).ravel(), axis=0)[::2]
    count = last - first
    whole = (count > 0) & (count >= WRENCH_SHARE * expected) & np.isfinite(sums).all(axis=1)
    means[whole] = sums[whole] / count[whole, None]
    return means


def _finger_on_ticks(
    fields: tuple[MarkerField, ...], finger: Finger, tick_s: FloatArray
) -> FingerTicks:
    own = [field for field in fields if field.finger == finger]
    dropped = _missing_numbers(own, tick_s)
    frame_s = np.array([field.t_s for field in own])
    moved = np.array([field.displacement_px for field in own]).reshape(-1, MARKERS, 2)
    state = np.array([field.state for field in own], dtype=np.uint8).reshape(-1, MARKERS)
    # A field with NaN counts as a missing frame.
    whole = np.isfinite(moved).all(axis=(1, 2))
    frame_s, moved, state = frame_s[whole], moved[whole], state[whole]
    before, after, part, measured = _frames_around_ticks(frame_s, tick_s)
    values = np.full((len(tick_s), MARKERS, 2), np.nan)
    worst = np.zeros((len(tick_s), MARKERS), dtype=np.uint8)
    share = part[measured, None, None]
    values[measured] = (1.0 - share) * moved[before[measured]] + share * moved[after[measured]]
    worst[measured] = np.maximum(state[before[measured]], state[after[measured]])
    skew_s = _nearest_frame_s(frame_s, tick_s)
    near = (skew_s <= NEAREST_FRAME_S + ROUNDING_S) & measured
    inferred, lost = worst >= int(MarkerState.INFERRED), worst == int(MarkerState.LOST)
    return FingerTicks(
        values, near, inferred, lost, skew_s, _longest_hole_s(frame_s, tick_s), dropped
    )


def _frames_around_ticks(
    frame_s: FloatArray, tick_s: FloatArray
) -> tuple[NDArray[np.intp], NDArray[np.intp], FloatArray, NDArray[np.bool_]]:
    """Return per tick the frames before and after it, the fraction between, and ``measured``.

    A tick is measured between frames at most ``LONGEST_HOLE_S`` apart, or exactly at a frame.
    """
    if not len(frame_s):
        nothing = np.zeros(len(tick_s), dtype=np.intp)
        return nothing, nothing, np.zeros(len(tick_s)), np.zeros(len(tick_s), dtype=np.bool_)
    last = len(frame_s) - 1
    found = np.searchsorted(frame_s, tick_s - ROUNDING_S, side="left")
    after = np.minimum(found, last)
    exact = np.abs(frame_s[after] - tick_s) <= ROUNDING_S
    before = np.where(exact, after, np.maximum(found - 1, 0))
    gap_s = frame_s[after] - frame_s[before]
    way_s = tick_s - frame_s[before]
    part = np.where(exact | (gap_s <= 0), 0.0, way_s / np.where(gap_s > 0, gap_s, 1.0))
    both_sides = (found > 0) & (found <= last)
    measured = exact | (both_sides & (gap_s <= LONGEST_HOLE_S + ROUNDING_S))
    return before, after, np.asarray(part, dtype=np.float64), measured


def _nearest_frame_s(frame_s: FloatArray, tick_s: FloatArray) -> FloatArray:
    if not len(frame_s):
        return np.full(len(tick_s), np.inf)
    after = np.searchsorted(frame_s, tick_s)
    neighbours = np.stack((np.maximum(after - 1, 0), np.minimum(after, len(frame_s) - 1)))
    return np.asarray(np.abs(frame_s[neighbours] - tick_s).min(axis=0), dtype=np.float64)


def _longest_hole_s(frame_s: FloatArray, tick_s: FloatArray) -> float:
    """Return the longest time without a frame between the onset and the last tick."""
    start, end = float(tick_s[0] - TICK_S), float(tick_s[-1])
    before = frame_s[frame_s <= start + ROUNDING_S]
    after = frame_s[frame_s >= end - ROUNDING_S]
    edges = [float(before[-1]) if len(before) else start, float(after[0]) if len(after) else end]
    inner = frame_s[(frame_s > start + ROUNDING_S) & (frame_s < end - ROUNDING_S)]
    return float(np.diff(np.concatenate((edges[:1], inner, edges[1:]))).max())


def _missing_numbers(fields: list[MarkerField], tick_s: FloatArray) -> int:
    """Count frames missing in the probe by their sequence numbers."""
    start, end = tick_s[0] - TICK_S, tick_s[-1]
    return sum(
        max(0, field.sequence - before.sequence - 1)
        for before, field in pairwise(fields)
        if field.t_s >= start and before.t_s <= end
    )


@dataclass(frozen=True, slots=True)
class EpisodeLimits:
    """Limits for accepting a probe. Comparisons are positive, so that NaN is refused."""

    # Ticks per finger with a frame within 60 ms (reliability C5).
    least_ticks: int = SAMPLES_PER_PROBE - 1
    longest_hole_s: float = LONGEST_HOLE_S  # longest time without a frame
    inferred_share: float = 0.25  # upward shear moves one row of seven out of view: 14 % is normal
    # The tracker is tested with six covered dots (marker-tracking, occlusion).
    lost_markers: int = 6
    contact_n: float = 1.0  # smallest press force at the last tick: the contact threshold
    slip_mm: float = 0.3  # largest slip in the grasp, as in the release interlock


def assemble_episode(
    recording: Recording,
    *,
    onset_s: float,
    offset_mm: FloatArray,
    piece: str,
    metadata: tuple[tuple[str, str], ...] = (),
) -> Episode:
    """Assemble the episode of one probe, accepted or not.

    Parameters
    ----------
    recording
        Signals of the probe at their native rates.
    onset_s
        Back-dated contact, bench clock, s.
    offset_mm
        (2,) commanded displacement of ``F`` in ``O``, mm.
    piece
        Name of the grasped piece.
    metadata
        Further facts by name.

    Returns
    -------
    Episode
        Its ``episode_id`` is a digest of the content. An episode with a missing or non-finite value
        is not accepted, and its observation contains NaN. Never raises on missing data.

    """
    ticks = synchronise(recording, onset_s)
    observation = ticks.observation()
    slip_mm = press_slip_mm(recording, onset_s, onset_s + SAMPLES_PER_PROBE * TICK_S)
    offset = np.array(offset_mm, dtype=np.float64)
    quality = judge_quality(ticks, slip_mm, EpisodeLimits())
    if quality.accepted and not (np.isfinite(offset).all() and np.isfinite(observation).all()):
        reasons = (*quality.reasons, "A value of the observation is not a finite number")
        quality = replace(quality, accepted=False, reasons=reasons)
    bridged = _bridged_ticks(ticks)
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


def judge_quality(
    ticks: SynchronisedProbe, slip_mm: float, limits: EpisodeLimits
) -> EpisodeQuality:
    """Return the quality of a probe on the common clock, with the reasons."""
    inferred = float(np.mean([finger.inferred for finger in ticks.fingers]))
    lost = sum(int(finger.lost.any(axis=0).sum()) for finger in ticks.fingers)
    reasons: list[str] = []
    for name, finger in zip(FINGERS, ticks.fingers, strict=True):
        reasons += _frame_reasons(name, finger, limits)
    if not inferred <= limits.inferred_share:
        reasons.append(f"{100 * inferred:.0f} % of the markers were not seen")
    if not lost <= limits.lost_markers:
        reasons.append(f"{lost} of {2 * MARKERS} markers were lost")
    reasons += _press_reasons(ticks.wrench, slip_mm, limits)
    return EpisodeQuality(
        accepted=not reasons,
        reasons=tuple(reasons),
        dropped_frames=sum(finger.dropped for finger in ticks.fingers),
        inferred_share=inferred,
        lost_markers=lost,
        skew_ms=1e3 * ticks.skew_s,
        slip_mm=slip_mm,
    )


def refuse_observation(
    observation: NDArray[np.float32], travel_mm: FloatArray, limits: EpisodeLimits
) -> list[str]:
    """Return the reasons for which a press is refused, from its model input alone.

    These are the rules of ``judge_quality`` on force and slip, on signals at the ticks.

    Parameters
    ----------
    observation
        (20, 258) model input.
    travel_mm
        (20,) measured travel of the arm at the ticks, downwards from the onset.
    limits
        Limits for accepting a probe.
    """
    values = observation.astype(np.float64)
    markers = values[:, :TACTILE_CHANNELS].reshape(len(values), len(FINGERS), 2, MARKERS)
    slips = [shortfall_mm(travel_mm, shear) for shear in markers[:, :, 1].mean(axis=-1).T]
    return _press_reasons(values[:, TACTILE_CHANNELS:], float(np.max(slips)), limits)


def _press_reasons(wrench: FloatArray, slip_mm: float, limits: EpisodeLimits) -> list[str]:
    """Judge ``wrench`` (20, 6) at the ticks and the slip; NaN slip is refused."""
    reasons = []
    missing, press_n = int((~np.isfinite(wrench).all(axis=1)).sum()), wrench[-1, 2]
    if missing:
        reasons.append(f"The force sensor has no whole reading at {missing} of {len(wrench)} ticks")
    elif not press_n >= limits.contact_n:
        reasons.append(f"No contact: {press_n:.2f} N at the end of the press")
    if not np.isfinite(slip_mm):
        reasons.append("Slip in the grasp cannot be judged")
    elif not 0 <= slip_mm <= limits.slip_mm:
        reasons.append(f"The piece slipped by {slip_mm:.2f} mm in the grasp")
    return reasons


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


def _bridged_ticks(ticks: SynchronisedProbe) -> str:
    """Return the ticks that were interpolated across a hole, such as "left:3 right:7"."""
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
