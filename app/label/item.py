"""One episode as the label page holds it: signals, geometry, and what the model says of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

from app.label.scene_shots import SceneEvidence, scene_of
from backend.catalogue.dataset import Dataset
from backend.catalogue.geometry import Pair
from backend.catalogue.values import EpisodeEntry
from backend.core.flow import FINGERS, Episode, FloatArray, MarkerField
from backend.dataset.film_reading import FilmedEpisode
from backend.placement.offset_fit import OffsetFit
from widgets.film import FilmTrack, Reel, latest
from widgets.phase_plot import PhaseDrawn, PhaseSheet, has_moments
from widgets.recorded_traces import Drawn
from widgets.trace_sheet import TraceSheet, WrenchTrace

Outlines = tuple[FloatArray, FloatArray]
MOST_PAIRS = 16
KEPT_PICTURES, PICTURE_BYTES = 2, 3 * 240 * 320
"""So many decoded pictures a finger are kept: views ask for the present one again and again."""
CURSOR_S = 2.0
"""The end of the press says most: an episode is first shown there."""


@dataclass(frozen=True, slots=True)
class Sheets:
    """What the wrench is drawn on at present: forces, moments, and one over the other."""

    forces: TraceSheet
    moments: TraceSheet
    phase: PhaseSheet


@dataclass(frozen=True, slots=True)
class Ahead:
    """What was drawn before it is shown; used as long as the window has not changed."""

    forces: Drawn
    moments: Drawn
    phase: PhaseDrawn

    @property
    def bytes(self) -> int:
        """Size of the pictures in memory."""
        return sum(image.sizeInBytes() for _, image in (self.forces, self.moments, self.phase))


@dataclass(frozen=True, slots=True)
class ModelLabel:
    """What the models make of an episode; ``spread_mm`` between them.

    ``weights``: hashes that name them for ever, joined by ``+``.
    """

    fit: OffsetFit
    entropy: float
    weights: str
    spread_mm: float = 0.0

    @property
    def source(self) -> str:
        """The source under which such a label is kept."""
        return f"model:{self.weights}"


class Prelabel(Protocol):
    """The model's opinion of an episode, or None where there is no model of its piece."""

    def __call__(self, episode: Episode, pair: Pair) -> ModelLabel | None:
        """Return the model's displacement."""
        ...


@dataclass(frozen=True, slots=True)
class LabelItem:
    """What does not change while an episode is labelled; ``bytes`` is its size in memory."""

    entry: EpisodeEntry
    episode: Episode
    pair: Pair
    face: FloatArray
    bottom: FloatArray
    reel: Reel
    trace: WrenchTrace | None
    model: ModelLabel | None
    bytes: int
    scene: SceneEvidence | None = None
    doubt: tuple[str, float] | None = None
    """Revision that was judged by the other episodes of its pair, and the score ``doubt``."""
    ahead: Ahead | None = None

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant worth showing, after the contact onset."""
        if self.trace is None or not len(self.trace.t_s):
            return 0.0, 2.0
        return float(self.trace.t_s[0]), float(self.trace.t_s[-1])


def reader(
    dataset: Dataset, prelabel: Prelabel, sheets: Callable[[], Sheets | None]
) -> Callable[[str], LabelItem]:
    """Return the function that reads an episode of ``dataset``; it may run on any thread.

    What does not follow from the label is drawn here, on the present ``sheets`` of the page.
    """
    outlines = lru_cache(MOST_PAIRS)(outlines_of)

    def read(uuid: str) -> LabelItem:
        entry = dataset.entry(uuid)
        film = dataset.film(uuid)
        pair = dataset.geometry.pair(entry.geometry)
        item = make_item(entry, film, pair, prelabel(film.episode, pair), outlines(pair))
        item = replace(item, doubt=dataset.scores.of_revision("doubt", uuid))
        return drawn_ahead(item, sheets())

    return read


def outlines_of(pair: Pair) -> Outlines:
    """Return the outlines (k, 2) of face and bottom; views know a pair by these very arrays."""
    return pair.face.polygon(96), pair.bottom.polygon(96)


def drawn_ahead(item: LabelItem, sheets: Sheets | None) -> LabelItem:
    """Return the item with its first pictures decoded and its curves drawn."""
    first, last = item.span_s
    for track in item.reel.values():
        index = latest(track.picture_t_s, min(max(CURSOR_S, first), last))
        if index >= 0:
            track.picture(index)
    trace = item.trace
    if trace is None or sheets is None or len(trace.t_s) < 2 or not has_moments(trace):
        return item
    ahead = Ahead(
        (sheets.forces, sheets.forces.draw(trace)),
        (sheets.moments, sheets.moments.draw(trace)),
        (sheets.phase, sheets.phase.draw(trace)),
    )
    return replace(item, ahead=ahead, bytes=item.bytes + ahead.bytes)


def make_item(
    entry: EpisodeEntry,
    film: FilmedEpisode,
    pair: Pair,
    model: ModelLabel | None,
    outlines: Outlines,
) -> LabelItem:
    """Put together what was read; times are counted from the contact onset."""
    episode, recording = film.episode, film.episode.recording
    trace, fields = None, {finger: tuple[MarkerField, ...]() for finger in FINGERS}
    if recording is not None:
        trace = WrenchTrace(recording.wrench_t_s - episode.onset_s, recording.wrench)
        fields = {f: tuple(x for x in recording.fields if x.finger == f) for f in FINGERS}
    reel = {
        finger: FilmTrack(
            film.pictures[finger].t_s - episode.onset_s,
            lru_cache(KEPT_PICTURES)(film.pictures[finger].picture),
            np.array([x.t_s for x in fields[finger]]) - episode.onset_s,
            fields[finger],
        )
        for finger in FINGERS
    }
    numbers = 0 if recording is None else recording.wrench.nbytes + recording.pose_mm.nbytes
    per_field = sum(len(x) for x in fields.values()) * 3 * 1024
    scene = scene_of(episode, pair, outlines[0])
    return LabelItem(
        entry, episode, pair, *outlines, reel, trace, model,
        film.bytes + numbers + per_field + len(FINGERS) * KEPT_PICTURES * PICTURE_BYTES
        + (0 if scene is None else scene.bytes), scene,
    )  # fmt: skip
