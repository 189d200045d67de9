"""Frames that are dropped, and in plain loops what must become of the episode.

A tick has a value only between two frames at most 200 ms apart, and then the one that lies on the
line between them. It is near a frame within 60 ms, else it is marked. An episode needs 19 of 20
ticks near a frame, for each finger, and no hole over 200 ms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from touchdown.backend.core.values import FINGERS, Finger, MarkerField, Recording
from touchdown.backend.sensing.episode import assemble_episode

ONSET_S, PERIOD_S, COUNT = 5.0, 0.04, 60
ONSET_US, TICKS_US = 5_000_000, tuple(range(5_100_000, 7_000_001, 100_000))
"""The clock counts whole microseconds: a hole of 200 ms is one of 200,000."""
KINDS = ("10 % dropped", "30 % dropped", "burst of 0.5 s", "2 % and a short burst")
Frames = list[tuple[int, float]]
"""Time in microseconds and the value of all its markers along u, of each frame that came."""


@dataclass(frozen=True, slots=True)
class Expected:
    """Of one finger: value of each tick (None: none), the marked ones, and whether it will do."""

    values: tuple[float | None, ...]
    marked: tuple[int, ...]
    good: bool


def expect(frames: Frames) -> Expected:
    """Return what the rules say of ``frames``."""
    values: list[float | None] = []
    marked, near = [], 0
    for number, tick_us in enumerate(TICKS_US, start=1):
        before = [frame for frame in frames if frame[0] <= tick_us]
        after = [frame for frame in frames if frame[0] >= tick_us]
        if not before or not after or after[0][0] - before[-1][0] > 200_000:
            values.append(None)
            continue
        (t0, v0), (t1, v1) = before[-1], after[0]
        values.append(v0 + (v1 - v0) * (tick_us - t0) / (t1 - t0))
        if min(tick_us - t0, t1 - tick_us) <= 60_000:
            near += 1
        else:
            marked.append(number)
    inside = [t for t, _ in frames if ONSET_US < t < TICKS_US[-1]]
    first = [t for t, _ in frames if t <= ONSET_US][-1:]
    last = [t for t, _ in frames if t >= TICKS_US[-1]][:1]
    hole_us = max((b - a for a, b in pairwise([*first, *inside, *last])), default=np.inf)
    return Expected(
        tuple(values), tuple(marked), None not in values and near >= 19 and hole_us <= 200_000
    )


def broken(patterns: int, whole: Recording, seed: int = 5) -> tuple[list[str], int]:
    """Drop frames of ``whole`` (``COUNT`` a finger) at random, by each of ``KINDS`` in turn.

    Returns what differs from the oracle, and how many episodes were accepted.
    """
    rng = np.random.default_rng(seed)
    # Each frame shows something else: what is made up between two of them cannot go unseen.
    shown = {finger: rng.uniform(-3.0, 3.0, COUNT) for finger in FINGERS}
    fields = [_showing(field, shown[field.finger][field.sequence]) for field in whole.fields]
    wrong, accepted = [], 0
    for pattern in range(patterns):
        kind = KINDS[pattern % len(KINDS)]
        kept = {finger: _kept(kind, rng) for finger in FINGERS}
        came = [field for field in fields if kept[field.finger][field.sequence]]
        episode = assemble_episode(
            replace(whole, fields=tuple(came)), onset_s=ONSET_S, offset_mm=np.zeros(2), piece="pot"
        )
        told: dict[Finger, Expected] = {
            finger: expect(
                [
                    (round(1e6 * f.t_s), float(f.displacement_px[0, 0]))
                    for f in came
                    if f.finger == finger
                ]
            )
            for finger in FINGERS
        }
        accepted += episode.quality.accepted
        if episode.quality.accepted != all(one.good for one in told.values()):
            wrong.append(f"{pattern}: verdict, {kind}: {episode.quality.reasons}")
        values = episode.observation[:, :252].reshape(20, 2, 2, 63)[:, :, 0]
        for k, finger in enumerate(FINGERS):
            due = np.array([np.nan if v is None else v for v in told[finger].values])
            if not np.allclose(values[:, k], due[:, None], atol=1e-4, equal_nan=True):
                wrong.append(f"{pattern}: values, {kind}, {finger}")
        marks = " ".join(f"{f}:{n}" for f in FINGERS for n in told[f].marked)
        if dict(episode.metadata).get("bridged_ticks", "") != marks:
            wrong.append(f"{pattern}: marks, {kind}")
    return wrong, accepted


def _kept(kind: str, rng: np.random.Generator) -> np.ndarray:
    share = {"10 % dropped": 0.1, "30 % dropped": 0.3}.get(kind, 0.02)
    keep = rng.random(COUNT) >= share
    if "burst" in kind:
        start = int(rng.integers(5, 45))
        length = round(0.5 / PERIOD_S) if kind == KINDS[2] else int(rng.integers(1, 7))
        keep[start : start + length] = False
    keep[:4] = True
    return keep


def _showing(field: MarkerField, value: float) -> MarkerField:
    moved = field.displacement_px.copy()
    moved[:, 0] = value
    return replace(field, displacement_px=moved)
