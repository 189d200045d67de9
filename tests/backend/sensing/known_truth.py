"""The known-truth test of marker tracking, built from its definition.

A real rest frame is warped by a known smooth field that grows to an amplitude and goes back, with
camera noise and one of four faults; the true place of every dot is solved from the same field. The
score compares a tracker with that truth. See docs/tracking.md for the definition in words.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from touchdown.backend.core.values import TactileFrame
from touchdown.backend.sensing.tracker import MarkerTracker

GELSIGHT = Path(__file__).resolve().parents[2] / "data" / "gelsight"
REST_FRAME = GELSIGHT / "nocontact_train_sensor.png"
COVERED = ((2, 5), (2, 6), (2, 7), (3, 3), (3, 4), (3, 8))
SMEAR_BGR = (120, 110, 105)
MARGIN = 30

Field = Callable[[np.ndarray, float], np.ndarray]


@dataclass(frozen=True)
class Case:
    """Amplitude in px and the fault: none, flick, drop or occl."""

    amplitude: float
    fault: str


CASES = tuple(Case(a, fault) for a in (6.0, 14.0) for fault in ("none", "flick", "drop", "occl"))


@dataclass(frozen=True)
class Shot:
    """One frame of a case: its number, image (240, 320, 3), true places (63, 2), covered (63,)."""

    k: int
    image: np.ndarray
    truth: np.ndarray
    covered: np.ndarray


@dataclass(frozen=True)
class Score:
    """Errors in px of one case (``rms`` over e < 10; ``wrong`` counts e >= 10) and ms per frame."""

    rms: float
    rms_seen: float
    worst_covered: float
    wrong: int
    end_drift: float
    lost: int
    late_flags: int
    ms_median: float


def bump_field(q: np.ndarray, a: float) -> np.ndarray:
    """U(q) of the definition for amplitude ``a``; ``q`` (..., 2) in px."""
    xi, eta = (q[..., 0] - 180) / 70, (q[..., 1] - 120) / 60
    g = np.exp(-(xi**2) - eta**2)
    u = -a * (0.8 * g + 0.15 + 0.35 * g * xi)
    v = -a * (0.35 * g + 0.35 * g * eta)
    return np.stack([u, v], axis=-1)


def shear_field(q: np.ndarray, a: float) -> np.ndarray:
    """Field of the *large* extension: more than one pitch in the middle, less around it."""
    xi, eta = (q[..., 0] - 180) / 70, (q[..., 1] - 120) / 60
    g = np.exp(-(xi**2) - eta**2)
    return np.stack([-a * (0.9 * g + 0.1), np.zeros_like(g)], axis=-1)


def upward_field(q: np.ndarray, a: float) -> np.ndarray:
    """Field of the *edge* extension: all dots move up by ``a``."""
    return np.stack([np.zeros(q.shape[:-1]), np.full(q.shape[:-1], a)], axis=-1)


def true_places(rest: np.ndarray, field: Field, a: float) -> np.ndarray:
    """Where the dots at ``rest`` (63, 2) are in the warped image: q = p - U(q)."""
    return _places(rest.tobytes(), field, a).copy()


@lru_cache(maxsize=256)
def _places(rest: bytes, field: Field, a: float) -> np.ndarray:
    start = q = np.frombuffer(rest).reshape(-1, 2)
    for _ in range(60):
        before, q = q, start - field(q, a)
        if np.array_equal(before, q):
            break
    return q


def warp(image: np.ndarray, field: Field, a: float) -> np.ndarray:
    """Inverse warp: the value at q comes from q + U(q)."""
    source = _source(field, a)
    return cv2.remap(
        image, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
    )


@lru_cache(maxsize=256)
def _source(field: Field, a: float) -> np.ndarray:
    rows, cols = 240, 320
    q = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1).astype(float)
    return (q + field(q, a)).astype(np.float32)


def plain_detector(image: np.ndarray) -> np.ndarray:
    """The plain detector of the definition: (n, 2) centroids of dark dots in no order."""
    g = image.max(axis=2).astype(np.float32)
    h = cv2.GaussianBlur(g, (0, 0), 12) - g
    mask = cv2.morphologyEx((h > 14).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    rows, cols = g.shape
    found = []
    for label in range(1, count):
        x, y, w, hh, area = (int(v) for v in stats[label])
        inside = x > 0 and y > 0 and x + w < cols and y + hh < rows
        if not (25 <= area <= 600 and w < 36 and hh < 36 and inside):
            continue
        v, u = np.nonzero(labels == label)
        weight = h[v, u]
        found.append((float(u @ weight / weight.sum()), float(v @ weight / weight.sum())))
    return np.array(found).reshape(-1, 2)


def row_major(dots: np.ndarray) -> np.ndarray:
    """Sort the 63 dots of a frame at rest into 7 rows of 9 (rows are well apart there)."""
    by_row = dots[np.argsort(dots[:, 1])].reshape(7, 9, 2)
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def rest_dots() -> tuple[np.ndarray, np.ndarray]:
    """The real rest frame and P0, its 63 dots in row-major order."""
    image = cv2.imread(str(REST_FRAME))
    return image, row_major(plain_detector(image))


def time_line(amplitude: float) -> np.ndarray:
    """a_k for k = 0..120."""
    up, down = np.linspace(0, amplitude, 51), np.linspace(amplitude, 0, 50)
    return np.concatenate([up, np.full(20, amplitude), down])


def shots(
    case: Case,
    noise: np.random.Generator,
    *,
    field: Field = bump_field,
    line: np.ndarray | None = None,
    occluded: range = range(40, 56),
    base: np.ndarray | None = None,
) -> Iterator[Shot]:
    """Yield the frames of a case; ``noise`` is drawn from in order."""
    image, rest = rest_dots()
    image = image if base is None else base
    grain = np.empty(image.shape)
    for k, a in enumerate(map(float, time_line(case.amplitude) if line is None else line)):
        if case.fault == "drop" and 30 <= k <= 37:
            continue
        truth = true_places(rest, field, a)
        frame = warp(image, field, a).astype(float)
        covered = np.zeros(63, dtype=bool)
        if case.fault == "flick":
            frame *= 1 + 0.25 * np.sin(1.3 * k)
        if case.fault == "occl" and k in occluded:
            for row, col in COVERED:
                covered[row * 9 + col] = True
                centre = tuple(int(v) for v in truth[row * 9 + col])
                cv2.circle(frame, centre, 14, SMEAR_BGR, -1)
        # As ``noise.normal(0, 1.5, ...)``, without the time that new pages of memory take.
        noise.standard_normal(out=grain)
        grain *= 1.5
        frame += grain
        np.clip(frame, 0, 255, out=frame)
        yield Shot(k, frame.astype(np.uint8), truth, covered)


Follow = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Track one image: positions (63, 2) px and states (63,) of MarkerState."""


def score(shots_of_case: Iterator[Shot], follow: Follow) -> Score:
    """Run ``follow`` over the frames and compare with the truth."""
    errors, seen, covered, spent = [], [], [], []
    lost = late = 0
    offset = np.zeros((63, 2))
    was_covered = np.zeros(63, dtype=bool)
    for shot in shots_of_case:
        start = time.perf_counter()
        position, state = follow(shot.image)
        spent.append(time.perf_counter() - start)
        if not errors:
            gap = np.linalg.norm(position[:, None] - shot.truth[None], axis=-1)
            if (gap.argmin(axis=0) != np.arange(63)).any():
                raise AssertionError("the first frame is not in row-major order")
            offset = position - shot.truth
        errors.append(np.linalg.norm(position - offset - shot.truth, axis=1))
        seen.append(state == 0)
        covered.append(shot.covered)
        lost += int((state == 2).sum())
        late += int((shot.covered & was_covered & (state == 0)).sum())
        was_covered = shot.covered
    e, s, c = np.array(errors), np.array(seen), np.array(covered)
    return Score(
        rms=float(np.sqrt((e[e < 10] ** 2).mean())),
        rms_seen=float(np.sqrt((e[s & (e < 10)] ** 2).mean())),
        worst_covered=float(e[c].max(initial=0.0)),
        wrong=int((e >= 10).sum()),
        end_drift=float(np.sqrt((np.minimum(e[-1], 50) ** 2).mean())),
        lost=lost,
        late_flags=late,
        ms_median=1e3 * float(np.median(spent)),
    )


def tracker_follower() -> Follow:
    """A fresh live tracker at 25 frames per second."""
    tracker = MarkerTracker("left")
    sequence = 0

    def follow(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal sequence
        field = tracker.track(TactileFrame("left", sequence, sequence / 25, image))
        sequence += 1
        return field.position_px, field.state

    return follow


def known_truth(follower: Callable[[], Follow] = tracker_follower) -> dict[Case, Score]:
    """Score a fresh tracker on every case; one noise stream over all cases, in order."""
    noise = np.random.Generator(np.random.PCG64(0))
    return {case: score(shots(case, noise), follower()) for case in CASES}
