"""Review workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from touchdown.app.review import exports
from touchdown.app.review.page import ReviewPage
from touchdown.app.review.presenter import ReviewPresenter
from touchdown.app.review.recordings import ReviewDataset
from touchdown.app.review.reports import ReportsPresenter, report_html
from touchdown.app.shell import SaveWorker, WindowCommand, Workspace, WorkspaceContext
from touchdown.backend.runs import dataset_folder
from touchdown.widgets.base import tr
from touchdown.widgets.shell import CardText


class ReviewWorkspace(Workspace):
    """Recorded runs and series along one time line."""

    name, title, key = "review", "Review", "Ctrl+5"
    page: ReviewPage

    def __init__(self, context: WorkspaceContext) -> None:
        self._context = context
        self.exports = context.runs.parent / "exports"
        self.commands = (
            WindowCommand("refresh", "Look for new recordings", "Ctrl+R",
                    lambda: self.presenter.recordings.refresh()),
            WindowCommand("play", "Play from the cursor, or pause (Space)", "",
                          lambda: self.page.film.play_or_pause()),
            WindowCommand("back", "One sample back", "Left",
                    lambda: self.presenter.replay.step(-1), repeats=True),
            WindowCommand("on", "One sample forward", "Right",
                    lambda: self.presenter.replay.step(1), repeats=True),
            WindowCommand("second-back", "One second back", "J",
                    lambda: self.presenter.replay.jump(-1.0), repeats=True),
            WindowCommand("second-on", "One second forward", "L",
                    lambda: self.presenter.replay.jump(1.0), repeats=True),
            WindowCommand("bookmark", "Bookmark at the cursor: add, change or remove", "B",
                          self._bookmark),
            WindowCommand("next-bookmark", "Next bookmark", "N",
                          lambda: self.presenter.replay.jump_to_bookmark(1)),
            WindowCommand("previous-bookmark", "Previous bookmark", "Shift+N",
                          lambda: self.presenter.replay.jump_to_bookmark(-1)),
            WindowCommand("filter", "Filter the recordings", "/",
                    lambda: self.page.filter.setFocus()),
            WindowCommand("picture", "Export what is shown as PNG and SVG", "Ctrl+E",
                          self._picture),
            WindowCommand("table", "Export the probes as CSV", "Ctrl+Shift+E", self._table),
            WindowCommand("report", "Export picture and probes as one HTML page", "", self._report),
            WindowCommand("cancel", "Stop reading a long run", "Esc",
                    lambda: self.presenter.cancel_reading()),
            WindowCommand("experiments", "Open a report of experiments", "Ctrl+Shift+O",
                    lambda: self.reports.offer()),
            WindowCommand("viewer", "Open the file in its own program", "Ctrl+O",
                          self._open_outside),
        )  # fmt: skip

    def build(self) -> Iterator[None]:
        """Create the page and the thread that reads for it."""
        self.page = ReviewPage(self._context.theme)
        yield
        self.reader = SaveWorker(self.page, "review-reader")
        self.library = ReviewDataset(dataset_folder())
        self.presenter = ReviewPresenter(
            self.page, self._context.runs, self._context.cards, self.reader, self.library
        )
        self.parts = (self.presenter.draw,)
        self.reports = ReportsPresenter(self.page, self._context, self.reader, self.exports)
        page = self.page
        page.recording_chosen.connect(self.presenter.choose)
        page.probe_chosen.connect(self.presenter.replay.choose_probe)
        page.time_chosen.connect(self.presenter.replay.seek)
        page.play.clicked.connect(page.film.play_or_pause)
        page.filter_changed.connect(self.presenter.recordings.show)
        page.bookmark.clicked.connect(self._bookmark)
        page.picture.clicked.connect(self._picture)
        page.table.clicked.connect(self._table)
        page.html.clicked.connect(self._report)
        page.experiments.clicked.connect(self.reports.offer)
        page.viewer.clicked.connect(self._open_outside)

    def enter(self) -> None:
        """Look for new recordings."""
        self.page.setFocus()
        self.presenter.recordings.refresh()

    def fit_to_theme(self) -> None:
        """Apply the sizes of the theme; draw the pictures of an open report again."""
        super().fit_to_theme()
        self.reports.fit_to_theme()

    def leave(self) -> None:
        """Stop the film."""
        self.page.film.stop()

    def close(self) -> None:
        """End the reading thread."""
        self.page.film.stop()
        self.presenter.cancel_reading()
        self.reader.submit(self.library.close, lambda _: None, lambda _: None)
        self.reader.close()

    # -- orders -----------------------------------------------------------------------------------

    def _picture(self) -> None:
        if self.presenter.file is None:
            self._context.say("The selection cannot be exported as a picture.")
            return
        name = exports.dated_file_name(f"review-{self.presenter.replay.cursor_s:.2f}s")
        shown, theme, caption = self.page.shown, self._context.theme, self._caption()
        self._export(lambda: exports.export_picture(shown, theme, self.exports, name, caption)[0])

    def _bookmark(self) -> None:
        if not self.presenter.bookmark():
            self._context.say("The selection cannot have a bookmark.")

    def _caption(self) -> str:
        at_s = self.presenter.replay.cursor_s
        return tr("{}, at {:.2f} s", self.presenter.caption, at_s)

    def _table(self) -> None:
        def write(text: str) -> None:
            self._export(
                lambda: exports.write_export(
                    text, self.exports, f"{exports.dated_file_name('probes')}.csv"
                )
            )

        if not self.presenter.make_table(write):
            self._context.say("The selection cannot be exported as a table.")

    def _report(self) -> None:
        if self.presenter.file is None:
            self._context.say("The selection has no report.")
            return
        # Take the picture now: the page may have changed when the table is ready.
        name, caption = exports.dated_file_name("review"), self._caption()
        notes = [tr("Bookmark, trial {}, {:.2f} s: {}", mark.trial, mark.t_s, mark.note)
                 for mark in self.presenter.bookmarks]  # fmt: skip
        facts, head = "\n".join((self.page.score.words, *notes)), self.presenter.story.head
        with self._context.theme.on_paper(self.page.shown):
            picture = exports.view_picture(self.page.shown, self._context.theme, caption)

        def write(table: str) -> None:
            text = report_html(caption, facts, picture, table, head)
            self._export(lambda: exports.write_export(text, self.exports, f"{name}.html"))

        self.presenter.make_table(write)

    def _open_outside(self) -> None:
        if self.presenter.file is not None:
            self._context.say(exports.open_in_viewer(self.presenter.file))
        else:
            self._context.say("The selection cannot be opened.")

    def _export(self, write: Callable[[], Path]) -> None:
        try:
            self._context.say(tr("Written: {}", write()))
        except OSError as error:
            what = tr("It could not be written: {}.", error.strerror or error)
            where, step = tr("In {}.", self.exports), "Free some space."
            self._context.cards.show_card(CardText("EXPORT", what, where, step, reset=False))
