"""Annotation session: its person, the review queue and the episodes read ahead."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Generic, TypeVar

from pydantic import Field

from touchdown.app.label.text import FINDING, blind_queue_row, queue_row
from touchdown.app.shell import LabelDraft, LabelItem, SaveWorker
from touchdown.backend.annotations import (
    SCORES,
    ControlItemView,
    Dataset,
    EpisodeEntry,
    Revision,
    ScoredLabel,
    Verdict,
    parse_filter,
    with_control_items,
)
from touchdown.backend.core import InputError
from touchdown.widgets.lists import LabelList, LabelListRow, RowsOnDemand


@dataclass(frozen=True, slots=True)
class FindingQueue:
    """A temporary queue: a title, and the text of the finding by episode."""

    title: str
    said: dict[str, str]


USUAL_MM = 0.2  # uncertainty of a person who has not stated one


@dataclass(slots=True)
class AnnotationSession:
    """Person and settings of the labelling.

    ``sigma_mm`` is the uncertainty that the person stated last. ``chosen`` is the content of the
    queue ``finding``; it is not stored. ``filter`` is that of the queue ``all``; each of ``saved``
    is a queue under its own name.
    """

    person: str = ""
    queue: str = "unlabelled"
    seed: int = 0
    sigma_mm: Annotated[float, Field(gt=0, le=20)] | None = None
    blind: bool = False
    hidden: bool = False
    chosen: FindingQueue | None = None
    filter: str = ""
    saved: dict[str, str] = field(default_factory=dict)

    @property
    def wanted(self) -> str | None:
        """Filter of the queue, None if it is not one of all episodes."""
        return self.filter if self.queue == "all" else self.saved.get(self.queue)

    @property
    def trusted_mm(self) -> float:
        """The stated uncertainty of the person, else the usual one."""
        return self.sigma_mm or USUAL_MM

    @property
    def opines(self) -> bool:
        """True if answers are stored as opinions and change no label."""
        return self.queue == "gold" or (self.blind and self.queue == "audit")

    @property
    def hides(self) -> bool:
        """True if model and other sources are hidden."""
        return self.blind or self.hidden or self.opines


@dataclass(slots=True)
class PresentEpisode:
    """The shown episode. ``verdict``: stability as judged blind, stored with the opinion."""

    item: LabelItem
    edit: LabelDraft
    history: list[Revision] = field(default_factory=list)
    verdict: Verdict | None = None


PREFETCH_DISTANCE = 3  # number of episodes kept ready before and after the present one
IDLE_BEFORE_READ_S = 0.08
PREFETCH_JOIN_S = 1.0  # the thread only reads, so one that hangs on a disk is abandoned

Item = TypeVar("Item")


class Prefetcher(Generic[Item]):
    """Reads the wanted items on a thread; keeps at most ``2 * PREFETCH_DISTANCE + 1``.

    ``arrived`` is called on the thread of the window with the id of each item read.
    """

    def __init__(
        self, read: Callable[[str], Item], main_thread: SaveWorker, arrived: Callable[[str], None]
    ) -> None:
        self._read, self._main_thread, self._arrived = read, main_thread, arrived
        self._changed = threading.Condition()
        self._wanted: tuple[str, ...] = ()
        self._items: dict[str, Item | Exception] = {}
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="label-prefetch", daemon=True)
        self._thread.start()

    def want(self, wanted: Sequence[str]) -> None:
        """Keep exactly these items; the first one is read first."""
        with self._changed:
            self._wanted = tuple(wanted[: 2 * PREFETCH_DISTANCE + 1])
            self._drop()
            self._changed.notify()

    def get(self, uuid: str) -> Item | Exception | None:
        """Return the item, its read error, or None while it is not read yet."""
        with self._changed:
            return self._items.get(uuid)

    def forget(self) -> None:
        """Read all items again."""
        with self._changed:
            self._items.clear()
            self._changed.notify()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(PREFETCH_JOIN_S)

    def _drop(self) -> None:
        for uuid in set(self._items) - set(self._wanted):
            del self._items[uuid]

    def _run(self) -> None:
        while (uuid := self._next()) is not None:
            item: Item | Exception
            try:
                item = self._read(uuid)
            except Exception as error:  # noqa: BLE001 - one bad episode must not end the reading
                item = error
            with self._changed:
                self._items[uuid] = item
                self._drop()
            self._main_thread.put(lambda uuid=uuid: self._arrived(uuid))  # type: ignore[misc]

    def _next(self) -> str | None:
        """Wait for the next item to read; return None at the end.

        The present episode is read at once. Its neighbours are read after a pause, so that reading
        ahead does not delay painting.
        """
        with self._changed:
            while not self._closed:
                missing = [uuid for uuid in self._wanted if uuid not in self._items]
                if missing and missing[0] == self._wanted[0]:
                    return missing[0]
                if missing and not self._changed.wait(IDLE_BEFORE_READ_S):
                    return missing[0]
                if not missing:
                    self._changed.wait()
        return None


def neighbours(order: Sequence[str], at: int) -> list[str]:
    """Return the present id and its neighbours, nearest first, later before earlier."""
    places = [at]
    for distance in range(1, PREFETCH_DISTANCE + 1):
        places += [at + distance, at - distance]
    return [order[place] for place in places if 0 <= place < len(order)]


class QueueEntries(dict[str, EpisodeEntry]):
    """Entries of a queue by id, read in pages on first use. ``total``: episodes of the dataset.

    ``beside``: their labels and those of the model, if the queue is about ``score``.
    """

    def __init__(self, dataset: Dataset, order: Sequence[str], total: int, score: str = "") -> None:
        super().__init__()
        self._dataset, self._order, self.total, self._score = dataset, order, total, score
        self.beside: dict[str, ScoredLabel] = {}
        self._place = {uuid: at for at, uuid in enumerate(order)}

    def __missing__(self, uuid: str) -> EpisodeEntry:
        start = self._place.get(uuid, 0) // ENTRIES_PER_PAGE * ENTRIES_PER_PAGE
        page = self._dataset.entries([uuid, *self._order[start : start + ENTRIES_PER_PAGE]])
        self.update(page | self)
        self._compare(list(page))
        return dict.__getitem__(self, uuid)

    def renew(self, entry: EpisodeEntry) -> None:
        """Update an episode after a change of its label."""
        self[entry.uuid] = entry
        self._compare([entry.uuid])

    def _compare(self, uuids: Sequence[str]) -> None:
        if self._score:
            self.beside.update(self._dataset.scores.beside(uuids, self._score))


ENTRIES_PER_PAGE = 200

# Ids in order, their entries, and the control items among the ids.
QueueContent = tuple[list[str], QueueEntries, dict[str, ControlItemView]]


def read_queue(dataset: Dataset, session: AnnotationSession) -> QueueContent:
    """Return a queue with control items mixed in. Slow: do not call on the thread of the window."""
    s, score = session, session.queue if session.queue in SCORES else ""
    if s.queue == FINDING:
        order = [] if s.chosen is None else list(s.chosen.said)
    elif s.wanted is not None:
        order, score = dataset.queue("all", s.person, wanted=s.wanted), parse_filter(s.wanted).score
    else:
        order = dataset.queue(s.queue, s.person, seed=s.seed)
    known, gold = dataset.uuids(), dict[str, ControlItemView]()
    order = [uuid for uuid in order if uuid in known]
    if s.queue == "unlabelled":
        order, gold = with_control_items(dataset, s.person, order, known, s.seed)
    return order, QueueEntries(dataset, order, len(known), score), gold


class QueueCursor:
    """Keeps list, order and prefetch consistent. The order does not change until the next read."""

    def __init__(
        self, rows: LabelList, prefetch: Prefetcher[LabelItem], entries: QueueEntries
    ) -> None:
        self._rows, self._prefetch, self.entries = rows, prefetch, entries
        self.order: list[str] = []
        self.badges: dict[str, tuple[str, ...]] = {}
        self.at = -1
        self.begun = False
        self._blind = self._hides = False
        # Answered blind since the queue was read.
        self.answered: set[str] = set()

    @property
    def uuid(self) -> str | None:
        """The present episode."""
        return self.order[self.at] if 0 <= self.at < len(self.order) else None

    @property
    def selected(self) -> list[str]:
        """The selected episodes if there are several, else all of the queue."""
        rows = self._rows.selected()
        return [self.order[at] for at in rows] if len(rows) > 1 else self.order

    def begin(self, order: Sequence[str], entries: QueueEntries, stay: str) -> None:
        """Use a queue; start with ``stay`` if it contains it, else with the first episode."""
        self.begun = True
        self.answered.clear()
        self.order, self.entries = list(order), entries
        self._show_rows()
        self.at = self.order.index(stay) if stay in self.order else (0 if self.order else -1)
        self._want()

    def move_to(self, at: int) -> bool:
        """Go to a place; return False if there is none."""
        if not 0 <= at < len(self.order):
            return False
        self.at = at
        self._want()
        return True

    def find(self, uuid: str) -> int:
        """Return the place of an episode, -1 if it is not in this queue."""
        return self.order.index(uuid) if uuid in self.order else -1

    def ready(self) -> LabelItem | Exception | None:
        """Return the present item, its read error, or None while it is being read."""
        uuid = self.uuid
        return InputError("The queue is empty.", "queue", "Choose another.") if uuid is None else (
            self._prefetch.get(uuid)
        )  # fmt: skip

    def ahead(self) -> LabelItem | Exception | None:
        """Return the next item of the queue, None if it is not read yet."""
        at = self.at + 1
        return self._prefetch.get(self.order[at]) if at < len(self.order) else None

    def cover(self, *, blind: bool, hides: bool) -> None:
        """Hide the states of the episodes (``blind``) or other evidence (``hides``)."""
        if (blind, hides) != (self._blind, self._hides):
            self._blind, self._hides = blind, hides
            self._show_rows()
            if self.at >= 0:
                self._rows.choose(self.at)

    def note(self, uuid: str, badges: tuple[str, ...]) -> None:
        """Set the badges of an episode and update its row."""
        self.badges[uuid] = badges
        at = self.at if uuid == self.uuid else self.find(uuid)
        if at >= 0:
            self._rows.show_row(at, self._row(uuid))

    def take(self, entry: EpisodeEntry) -> None:
        """Update the entry of an episode and its row."""
        self.entries.renew(entry)
        self.note(entry.uuid, self.badges.get(entry.uuid, ()))

    def _show_rows(self) -> None:
        self._rows.show_rows(RowsOnDemand(len(self.order), lambda at: self._row(self.order[at])))

    def _row(self, uuid: str) -> LabelListRow:
        entry = self.entries[uuid]
        if self._blind:
            return blind_queue_row(entry, answered=uuid in self.answered)
        if self._hides:
            return queue_row(entry, entry.state)
        beside = self.entries.beside.get(uuid)
        return queue_row(entry, entry.state, self.badges.get(uuid, ()), beside)

    def _want(self) -> None:
        if self.at >= 0:
            self._prefetch.want(neighbours(self.order, self.at))
            self._rows.choose(self.at)
        else:
            self._prefetch.want(())
