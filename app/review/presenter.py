"""Presenter of the review workspace."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from touchdown.app.review import episodes, recordings
from touchdown.app.review.campaign import CollectedRun
from touchdown.app.review.exports import probe_table
from touchdown.app.review.page import ReviewPage
from touchdown.app.review.replay import TOUCH_S, ReplayPresenter
from touchdown.app.review.timing import TrialTimeline
from touchdown.app.shell import BookmarkDialog, RunStory, SaveWorker, TrialStory, run_score
from touchdown.backend.core import InputError
from touchdown.backend.runs import BOOKMARKS_NAME, EVENT_LOG_NAME, Bookmark, read_bookmarks
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.shell import CardText, FaultCards
from touchdown.widgets.views import OUTCOME_WORDS, DecisionText

# Longer lists use the height of their first row for all: measuring 10,000 takes 1 s.
MOST_MEASURED = 500


class ReviewPresenter:
    """Lists runs and series, reads the chosen one and shows one trial or episode of it."""

    def __init__(
        self,
        page: ReviewPage,
        runs: Path,
        cards: FaultCards,
        reader: SaveWorker,
        library: recordings.ReviewDataset,
    ) -> None:
        self._page, self._cards = page, cards
        self._reader, self.library = reader, library
        self.replay = ReplayPresenter(page)
        self.recordings = recordings.RecordingsPresenter(
            page, runs, reader, library.series, self._failed
        )
        self.story = RunStory()
        self.timed: list[TrialTimeline] = []
        self._run: Path | None = None
        self._episodes: list[str] = []  # rows of a series or a collecting run
        self._told: list[str] = []
        # Name of a series or a collecting run, for captions.
        self._whole = ""
        self._notes: tuple[Path, int] | None = None  # file of the bookmarks, and the trial
        self.note = BookmarkDialog(page, "Bookmark")
        self.bookmarks: list[Bookmark] = []  # of the whole run, or of the episode
        self.file: Path | None = None  # file for an external viewer
        self.caption = ""  # caption of the shown trial or episode
        self._asked = 0
        self._reading: recordings.RunReader | None = None
        self._said = ""  # progress shown last
        page.refresh.clicked.connect(self.recordings.refresh)
        page.trials.currentRowChanged.connect(self._choose_part)
        self.replay.show(None)

    # -- the list ---------------------------------------------------------------------------------

    def choose(self, at: int) -> None:
        """Open the recording with this number."""
        runs = self.recordings.folders
        if at < len(runs):
            self.recordings.describe(at)
            self.open(runs[at])
        else:
            self._open_series(self.recordings.series[at - len(runs)])

    # -- one recording ----------------------------------------------------------------------------

    @property
    def reading(self) -> bool:
        """True while the chosen run is being read."""
        return self._reading is not None

    def open(self, run: Path) -> None:
        """Read a run and show its last trial; show a card for a damaged log."""
        self._drop_reading()
        reading = self._reading = recordings.RunReader(run)
        self._page.trials_panel.detail.setText(tr("reading"))

        def done(read: recordings.ReadRun | None) -> None:
            if reading is self._reading and read is not None:
                self._drop_reading()
                self._take_run(read)

        def failed(error: Exception) -> None:
            if reading is self._reading:
                self.cancel_reading()
                what = error.what if isinstance(error, InputError) else str(error)
                self._card(tr("The run could not be read: {}", what), tr("In {}.", run))

        self._reader.submit(reading.read, done, failed)

    def draw(self) -> None:
        """Show the progress of a long reading; enable what acts on a chosen recording."""
        for button in self._page.acts:
            button.setEnabled(self.file is not None)
        said = "" if self._reading is None else self._reading.progress()
        if said and said != self._said:
            if not self._said:
                self._forget()
            self._said = said
            self._page.decision.show_text(DecisionText("Reading the run", "", "", said))

    def cancel_reading(self) -> None:
        """Stop reading the chosen run and show nothing of it."""
        if self._reading is not None:
            self._drop_reading()
            self._forget()
            again = "Choose another recording, then this one again."
            self._page.decision.show_text(DecisionText("Not read", "", "", again))

    def _drop_reading(self) -> None:
        if self._reading is not None:
            self._reading.drop()
        self._reading, self._said = None, ""

    def _forget(self) -> None:
        self.story, self._run, self.timed = RunStory(), None, []
        self._episodes, self._told, self.caption = [], [], ""
        self._page.score.show_facts("", "")
        self._name_parts("Trials", "", "Outcomes")
        self._fill([], -1)

    def _take_run(self, read: recordings.ReadRun) -> None:
        self.story, self._run = read.story, read.folder
        if read.collection is not None:
            self._open_collection(read.collection)
            return
        self.timed, self._episodes, self._told = read.trials, [], []
        self._name_parts("Trials", "of the run", "Outcomes")
        self._show_score()
        lines = [_trial_title(trial) for trial in self.story.trials]
        lines = lines or [tr("1.  single probe") for _ in self.timed]
        self._fill(lines, len(lines) - 1)

    def _open_collection(self, collection: CollectedRun) -> None:
        self.timed, self._told = [], collection.told
        self._episodes = [probe.uuid for probe in collection.probes]
        self._whole = tr("Run {}, seed {}", collection.head.run_id, collection.head.seed)
        self._page.score.show_facts(collection.headline, collection.facts())
        self._name_parts("Probes", "of the run", "Collection")
        self._fill(collection.lines(), len(self._episodes) - 1)

    def _open_series(self, series: episodes.EpisodeSeries) -> None:
        self._drop_reading()
        self.story, self._run, self.timed, self._told = RunStory(), None, [], []
        self._episodes = [uuid for uuid, _ in series.episodes]
        self._whole = ", ".join((tr("Series {}", series.first.series), series.plan)).rstrip(", ")
        count = len(series.episodes)
        self._page.score.show_facts(count_noun(count, "episode"), series.facts)
        self._name_parts("Episodes", "of the series", "Series")
        numbered = enumerate(series.episodes, 1)
        lines = [f"{at}.  {tr(state)}, {uuid[-8:]}" for at, (uuid, state) in numbered]
        self._fill(lines, count - 1)

    def _name_parts(self, title: str, detail: str, whole: str) -> None:
        self._page.score.rename(whole)
        self._page.trials_panel.rename(title)
        self._page.trials_panel.detail.setText(tr(detail))

    def _fill(self, lines: list[str], chosen: int) -> None:
        trials = self._page.trials
        trials.blockSignals(True)
        trials.clear()
        trials.setUniformItemSizes(len(lines) > MOST_MEASURED)
        trials.addItems(lines)
        trials.setCurrentRow(chosen)
        trials.blockSignals(False)
        self._choose_part(chosen)

    def _choose_part(self, row: int) -> None:
        self._page.film.stop()
        self._notes, self.bookmarks = None, []
        self._asked += 1
        if 0 <= row < len(self._episodes):
            uuid = self._episodes[row]
            self._page.signals_panel.detail.setText(tr("reading"))
            self._later(lambda: self.library.episode(uuid), self._take_episode)
        elif not self._episodes and 0 <= row < len(self.timed):
            self._show_trial(self.timed[row])
        else:
            self.file = None if self._run is None else self._run / EVENT_LOG_NAME
            self.replay.show(None, told=self._told)

    def _show_trial(self, trial: TrialTimeline) -> None:
        assert self._run is not None
        self.file = self._run / EVENT_LOG_NAME
        head, whole = trial.head, trial.story(float("inf"))
        pair = tr("{} on {}", head.piece, head.bottom)
        names = self._run.name, pair, whole.trial, whole.seed
        self.caption = tr("Run {}: {}, trial {}, seed {}", *names)
        faces = self.library.face(head.piece), self.library.face(head.bottom.split("+")[-1])
        self.replay.show(trial, *faces)
        self._read_notes(self._run / BOOKMARKS_NAME, whole.trial)
        kept = [f.path for f in trial.episodes() if f.path]
        if not kept:
            self._page.signals_panel.detail.setText(tr("no signals were kept"))
            return
        paths = [self._run / "episodes" / name for name in kept]
        self._later(lambda: episodes.read_trial_recording(paths), self._take_recorded)

    def _take_recorded(self, recorded: episodes.TrialRecording) -> None:
        self.replay.take(recorded)
        detail = self._page.signals_panel.detail
        detail.setText("; ".join(recorded.missing) or count_noun(len(recorded.traces), "probe"))
        detail.setToolTip("\n".join(recorded.missing))

    def _take_episode(self, shown: episodes.StoredEpisode) -> None:
        entry = shown.entry
        self.file = self.library.folder / entry.path
        self.timed = [shown.trial]
        pair = tr("{} on {}", entry.piece, entry.bottom)
        self.caption = f"{self._whole}: {pair}, {tr('episode {}', entry.uuid)}"
        faces = self.library.face(entry.piece), self.library.face(entry.bottom)
        self.replay.show(shown.trial, *faces, told=self._told)
        self.replay.take(shown.recorded)
        self._read_notes(self.library.folder / "bookmarks" / f"{entry.uuid}.json", 1)
        self._page.signals_panel.detail.setText(shown.says)

    def _read_notes(self, path: Path, trial: int) -> None:
        self._notes = path, trial
        self._later(lambda: read_bookmarks(path), partial(self._show_notes, path, trial))

    def _show_notes(self, path: Path, trial: int, marks: list[Bookmark]) -> None:
        if self._notes == (path, trial):
            self.bookmarks = marks
            self.replay.show_bookmarks([mark for mark in marks if mark.trial == trial])

    def bookmark(self) -> bool:
        """Ask for the note at the cursor; return False if nothing is shown."""
        if self._notes is not None:
            (path, trial), t_s = self._notes, round(self.replay.cursor_s, 2)
            known = (mark for mark in self.replay.bookmarks if abs(mark.t_s - t_s) < TOUCH_S)
            take = partial(self._show_notes, path, trial)
            self.note.ask_note(path, next(known, Bookmark(trial, t_s)), take)
        return self._notes is not None

    def _later(self, work: Callable[[], object], take: Callable[..., None]) -> None:
        """Run ``work`` on the reader's thread; drop the result after another choice."""
        asked = self._asked

        def done(result: object) -> None:
            if asked == self._asked:
                take(result)

        self._reader.submit(work, done, self._failed)

    def _failed(self, error: Exception) -> None:
        what = error.what if isinstance(error, InputError) else str(error)
        self._page.signals_panel.detail.setText(tr("cannot be read"))
        self._card(what, tr("In {}.", error.where) if isinstance(error, InputError) else "")

    def _card(self, what: str, where: str) -> None:
        self._cards.show_card(
            CardText("REPLAY", what, where, "The other recordings are not affected.", reset=False)
        )

    def make_table(self, done: Callable[[str], None]) -> bool:
        """Pass the probe table of the recording to a function; return False without one."""
        if self._episodes:
            uuids = list(self._episodes)
            self._reader.submit(lambda: self.library.table(uuids), done, self._failed)
        elif self.timed:
            timed, face = list(self.timed), self.library.face
            self._reader.submit(
                lambda: probe_table([(t, face(t.head.bottom.split("+")[-1])) for t in timed]),
                done,
                self._failed,
            )
        return bool(self._episodes or self.timed)

    def _show_score(self) -> None:
        head, ended = self.story.head, self.story.ended
        last = tr("The journal ends before the run did.")
        if ended is not None:
            last = tr("Run {}.", tr(ended.ending))
        if head is not None:
            what = ", ".join(recordings.activity_text(head)) or head.strategy
            last = f"{tr('{} on {}', head.piece, head.bottom)}, {what}. {last}"
        if head is not None and head.activity != "stack":
            self._page.score.show_facts(what.capitalize(), last)
            return
        trials = 0 if head is None else head.trials
        self._page.score.show_score(run_score(self.story.trials, trials, last))


def _trial_title(trial: TrialStory) -> str:
    done = trial.finished
    word = tr("not finished" if done is None else OUTCOME_WORDS[done.outcome])
    if trial.excuse:
        word = tr("{} by {}, not counted", word, trial.excuse)
    probes = count_noun(len(trial.probes), "probe")
    return tr("{}.  seed {}: {}, {}", trial.trial, trial.seed, word, probes)
