"""The signals of one trial on the clock of its bench: all its episodes as one film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np

from backend.core.faults import InputError
from backend.core.flow import FINGERS, Finger, ImageArray
from backend.dataset.film_reading import FilmedEpisode, read_film
from widgets.film import FilmTrack, Reel
from widgets.trace_sheet import WrenchTrace

KEPT_PICTURES = 2


@dataclass(frozen=True, slots=True)
class Recorded:
    """``traces`` of the episodes in order of time; ``missing``: what could not be read."""

    reel: Reel = field(default_factory=dict)
    traces: tuple[WrenchTrace, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def spans_s(self) -> tuple[tuple[float, float], ...]:
        """First and last instant of each episode."""
        return tuple((float(t.t_s[0]), float(t.t_s[-1])) for t in self.traces if len(t.t_s))

    def trace_at(self, cursor_s: float) -> WrenchTrace | None:
        """Return the wrench of the episode that had begun last at the cursor, else the first."""
        begun = [t for t in self.traces if len(t.t_s) and t.t_s[0] <= cursor_s + 1e-9]
        return begun[-1] if begun else next(iter(self.traces), None)


def read_recorded(paths: Sequence[Path]) -> Recorded:
    """Read the episodes ``paths`` of one trial; a damaged one leaves a gap and a sentence."""
    films, missing = [], []
    for path in paths:
        try:
            films.append(read_film(path))
        except InputError as error:
            missing.append(f"{path.name}: {error.what}")
    return recorded(films, tuple(missing))


def recorded(films: Sequence[FilmedEpisode], missing: tuple[str, ...] = ()) -> Recorded:
    """Join films that were recorded one after the other."""
    films = sorted(films, key=lambda film: film.episode.onset_s)
    traces = tuple(
        WrenchTrace(r.wrench_t_s, r.wrench)
        for film in films
        if (r := film.episode.recording) is not None and len(r.wrench_t_s)
    )
    return Recorded({finger: _track(films, finger) for finger in FINGERS}, traces, missing)


def _track(films: Sequence[FilmedEpisode], finger: Finger) -> FilmTrack:
    fields = tuple(
        one
        for film in films
        if film.episode.recording is not None
        for one in film.episode.recording.fields
        if one.finger == finger
    )
    where = [(film, k) for film in films for k in range(len(film.pictures[finger].t_s))]
    stamps = [film.pictures[finger].t_s for film in films]

    @lru_cache(KEPT_PICTURES)
    def picture(index: int) -> ImageArray:
        film, at = where[index]
        return film.pictures[finger].picture(at)

    field_t_s = np.array([one.t_s for one in fields], dtype=np.float64)
    return FilmTrack(np.concatenate([np.zeros(0), *stamps]), picture, field_t_s, fields)
