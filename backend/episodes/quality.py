"""Quality of collected episodes: outliers, coverage of offsets, contradicting repeats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import core
from touchdown.backend.config import TICK_S
from touchdown.backend.geometry import MIN_OVERLAP_MM2, Outline, overlap_area_mm2

BIN_MM = 2.0


@dataclass(frozen=True, slots=True)
class Coverage:
    """Bins of ``bin_mm`` in frame ``O``, with one bin centred on the origin.

    ``counts`` (ny, nx): episodes; ``possible`` (ny, nx): True if the faces overlap enough at the
    centre of the bin. Bin (i, j) is centred at ``bin_mm * (j - nx // 2, i - ny // 2)``.
    """

    counts: NDArray[np.intp]
    possible: NDArray[np.bool_]
    bin_mm: float = BIN_MM

    def __post_init__(self) -> None:
        core.read_only(self.counts)
        core.read_only(self.possible)

    def centre_mm(self, row: int, column: int) -> tuple[float, float]:
        """Return the centre of a bin."""
        rows, columns = self.counts.shape
        return self.bin_mm * (column - columns // 2), self.bin_mm * (row - rows // 2)

    @property
    def holes(self) -> int:
        """Number of possible bins without an episode."""
        return int((self.possible & (self.counts == 0)).sum())

    @property
    def covered(self) -> float:
        """Share of the possible bins with at least one episode."""
        possible = int(self.possible.sum())
        return 1.0 - self.holes / possible if possible else 0.0

    def with_offset(self, offset_mm: tuple[float, float]) -> Coverage:
        """Return the coverage with one more episode; offsets outside all bins are ignored."""
        counts = self.counts + count_bins(np.array([offset_mm]), self.counts.shape)
        return Coverage(counts, self.possible)


def count_coverage(offsets_mm: core.FloatArray, face: Outline, bottom: Outline) -> Coverage:
    """Count ``offsets_mm`` (n, 2) of ``face`` above ``bottom`` per bin."""
    reach = np.add(face.half_extents_mm, bottom.half_extents_mm)
    columns, rows = (2 * np.ceil(reach / BIN_MM).astype(int) + 1).tolist()
    x = BIN_MM * (np.arange(columns) - columns // 2)
    y = BIN_MM * (np.arange(rows) - rows // 2)
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    possible = overlap_area_mm2(face, centres, bottom) >= MIN_OVERLAP_MM2
    return Coverage(count_bins(offsets_mm, (rows, columns)), possible)


def count_bins(offsets_mm: core.FloatArray, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Return the number of ``offsets_mm`` (n, 2) per bin, (ny, nx)."""
    counts = np.zeros(shape, dtype=np.intp)
    offsets = np.asarray(offsets_mm, dtype=np.float64).reshape(-1, 2)
    offsets = offsets[np.isfinite(offsets).all(axis=1)]
    index = np.rint(offsets[:, ::-1] / BIN_MM).astype(np.intp) + np.array(shape) // 2
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    np.add.at(counts, tuple(index[inside].T), 1)
    return counts


Kind = Literal[
    "asymmetry", "jerk", "no contact", "saturated markers", "lost markers", "dropped frames",
    "clock skew", "slip", "twins", "divided series", "unreadable",
]  # fmt: skip

CONTACT_N = 1.0
# Deviation of a force from the mean of its neighbours (undisturbed: 0.35 N, at the knee).
JERK_N = 0.6
# One marker pitch: a larger step may confuse neighbouring markers (undisturbed: 20).
SATURATED_PX = 31.0
LOST_MARKERS = 3
DROPPED_FRAMES = 3  # frames of 100 (undisturbed: 0.5 % are lost)
LAG_S = 0.03  # delay of the gel relative to the force (undisturbed: 0.011 s)
SLIP_MM = 0.3
TWIN_APART_MM = 5.0
TWIN_SHARE = 0.25  # limit of a repeat, relative to the median distance to the nearest other label
FEWEST = 20  # fewest episodes for a test of the distribution
RARE = 0.001  # significance level of that test

_RAMP = slice(8, 14)
_HELD = slice(16, 20)
_FX, _FZ = core.TACTILE_CHANNELS, core.TACTILE_CHANNELS + 2


@dataclass(frozen=True, slots=True)
class ExaminedEpisode:
    """Input of the checks for one episode: about 1 kB instead of the 20 kB of its signals.

    ``offset_mm`` (2,) is the labelled displacement, ``features`` (258,) the mean signals of the
    last 0.5 s (NaN if any signal is unknown), ``findings`` those of this episode alone.
    """

    uuid: str
    offset_mm: core.FloatArray
    features: NDArray[np.float32]
    findings: tuple[tuple[Kind, str], ...]

    @classmethod
    def of(
        cls,
        uuid: str,
        observation: NDArray[np.float32],
        offset_mm: core.FloatArray,
        quality: core.EpisodeQuality,
    ) -> ExaminedEpisode:
        """Examine an episode; ``observation`` (20, 258) as in ``Episode``."""
        features = observation[-5:].mean(axis=0)
        if not np.isfinite(observation).all():
            features[:] = np.nan
        return cls(uuid, offset_mm, features, tuple(_single_findings(observation, quality)))


@dataclass(frozen=True, slots=True)
class QualityIssue:
    """One finding about these episodes (none: about all), with a message."""

    kind: Kind
    episodes: tuple[str, ...]
    text: str


def check_quality(rows: Sequence[ExaminedEpisode]) -> list[QualityIssue]:
    """Return all findings: distribution first, then repeats, then single episodes."""
    singles = [QualityIssue(kind, (row.uuid,), text) for row in rows for kind, text in row.findings]
    return [*find_asymmetry(rows), *find_contradicting_repeats(rows), *singles]


def find_asymmetry(rows: Sequence[ExaminedEpisode]) -> list[QualityIssue]:
    """Test for symmetric offsets about the bottom (signed-rank test per axis).

    An asymmetric distribution indicates a wrong origin, a wrong range, or an incomplete campaign.
    """
    # imported here: slow to import and rarely needed
    from scipy.stats import wilcoxon

    offsets = np.array([row.offset_mm for row in rows]).reshape(-1, 2)
    offsets = offsets[np.isfinite(offsets).all(axis=1)]
    if len(offsets) < FEWEST:
        return []
    found = []
    for axis, name in enumerate("xy"):
        values = offsets[:, axis]
        if not np.any(values):
            continue
        p = float(wilcoxon(values).pvalue)
        if p < RARE:
            median = float(np.median(values))
            text = (
                f"The displacements are uneven along {name}: median {median:+.1f} mm "
                f"(p = {p:.1g}). Check the origin of the bottom."
            )
            found.append(QualityIssue("asymmetry", (), text))
    return found


def find_contradicting_repeats(rows: Sequence[ExaminedEpisode]) -> list[QualityIssue]:
    """Find nearly equal signals with labels more than 5 mm apart, nearest first.

    "Nearly equal" is relative to the usual distance between the standardised features of episodes
    with different labels.
    """
    known = [row for row in rows if np.isfinite(row.features).all()]
    known = [row for row in known if np.isfinite(row.offset_mm).all()]
    if len(known) < FEWEST:
        return []
    features = np.stack([row.features for row in known]).astype(np.float64)
    spread = features.std(axis=0)
    features = (features - features.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    offsets = np.stack([row.offset_mm for row in known])
    distance, nearest = _nearest_other_label(features, offsets)
    usual = (
        float(np.median(distance[np.isfinite(distance)])) if np.isfinite(distance).any() else 0.0
    )
    pairs = {
        tuple(sorted((i, int(nearest[i]))))
        for i in np.flatnonzero(distance < TWIN_SHARE * usual).tolist()
    }
    order = sorted(pairs, key=lambda pair: float(distance[list(pair)].min()))
    found = []
    for i, j in order:
        apart_mm = float(np.hypot(*(offsets[i] - offsets[j])))
        text = f"Nearly the same signals, but labels {apart_mm:.1f} mm apart."
        found.append(QualityIssue("twins", (known[i].uuid, known[j].uuid), text))
    return found


def _nearest_other_label(
    features: core.FloatArray, offsets: core.FloatArray
) -> tuple[core.FloatArray, NDArray[np.intp]]:
    """Return distance to and index of the nearest episode with another label, (n,) each."""
    count = len(features)
    distance, nearest = np.full(count, np.inf), np.zeros(count, dtype=np.intp)
    squares = (features**2).sum(axis=1)
    for start in range(0, count, 256):
        part = slice(start, min(start + 256, count))
        apart = squares[part, None] + squares - 2.0 * features[part] @ features.T
        labels = np.hypot(*(offsets[part, None] - offsets).transpose(2, 0, 1))
        apart[labels <= TWIN_APART_MM] = np.inf
        nearest[part] = apart.argmin(axis=1)
        distance[part] = np.sqrt(np.maximum(apart.min(axis=1), 0.0))
    return distance, nearest


def _single_findings(
    observation: NDArray[np.float32], quality: core.EpisodeQuality
) -> Iterator[tuple[Kind, str]]:
    press_n = float(observation[-1, _FZ])
    if not press_n >= CONTACT_N:
        known = np.isfinite(press_n)
        text = f"The press ended with {press_n:.2f} N." if known else "The press force is unknown."
        yield "no contact", text
    forces = observation[:, _FX : _FX + 3].astype(np.float64)
    step = np.abs(forces[1:-1] - 0.5 * (forces[:-2] + forces[2:])).max(axis=1)
    worst = int(np.nanargmax(step)) if np.isfinite(step).any() else 0
    if step[worst] > JERK_N:
        at_s = (worst + 2) * TICK_S
        yield "jerk", f"The force jumps by {step[worst]:.1f} N at {at_s:.1f} s."
    shift = float(np.nanmax(np.abs(observation[:, : core.TACTILE_CHANNELS]), initial=0.0))
    if shift > SATURATED_PX:
        yield "saturated markers", f"A marker moved by {shift:.0f} px."
    if quality.lost_markers > LOST_MARKERS:
        yield "lost markers", f"{quality.lost_markers} markers were lost."
    if quality.dropped_frames > DROPPED_FRAMES:
        yield "dropped frames", f"{quality.dropped_frames} frames were lost."
    skews = []
    for finger, lag_s in zip(core.FINGERS, lags_s(observation), strict=True):
        if abs(lag_s) > LAG_S:
            way = "behind" if lag_s > 0 else "ahead of"
            skews.append(f"The {finger} gel is {1e3 * abs(lag_s):.0f} ms {way} the force.")
    if skews:
        yield "clock skew", " ".join(skews)
    if quality.slip_mm > SLIP_MM:
        yield "slip", f"The piece slipped by {quality.slip_mm:.2f} mm."


def lags_s(observation: NDArray[np.float32]) -> Iterator[float]:
    """Yield the delay of the vertical gel shear of each finger relative to the press force, in s.

    Both rise along the ramp and then stay constant, with the knee at the same instant whatever
    their scale and offset. NaN if there is no knee.
    """
    # The wrench of a tick is the mean of the 0.1 s before it, which delays its knee by 0.05 s.
    force_s = _knee_s(observation[:, _FZ].astype(np.float64)) - 0.5 * TICK_S
    shear = observation[:, : core.TACTILE_CHANNELS].astype(np.float64)
    for finger in range(len(core.FINGERS)):
        down = shear.reshape(-1, len(core.FINGERS), 2, core.MARKERS)[:, finger, 1].mean(axis=1)
        yield _knee_s(down) - force_s


def _knee_s(signal: core.FloatArray) -> float:
    """Return the time at which the line through the ramp reaches the level of the hold."""
    t_s = TICK_S * np.arange(1, len(signal) + 1)
    if not np.isfinite(signal).all():
        return float("nan")
    slope, start = np.polyfit(t_s[_RAMP], signal[_RAMP], 1)
    return float((signal[_HELD].mean() - start) / slope) if slope else float("nan")
