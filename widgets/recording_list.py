"""Recordings in a list, two lines each: only the rows in sight cost anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QAbstractListModel, QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter
from PySide6.QtWidgets import QStyleOptionViewItem, QWidget

from widgets.rows import ROOT, Index, RowList, RowPainter, draw_line
from widgets.theme import Theme, ui_font

PAD_X, PAD_Y = 8, 5


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """One recording: when it was made, and what it was ("" while that is not known)."""

    title: str
    detail: str = ""

    @property
    def text(self) -> str:
        """Both lines, as they are searched and read aloud."""
        return "\n".join(filter(None, (self.title, self.detail)))


class RecordingList(RowList):
    """Shows some of many rows in any order; ``chosen`` is told the number of the row picked.

    Rows keep their number (their place in ``take``) however they are ordered or left out. A detail
    that is too long for its line is whole in the tool tip.
    """

    def __init__(self, theme: Theme, name: str, chosen: Callable[[int], None]) -> None:
        super().__init__(name)
        self._rows, self._chosen = _Rows(self), chosen
        self.current = -1
        """Number of the chosen row, -1 for none; it stays chosen while it is left out."""
        self._telling = True
        self.draw_rows(self._rows, _TwoLines(theme, self))
        self.setMinimumHeight(60)
        self.selectionModel().selectionChanged.connect(lambda *_: self._on_selected())

    def take(self, rows: Sequence[RecordingRow]) -> None:
        """Take other recordings: none is chosen, none is shown until ``show_order``."""
        self.current = -1
        self._rows.rows = list(rows)
        self.show_order([])

    def show_order(self, order: Sequence[int]) -> None:
        """Show the rows of these numbers, in this order; what is chosen stays chosen."""
        if list(order) == self._rows.order:
            return
        self._telling = False
        self._rows.show(order)
        if self.current in self._rows.order:
            self.setCurrentIndex(self._rows.index(self._rows.order.index(self.current)))
        self._telling = True

    def show_row(self, number: int, row: RecordingRow) -> None:
        """Show one recording anew."""
        if self._rows.rows[number] != row:
            # Not told by ``dataChanged``: a list would lay out all of its rows anew.
            self._rows.rows[number] = row
            if number in self._rows.order:
                self.update(self._rows.index(self._rows.order.index(number)))

    def choose(self, number: int) -> None:
        """Mark a recording as the chosen one without telling so."""
        self._telling = False
        self.current = number
        if number in self._rows.order:
            self.setCurrentIndex(self._rows.index(self._rows.order.index(number)))
        self._telling = True

    def choose_row(self, at: int) -> None:
        """Pick the row at this place of those that are shown, as a click does."""
        self.setCurrentIndex(self._rows.index(at))

    def rows(self) -> Sequence[RecordingRow]:
        """Return all recordings by number."""
        return self._rows.rows

    def shown(self) -> list[RecordingRow]:
        """Return the rows that are shown, in their order."""
        return [self._rows.rows[number] for number in self._rows.order]

    def _on_selected(self) -> None:
        """Take what was selected; a list that only gets the focus has its cursor on a row too."""
        found = self.selectedIndexes()
        if self._telling and found:
            self.current = self._rows.order[found[0].row()]
            self._chosen(self.current)


class _Rows(QAbstractListModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[RecordingRow] = []
        self.order: list[int] = []

    def rowCount(self, parent: Index = ROOT) -> int:
        return 0 if parent.isValid() else len(self.order)

    def data(self, index: Index, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        if not 0 <= index.row() < len(self.order):
            return None
        row = self.rows[self.order[index.row()]]
        if role == Qt.ItemDataRole.DisplayRole:
            return row.text
        if role in (Qt.ItemDataRole.AccessibleTextRole, Qt.ItemDataRole.ToolTipRole):
            return row.detail or row.title
        return row if role == Qt.ItemDataRole.UserRole else None

    def show(self, order: Sequence[int]) -> None:
        self.beginResetModel()
        self.order = list(order)
        self.endResetModel()


class _TwoLines(RowPainter):
    """Of one height: the title, and below it what the recording was."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: Index) -> QSize:
        line = QFontMetrics(ui_font(self.theme.scale)).height()
        return QSize(160, 2 * line + 2 * PAD_Y)

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: Index) -> None:
        row = index.data(Qt.ItemDataRole.UserRole)
        if not isinstance(row, RecordingRow):
            return
        painter.save()
        text, _ = self.colours(painter, option)
        painter.setFont(ui_font(self.theme.scale))
        inner = QRectF(option.rect).adjusted(PAD_X, PAD_Y, -PAD_X, -PAD_Y)
        for at, words in enumerate((row.title, row.detail)):
            line = inner.adjusted(0, at * painter.fontMetrics().height(), 0, 0)
            draw_line(painter, line, words, text)
        painter.restore()
