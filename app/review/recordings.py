"""List of recordings."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path

from touchdown.app.review.campaign import CollectedRun, collected_run
from touchdown.app.review.episodes import (
    EpisodeSeries,
    StoredEpisode,
    list_series,
    read_stored_episode,
)
from touchdown.app.review.exports import probe_table
from touchdown.app.review.page import ReviewPage
from touchdown.app.review.timing import TrialTimeline, split_into_trials
from touchdown.app.shell import ModelPrelabeller, RunStory, SaveWorker, model_path_in_use
from touchdown.backend import core
from touchdown.backend.annotations import DESCRIPTION_FILE, Dataset
from touchdown.backend.geometry import Outline, PieceLibrary, load_pieces
from touchdown.backend.runs import EVENT_LOG_NAME, decode_event, event_log_path, read_events
from touchdown.widgets.base import tr
from touchdown.widgets.lists import RecordingRow
from touchdown.widgets.views import OUTCOME_WORDS

# Start of the log lines that are read here; other lines are skipped.
_STARTS = tuple(
    f'{{"kind":"{kind.__name__}",'.encode()
    for kind in (core.RunStarted, core.TrialFinished, core.RunFinished)
)

ACTIVITIES = {"collect": "collecting", "probe": "single probe"}  # kinds of runs without trials


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of a run: its start, the outcomes so far and its end, if any."""

    head: core.RunStarted | None = None
    outcomes: tuple[core.Outcome, ...] = ()
    ended: core.RunFinished | None = None

    def text(self) -> str:
        """Return piece, bottom and outcomes as text."""
        if self.head is None:
            return tr("nothing recorded")
        said = _outcome_counts(self.outcomes) or activity_text(self.head)
        if self.ended is None:
            said.append(tr("not finished"))
        elif self.ended.ending != "finished":
            said.append(tr("run {}", tr(self.ended.ending)))
        pair = tr("{} on {}", self.head.piece, self.head.bottom)
        return f"{pair}: {', '.join(said) or tr('no trial')}"


def read_run_summary(run: Path) -> RunSummary:
    """Read the summary of ``run``. Raises ``InputError`` or ``OSError``.

    An incomplete last line is ignored, as in ``read_journal``.
    """
    head: core.RunStarted | None = None
    ended: core.RunFinished | None = None
    outcomes: list[core.Outcome] = []
    path = event_log_path(run)
    with path.open("rb") as file:
        for number, raw in enumerate(file, start=1):
            if not raw.startswith(_STARTS) or not raw.endswith(b"\n"):
                continue
            where = tr("{}, line {}", path, number)
            try:
                event = decode_event(core.parse_json(raw), where)
            except ValueError as error:
                raise core.InputError(
                    "A line is not valid JSON.", where, "Open the run."
                ) from error
            if isinstance(event, core.RunStarted):
                head = event
            elif isinstance(event, core.TrialFinished):
                outcomes.append(event.outcome)
            elif isinstance(event, core.RunFinished):
                ended = event
    return RunSummary(head, tuple(outcomes), ended)


def activity_text(head: core.RunStarted) -> list[str]:
    """Return the kind of a run without trials; nothing for a stacking run."""
    return [] if head.activity == "stack" else [tr(ACTIVITIES.get(head.activity, head.activity))]


def _outcome_counts(outcomes: tuple[core.Outcome, ...]) -> list[str]:
    if len(outcomes) == 1:
        return [tr(OUTCOME_WORDS[outcomes[0]])]
    counts = Counter(outcomes).most_common()
    return [f"{count} {tr(OUTCOME_WORDS[outcome])}" for outcome, count in counts]


MOST_DESCRIBED = 50  # number of the newest runs that are described at once; older ones on demand
SHOWN_ANEW = 100  # number of newly described runs after which a filtered list is updated
UNREAD = -1  # size of a log that cannot be read
CANNOT = "cannot be read"
LOOKING = "Looking for recordings \N{HORIZONTAL ELLIPSIS}"
NOTHING = "No recordings yet. Every run of the Stack workspace is kept."
UNLISTED = "The recordings cannot be listed."
NO_MATCH = "No recording fits filter and kind."


class RecordingsPresenter:
    """List of recordings: runs numbered from 0, newest first, then the series of the dataset.

    Everything is read on the thread of ``reader``; ``failed`` receives read errors.
    """

    def __init__(
        self,
        page: ReviewPage,
        runs: Path,
        reader: SaveWorker,
        series: Callable[[], list[EpisodeSeries]],
        failed: Callable[[Exception], None],
    ) -> None:
        self._page, self._runs, self._reader = page, runs, reader
        self._read_series, self._failed = series, failed
        self.folders: list[Path] = []
        self.series: list[EpisodeSeries] = []
        self._titles: list[str] = []
        # Size of each log and description of its run.
        self._described: dict[Path, tuple[int, str]] = {}
        self._to_describe: list[Path] = []
        self._awaited = 0  # listings in progress
        self._trouble = False  # true if the last listing failed
        self._in_hand = False  # true while a run is being described
        self._all_wanted = False  # true if older runs are described, too

    @property
    def describing(self) -> bool:
        """True while recordings are being listed or described."""
        return self._awaited > 0 or self._in_hand

    def refresh(self) -> None:
        """List the recordings again; the selection stays."""
        self._awaited, self._trouble = self._awaited + 2, False
        self._say_what_is_there()
        known = self.folders
        self._reader.submit(
            lambda: _looked_for(self._runs, known), self._take_runs, self._could_not_look
        )
        self._reader.submit(self._read_series, self._take_series, self._could_not_look)

    def show(self) -> None:
        """Show the recordings that match kind and filter, in the chosen order."""
        words, kind = self._page.filter.text().lower().split(), self._page.kind.currentData()
        order, rows = self._page.order.currentData(), self._page.runs.rows()
        found = [
            at
            for at, row in enumerate(rows)
            if (kind == "all" or (kind == "runs") == (at < len(self.folders)))
            and all(word in row.text.lower() for word in words)
        ]
        if order == "pair":
            found.sort(key=lambda at: rows[at].detail.removeprefix("series: "))
        elif order != "kind":
            found.sort(key=lambda at: rows[at].text, reverse=order == "newest")
        self._page.runs.show_order(found)
        if (words or order == "pair") and not self._all_wanted:
            self._all_wanted = True
            self._to_describe += self.folders[MOST_DESCRIBED:]
            self._describe_next()
        self._say_what_is_there()

    def describe(self, at: int) -> None:
        """Describe a run; read it again only if its log has grown."""
        self._to_describe.insert(0, self.folders[at])
        self._describe_next()

    def _list(self, folders: list[Path], titles: list[str], series: list[EpisodeSeries]) -> None:
        chosen = self._page.runs.current
        before: list[Path | str] = [*self.folders, *(one.first.series for one in self.series)]
        self.folders, self._titles, self.series = folders, titles, series
        now: list[Path | str] = [*folders, *(one.first.series for one in series)]
        self._page.runs.take([
            *(RecordingRow(title, self._described.get(folder, (UNREAD, ""))[1])
              for folder, title in zip(folders, titles, strict=True)),
            *(RecordingRow(*one.title.split("\n")) for one in series),
        ])  # fmt: skip
        if 0 <= chosen < len(before) and before[chosen] in now:
            self._page.runs.choose(now.index(before[chosen]))
        self.show()

    def _take_runs(self, found: tuple[list[Path], list[str]]) -> None:
        self._awaited -= 1
        folders, titles = found
        # The same list object means that nothing changed.
        if folders is not self.folders:
            self._list(folders, titles, self.series)
        # One run per job, so that a chosen run need not wait for all of them.
        older = folders[MOST_DESCRIBED:] if self._all_wanted else []
        self._to_describe = folders[:MOST_DESCRIBED]
        self._to_describe += [folder for folder in older if folder not in self._described]
        self._describe_next()
        self._say_what_is_there()

    def _take_series(self, series: list[EpisodeSeries]) -> None:
        self._awaited -= 1
        # The library returns the same list object while nothing changed.
        if series is not self.series:
            self._list(self.folders, self._titles, series)
        self._say_what_is_there()

    def _could_not_look(self, error: Exception) -> None:
        self._awaited -= 1
        self._trouble = True
        self._say_what_is_there()
        self._failed(error)

    def _describe_next(self) -> None:
        if self._in_hand or not self._to_describe:
            return
        self._in_hand = True
        folder = self._to_describe.pop(0)
        known = self._described.get(folder, (UNREAD, ""))
        self._reader.submit(
            lambda: _described(folder, known),
            lambda said: self._say(folder, said),
            lambda _: self._say(folder, (UNREAD, CANNOT)),
        )

    def _say(self, folder: Path, said: tuple[int, str]) -> None:
        self._in_hand = False
        self._described[folder] = said
        if folder in self.folders:
            at = self.folders.index(folder)
            self._page.runs.show_row(at, RecordingRow(self._titles[at], said[1]))
        self._describe_next()
        if len(self._to_describe) % SHOWN_ANEW == 0:
            self.show()

    def _say_what_is_there(self) -> None:
        """Show why the list is empty, or how many runs are still to be read."""
        page, left = self._page, len(self._to_describe)
        page.runs_panel.detail.setText(tr("{:,} to read", left) if left > MOST_DESCRIBED else "")
        there = bool(self.folders or self.series)
        if (self._awaited and not there) or (self.describing and not page.runs.shown()):
            page.empty.setText(tr(LOOKING))
        else:
            page.empty.setText(tr(NO_MATCH if there else UNLISTED if self._trouble else NOTHING))
        page.empty.setVisible(not page.runs.shown())


def _looked_for(runs: Path, known: list[Path]) -> tuple[list[Path], list[str]]:
    """Return the runs of a folder, newest first, with titles; ``known`` if unchanged."""
    found = [path.parent for path in runs.glob(f"*/{EVENT_LOG_NAME}")] if runs.is_dir() else []
    found.sort(key=lambda folder: folder.name, reverse=True)
    found = known if found == known else found
    return found, [run_title(folder.name) for folder in found]


def run_title(name: str) -> str:
    """Return the name of a run, a time in UTC, as local date and time, where it is one."""
    try:
        when = datetime.strptime(name[:15], "%Y%m%d-%H%M%S").replace(tzinfo=UTC).astimezone()
    except ValueError:
        return name
    return f"{when:%Y-%m-%d  %H:%M:%S}"


def _described(folder: Path, known: tuple[int, str]) -> tuple[int, str]:
    """Return the size of a log and the description of its run; ``known`` if unchanged."""
    try:
        size = (folder / EVENT_LOG_NAME).stat().st_size
        return known if size == known[0] else (size, read_run_summary(folder).text())
    except (core.InputError, OSError):
        return UNREAD, CANNOT


class ReviewDataset:
    """Opens the dataset in ``folder`` once it exists. Use one thread for all but ``catalogue``."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._dataset: Dataset | None = None
        self._models: ModelPrelabeller | None = None
        self._series: list[EpisodeSeries] = []

    @cached_property
    def catalogue(self) -> PieceLibrary:
        """The pieces."""
        return load_pieces()

    def series(self) -> list[EpisodeSeries]:
        """Return the series of the dataset, newest first; none without a dataset.

        Returns the same list object while nothing changed, so that callers need not compare
        episodes.
        """
        if self._dataset is None and not (self.folder / DESCRIPTION_FILE).is_file():
            return self._series
        found = list_series(self._opened())
        if found != self._series:
            self._series = found
        return self._series

    def episode(self, uuid: str) -> StoredEpisode:
        """Read one episode. Raises ``InputError`` for a damaged file."""
        if self._models is None:
            self._models = ModelPrelabeller(self.catalogue, model_path_in_use)
        dataset = self._opened()
        return read_stored_episode(dataset, self._models, self.catalogue, dataset.entry(uuid))

    def table(self, uuids: Sequence[str]) -> str:
        """Return the table of these episodes, one line each; unreadable ones are left out."""
        return probe_table(self._numbered(uuids))

    def _numbered(self, uuids: Sequence[str]) -> Iterator[tuple[TrialTimeline, Outline | None]]:
        for number, uuid in enumerate(uuids, start=1):
            try:
                shown = self.episode(uuid)
            except core.InputError:
                continue
            yield shown.trial.numbered(number), self.face(shown.entry.bottom)

    def face(self, name: str) -> Outline | None:
        """Return the outline of a face, None for an unknown piece."""
        piece = self.catalogue.pieces.get(name)
        return None if piece is None else piece.face

    def close(self) -> None:
        """Close the dataset."""
        if self._dataset is not None:
            self._dataset.close()
            self._dataset = None

    def _opened(self) -> Dataset:
        if self._dataset is None:
            self._dataset = Dataset.open(self.folder, create=False, write=False)
        return self._dataset


LONG_S = 0.3  # a reading that takes longer shows its progress
BLOCK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class ReadRun:
    """A run read from its log: ``collection`` if it collected, else its ``trials``."""

    folder: Path
    story: RunStory
    collection: CollectedRun | None
    trials: list[TrialTimeline]


class RunReader:
    """Reads one log. ``read`` is called on another thread, all else on that of the window."""

    def __init__(self, run: Path) -> None:
        self._run, self._begun_s = run, time.monotonic()
        self._share = 0.0
        self._dropped = False

    def read(self) -> ReadRun | None:
        """Return the run, None if reading was cancelled. Raises ``InputError`` or ``OSError``."""
        lines = _line_count(event_log_path(self._run))
        story, events = RunStory(of_any=True), list[core.Event]()
        for event in read_events(self._run):
            if self._dropped:
                return None
            story.take(event)
            events.append(event)
            self._share = min(1.0, len(events) / lines)
        collection = collected_run(events)
        trials = [] if collection is not None else split_into_trials(events)
        return ReadRun(self._run, story, collection, trials)

    def drop(self) -> None:
        """Cancel reading after the present line."""
        self._dropped = True

    def progress(self) -> str:
        """Return progress and remaining time, "" for short readings."""
        taken_s, share = time.monotonic() - self._begun_s, self._share
        if taken_s < LONG_S:
            return ""
        if share <= 0.0:
            return tr("{:.0f} % read", 0.0)
        return tr("{:.0f} % read, {:.0f} s left", 100.0 * share, taken_s * (1.0 / share - 1.0))


def _line_count(journal: Path) -> int:
    with journal.open("rb") as file:
        blocks = iter(lambda: file.read(BLOCK_BYTES), b"")
        return max(1, sum(block.count(b"\n") for block in blocks))
