"""Small read-only tables of words and figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QItemSelectionModel, QSignalBlocker, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPaintEvent
from PySide6.QtWidgets import QAbstractItemView, QHeaderView, QTableWidget, QTableWidgetItem

from widgets.theme import Theme, ui_font

MOST_COMPARED = 3
LEAST_ROWS = 3
"""Every table has room for so many, at the least size of the window too."""
RIGHT = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter


class FigureTable(QTableWidget):
    """Rows of texts; all columns but the first are figures at the right.

    ``empty`` is written in the middle while there is no row.
    """

    empty = ""

    def __init__(self, theme: Theme, name: str, columns: Sequence[str]) -> None:
        super().__init__(0, len(columns))
        self._theme = theme
        self.setAccessibleName(name)
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionMode(QAbstractItemView.SelectionMode.NoSelection)
        self.setShowGrid(False)
        self.setWordWrap(False)
        self.setTabKeyNavigation(False)
        self.verticalHeader().hide()
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.show_columns(columns)

    def show_columns(self, columns: Sequence[str]) -> None:
        """Name the columns."""
        self.setColumnCount(len(columns))
        for at, text in enumerate(columns):
            item = QTableWidgetItem(text)
            if at:
                item.setTextAlignment(RIGHT)
            else:
                item.setTextAlignment(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter)
            self.setHorizontalHeaderItem(at, item)
        header = self.horizontalHeader()
        header.setHighlightSections(False)
        header.setMinimumSectionSize(24)
        header.setSectionResizeMode(QHeaderView.ResizeMode.ResizeToContents)
        header.setSectionResizeMode(0, QHeaderView.ResizeMode.Stretch)
        self.fit_to_theme()

    def show_rows(self, rows: Sequence[Sequence[str]]) -> None:
        """Show these texts; a row may be shorter than the table."""
        self.setRowCount(len(rows))
        for r, row in enumerate(rows):
            for c in range(self.columnCount()):
                text = row[c] if c < len(row) else ""
                item = QTableWidgetItem(text)
                item.setToolTip(text)
                if c:
                    item.setTextAlignment(RIGHT)
                self.setItem(r, c, item)
        self.updateGeometry()

    def sizeHint(self) -> QSize:
        """Return the room of all rows."""
        rows = max(self.rowCount(), LEAST_ROWS) * self.verticalHeader().defaultSectionSize()
        return QSize(256, self.horizontalHeader().height() + rows + 2 * self.frameWidth() + 2)

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the rows, or why there are none."""
        super().paintEvent(event)
        if self.empty and not self.rowCount():
            painter = QPainter(self.viewport())
            painter.setPen(self._theme.tokens.colour("muted"))
            painter.setFont(ui_font(self._theme.scale, 0.92))
            area = self.viewport().rect().adjusted(8, 2, -8, -2)
            flags = Qt.AlignmentFlag.AlignCenter | Qt.TextFlag.TextWordWrap
            painter.drawText(area, int(flags), self.empty)
            painter.end()

    def texts(self) -> list[list[str]]:
        """Return what is shown."""
        return [
            [item.text() if (item := self.item(r, c)) else "" for c in range(self.columnCount())]
            for r in range(self.rowCount())
        ]

    def fit_to_theme(self) -> None:
        """Take the row height of the font scale."""
        height = round(1.55 * QFontMetrics(ui_font(self._theme.scale)).height())
        # The least first: below it Qt takes no usual height, and smaller text kept the old rows.
        self.verticalHeader().setMinimumSectionSize(height)
        self.verticalHeader().setDefaultSectionSize(height)
        self.horizontalHeader().setFixedHeight(height)
        self.setMinimumHeight((1 + LEAST_ROWS) * height + 2 * self.frameWidth())


@dataclass(frozen=True, slots=True)
class RunRow:
    """One training in words: id, then the texts of the columns."""

    uuid: str
    cells: tuple[str, ...]


RUN_COLUMNS = ("run", "state", "sees", "IoU %", "epoch")


class RunTable(FigureTable):
    """The trainings; up to three can be chosen, and are then compared."""

    def __init__(self, theme: Theme, chosen: Callable[[tuple[str, ...]], None]) -> None:
        super().__init__(theme, "Trainings", RUN_COLUMNS)
        self._chosen, self._uuids = chosen, list[str]()
        self.setSelectionBehavior(QAbstractItemView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.itemSelectionChanged.connect(self._tell)

    def show_runs(self, rows: Sequence[RunRow]) -> None:
        """Show the trainings without telling; what is chosen stays chosen."""
        kept = self.chosen()
        with QSignalBlocker(self):
            self._uuids = [row.uuid for row in rows]
            self.show_rows([row.cells for row in rows])
            self._select(kept)

    def choose(self, uuids: Sequence[str]) -> None:
        """Choose these trainings, and no others."""
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
        """Return the ids of the chosen trainings, in the order of the table, three at most."""
        rows = sorted({index.row() for index in self.selectedIndexes()})
        return tuple(self._uuids[row] for row in rows[:MOST_COMPARED])

    def _tell(self) -> None:
        self._chosen(self.chosen())
