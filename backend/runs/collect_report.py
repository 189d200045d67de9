"""What a campaign has so far: coverage of the displacements, and the health of its episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry
from backend.dataset.channels import OBS
from backend.dataset.contents import explained, read_first
from backend.dataset.coverage import Coverage, coverage
from backend.dataset.health import Examined
from backend.dataset.unpacking import unpack_observation
from backend.objects.shapes import Outline


def coverage_of(
    dataset: Dataset, entries: Sequence[EpisodeEntry], face: Outline, bottom: Outline
) -> Coverage:
    """Count the labelled displacements of the accepted ``entries`` of one pair."""
    kept = [e for e in entries if e.quality.accepted and not e.deleted]
    offsets = [dataset.labels.head(entry.uuid).label.offset_mm for entry in kept]
    return coverage(np.array(offsets).reshape(-1, 2), face, bottom)


def examined(dataset: Dataset, entries: Sequence[EpisodeEntry]) -> list[Examined]:
    """Read what the health checks look at; raises ``InputError`` naming a damaged file."""
    rows = []
    for entry in entries:
        path = dataset.folder / entry.path
        with explained(path):
            observation = unpack_observation(read_first(path).messages[OBS.name])
        offset_mm = dataset.labels.head(entry.uuid).label.offset_mm
        rows.append(Examined(entry.uuid, observation, offset_mm, entry.quality))
    return rows
