"""Stored episodes shown in review."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import numpy as np

from touchdown.app.review.timing import TrialTimeline
from touchdown.app.shell import ModelPrelabeller
from touchdown.backend import core
from touchdown.backend.annotations import Dataset, EpisodeEntry
from touchdown.backend.config import StackSettings
from touchdown.backend.episodes import CompressedEpisode, read_compressed_episode
from touchdown.backend.geometry import PieceLibrary
from touchdown.backend.placement import Belief, judge_stability
from touchdown.backend.runs import read_campaign
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.plots import WrenchTrace
from touchdown.widgets.views import FilmTrack, Reel

KEPT_PICTURES = 2


@dataclass(frozen=True, slots=True)
class TrialRecording:
    """``traces`` of the episodes in order of time; ``missing`` lists read errors."""

    reel: Reel = field(default_factory=dict)
    traces: tuple[WrenchTrace, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def spans_s(self) -> tuple[tuple[float, float], ...]:
        """First and last time of each episode."""
        return tuple((float(t.t_s[0]), float(t.t_s[-1])) for t in self.traces if len(t.t_s))

    def trace_at(self, cursor_s: float) -> WrenchTrace | None:
        """Return the wrench of the last episode that began before the cursor, else the first."""
        begun = [t for t in self.traces if len(t.t_s) and t.t_s[0] <= cursor_s + 1e-9]
        return begun[-1] if begun else next(iter(self.traces), None)


def read_trial_recording(paths: Sequence[Path]) -> TrialRecording:
    """Read the episodes of one trial; a damaged one leaves a gap and a message."""
    films, missing = [], []
    for path in paths:
        try:
            films.append(read_compressed_episode(path))
        except core.InputError as error:
            missing.append(f"{path.name}: {error.what}")
    return join_films(films, tuple(missing))


def join_films(films: Sequence[CompressedEpisode], missing: tuple[str, ...] = ()) -> TrialRecording:
    """Join consecutive films."""
    films = sorted(films, key=lambda film: film.episode.onset_s)
    traces = tuple(
        WrenchTrace(r.wrench_t_s, r.wrench)
        for film in films
        if (r := film.episode.recording) is not None and len(r.wrench_t_s)
    )
    return TrialRecording(
        {finger: _film_track(films, finger) for finger in core.FINGERS}, traces, missing
    )


def _film_track(films: Sequence[CompressedEpisode], finger: core.Finger) -> FilmTrack:
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
    def picture(index: int) -> core.ImageArray:
        film, at = where[index]
        return film.pictures[finger].picture(at)

    field_t_s = np.array([one.t_s for one in fields], dtype=np.float64)
    return FilmTrack(np.concatenate([np.zeros(0), *stamps]), picture, field_t_s, fields)


JUDGED_S = 2.0  # time after the contact onset at which the model reads a probe


@dataclass(slots=True)
class EpisodeSeries:
    """One series of a dataset: its ``first`` episode, and what is counted over all of them.

    ``episodes``: id and label state of each, oldest first. ``plan`` as text, "" if unknown.
    """

    first: EpisodeEntry
    plan: str = ""
    episodes: list[tuple[str, str]] = field(default_factory=list)
    people: set[str] = field(default_factory=set)
    grips: set[tuple[str, str]] = field(default_factory=set)
    refused: int = 0

    def add(self, entry: EpisodeEntry) -> None:
        """Count one more episode."""
        self.episodes.append((entry.uuid, entry.state))
        self.people.add(entry.person)
        self.grips.add((entry.mounting_id, entry.grip_id))
        self.refused += not entry.quality.accepted

    @property
    def title(self) -> str:
        """Date of the first episode, and the pair."""
        first = self.first
        when = datetime.fromtimestamp(first.recorded_ns * 1e-9)
        episodes = count_noun(len(self.episodes), "episode")
        pair = tr("{} on {}", first.piece, first.bottom)
        return f"{when:%Y-%m-%d  %H:%M:%S}\n{tr('series: {}, {}', pair, episodes)}"

    @property
    def facts(self) -> str:
        """Pair, plan, person and progress, one line each."""
        first = self.first
        people = ", ".join(sorted(filter(None, self.people))) or tr("nobody named")
        mountings = len({mounting for mounting, _ in self.grips})
        states = Counter(state for _, state in self.episodes).most_common()
        lines = [
            f"{tr('{} on {}', first.piece, first.bottom)}, {tr(first.mode)}",
            self.plan,
            tr("recorded by {}", people),
            f"{', '.join(f'{count} {tr(state)}' for state, count in states)}; "
            + tr("{} refused", self.refused),
            tr("{} on {}", count_noun(len(self.grips), "grip"), count_noun(mountings, "mounting")),
        ]
        return "\n".join(line for line in lines if line)


@dataclass(frozen=True, slots=True)
class StoredEpisode:
    """One stored episode with its signals, presented as a trial of one probe."""

    entry: EpisodeEntry
    recorded: TrialRecording
    trial: TrialTimeline
    says: str


def list_series(dataset: Dataset) -> list[EpisodeSeries]:
    """Return the series of a dataset, newest first. Entries are read in pages and not kept."""
    found: dict[str, EpisodeSeries] = {}
    for entry in dataset:
        if entry.series not in found:
            found[entry.series] = EpisodeSeries(entry, plan_text(dataset, entry.campaign))
        found[entry.series].add(entry)
    return list(reversed(found.values()))


def plan_text(dataset: Dataset, campaign: str) -> str:
    """Return the plan of a campaign as text, "" without a readable plan."""
    try:
        plan = read_campaign(dataset.folder, campaign) if campaign else None
    except core.InputError:
        return ""
    if plan is None:
        return ""
    return tr("plan: {}, {} probes, seed {}", tr(plan.pattern), plan.count, plan.seed)


def read_stored_episode(
    dataset: Dataset, models: ModelPrelabeller, catalogue: PieceLibrary, entry: EpisodeEntry
) -> StoredEpisode:
    """Read one episode and let the model read it. Raises ``InputError`` for a damaged file."""
    film: CompressedEpisode = dataset.film(entry.uuid)
    label = dataset.labels.head(entry.uuid)
    x_mm, y_mm = label.label.offset_mm.tolist()
    at = (x_mm, y_mm) if label.label.is_set else None
    episode = film.episode
    recording = episode.recording
    begun_s = episode.onset_s if recording is None else float(recording.wrench_t_s[0])
    head = core.RunStarted(
        begun_s, entry.series, entry.piece, entry.bottom, "paper", 0, 1, entry.mode != "lab", "{}"
    )  # fmt: skip
    bare = core.Episode(entry.uuid, entry.piece, episode.observation, episode.offset_mm,
                   episode.onset_s, episode.quality)  # fmt: skip
    facts: list[core.Event] = [
        core.TrialStarted(begun_s, 1, 0, at),
        core.EpisodeRecorded(episode.onset_s + JUDGED_S, bare, 1, entry.path),
    ]
    says = tr("No displacement is labelled.") if at is None else ""
    if at is not None:
        facts += _model_reading(models, catalogue, entry, episode, at)
        source = tr(label.source.split(":")[0])
        says = tr("Label {}, {}, by {}.", tr(label.state), source, label.person)
    return StoredEpisode(entry, join_films([film]), TrialTimeline(head, tuple(facts)), says)


def _model_reading(
    models: ModelPrelabeller,
    catalogue: PieceLibrary,
    entry: EpisodeEntry,
    episode: core.Episode,
    at_mm: tuple[float, float],
) -> Sequence[core.Event]:
    """Return the events of the method for this probe at the labelled displacement."""
    found = models.model(entry.piece)
    if found is None:
        return []
    model = found.members[0]
    t_s, settings = episode.onset_s + JUDGED_S, StackSettings()
    try:
        patch = model.estimate(episode)
        piece = catalogue.piece(entry.piece)
    except (core.InputError, ValueError):
        # No estimate for a dropped sample or a piece of another catalogue.
        return []
    unknown = Belief.unknown(settings.belief, at_mm, model.base_rate)
    belief = unknown.updated(patch, at_mm)
    stability = judge_stability(belief, patch, piece.com_xy_mm, at_mm, settings.stability)
    return [
        core.PatchEstimated(t_s, patch, at_mm, 1),
        core.BeliefUpdated(t_s, belief.map, 1),
        core.StabilityJudged(t_s, stability, 1),
    ]
