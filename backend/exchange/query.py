"""Selection of the episodes to export, with label revision and side of the split."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from touchdown.backend.annotations import (
    Dataset,
    EpisodeEntry,
    EpisodeFilter,
    Revision,
    tagged_sides,
)
from touchdown.backend.core import InputError
from touchdown.backend.episodes import Split, divided_indices, split_grips, split_series

ExportState = Literal["approved", "submitted", "draft"]
EXPORT_STATES: tuple[ExportState, ...] = get_args(ExportState)

TRAIN, HELD_OUT = "train", "held_out"
MAX_LISTED = 12  # names in an error


@dataclass(frozen=True, slots=True)
class ExportQuery:
    """Selection of episodes, and split.

    ``held_out``: share (0..1) of the episodes on the validation side, in whole series or mountings,
    unless tags define the split; ``seed`` of the draw. ``divide_series``: a pair of one series may
    be on both sides, which the manifest states.
    """

    piece: str | None = None
    bottom: str | None = None
    series: str | None = None
    campaign: str | None = None
    states: tuple[ExportState, ...] = ("approved",)
    held_out: float = 0.2
    seed: int = 0
    divide_series: bool = False

    def text(self) -> str:
        """Return the query as text for the manifest."""
        named = ("piece", "bottom", "series", "campaign")
        parts = [f"{name}={getattr(self, name)}" for name in named if getattr(self, name)]
        return " ".join([*parts, f"states={','.join(self.states)}"])


@dataclass(frozen=True, slots=True)
class SelectedEpisode:
    """One episode to export. ``index``: its number in the export; ``split``: its side."""

    index: int
    entry: EpisodeEntry
    revision: Revision
    split: str


@dataclass(frozen=True, slots=True)
class Selection:
    """Selected episodes sorted by side of the split. ``warnings``: sentences for the manifest."""

    chosen: tuple[SelectedEpisode, ...]
    warnings: tuple[str, ...]


def indices_by_side(chosen: Sequence[SelectedEpisode]) -> dict[str, list[int]]:
    """Return the export numbers on each side of the split."""
    sides: dict[str, list[int]] = {}
    for one in chosen:
        sides.setdefault(one.split, []).append(one.index)
    return sides


def select_episodes(dataset: Dataset, query: ExportQuery) -> Selection:
    """Select the episodes of ``query``; raises ``InputError`` if there are none."""
    if not 0.0 <= query.held_out < 1.0:
        fix = "Use 0 to below 1."
        raise InputError(f"A share of {query.held_out:g} cannot be held out.", "--held-out", fix)
    found: list[tuple[EpisodeEntry, Revision]] = []
    left_out: Counter[str] = Counter()
    wanted = EpisodeFilter(
        piece=query.piece, bottom=query.bottom, series=query.series, campaign=query.campaign
    )
    for entry in dataset.episodes(wanted):
        revision = _counting(dataset, entry, query.states)
        reason = _unfit(entry) or ("its label is in another state" if revision is None else "")
        if reason or revision is None:
            left_out[reason] += 1
        else:
            found.append((entry, revision))
    if not found:
        raise _nothing(dataset, query, left_out)
    sides, warnings = _sides(dataset, [entry for entry, _ in found], query)
    order = sorted(range(len(found)), key=lambda k: (sides[k] != TRAIN, sides[k], k))
    chosen = tuple(SelectedEpisode(i, *found[k], sides[k]) for i, k in enumerate(order))
    notes = [f"Episodes left out: {count}, {why}." for why, count in sorted(left_out.items())]
    return Selection(chosen, (*notes, *warnings))


def _unfit(entry: EpisodeEntry) -> str:
    if entry.file_state != "complete":
        return f"its file is {entry.file_state}"
    if not entry.quality.accepted:
        return "it failed its quality checks"
    if entry.conflict:
        return "it has two labels since a merge"
    return "its label is rejected" if entry.state == "rejected" else ""


def _counting(
    dataset: Dataset, entry: EpisodeEntry, states: Sequence[ExportState]
) -> Revision | None:
    revision = dataset.labels.counting(entry.uuid) if "approved" in states else None
    if revision is None and entry.state in states:
        revision = dataset.labels.head(entry.uuid)
    return revision if revision is not None and revision.label.is_set else None


def _sides(
    dataset: Dataset, entries: Sequence[EpisodeEntry], query: ExportQuery
) -> tuple[list[str], list[str]]:
    """Return the side of each episode: by tags if any has one, else drawn.

    Raises ``InputError`` if tags divide a pair of a series and ``divide_series`` is not set.
    """
    tagged = tagged_sides(dataset.database)
    sides = [tagged.get(entry.uuid, TRAIN) for entry in entries]
    by_tag = any(entry.uuid in tagged for entry in entries)
    if not by_tag and query.held_out > 0.0:
        try:
            split = _drawn(entries, query)
        except InputError as error:
            return sides, [f"Nothing is held out. {error.what} {error.fix}"]
        for k in split.held_out.tolist():
            sides[k] = HELD_OUT
    series = [(entry.mounting_id, entry.piece, entry.bottom) for entry in entries]
    leaks = divided_indices(sides, series)
    if not len(leaks):
        return sides, []
    count = len({series[k] for k in leaks.tolist()})
    what = "1 pair of a series is" if count == 1 else f"{count} pairs of a series are"
    what = f"Leakage: {what} on both sides, so validation knows their errors."
    if not query.divide_series:
        where = f"tags of {len(leaks)} episodes, {entries[int(leaks[0])].uuid} first"
        raise InputError(what, where, "Tag whole series alike, or add --divide-series.")
    return sides, [what]


def _drawn(entries: Sequence[EpisodeEntry], query: ExportQuery) -> Split:
    mountings = [entry.mounting_id for entry in entries]
    if query.divide_series:
        return split_grips(mountings, [e.grip_id for e in entries], query.held_out, query.seed)
    pairs = [f"{entry.piece} on {entry.bottom}" for entry in entries]
    return split_series(mountings, pairs, query.held_out, query.seed)


def _nothing(dataset: Dataset, query: ExportQuery, left_out: Counter[str]) -> InputError:
    where, entries = f"{dataset.folder}: {query.text()}", dataset.episodes()
    for name in ("piece", "bottom", "series", "campaign"):
        wanted, known = getattr(query, name), sorted({getattr(entry, name) for entry in entries})
        if wanted is not None and wanted not in known:
            fix = f"It has {', '.join(known[:MAX_LISTED]) or 'no episodes'}."
            return InputError(f"The dataset has no {name} '{wanted}'.", where, fix)
    others = [state for state in EXPORT_STATES if state not in query.states]
    fix = "Label and approve some"
    fix += f", or add --states {','.join((*query.states, *others))}." if others else "."
    why = "; ".join(f"{count}: {reason}" for reason, count in sorted(left_out.items()))
    what = "No episode can be exported" + (f" ({why})." if why else ".")
    return InputError(what, where, fix)
