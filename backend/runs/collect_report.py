"""What a campaign has so far: coverage of the displacements, and the health of its episodes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry, EpisodeFilter
from backend.dataset.channels import OBS
from backend.dataset.contents import explained, read_first
from backend.dataset.coverage import Coverage, coverage
from backend.dataset.health import Examined
from backend.dataset.unpacking import unpack_observation
from backend.objects.shapes import Outline
from backend.runs.campaign import Campaign
from backend.runs.collect_plan import Target


def coverage_of(
    dataset: Dataset, entries: Sequence[EpisodeEntry], face: Outline, bottom: Outline
) -> Coverage:
    """Count the labelled displacements of those ``entries`` of one pair that count."""
    kept = [entry.uuid for entry in entries if counts(entry)]
    return coverage(dataset.labels.offsets_mm(kept), face, bottom)


def counts(entry: EpisodeEntry) -> bool:
    """Whether a probe covers its place: an observation that nobody discarded or rejected."""
    return entry.quality.accepted and not entry.deleted and entry.state != "rejected"


def pair_coverage(dataset: Dataset, campaign: Campaign, target: Target) -> Coverage:
    """Count what there is for ``campaign`` to fill up: its own probes, and all others of its pair
    that somebody stands for (submitted or approved).
    """
    entries = dataset.episodes(EpisodeFilter(piece=campaign.piece, bottom=campaign.bottom))
    stood_for = [
        entry
        for entry in entries
        if entry.campaign == campaign.uuid or entry.state in ("submitted", "approved")
    ]
    return coverage_of(dataset, stood_for, target.face, target.bottom)


@dataclass(frozen=True, slots=True)
class Seen:
    """What is looked at of a probe: for the checks, and where it was meant to go (mm)."""

    examined: Examined
    commanded_mm: tuple[float, float]


def look_at(dataset: Dataset, entry: EpisodeEntry) -> Seen:
    """Read one probe without its pictures; raises ``InputError`` naming a damaged file."""
    label_mm = dataset.labels.head(entry.uuid).label.offset_mm
    if entry.mode == "mass":
        episode = dataset.read(entry.uuid)
        observation, commanded_mm = episode.observation, episode.offset_mm.tolist()
    else:
        path = dataset.folder / entry.path
        contents = read_first(path)
        with explained(path):
            observation = unpack_observation(contents.messages[OBS.name])
            commanded_mm = json.loads(contents.metadata["episode"]["offset_mm"])
    x_mm, y_mm = commanded_mm
    return Seen(Examined(entry.uuid, observation, label_mm, entry.quality), (x_mm, y_mm))


def examined(dataset: Dataset, entries: Sequence[EpisodeEntry]) -> list[Examined]:
    """Read what the health checks look at; raises ``InputError`` naming a damaged file."""
    return [look_at(dataset, entry).examined for entry in entries]
