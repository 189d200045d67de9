"""Which episodes are handed on, with which revision of their label, and on which side of a split.

Of each episode the approved revision counts where approved labels are wanted, else its head. Never
handed on: deleted, conflicting and rejected episodes, those that failed their quality checks, and
those whose file is not there.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from backend.catalogue.dataset import Dataset
from backend.catalogue.values import EpisodeEntry, EpisodeFilter, Revision
from backend.core.faults import InputError
from backend.dataset.splits import split_groups

ExportState = Literal["approved", "submitted", "draft"]
EXPORT_STATES: tuple[ExportState, ...] = get_args(ExportState)

SPLIT_TAG = "split:"
"""Tags of this prefix name the side of a split that an episode is on."""
TRAIN, HELD_OUT = "train", "held_out"


@dataclass(frozen=True, slots=True)
class ExportQuery:
    """What to hand on. ``held_out``: share (0..1) of the episodes kept from training, in whole
    grips or mountings, where no tags name a split; ``seed`` draws which.
    """

    piece: str | None = None
    bottom: str | None = None
    series: str | None = None
    campaign: str | None = None
    states: tuple[ExportState, ...] = ("approved",)
    held_out: float = 0.2
    seed: int = 0

    def text(self) -> str:
        """Return the query in words, for the manifest."""
        named = ("piece", "bottom", "series", "campaign")
        parts = [f"{name}={getattr(self, name)}" for name in named if getattr(self, name)]
        return " ".join([*parts, f"states={','.join(self.states)}"])


@dataclass(frozen=True, slots=True)
class Chosen:
    """One episode to hand on. ``index``: its number in the export; ``split``: its side."""

    index: int
    entry: EpisodeEntry
    revision: Revision
    split: str


@dataclass(frozen=True, slots=True)
class Selection:
    """The chosen episodes, side by side of the split; ``left_out``: why others are not among them.

    ``warnings``: sentences for the manifest.
    """

    chosen: tuple[Chosen, ...]
    left_out: tuple[tuple[str, int], ...]
    warnings: tuple[str, ...]


def select(dataset: Dataset, query: ExportQuery) -> Selection:
    """Choose the episodes of ``query``; raises ``InputError`` if there are none."""
    if not 0.0 <= query.held_out < 1.0:
        raise InputError(
            f"A share of {query.held_out:g} cannot be held out.", "--held-out", "Use 0 to below 1."
        )
    found: list[tuple[EpisodeEntry, Revision]] = []
    left_out: Counter[str] = Counter()
    for entry in dataset.episodes(_filter(query)):
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
    chosen = tuple(Chosen(i, *found[k], sides[k]) for i, k in enumerate(order))
    said = [f"{count} episodes are left out: {why}." for why, count in sorted(left_out.items())]
    return Selection(chosen, tuple(sorted(left_out.items())), (*said, *warnings))


def _filter(query: ExportQuery) -> EpisodeFilter:
    return EpisodeFilter(
        piece=query.piece, bottom=query.bottom, series=query.series, campaign=query.campaign
    )


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
    """Return the side of each episode: by its tag where any has one, else by grip or mounting."""
    rows = dataset.database.rows(
        "SELECT episode, name FROM mark WHERE present AND name LIKE ?", (f"{SPLIT_TAG}%",)
    )
    tagged = {episode: name.removeprefix(SPLIT_TAG) for episode, name in rows}
    sides = [tagged.get(entry.uuid, TRAIN) for entry in entries]
    if any(entry.uuid in tagged for entry in entries):
        return sides, []
    if query.held_out == 0.0:
        return sides, []
    mountings = [entry.mounting_id for entry in entries]
    grips = [entry.grip_id for entry in entries]
    try:
        split = split_groups(mountings, grips, query.held_out, query.seed)
    except InputError as error:
        return sides, [f"Nothing is held out. {error.what}"]
    for k in split.held_out.tolist():
        sides[k] = HELD_OUT
    return sides, []


def _nothing(dataset: Dataset, query: ExportQuery, left_out: Counter[str]) -> InputError:
    others = [state for state in EXPORT_STATES if state not in query.states]
    fix = "Label and approve some"
    fix += f", or add --states {','.join((*query.states, *others))}." if others else "."
    why = "; ".join(f"{count}: {reason}" for reason, count in sorted(left_out.items()))
    what = "No episode is fit to be handed on" + (f" ({why})." if why else ".")
    return InputError(what, f"{dataset.folder}: {query.text()}", fix)
