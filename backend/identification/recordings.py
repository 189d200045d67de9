"""Recordings of a dataset as the input of an identification: presses and rest in air.

Only measured signals, labels and the settings of the press are read. Presses are sampled at the
ticks of the model input, with the signals before contact subtracted.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from touchdown.backend.annotations import Dataset, EpisodeEntry, EpisodeFilter, Label
from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S, ProbeSettings
from touchdown.backend.core import FINGERS, MARKERS, FloatArray, InputError, MarkerState, Recording
from touchdown.backend.episodes import REST_KEY, read_compressed_episode, read_first
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.sensing import DRAGGED, synchronise

STEPS_PER_TICK = 2  # samples of the hand's path a tick
STEPS = STEPS_PER_TICK * SAMPLES_PER_PROBE
STEP_S = TICK_S / STEPS_PER_TICK
AIR_END_S = 0.04  # the window in air ends this long before the onset
LEAST_AIR_S = 0.15
GEL_STAGES = ("", "gel")
CONTACT_STAGE = "contact"

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class PressRecording:
    """One recorded press; ``offset_mm`` (2,) is the measured displacement of its label."""

    uuid: str
    grip: str
    mounting: str
    piece: str
    bottom: str
    stage: str
    accepted: bool
    offset_mm: FloatArray
    sigma_mm: float
    onset_s: float
    probe: ProbeSettings
    signals: Recording
    imported: bool = False  # tared on the air before the press


@dataclass(frozen=True, slots=True, eq=False)
class RestRecording:
    """Signals at rest in air, in blocks that follow each other.

    ``levels``: per finger the mean grey level of each stored image. ``lossless``: images were
    stored without loss.
    """

    blocks: tuple[Recording, ...]
    levels: tuple[FloatArray, FloatArray]
    lossless: bool

    @classmethod
    def joined(cls, parts: Sequence[RestRecording]) -> RestRecording:
        """Return the recordings ``parts`` as one."""
        left, right = (np.concatenate([part.levels[k] for part in parts]) for k in range(2))
        blocks = tuple(block for part in parts for block in part.blocks)
        return cls(blocks, (left, right), all(part.lossless for part in parts))

    @property
    def length_s(self) -> float:
        """Total length in s."""
        return float(sum(b.wrench_t_s[-1] - b.wrench_t_s[0] for b in self.blocks))


@dataclass(frozen=True, slots=True, eq=False)
class Recordings:
    """All recordings of a dataset; ``sha256`` of the episodes in order identifies them.

    ``simulated``: no real device took part.
    """

    presses: tuple[PressRecording, ...]
    rest: RestRecording | None
    sha256: tuple[str, ...]
    simulated: bool = True

    def of_stage(self, *stages: str) -> list[PressRecording]:
        """Return the presses recorded for one of ``stages``."""
        return [press for press in self.presses if press.stage in stages]


def read_recordings(dataset: Dataset, progress: Progress = lambda _done, _of: None) -> Recordings:
    """Read presses and rest of a dataset; raises ``InputError`` for a damaged episode."""
    entries = [e for e in dataset.episodes(EpisodeFilter()) if e.mode != "mass"]
    presses: list[PressRecording] = []
    rests: dict[str, list[RestRecording]] = {}
    for done, entry in enumerate(entries):
        progress(done, len(entries))
        compressed = read_compressed_episode(dataset.folder / entry.path)
        episode = compressed.episode
        if episode.recording is None:
            continue
        if dict(episode.metadata).get(REST_KEY):
            films = [compressed.pictures[finger] for finger in FINGERS]
            left, right = (
                np.array([film.picture(k).mean() for k in range(0, len(film.packed), 5)])
                for film in films
            )
            block = RestRecording((episode.recording,), (left, right), entry.keep_frames == "png")
            rests.setdefault(entry.mounting_id, []).append(block)
            continue
        facts = read_first(dataset.folder / entry.path).metadata["bench"]
        reasons = episode.quality.reasons
        slipped = all("slipped" in reason or DRAGGED in reason for reason in reasons)
        label = dataset.labels.head(entry.uuid).label
        used = episode.quality.accepted or (slipped and facts.get("stage") == CONTACT_STAGE)
        if used and label.is_set:
            presses.append(_press(entry, facts, label, episode.recording, episode.onset_s))
    simulated = all(entry.mode not in ("lab", "imported") for entry in entries)
    # The clock starts anew with each mounting: only the longest rest is used.
    longest = max(rests.values(), key=len, default=[])
    rest = RestRecording.joined(longest) if longest else None
    return Recordings(tuple(presses), rest, tuple(entry.sha256 for entry in entries), simulated)


def _press(
    entry: EpisodeEntry, facts: dict[str, str], label: Label, signals: Recording, onset_s: float
) -> PressRecording:
    probe = ProbeSettings.model_validate(json.loads(facts.get("probe", "{}")))
    return PressRecording(
        uuid=entry.uuid,
        grip=entry.grip_id,
        mounting=entry.mounting_id,
        piece=entry.piece,
        bottom=entry.bottom,
        stage=facts.get("stage", ""),
        accepted=entry.quality.accepted,
        offset_mm=label.offset_mm,
        sigma_mm=1e-3 * (label.sigma_um or 100),
        onset_s=onset_s,
        probe=probe,
        signals=signals,
        imported=entry.mode == "imported",
    )


LEAST_PRESSES, LEAST_GRIPS, LEAST_MOUNTINGS = 24, 5, 2
LEAST_WRENCH_HZ, LEAST_FRAMES_HZ = 100.0, 10.0
LEAST_TRAVEL_MM, LEAST_RANGE_MM = 0.5, 4.0
SATURATED_SHARE = 0.2  # equal extreme values of a channel in contact
RECORD_GEL = "Record more with `touchdown collect --plan gel`."
NAME_GRIPS = "Name grips and mountings in [grips] of the mapping, and import into another dataset."
RECORD_WHOLE = "Record whole presses, from the air to 2 s after contact: `collect --plan gel`."


def refuse_unusable(presses: Sequence[PressRecording], library: PieceLibrary, where: str) -> None:
    """Raise ``InputError`` naming what the recordings lack and which recording adds it."""
    grips = {press.grip for press in presses}
    mountings = {press.mounting for press in presses}
    numbers = (
        ("valid presses", len(presses), LEAST_PRESSES),
        ("grippings with valid presses", len(grips), LEAST_GRIPS),
        ("mountings with valid presses", len(mountings), LEAST_MOUNTINGS),
    )
    for what, count, least in numbers:
        if count < least:
            text = f"The dataset has {count} {what}; an identification needs {least}."
            divided = what.startswith("valid") or not all(press.imported for press in presses)
            raise InputError(text, where, RECORD_GEL if divided else NAME_GRIPS)
    free = sorted({p.bottom for p in presses if not library.bottom(p.bottom).fixed})
    if free:
        raise InputError(
            f"The bottom {free[0]} can move, which hides the stiffness of the grasp.", where,
            "Record on a bottom that is fixed to the table, such as square15.",
        )  # fmt: skip
    offsets = np.array([press.offset_mm for press in presses])
    if float(np.ptp(offsets, axis=0).min()) < LEAST_RANGE_MM:
        raise InputError(
            f"All presses lie within {LEAST_RANGE_MM:g} mm of each other.", where,
            "Record displacements over the whole face, without --within.",
        )  # fmt: skip
    problems = [found for press in presses if (found := _press_problem(press)) is not None]
    if 2 * len(problems) > len(presses):
        common = max(problems, key=problems.count)
        what = f"{len(problems)} of {len(presses)} presses cannot be used: {common[0]}."
        raise InputError(what, where, common[1])


def _press_problem(press: PressRecording) -> tuple[str, str] | None:
    """Return why a press cannot be used, and what to record; None if it can."""
    signals, onset_s = press.signals, press.onset_s
    if len(signals.wrench_t_s) < 2 or len(signals.pose_t_s) < 2:
        return "wrench or pose is missing", "Record with wrist sensor and arm connected."
    wrench_hz = 1.0 / float(np.median(np.diff(signals.wrench_t_s)))
    if not wrench_hz >= LEAST_WRENCH_HZ:
        what = f"the wrist sensor gives {wrench_hz:.0f} Hz"
        return what, f"Set it to at least {LEAST_WRENCH_HZ:g} Hz and record again."
    for finger in FINGERS:
        t_s = np.array([field.t_s for field in signals.fields if field.finger == finger])
        if len(t_s) < 2 or not np.median(np.diff(t_s)) <= 1.0 / LEAST_FRAMES_HZ:
            what = f"the {finger} camera gives fewer than {LEAST_FRAMES_HZ:g} frames a second"
            return what, "Raise its frame rate and record again."
    held_s = float(min(signals.wrench_t_s[-1], signals.pose_t_s[-1])) - onset_s
    if held_s < SAMPLES_PER_PROBE * TICK_S - 1e-6:
        return f"it ends {max(held_s, 0.0):.1f} s after contact", RECORD_WHOLE
    if signals.wrench_t_s[0] > onset_s - LEAST_AIR_S:
        return "the time in air before contact is missing", RECORD_WHOLE
    if float(np.ptp(signals.pose_mm[:, 2])) < LEAST_TRAVEL_MM:
        return "the arm does not move", "Record presses with the arm, and its measured pose."
    top = np.abs(signals.wrench[signals.wrench_t_s > onset_s + 0.5, 2])
    if len(top) and float((top == top.max()).mean()) > SATURATED_SHARE:
        what = f"the press force is saturated at {float(top.max()):.1f} N"
        return what, "Widen the range of the wrist sensor, or record a plan of less depth_mm."
    return None


@dataclass(frozen=True, slots=True, eq=False)
class PressSet:
    """B sampled presses.

    ``motion_mm`` (B, 40, 3): path of the measured hand from the onset, every 50 ms. ``wrench``
    (B, 20, 6) and ``field_px`` (B, 20, 2, 63, 2) at the ticks, less their means in air; ``seen``
    (B, 20, 2, 63). ``air_wrench``, ``air_sd`` (B, 6) and ``air_px`` (B, 2, 2): mean and standard
    deviation in air after tare and reference. ``contact_mm`` (B,): height of the hand at the onset.
    ``grip``, ``mounting`` (B,): numbers of the names in ``grips``, and of the mountings.
    """

    recordings: tuple[PressRecording, ...]
    grips: tuple[str, ...]
    grip: NDArray[np.intp]
    mounting: NDArray[np.intp]
    offset_mm: FloatArray
    contact_mm: FloatArray
    motion_mm: FloatArray
    wrench: FloatArray
    field_px: FloatArray
    seen: NDArray[np.bool_]
    air_wrench: FloatArray
    air_sd: FloatArray
    air_px: FloatArray

    def __len__(self) -> int:
        return len(self.grip)

    def take(self, rows: NDArray[np.intp]) -> PressSet:
        """Return the presses ``rows``; grips and mountings keep their numbers."""
        names = ("grip", "mounting", "offset_mm", "contact_mm", "motion_mm", "wrench", "field_px",
                 "seen", "air_wrench", "air_sd", "air_px")  # fmt: skip
        parts = {name: getattr(self, name)[rows] for name in names}
        return replace(self, recordings=tuple(self.recordings[i] for i in rows), **parts)


@dataclass(frozen=True, slots=True)
class Delays:
    """Delays of wrench and markers behind the measured pose, s."""

    wrench_s: float = 0.0
    markers_s: float = 0.0


def sample_presses(presses: Sequence[PressRecording], delays: Delays) -> PressSet:
    """Sample the usable ``presses``; ``delays`` are taken out of the time stamps."""
    kept, parts = [], []
    for press in presses:
        if _press_problem(press) is None:
            part = _sampled(press, delays)
            if all(np.isfinite(value).all() for value in part.values()):
                kept.append(press)
                parts.append(part)
    if not kept:
        raise InputError("No press can be sampled.", "recordings", RECORD_GEL)
    grips = tuple(dict.fromkeys(press.grip for press in kept))
    mountings = tuple(dict.fromkeys(press.mounting for press in kept))
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    return PressSet(
        recordings=tuple(kept),
        grips=grips,
        grip=np.array([grips.index(press.grip) for press in kept]),
        mounting=np.array([mountings.index(press.mounting) for press in kept]),
        offset_mm=np.stack([press.offset_mm for press in kept]),
        seen=stacked.pop("seen").astype(bool),
        **stacked,
    )


def _sampled(press: PressRecording, delays: Delays) -> dict[str, FloatArray]:
    raw, onset_s = press.signals, press.onset_s
    signals = replace(
        raw,
        wrench_t_s=raw.wrench_t_s - delays.wrench_s,
        fields=tuple(replace(f, t_s=f.t_s - delays.markers_s) for f in raw.fields),
    )
    ticks = synchronise(signals, onset_s)
    air_end_s = onset_s - AIR_END_S
    air = signals.wrench[signals.wrench_t_s < air_end_s]
    path = make_interp_spline(signals.pose_t_s, signals.pose_mm, k=1)
    hand = path(onset_s + STEP_S * np.arange(STEPS + 1))

    def travel(t_s: FloatArray) -> FloatArray:
        inside = np.clip(t_s, signals.pose_t_s[0], signals.pose_t_s[-1])
        return np.asarray(np.maximum(hand[0, 2] - path(inside)[:, 2], 0.0) + 1e-3)

    field, seen, still = [], [], []
    for finger, at_ticks in zip(FINGERS, ticks.fingers, strict=True):
        own = [f for f in signals.fields if f.finger == finger and f.t_s < air_end_s]
        moved = np.array([f.displacement_px for f in own]).reshape(-1, MARKERS, 2)
        rest = moved.mean(axis=0) if len(own) else np.full((MARKERS, 2), np.nan)
        # Between two frames the markers follow the travel, which is no straight line at touch and
        # at the end of the ramp.
        t_s = np.array([f.t_s for f in signals.fields if f.finger == finger])
        share = travel(ticks.tick_s) / np.interp(ticks.tick_s, t_s, travel(t_s))
        field.append((at_ticks.displacement_px - rest) * share[:, None, None])
        seen.append(~at_ticks.inferred)
        still.append(rest.mean(axis=0))
    return {
        "contact_mm": np.asarray(hand[0, 2]),
        "motion_mm": hand[1:] - hand[0],
        "wrench": ticks.wrench - air.mean(axis=0),
        "field_px": np.stack(field, axis=1),
        "seen": np.stack(seen, axis=1).astype(float),
        "air_wrench": air.mean(axis=0),
        "air_sd": air.std(axis=0, ddof=1),
        "air_px": np.stack(still),
    }


def seen_in(fields: Recording, finger: str) -> NDArray[np.bool_]:
    """Return (n, 63): markers that were detected in the fields of ``finger``."""
    state = np.array([f.state for f in fields.fields if f.finger == finger]).reshape(-1, MARKERS)
    return np.asarray(state == int(MarkerState.SEEN))
