"""Look through a whole dataset for what is out of order in its episodes: a job, pair by pair."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backend.catalogue.dataset import Dataset
from backend.catalogue.split_tags import tagged_sides
from backend.catalogue.values import EpisodeEntry
from backend.core.faults import InputError
from backend.dataset.channels import OBS
from backend.dataset.contents import explained, read_chunk, read_first
from backend.dataset.health import Examined, Finding, examine
from backend.dataset.splits import divided
from backend.dataset.unpacking import unpack_observation

Progress = Callable[[int, int], bool]
"""Gets (done, all) after each episode; False stops."""


@dataclass(frozen=True, slots=True)
class DataHealth:
    """``findings`` of the ``looked`` episodes, of ``count`` that the dataset has."""

    findings: tuple[Finding, ...]
    looked: int
    count: int


def look_through(dataset: Dataset, progress: Progress) -> DataHealth:
    """Examine every episode that is not deleted; stopped early, what was read until then.

    Distribution and twins are judged pair by pair. Episodes that cannot be read are findings.
    """
    entries = [entry for entry in dataset.episodes() if entry.file_state == "complete"]
    pairs: dict[tuple[str, str], list[Examined]] = defaultdict(list)
    found, looked = list(_divided(dataset, entries)), 0
    for entry, seen in observations(dataset, entries):
        looked += 1
        if isinstance(seen, InputError):
            found.append(Finding("unreadable", (entry.uuid,), seen.what))
        else:
            offset_mm = dataset.labels.head(entry.uuid).label.offset_mm
            pair = pairs[entry.piece, entry.bottom]
            pair.append(Examined(entry.uuid, seen, offset_mm, entry.quality))
        if not progress(looked, len(entries)):
            break
    for names, rows in pairs.items():
        found += [_named(finding, names, rows) for finding in examine(rows)]
    return DataHealth(tuple(found), looked, len(entries))


def observations(
    dataset: Dataset, entries: Iterable[EpisodeEntry]
) -> Iterator[tuple[EpisodeEntry, NDArray[np.float32] | InputError]]:
    """Yield what the model sees of each episode, (20, 258), or why it cannot be read."""
    sql = "SELECT uuid, chunk_off, chunk_len FROM episode WHERE chunk_off IS NOT NULL"
    chunks = {uuid: (offset, length) for uuid, offset, length in dataset.database.rows(sql)}
    for entry in entries:
        try:
            yield entry, _observation(dataset.folder / entry.path, chunks.get(entry.uuid))
        except InputError as error:
            yield entry, error


def _observation(path: Path, chunk: tuple[int, int] | None) -> NDArray[np.float32]:
    group = read_first(path) if chunk is None else read_chunk(path, *chunk)
    with explained(path):
        return unpack_observation(group.messages[OBS.name])


def _named(finding: Finding, pair: tuple[str, str], rows: list[Examined]) -> Finding:
    """Name the pair where a finding is of all its episodes."""
    if finding.episodes:
        return finding
    uuids = tuple(row.uuid for row in rows)
    return Finding(finding.kind, uuids, f"{pair[0]} on {pair[1]}: {finding.text}")


def _divided(dataset: Dataset, entries: list[EpisodeEntry]) -> Iterator[Finding]:
    """Yield each pair of a series that tags put on both sides of a split."""
    tagged = tagged_sides(dataset.database)
    if not tagged:
        return
    sides = [tagged.get(entry.uuid, "train") for entry in entries]
    series = [(entry.mounting_id, entry.piece, entry.bottom) for entry in entries]
    groups: dict[tuple[str, str, str], list[str]] = defaultdict(list)
    for k in divided(sides, series).tolist():
        groups[series[k]].append(entries[k].uuid)
    for (mounting, piece, bottom), uuids in groups.items():
        text = f"Tags put {piece} on {bottom} of mounting {mounting} on both sides of the split."
        yield Finding("divided series", tuple(uuids), text)
