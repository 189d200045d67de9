"""Tables of episodes and trainings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QAbstractTableModel, QItemSelectionModel, QSignalBlocker, QSize, Qt
from PySide6.QtGui import QFontMetrics, QKeyEvent, QPainter, QPaintEvent, QResizeEvent
from PySide6.QtWidgets import (
    QAbstractItemView,
    QHeaderView,
    QStyledItemDelegate,
    QTableView,
    QTableWidget,
    QTableWidgetItem,
    QWidget,
)

from touchdown.widgets.base import ENTER, ROOT, ModelIndex, Theme, plain_table, tr, ui_font

HEADS = ("No.", "Status", "Quality", "x, y (mm)", "Time")
RIGHT = frozenset((0, 3, 4))
WIDTHS_EM = (2.1, 4.5, 4.1, 5.0, 4.05)
QUALITY = 2
ALIGN_LEFT = Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter
ALIGN_RIGHT = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter


@dataclass(frozen=True, slots=True)
class EpisodeTableRow:
    """One probe. ``status``: state of its label or "deleted"; ``quality``: ok, or the defect."""

    uuid: str
    number: str
    status: str
    quality: str
    where: str
    time: str
    flagged: bool = False
    deleted: bool = False

    def cells(self) -> tuple[str, ...]:
        """Return the texts of the columns."""
        status = f"\N{BLACK FLAG} {tr(self.status)}" if self.flagged else tr(self.status)
        return self.number, status, tr(self.quality), self.where, self.time


class EpisodeTable(QTableView):
    """Table of thousands of episodes; ``choose`` gets the uuid of the clicked row."""

    def __init__(self, theme: Theme, choose: Callable[[str], None]) -> None:
        super().__init__()
        self._theme, self._choose = theme, choose
        self._rows = _EpisodeModel(self)
        self.setModel(self._rows)
        plain_table(self, "Episodes")
        self.setSelectionBehavior(QTableView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QTableView.SelectionMode.SingleSelection)
        head = self.horizontalHeader()
        head.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        head.setSectionResizeMode(QUALITY, QHeaderView.ResizeMode.Stretch)
        self.clicked.connect(lambda index: self._choose(self._rows.rows[index.row()].uuid))
        self.fit_to_theme()

    def show_rows(self, rows: Sequence[EpisodeTableRow], chosen: str) -> None:
        """Replace the rows, highest number first, and select one."""
        self._rows.show(rows)
        self.fit_to_theme()
        self.mark(chosen)

    def rows(self) -> Sequence[EpisodeTableRow]:
        """Return the rows in their present order."""
        return self._rows.rows

    def mark(self, uuid: str) -> None:
        """Select one row and scroll to it; an unknown uuid clears the selection."""
        uuids = [row.uuid for row in self._rows.rows]
        if uuid in uuids:
            self.setCurrentIndex(self._rows.index(uuids.index(uuid), 0))
            self.scrollTo(self.currentIndex())
        else:
            self.clearSelection()

    def fit_to_theme(self) -> None:
        """Adapt row height and column widths to the font scale."""
        metrics, rows = QFontMetrics(ui_font(self._theme.scale)), self._rows.rows
        em, digits = metrics.height(), len(rows[0].number) if rows else 0
        self.verticalHeader().setDefaultSectionSize(round(1.45 * em))
        self.horizontalHeader().setMinimumSectionSize(round(min(WIDTHS_EM) * em))
        for column, width in enumerate(WIDTHS_EM):
            self.setColumnWidth(column, round(width * em))
        number_px = metrics.horizontalAdvance("8" * digits) + em
        self.setColumnWidth(0, max(self.columnWidth(0), number_px))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Leave letters and Enter to the page."""
        if event.key() in ENTER or event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)


class _EpisodeModel(QAbstractTableModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[EpisodeTableRow] = []

    def rowCount(self, parent: ModelIndex = ROOT) -> int:
        return 0 if parent.isValid() else len(self.rows)

    def columnCount(self, parent: ModelIndex = ROOT) -> int:
        return 0 if parent.isValid() else len(HEADS)

    def headerData(self, section: int, orientation: Qt.Orientation, role: int = 0) -> Any:
        if orientation is not Qt.Orientation.Horizontal:
            return None
        if role == Qt.ItemDataRole.TextAlignmentRole:
            return ALIGN_RIGHT if section in RIGHT else ALIGN_LEFT
        return tr(HEADS[section]) if role == Qt.ItemDataRole.DisplayRole else None

    def data(self, index: ModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        row = self.rows[index.row()]
        if role == Qt.ItemDataRole.DisplayRole:
            return row.cells()[index.column()]
        if role == Qt.ItemDataRole.ToolTipRole:
            return ", ".join(row.cells())
        if role == Qt.ItemDataRole.TextAlignmentRole:
            return ALIGN_RIGHT if index.column() in RIGHT else ALIGN_LEFT
        if role == Qt.ItemDataRole.FontRole and row.deleted:
            font = ui_font()
            font.setStrikeOut(True)
            return font
        return None

    def show(self, rows: Sequence[EpisodeTableRow]) -> None:
        self.beginResetModel()
        self.rows = list(rows)
        self.endResetModel()


MOST_COMPARED = 3
CROSS = "\N{MULTIPLICATION X}"
ELIDED_EM = 5  # least width of an elided column
LEAST_ROWS = 3  # rows that fit even at the smallest window size


class _FigurePainter(QStyledItemDelegate):
    theme: Theme

    def initStyleOption(self, option: Any, index: ModelIndex) -> None:
        super().initStyleOption(option, index)
        if str(index.sibling(index.row(), 0).data()).startswith(CROSS):
            option.palette.setColor(option.palette.ColorRole.Text, self.theme.tokens.colour("bad"))


class FigureTable(QTableWidget):
    """Table of texts; all columns but the first are right-aligned figures.

    ``empty`` is the text shown while there are no rows. A row that begins with a cross is red.
    ``elided``: the first column is elided down to ``ELIDED_EM``.
    """

    empty, elided = "", False

    def __init__(self, theme: Theme, name: str, columns: Sequence[str]) -> None:
        super().__init__(0, len(columns))
        self._theme, painter = theme, _FigurePainter(self)
        painter.theme = theme
        self.setItemDelegate(painter)
        plain_table(self, name)
        self.setSelectionMode(QAbstractItemView.SelectionMode.NoSelection)
        self.show_columns(columns)

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Fit the first column."""
        super().resizeEvent(event)
        self._fit_first()

    def _fit_first(self) -> None:
        """Give the first column the free width; the table scrolls where there is none."""
        mode, head = QHeaderView.ResizeMode, self.horizontalHeader()
        columns = range(self.columnCount())
        px = [max(head.sectionSizeHint(at), self.sizeHintForColumn(at)) for at in columns]
        if self.elided:
            px[0] = min(px[0], ELIDED_EM * self.fontMetrics().height())
        fits = sum(px) <= self.viewport().width()
        head.setSectionResizeMode(0, mode.Stretch if fits else mode.ResizeToContents)

    def show_columns(self, columns: Sequence[str]) -> None:
        """Set the column headers."""
        self.setColumnCount(len(columns))
        for at, text in enumerate(columns):
            item = QTableWidgetItem(tr(text))
            item.setTextAlignment(ALIGN_RIGHT if at else ALIGN_LEFT)
            self.setHorizontalHeaderItem(at, item)
        header = self.horizontalHeader()
        header.setMinimumSectionSize(24)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        self.fit_to_theme()

    def show_rows(self, rows: Sequence[Sequence[str]]) -> None:
        """Replace the rows; a row may have fewer cells than the table has columns."""
        self.setRowCount(len(rows))
        for r, row in enumerate(rows):
            padded = [*row, *[""] * (self.columnCount() - len(row))]
            for c, text in enumerate(padded):
                item = QTableWidgetItem(text)
                item.setToolTip(text)
                if c:
                    item.setTextAlignment(ALIGN_RIGHT)
                self.setItem(r, c, item)
        self._fit_first()
        self.updateGeometry()

    def sizeHint(self) -> QSize:
        """Return the size of all rows."""
        rows = max(self.rowCount(), LEAST_ROWS) * self.verticalHeader().defaultSectionSize()
        return QSize(256, self.horizontalHeader().height() + rows + 2 * self.frameWidth() + 2)

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the rows, or ``empty``."""
        super().paintEvent(event)
        if self.empty and not self.rowCount():
            with QPainter(self.viewport()) as painter:
                painter.setPen(self._theme.tokens.colour("muted"))
                painter.setFont(ui_font(self._theme.scale, 0.92))
                area = self.viewport().rect().adjusted(8, 2, -8, -2)
                flags = Qt.AlignmentFlag.AlignCenter | Qt.TextFlag.TextWordWrap
                painter.drawText(area, int(flags), tr(self.empty))

    def texts(self) -> list[list[str]]:
        """Return the shown texts by row."""
        return [
            [item.text() if (item := self.item(r, c)) else "" for c in range(self.columnCount())]
            for r in range(self.rowCount())
        ]

    def fit_to_theme(self) -> None:
        """Adapt the row height to the font scale."""
        height = round(1.55 * QFontMetrics(ui_font(self._theme.scale)).height())
        # Minimum first: Qt ignores a default below it, and smaller text would keep the old rows.
        self.verticalHeader().setMinimumSectionSize(height)
        self.verticalHeader().setDefaultSectionSize(height)
        self.horizontalHeader().setFixedHeight(height)
        self.setMinimumHeight((1 + LEAST_ROWS) * height + 2 * self.frameWidth())


@dataclass(frozen=True, slots=True)
class TrainingRow:
    """One training: its id and the texts of the columns."""

    uuid: str
    cells: tuple[str, ...]


RUN_COLUMNS = ("run", "state", "sees", "IoU %")


class TrainingTable(FigureTable):
    """Table of trainings; up to three can be selected for comparison."""

    def __init__(self, theme: Theme, chosen: Callable[[tuple[str, ...]], None]) -> None:
        super().__init__(theme, "Trainings", RUN_COLUMNS)
        self._chosen, self._uuids = chosen, list[str]()
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.itemSelectionChanged.connect(self._tell)

    def show_runs(self, rows: Sequence[TrainingRow]) -> None:
        """Replace the rows without calling ``chosen``; the selection is kept."""
        kept = self.chosen()
        with QSignalBlocker(self):
            self._uuids = [row.uuid for row in rows]
            self.show_rows([row.cells for row in rows])
            self._select(kept)

    def choose(self, uuids: Sequence[str]) -> None:
        """Select these trainings and no others."""
        with QSignalBlocker(self):
            self._select(uuids)
        self._tell()

    def _select(self, uuids: Sequence[str]) -> None:
        self.clearSelection()
        model, flag = self.selectionModel(), QItemSelectionModel.SelectionFlag
        for uuid in uuids:
            if uuid in self._uuids:
                index = self.model().index(self._uuids.index(uuid), 0)
                model.select(index, flag.Select | flag.Rows)

    def chosen(self) -> tuple[str, ...]:
        """Return the ids of the selected trainings in table order, three at most."""
        rows = sorted({index.row() for index in self.selectedIndexes()})
        return tuple(self._uuids[row] for row in rows[:MOST_COMPARED])

    def _tell(self) -> None:
        self._chosen(self.chosen())
