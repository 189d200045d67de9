"""Collected probes, as listed and shown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from touchdown.backend.annotations import Dataset, EpisodeEntry, EpisodeFilter
from touchdown.backend.core import EpisodeQuality, FloatArray, InputError
from touchdown.backend.episodes import Coverage, ExaminedEpisode, count_coverage
from touchdown.backend.geometry import Outline
from touchdown.backend.runs import SignalExcerpt, counts_for_coverage, read_probe_summary
from touchdown.widgets.base import signed, tr
from touchdown.widgets.lists import EpisodeTableRow
from touchdown.widgets.plots import BinCounts, DistributionScene, reach_of

# Signals that colour the distribution, in the order of ``ProbeCollected.signals``.
SIGNALS: tuple[tuple[str, str, float], ...] = (
    ("Largest marker shift u", "px", 1.0),
    ("Largest marker shift v", "px", 1.0),
    ("Tx", "mN\N{MIDDLE DOT}m", 1e3),
    ("Ty", "mN\N{MIDDLE DOT}m", 1e3),
    ("Fz", "N", 1.0),
)
# Number of the newest probes whose signals are read when a dataset is opened.
MAX_SIGNALS_READ = 400


@dataclass(frozen=True, slots=True)
class ProbeRecord:
    """One probe: its index entry and displacement; if it was read, also its target and signals."""

    entry: EpisodeEntry
    offset_mm: tuple[float, float]
    commanded_mm: tuple[float, float] | None = None
    seen: ExaminedEpisode | None = None
    signals: SignalExcerpt | None = None

    @property
    def counts(self) -> bool:
        """True if the probe counts for the coverage."""
        return counts_for_coverage(self.entry)


def read_probe(dataset: Dataset, entry: EpisodeEntry, *, signals: bool) -> ProbeRecord:
    """Read one probe. The signals of a damaged file stay unknown."""
    x_mm, y_mm = dataset.labels.head(entry.uuid).label.offset_mm.tolist()
    held = ProbeRecord(entry, (x_mm, y_mm))
    if not signals or entry.deleted:
        return held
    try:
        found = read_probe_summary(dataset, entry)
    except InputError:
        return held
    return replace(
        held, commanded_mm=found.commanded_mm, seen=found.examined, signals=found.signals
    )


def read_pair(dataset: Dataset, piece: str, bottom: str) -> list[ProbeRecord]:
    """Read the probes of a pair, oldest first; signals only of the newest ``MAX_SIGNALS_READ``."""
    entries = dataset.episodes(EpisodeFilter(piece=piece, bottom=bottom, deleted=None))
    late = len(entries) - MAX_SIGNALS_READ
    return [read_probe(dataset, e, signals=at >= late) for at, e in enumerate(entries)]


class PairProbes:
    """The probes of one pair, in the order of recording."""

    def __init__(self, face: Outline, bottom: Outline, held: Iterable[ProbeRecord] = ()) -> None:
        self._face, self._bottom = face, bottom
        self._outline = bottom.path(96)
        self._held = {h.entry.uuid: h for h in held}
        self._none = count_coverage(np.zeros((0, 2)), face, bottom)
        self._coverage: Coverage | None = None

    def __len__(self) -> int:
        return len(self._held)

    def put(self, held: ProbeRecord) -> None:
        """Add or update a probe."""
        before = self._held.get(held.entry.uuid)
        if before is not None and held.seen is None:
            held = replace(
                held, commanded_mm=before.commanded_mm, seen=before.seen, signals=before.signals
            )
        self._held[held.entry.uuid] = held
        self._coverage = None

    def get(self, uuid: str) -> ProbeRecord | None:
        """Return one probe, None if it is not of this pair."""
        return self._held.get(uuid)

    @property
    def newest(self) -> str:
        """Uuid of the newest probe, "" for none."""
        return next(reversed(self._held), "")

    @property
    def examined(self) -> list[ExaminedEpisode]:
        """Return the input of the quality checks."""
        return [h.seen for h in self._held.values() if h.seen is not None and not h.entry.deleted]

    @property
    def covered(self) -> Coverage:
        """Return the coverage by the probes that count."""
        if self._coverage is None:
            offsets = np.array([h.offset_mm for h in self._held.values() if h.counts])
            self._coverage = count_coverage(offsets.reshape(-1, 2), self._face, self._bottom)
        return self._coverage

    # -- shown ------------------------------------------------------------------------------------

    def shown(self) -> list[ProbeRecord]:
        """Return the probes drawn as dots: not deleted and with a displacement."""
        return [
            h for h in self._held.values() if not h.entry.deleted and np.isfinite(h.offset_mm).all()
        ]

    def distribution(self, signal: int, chosen: str) -> DistributionScene:
        """Return the dots, coloured by one of ``SIGNALS``."""
        shown = self.shown()
        name, unit, scale = SIGNALS[signal]
        values = np.array([np.nan if h.signals is None else scale * h.signals[signal]
                           for h in shown], dtype=np.float64)  # fmt: skip
        return replace(self._scene(shown, chosen), values=values, title=f"{tr(name)} ({unit})")

    def bins(self, chosen: str) -> DistributionScene:
        """Return counts per bin."""
        seen = self.covered
        bins = BinCounts(seen.counts, seen.possible, seen.centre_mm(0, 0), seen.bin_mm)
        return replace(self._scene(self.shown(), chosen), bins=bins, title=tr("episodes per bin"))

    def _scene(self, shown: Sequence[ProbeRecord], chosen: str) -> DistributionScene:
        points = np.array([h.offset_mm for h in shown], dtype=np.float64).reshape(-1, 2)
        uuids = [h.entry.uuid for h in shown]
        return DistributionScene(
            bottom=self._outline,
            points_mm=points,
            values=np.zeros(len(shown)),
            refused=np.array([not h.entry.quality.accepted for h in shown], dtype=np.bool_),
            flagged=np.array([h.entry.flagged for h in shown], dtype=np.bool_),
            chosen=uuids.index(chosen) if chosen in uuids else -1,
            reach_mm=reach_of(self._outline, np.concatenate([points, self._corners()])),
        )

    def _corners(self) -> FloatArray:
        """Return the outermost reachable bins, so that the scale stays constant."""
        rows, columns = np.nonzero(self._none.possible)
        return np.array(
            [
                self._none.centre_mm(i, j)
                for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
            ]
        ).reshape(-1, 2)

    def rows(self, *, deleted: bool) -> list[EpisodeTableRow]:
        """Return the table rows, newest first."""
        made = [probe_row(at, h) for at, h in enumerate(self._held.values(), 1)]
        return [row for row in reversed(made) if deleted or not row.deleted]


def probe_row(number: int, held: ProbeRecord) -> EpisodeTableRow:
    """Return a probe as a table row."""
    entry = held.entry
    local = datetime.fromtimestamp(entry.recorded_ns * 1e-9, UTC).astimezone()
    today = datetime.now(UTC).astimezone().date()
    return EpisodeTableRow(
        entry.uuid,
        str(number),
        "deleted" if entry.deleted else entry.state,
        quality_text(entry.quality),
        displacement_text(held.offset_mm),
        f"{local:%H:%M:%S}" if local.date() == today else f"{local:%y-%m-%d}",
        flagged=entry.flagged,
        deleted=entry.deleted,
    )


def quality_text(quality: EpisodeQuality) -> str:
    """Return "ok" or the first reason of rejection."""
    return tr("ok") if quality.accepted else "; ".join(quality.reasons) or tr("refused")


def displacement_text(at_mm: tuple[float, float], digits: int = 1, unit: str = "") -> str:
    """Return a displacement such as "+1.5, +0.3", or "none"."""
    if not np.isfinite(at_mm).all():
        return tr("none")
    x, y = (signed(v, digits) for v in at_mm)
    return f"{x}, {y}{unit}"
