"""Presenter of a report of experiments: read on a thread, shown part by part."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PySide6.QtCore import QSize
from PySide6.QtGui import QImage
from PySide6.QtWidgets import QFileDialog, QWidget

from app.label.commits import Commits
from app.review.exports import open_outside
from app.review.report_drawing import drawn, size_of
from app.workspace import Desk
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.experiments.document import Entry, Gallery, Grid, Picture, Report
from backend.experiments.reading import read_report
from backend.experiments.tables_page import tables_page
from widgets.fault_cards import CardText
from widgets.panel import label
from widgets.report_grid import CellLook, ReportGrid
from widgets.report_sheet import Flow, PictureCard, ReportIntents, ReportSheet

USUAL = Path("output/experiment")
"""Where ``touchdown experiment`` writes, below the folder that it is started in."""
JOBS = "jobs"


class Reports:
    """``window`` is what the sheet stands over, ``reader`` the thread; ``exports`` takes pages."""

    def __init__(self, window: QWidget, desk: Desk, reader: Commits, exports: Path) -> None:
        self._window, self._desk, self._reader, self._exports = window, desk, reader, exports
        self.sheet: ReportSheet | None = None
        self.report: Report | None = None
        self._file = Path()
        self._entry: Entry | None = None
        self._asked = 0
        self._part = 0
        self._drawing = 0

    def ask(self) -> None:
        """Let a file be chosen; the window goes on meanwhile."""
        last = self._file.parent if self.report is not None else USUAL
        start = last if last.is_dir() else Path.cwd()
        dialog = QFileDialog(self._window, "Report of experiments", str(start), "Reports (*.json)")
        dialog.setFileMode(QFileDialog.FileMode.ExistingFile)
        dialog.setOption(QFileDialog.Option.DontUseNativeDialog)
        dialog.fileSelected.connect(lambda name: self.open(Path(name)))
        dialog.finished.connect(dialog.deleteLater)
        dialog.open()

    def open(self, file: Path) -> None:
        """Read a report and show it; a file that is none becomes one card."""
        self._asked += 1
        asked = self._asked

        def take(found: tuple[object, Report]) -> None:
            if asked == self._asked:
                self._show(file, found[1])

        self._reader.submit(lambda: read_report(file), take, self._failed)

    def fit_to_theme(self) -> None:
        """Show the chosen part anew: pictures take their colours from the theme."""
        if self.sheet is not None and self.sheet.isVisible():
            self.show_part(self._part)

    def show_part(self, number: int) -> None:
        """Show one part of the report; its pictures come as they are drawn."""
        if self.report is None or self.sheet is None or number < 0:
            return
        self._part = number
        section = self.report.sections[number]
        self._choose(None)
        widgets: list[QWidget] = [label(section.title, "head", wrap=True)]
        about = self.report.about if number == 0 else ()
        widgets += [label(text, "muted", wrap=True) for text in (*about, *section.text)]
        cards: list[tuple[Picture, PictureCard]] = []
        for part in section.parts:
            if part.title:
                widgets.append(label(part.title, "title", wrap=True))
            if isinstance(part, Grid):
                widgets += self._grid(part)
            else:
                widgets += _gallery(part, cards)
        self.sheet.show_part(widgets)
        self._draw(cards)

    # -- inside -----------------------------------------------------------------------------------

    def _show(self, file: Path, report: Report) -> None:
        if self.sheet is None:
            intents = ReportIntents(
                self.show_part, self._open_folder, self._open_in_browser, self.ask
            )
            self.sheet = ReportSheet(self._window, intents)
        self.report, self._file = report, file
        self.sheet.show_head(
            report.title, report.banner, str(file), [s.title for s in report.sections]
        )
        self.sheet.open_large()

    def _grid(self, grid: Grid) -> list[QWidget]:
        def choose(row: int, column: int) -> None:
            inside = row >= 0 and column >= 0
            self._choose(grid.rows[row][1][column] if inside else None)

        columns = ["\n".join(filter(None, names)) for names in grid.columns]
        rows = [(name, [_look(entry) for entry in entries]) for name, entries in grid.rows]
        made: list[QWidget] = [
            ReportGrid(self._desk.theme, grid.title or "Table", columns, rows, choose)
        ]
        if grid.note:
            made.append(label(grid.note, "small", wrap=True))
        return made

    def _draw(self, cards: Sequence[tuple[Picture, PictureCard]]) -> None:
        """Have the pictures drawn one after the other on the thread, while the part is shown."""
        assert self.sheet is not None
        self._drawing += 1
        turn, tokens = self._drawing, self._desk.theme.tokens
        ratio = self.sheet.devicePixelRatioF()

        def draw(number: int) -> None:
            if number < len(cards):
                svg = cards[number][0].svg
                self._reader.submit(
                    lambda: drawn(svg, ratio, tokens),
                    lambda image: take(number, image),
                    self._failed,
                )

        def take(number: int, image: QImage) -> None:
            # Another part may be shown by now: the cards of this one are gone.
            if turn == self._drawing:
                cards[number][1].show_picture(image)
                draw(number + 1)

        draw(0)

    def _choose(self, entry: Entry | None) -> None:
        self._entry = entry
        if self.sheet is None:
            return
        if entry is None or not entry.value:
            self.sheet.show_trace("", can_open=False)
        elif not entry.jobs:
            self.sheet.show_trace("Made of the other cells.", can_open=False)
        else:
            there = self._folder(entry) is not None
            away = "" if there else "; its folder is where the experiment was run"
            self.sheet.show_trace(f"{entry.trace.capitalize()}{away}.", can_open=there)

    def _folder(self, entry: Entry) -> Path | None:
        """Return the run folder of a cell, None if it is not on this computer."""
        folder = self._file.parent / JOBS / entry.jobs[0]
        return folder if folder.is_dir() else None

    def _open_folder(self) -> None:
        folder = None if self._entry is None else self._folder(self._entry)
        if folder is not None:
            self._desk.say(open_outside(folder))

    def _open_in_browser(self) -> None:
        """Open the page that lies beside the file, made here where there is none."""
        assert self.report is not None
        report, page = self.report, self._file.with_suffix(".html")
        made = self._exports / f"{self._file.stem}.html"

        def there() -> Path:
            if page.is_file():
                return page
            self._exports.mkdir(parents=True, exist_ok=True)
            write_atomically(made, tables_page(report).encode())
            return made

        self._reader.submit(there, lambda path: self._desk.say(open_outside(path)), self._failed)

    def _failed(self, error: Exception) -> None:
        bad = error if isinstance(error, InputError) else None
        what = bad.what if bad else f"The report cannot be shown: {error}."
        where, fix = (f"In {bad.where}.", bad.fix) if bad else ("", "")
        self._desk.cards.show_card(CardText("REPORT", what, where, fix, reset=False))


def _look(entry: Entry) -> CellLook:
    interval = (entry.interval,) if entry.interval else ()
    return CellLook(entry.value, (*interval, *entry.notes), entry.trace)


def _gallery(gallery: Gallery, cards: list[tuple[Picture, PictureCard]]) -> list[QWidget]:
    """Return the widgets of a gallery; its cards are added to those that are to be drawn."""
    made: list[QWidget] = [label(gallery.text, "muted", wrap=True)] if gallery.text else []
    own = [
        PictureCard(p.title, p.note, p.title or gallery.title or "Chart", QSize(*size_of(p.svg)))
        for p in gallery.pictures
    ]
    cards += list(zip(gallery.pictures, own, strict=True))
    made.append(Flow(own))
    if gallery.end:
        made.append(label(gallery.end, wrap=True))
    return made
