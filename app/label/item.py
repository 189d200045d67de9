"""One episode as the label page holds it: signals, geometry, and what the model says of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from backend.catalogue.dataset import Dataset
from backend.catalogue.geometry import Pair
from backend.catalogue.values import EpisodeEntry
from backend.core.flow import FINGERS, Episode, FloatArray, MarkerField
from backend.dataset.film_reading import FilmedEpisode, read_film
from backend.placement.offset_fit import OffsetFit
from widgets.film import FilmTrack, Reel
from widgets.recorded_traces import WrenchTrace


@dataclass(frozen=True, slots=True)
class ModelLabel:
    """What the model makes of an episode. ``weights_sha256`` names the model for ever."""

    fit: OffsetFit
    entropy: float
    weights_sha256: str

    @property
    def source(self) -> str:
        """The source under which such a label is kept."""
        return f"model:{self.weights_sha256}"


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

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last instant worth showing, after the contact onset."""
        if self.trace is None or not len(self.trace.t_s):
            return 0.0, 2.0
        return float(self.trace.t_s[0]), float(self.trace.t_s[-1])


def reader(dataset: Dataset, prelabel: Prelabel) -> Callable[[str], LabelItem]:
    """Return the function that reads an episode of ``dataset``; it may run on any thread."""

    def read(uuid: str) -> LabelItem:
        entry = dataset.entry(uuid)
        film = read_film(dataset.folder / entry.path)
        pair = dataset.geometry.pair(entry.geometry)
        return make_item(entry, film, pair, prelabel(film.episode, pair))

    return read


def make_item(
    entry: EpisodeEntry, film: FilmedEpisode, pair: Pair, model: ModelLabel | None
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
            film.pictures[finger].picture,
            np.array([x.t_s for x in fields[finger]]) - episode.onset_s,
            fields[finger],
        )
        for finger in FINGERS
    }
    numbers = 0 if recording is None else recording.wrench.nbytes + recording.pose_mm.nbytes
    per_field = sum(len(x) for x in fields.values()) * 3 * 1024
    return LabelItem(
        entry, episode, pair, pair.face.polygon(96), pair.bottom.polygon(96), reel, trace, model,
        film.bytes + numbers + per_field,
    )  # fmt: skip
