"""The way through one queue: what comes in which order, where we are, what is ready to be shown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from app.label.item import LabelItem
from app.label.prefetch import Prefetch, around
from app.label.sitting import Sitting
from app.label.words import FINDING, blind_row, row_of
from backend.catalogue.dataset import Dataset
from backend.catalogue.gold import Shown, with_gold
from backend.catalogue.values import EpisodeEntry
from backend.core.faults import InputError
from widgets.label_list import LabelList, LabelRow

Queue = tuple[list[str], dict[str, EpisodeEntry], dict[str, Shown]]
"""Ids in their order, all entries, and the gold among the ids."""


def read_queue(dataset: Dataset, sitting: Sitting) -> Queue:
    """Return a queue, gold mixed into what is to be labelled; slow, not for the window."""
    s = sitting
    if s.queue == FINDING:
        order = [] if s.chosen is None else list(s.chosen.said)
    else:
        order = dataset.queue(s.queue, s.person, seed=s.seed)
    entries = {entry.uuid: entry for entry in dataset.episodes()}
    order = [uuid for uuid in order if uuid in entries]
    if s.queue != "unlabelled":
        return order, entries, {}
    order, gold = with_gold(dataset, s.person, order, entries, s.seed)
    return order, entries, gold


class Walk:
    """Keeps list, order and prefetch in step. The order stays as it was when it was read."""

    def __init__(self, rows: LabelList, prefetch: Prefetch[LabelItem]) -> None:
        self._rows, self._prefetch = rows, prefetch
        self.order: list[str] = []
        self.entries: dict[str, EpisodeEntry] = {}
        self.badges: dict[str, tuple[str, ...]] = {}
        self.at = -1
        self.begun = False
        self._blind = self._hides = False
        self.answered: set[str] = set()
        """Episodes that were answered blind since the queue was read."""

    @property
    def uuid(self) -> str | None:
        """The present episode."""
        return self.order[self.at] if 0 <= self.at < len(self.order) else None

    def begin(self, order: Sequence[str], entries: Mapping[str, EpisodeEntry], stay: str) -> None:
        """Take a queue; begin with ``stay`` if it is in it, else with the first."""
        self.begun = True
        self.answered.clear()
        self.order, self.entries = list(order), dict(entries)
        self._rows.show_rows([self._row(uuid) for uuid in self.order])
        self.at = self.order.index(stay) if stay in self.order else (0 if self.order else -1)
        self._want()

    def move_to(self, at: int) -> bool:
        """Go to a place; False if there is none."""
        if not 0 <= at < len(self.order):
            return False
        self.at = at
        self._want()
        return True

    def find(self, uuid: str) -> int:
        """Return the place of an episode, -1 if it is not in this queue."""
        return self.order.index(uuid) if uuid in self.order else -1

    def ready(self) -> LabelItem | Exception | None:
        """Return the present item, why it cannot be read, or None while it is being read."""
        uuid = self.uuid
        return InputError("The queue is empty.", "queue", "Choose another.") if uuid is None else (
            self._prefetch.get(uuid)
        )  # fmt: skip

    def ahead(self) -> LabelItem | Exception | None:
        """Return the next item of the queue, if there is one and it is there."""
        at = self.at + 1
        return self._prefetch.get(self.order[at]) if at < len(self.order) else None

    def held(self) -> tuple[str, ...]:
        """Return which episodes are in memory."""
        return self._prefetch.held()

    def size(self, uuid: str) -> int:
        """Return the bytes that an episode takes in memory, 0 if it is not there."""
        item = self._prefetch.get(uuid)
        return item.bytes if isinstance(item, LabelItem) else 0

    def cover(self, *, blind: bool, hides: bool) -> None:
        """Keep from sight how far episodes have come (``blind``), or other evidence (``hides``)."""
        if (blind, hides) != (self._blind, self._hides):
            self._blind, self._hides = blind, hides
            self._rows.show_rows([self._row(uuid) for uuid in self.order])
            if self.at >= 0:
                self._rows.choose(self.at)

    def note(self, uuid: str, badges: tuple[str, ...]) -> None:
        """Take the badges of an episode, and show its row anew."""
        self.badges[uuid] = badges
        at = self.at if uuid == self.uuid else self.find(uuid)
        if at >= 0:
            self._rows.show_row(at, self._row(uuid))

    def take(self, entry: EpisodeEntry) -> None:
        """Take what is new of an episode, and show its row anew."""
        self.entries[entry.uuid] = entry
        self.note(entry.uuid, self.badges.get(entry.uuid, ()))

    def _row(self, uuid: str) -> LabelRow:
        entry = self.entries[uuid]
        if self._blind:
            return blind_row(entry, answered=uuid in self.answered)
        badges = () if self._hides else self.badges.get(uuid, ())
        return row_of(entry, entry.state, badges)

    def _want(self) -> None:
        if self.at >= 0:
            self._prefetch.want(around(self.order, self.at))
            self._rows.choose(self.at)
        else:
            self._prefetch.want(())
