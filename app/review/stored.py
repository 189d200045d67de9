"""Episodes of a dataset for looking at: their label as truth, the shipped model's reading of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from app.label.prelabel import Prelabeller
from app.review.collection import counted
from app.review.recorded import Recorded, recorded
from app.review.timed import TimedTrial
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry
from backend.config.method import StackSettings
from backend.core.facts import (
    BeliefUpdated,
    EpisodeRecorded,
    Fact,
    PatchEstimated,
    RunStarted,
    StabilityJudged,
    TrialStarted,
)
from backend.core.faults import InputError
from backend.core.flow import Episode
from backend.dataset.film_reading import FilmedEpisode
from backend.objects.catalogue import Catalogue
from backend.placement.belief import Belief
from backend.placement.stability import judge
from backend.runs.campaign import read_campaign

JUDGED_S = 2.0
"""The model reads a probe when its last tick is over, so long after the contact onset."""


@dataclass(frozen=True, slots=True)
class Series:
    """The episodes of one series of a dataset, oldest first. ``plan`` in words, "" if unknown."""

    name: str
    entries: tuple[EpisodeEntry, ...]
    plan: str = ""

    @property
    def title(self) -> str:
        """Date of the first episode, and what was collected."""
        first = self.entries[0]
        when = datetime.fromtimestamp(first.recorded_ns * 1e-9, UTC)
        count = len(self.entries)
        noun = "episode" if count == 1 else "episodes"
        return (
            f"{when:%Y-%m-%d  %H:%M:%S} UTC\n"
            f"series: {first.piece} on {first.bottom}, {count} {noun}"
        )

    @property
    def facts(self) -> str:
        """Pair, plan, person and how far it came, a line each."""
        first = self.entries[0]
        people = ", ".join(sorted({e.person for e in self.entries if e.person})) or "nobody named"
        mountings = len({e.mounting_id for e in self.entries})
        grips = len({(e.mounting_id, e.grip_id) for e in self.entries})
        refused = sum(not e.quality.accepted for e in self.entries)
        lines = [
            f"{first.piece} on {first.bottom}, {first.mode}",
            self.plan,
            f"recorded by {people}",
            f"{counted([e.state for e in self.entries])}; {refused} refused",
            f"{grips} {'grip' if grips == 1 else 'grips'} on "
            f"{mountings} {'mounting' if mountings == 1 else 'mountings'}",
        ]
        return "\n".join(line for line in lines if line)


@dataclass(frozen=True, slots=True)
class StoredEpisode:
    """One episode with its signals and what is known of it, as a trial of one probe."""

    entry: EpisodeEntry
    recorded: Recorded
    trial: TimedTrial
    says: str


def series_of(dataset: Dataset) -> list[Series]:
    """Return the series of a dataset, newest first."""
    found: dict[str, list[EpisodeEntry]] = {}
    for entry in dataset.episodes():
        found.setdefault(entry.series, []).append(entry)
    return [
        Series(name, tuple(entries), plan_words(dataset, entries[0].campaign))
        for name, entries in reversed(found.items())
    ]


def plan_words(dataset: Dataset, campaign: str) -> str:
    """Return the plan of a campaign in words; "" where there is none, or none to be read."""
    try:
        plan = read_campaign(dataset.folder, campaign) if campaign else None
    except InputError:
        return ""
    return "" if plan is None else f"plan: {plan.pattern}, {plan.count} probes, seed {plan.seed}"


def read_stored(
    dataset: Dataset, models: Prelabeller, catalogue: Catalogue, entry: EpisodeEntry
) -> StoredEpisode:
    """Read one episode and let the model read it; raises ``InputError`` naming a damaged file."""
    film: FilmedEpisode = dataset.film(entry.uuid)
    label = dataset.labels.head(entry.uuid)
    x_mm, y_mm = label.label.offset_mm.tolist()
    at = (x_mm, y_mm) if label.label.is_set else None
    episode = film.episode
    recording = episode.recording
    begun_s = episode.onset_s if recording is None else float(recording.wrench_t_s[0])
    head = RunStarted(
        begun_s, entry.series, entry.piece, entry.bottom, "paper", 0, 1, entry.mode != "lab", "{}"
    )  # fmt: skip
    bare = Episode(entry.uuid, entry.piece, episode.observation, episode.offset_mm,
                   episode.onset_s, episode.quality)  # fmt: skip
    facts: list[Fact] = [
        TrialStarted(begun_s, 1, 0, at),
        EpisodeRecorded(episode.onset_s + JUDGED_S, bare, 1, entry.path),
    ]
    says = "No displacement is labelled." if at is None else ""
    if at is not None:
        facts += _reading(models, catalogue, entry, episode, at)
        says = f"Label {label.state}, {label.source.split(':')[0]}, by {label.person}."
    return StoredEpisode(entry, recorded([film]), TimedTrial(head, tuple(facts)), says)


def _reading(
    models: Prelabeller,
    catalogue: Catalogue,
    entry: EpisodeEntry,
    episode: Episode,
    at_mm: tuple[float, float],
) -> Sequence[Fact]:
    """Return what the method makes of this one probe at the labelled place."""
    found = models.model(entry.piece)
    if found is None:
        return []
    model = found.members[0]
    t_s, settings = episode.onset_s + JUDGED_S, StackSettings()
    try:
        patch = model.estimate(episode)
        piece = catalogue.piece(entry.piece)
    except (InputError, ValueError):
        # A dropped sample, or a piece of another catalogue: there is no estimate to show.
        return []
    unknown = Belief.unknown(settings.belief, at_mm, model.base_rate)
    belief = unknown.updated(patch, at_mm)
    stability = judge(belief, patch, piece.com_xy_mm, at_mm, settings.stability)
    return [
        PatchEstimated(t_s, patch, at_mm, 1),
        BeliefUpdated(t_s, belief.map, 1),
        StabilityJudged(t_s, stability, 1),
    ]
