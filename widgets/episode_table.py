"""The probes of a pair as a table: status, flag, quality, displacement, time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QAbstractTableModel, QModelIndex, QPersistentModelIndex, Qt
from PySide6.QtGui import QFontMetrics, QKeyEvent
from PySide6.QtWidgets import QHeaderView, QTableView, QWidget

from widgets.theme import Theme, ui_font

Index = QModelIndex | QPersistentModelIndex
ROOT = QModelIndex()
HEADS = ("No.", "Status", "Quality", "x, y (mm)", "Time")
RIGHT = frozenset((0, 3, 4))
WIDTHS_EM = (2.2, 4.6, 4.0, 5.6, 4.1)
QUALITY = 2


@dataclass(frozen=True, slots=True)
class EpisodeRow:
    """One probe. ``status``: state of its label or "deleted"; ``quality``: ok, or why not."""

    uuid: str
    number: str
    status: str
    quality: str
    where: str
    time: str
    flagged: bool = False
    deleted: bool = False

    def cells(self) -> tuple[str, ...]:
        """Return the texts of the row."""
        flag = "\N{BLACK FLAG} " if self.flagged else ""
        return self.number, f"{flag}{self.status}", self.quality, self.where, self.time


class EpisodeTable(QTableView):
    """Shows thousands of rows; ``choose`` is told the uuid of the row that was picked."""

    def __init__(self, theme: Theme, choose: Callable[[str], None]) -> None:
        super().__init__()
        self._theme, self._choose = theme, choose
        self._rows = _Rows(self)
        self.setModel(self._rows)
        self.setAccessibleName("Episodes")
        self.setSelectionBehavior(QTableView.SelectionBehavior.SelectRows)
        self.setSelectionMode(QTableView.SelectionMode.SingleSelection)
        self.setEditTriggers(QTableView.EditTrigger.NoEditTriggers)
        self.setShowGrid(False)
        self.setWordWrap(False)
        self.setTabKeyNavigation(False)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.verticalHeader().hide()
        head = self.horizontalHeader()
        head.setHighlightSections(False)
        head.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
        head.setSectionResizeMode(QUALITY, QHeaderView.ResizeMode.Stretch)
        head.setMinimumSectionSize(20)
        self.clicked.connect(lambda index: self._choose(self._rows.rows[index.row()].uuid))
        self.fit_to_theme()

    def show_rows(self, rows: Sequence[EpisodeRow], chosen: str) -> None:
        """Show these rows, newest first, with one of them marked."""
        self._rows.show(rows)
        self.mark(chosen)

    def rows(self) -> Sequence[EpisodeRow]:
        """Return what is shown."""
        return self._rows.rows

    def mark(self, uuid: str) -> None:
        """Mark one row, in sight; an unknown uuid marks none."""
        for at, row in enumerate(self._rows.rows):
            if row.uuid == uuid:
                index = self._rows.index(at, 0)
                self.setCurrentIndex(index)
                self.scrollTo(index)
                return
        self.clearSelection()

    def fit_to_theme(self) -> None:
        """Take row height and column widths of the font scale."""
        em = QFontMetrics(ui_font(self._theme.scale)).height()
        self.verticalHeader().setDefaultSectionSize(round(1.45 * em))
        for column, width in enumerate(WIDTHS_EM):
            self.setColumnWidth(column, round(width * em))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Leave letters and Enter to the page."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter) or event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)


class _Rows(QAbstractTableModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[EpisodeRow] = []

    def rowCount(self, parent: Index = ROOT) -> int:
        return 0 if parent.isValid() else len(self.rows)

    def columnCount(self, parent: Index = ROOT) -> int:
        return 0 if parent.isValid() else len(HEADS)

    def headerData(self, section: int, orientation: Qt.Orientation, role: int = 0) -> Any:
        if orientation is not Qt.Orientation.Horizontal:
            return None
        if role == Qt.ItemDataRole.TextAlignmentRole:
            return _aligned(section)
        return HEADS[section] if role == Qt.ItemDataRole.DisplayRole else None

    def data(self, index: Index, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        row = self.rows[index.row()]
        if role == Qt.ItemDataRole.DisplayRole:
            return row.cells()[index.column()]
        if role == Qt.ItemDataRole.ToolTipRole:
            return ", ".join(row.cells())
        if role == Qt.ItemDataRole.TextAlignmentRole:
            return _aligned(index.column())
        if role == Qt.ItemDataRole.FontRole and row.deleted:
            font = ui_font()
            font.setStrikeOut(True)
            return font
        return None

    def show(self, rows: Sequence[EpisodeRow]) -> None:
        self.beginResetModel()
        self.rows = list(rows)
        self.endResetModel()


def _aligned(column: int) -> int:
    side = Qt.AlignmentFlag.AlignRight if column in RIGHT else Qt.AlignmentFlag.AlignLeft
    return int(side | Qt.AlignmentFlag.AlignVCenter)
