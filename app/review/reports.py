"""Reports shown in review."""

from __future__ import annotations

import csv
import io
import re
from base64 import b64encode
from collections.abc import Sequence
from functools import partial
from html import escape
from pathlib import Path

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QCursor, QImage, QPainter
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QMenu, QWidget

from touchdown.app.review.exports import open_in_viewer
from touchdown.app.shell import SaveWorker, WorkspaceContext, ask_path, error_card
from touchdown.backend import experiments
from touchdown.backend.core import InputError, RunStarted, data_folder, write_atomically
from touchdown.widgets.base import FlowLayout, Theme, Tokens, label, tr
from touchdown.widgets.views import PictureCard, ReportCell, ReportGrid, ReportSheet

DEFAULT_SIZE_PX = 220, 220
NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


def drawing_size(svg: str) -> tuple[int, int]:
    """Return width and height of a drawing in px."""
    found = [re.search(rf'<svg [^>]*\b{name}="(\d+)"', svg) for name in ("width", "height")]
    width, height = (None if one is None else int(one[1]) for one in found)
    return (width, height) if width and height else DEFAULT_SIZE_PX


def render_drawing(svg: str, ratio: float, tokens: Tokens) -> QImage:
    """Return a drawing at ``ratio`` device pixels per pixel. Any thread may call it."""
    width, height = drawing_size(svg)
    image = QImage(round(width * ratio), round(height * ratio), QImage.Format.Format_ARGB32)
    image.setDevicePixelRatio(ratio)
    image.fill(Qt.GlobalColor.transparent)
    painter = QPainter(image)
    QSvgRenderer(recolour_drawing(svg, tokens).encode()).render(
        painter, QRectF(0, 0, width, height)
    )
    painter.end()
    return image


def recolour_drawing(svg: str, tokens: Tokens) -> str:
    """Return a chart in the colours of a theme, with the attribute names that Qt needs."""
    for own, theirs in (
        (experiments.INK, tokens.text),
        (experiments.FAINT, tokens.border),
        (experiments.BLUE, tokens.axis_x),
        (experiments.ORANGE, tokens.axis_y),
        (experiments.VIOLET, tokens.axis_z),
    ):
        svg = svg.replace(own, theirs)
    return svg.replace("<svg ", f"<svg {NAMESPACES} ", 1).replace(" href=", " xlink:href=")


# Output of ``touchdown experiment``, relative to its working directory.
USUAL = Path("output/experiment")
# Reports of the documents, where the program runs from a checkout.
SHIPPED = Path(__file__).resolve().parents[2] / "docs" / "results"
TABLES = "tables*.json"
MOST_OPENED = 5


class ReportsPresenter:
    """Shows reports above ``window``. ``reader`` reads them; ``exports`` is the folder of pages."""

    def __init__(
        self, window: QWidget, context: WorkspaceContext, reader: SaveWorker, exports: Path
    ) -> None:
        self._window, self._context, self._reader, self._exports = window, context, reader, exports
        self.sheet: ReportSheet | None = None
        self.report: experiments.Report | None = None
        self._file = Path()
        self._opened: list[Path] = []
        self.menu: QMenu | None = None
        self._asked = 0
        self._part = 0
        self._drawing = 0

    def offer(self) -> None:
        """List the reports opened last, of this folder, identifications, and of the program."""
        menu = self.menu = QMenu(self._window)
        menu.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        pages = sorted((data_folder() / "identified").rglob("*.html"))
        near = [*self._opened, *sorted(USUAL.glob(TABLES))]
        near += [*(page.with_suffix(".json") for page in pages), *sorted(SHIPPED.glob(TABLES))]
        for file in dict.fromkeys(path.resolve() for path in near):
            menu.addAction(f"{file.parent.name}/{file.name}", partial(self.open, file))
        menu.addAction(tr("Other file\N{HORIZONTAL ELLIPSIS}"), self.ask)
        menu.popup(QCursor.pos())

    def ask(self) -> None:
        """Let the user choose a file, without blocking the window."""
        last = self._file.parent if self.report is not None else USUAL
        start = last if last.is_dir() else Path.cwd()
        names = f"{tr('Reports')} (*.json)"
        ask_path(self._window, "Report of experiments", self.open, start=start, names=names)

    def open(self, file: Path) -> None:
        """Read and show a report; show a card for an invalid file."""
        self._asked += 1
        asked = self._asked

        def take(found: tuple[object, experiments.Report]) -> None:
            if asked == self._asked:
                self._show(file, found[1])

        self._reader.submit(lambda: experiments.read_report(file), take, self._failed)

    def fit_to_theme(self) -> None:
        """Show the part again with pictures in the colours of the theme."""
        if self.sheet is not None and self.sheet.isVisible():
            self.show_part(self._part)

    def show_part(self, number: int) -> None:
        """Show one part of the report; its pictures are drawn one by one."""
        if self.report is None or self.sheet is None or number < 0:
            return
        self._part = number
        section = self.report.sections[number]
        widgets: list[QWidget] = [label(section.title, "head", wrap=True)]
        about = self.report.about if number == 0 else ()
        widgets += [label(text, "muted", wrap=True) for text in (*about, *section.text)]
        cards: list[tuple[experiments.ReportPicture, PictureCard]] = []
        for part in section.parts:
            if part.title:
                widgets.append(label(part.title, "title", wrap=True))
            if isinstance(part, experiments.ReportTable):
                widgets += _table(part, self._context.theme)
            else:
                widgets += _gallery(part, cards)
        self.sheet.show_part(widgets)
        self._draw(cards)

    # -- inside -----------------------------------------------------------------------------------

    def _show(self, file: Path, report: experiments.Report) -> None:
        if self.sheet is None:
            self.sheet = sheet = ReportSheet(self._window)
            sheet.part_chosen.connect(self.show_part)
            sheet.browser.clicked.connect(self._open_in_browser)
            sheet.other.clicked.connect(self.ask)
        self.report, self._file = report, file
        self._opened = [file, *(one for one in self._opened if one != file)][:MOST_OPENED]
        self.sheet.show_head(
            report.title, report.banner, str(file), [s.title for s in report.sections]
        )
        self.sheet.open_large()

    def _draw(self, cards: Sequence[tuple[experiments.ReportPicture, PictureCard]]) -> None:
        """Draw the pictures one by one on the thread while the part is shown."""
        assert self.sheet is not None
        self._drawing += 1
        turn, tokens = self._drawing, self._context.theme.tokens
        ratio = self.sheet.devicePixelRatioF()

        def draw(number: int) -> None:
            if number < len(cards):
                svg = cards[number][0].svg
                self._reader.submit(
                    lambda: render_drawing(svg, ratio, tokens),
                    lambda image: take(number, image),
                    self._failed,
                )

        def take(number: int, image: QImage) -> None:
            # Another part may be shown by now.
            if turn == self._drawing:
                cards[number][1].show_picture(image)
                draw(number + 1)

        draw(0)

    def _open_in_browser(self) -> None:
        """Open the HTML page beside the file; write it first if it does not exist."""
        assert self.report is not None
        report, page = self.report, self._file.with_suffix(".html")
        made = self._exports / f"{self._file.stem}.html"

        def there() -> Path:
            if page.is_file():
                return page
            self._exports.mkdir(parents=True, exist_ok=True)
            write_atomically(made, experiments.report_page(report).encode())
            return made

        self._reader.submit(
            there, lambda path: self._context.say(open_in_viewer(path)), self._failed
        )

    def _failed(self, error: Exception) -> None:
        if not isinstance(error, InputError):
            error = RuntimeError(tr("The report cannot be shown: {}.", error))
        self._context.cards.show_card(error_card("REPORT", error))


def _table(table: experiments.ReportTable, theme: Theme) -> list[QWidget]:
    columns = ["\n".join(filter(None, names)) for names in table.columns]
    rows = [(name, list(map(_look, entries))) for name, entries in table.rows]
    made: list[QWidget] = [ReportGrid(theme, table.title or "Table", columns, rows)]
    if table.note:
        made.append(label(table.note, "small", wrap=True))
    return made


def _look(entry: experiments.TableEntry) -> ReportCell:
    interval = (entry.interval,) if entry.interval else ()
    return ReportCell(entry.value, (*interval, *entry.notes), entry.trace)


def _gallery(
    gallery: experiments.PictureGallery, cards: list[tuple[experiments.ReportPicture, PictureCard]]
) -> list[QWidget]:
    """Return the widgets of a gallery; add its cards to those to be drawn."""
    made: list[QWidget] = []
    own = [
        PictureCard(
            p.title, p.note, p.title or gallery.title or "Chart", QSize(*drawing_size(p.svg))
        )
        for p in gallery.pictures
    ]
    cards += list(zip(gallery.pictures, own, strict=True))
    row = QWidget()
    flow = FlowLayout(*own, parent=row)
    for card in own:
        flow.setAlignment(card, Qt.AlignmentFlag.AlignTop)
    made.append(row)
    if gallery.end:
        made.append(label(gallery.end, wrap=True))
    return made


def report_html(caption: str, facts: str, png: bytes, table: str, run: RunStarted | None) -> str:
    """Return an HTML page with ``caption``, the lines of ``facts``, a PNG and a CSV table.

    ``run``: start of the shown run, None for a series.
    """
    head, *rows = csv.reader(io.StringIO(table))
    # Units of column names in brackets, as "x (mm)" for x_mm.
    names = [re.sub(r"_(s|mm|%)$", r" (\1)", name.replace("percent", "%")) for name in head]
    source = f"data:image/png;base64,{b64encode(png).decode()}"
    image = f'<img style="max-width:100%" alt="{escape(caption)}" src="{source}">'
    parts = (
        experiments.PictureGallery("", (experiments.ReportPicture(image),)),
        experiments.ReportTable.of_texts("", names, rows),
    )
    about = [experiments.written_text(), *facts.splitlines()]
    if run is not None:
        about.insert(1, experiments.run_text(run))
    banner = experiments.SIMULATED if run is not None and run.simulated else ""
    sections = (experiments.ReportSection("", (), parts),)
    return experiments.report_page(experiments.Report(caption, tuple(about), sections, banner))
