"""The queue of episodes to label: one row each, its state as a word on a chip, badges beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QAbstractListModel, QModelIndex, QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPen
from PySide6.QtWidgets import QStyleOptionViewItem, QWidget

from widgets.rows import ROOT, Index, RowList, RowPainter, draw_line
from widgets.theme import Theme, ui_font

CHIPS: dict[str, tuple[str, str]] = {
    "unlabelled": ("pill_grey", "on_dark"),
    "draft": ("pill_yellow", "on_light"),
    "submitted": ("pill_blue", "on_dark"),
    "approved": ("pill_green", "on_light"),
    "rejected": ("pill_red", "on_dark"),
    "superseded": ("pill_grey", "on_dark"),
}
"""Fill and text of the chip of each state; the word is always written."""


@dataclass(frozen=True, slots=True)
class LabelRow:
    """One episode of the queue. ``badges``: short words such as "flag" or "model 4.2 sigma"."""

    uuid: str
    title: str
    detail: str
    state: str
    badges: tuple[str, ...] = ()


class LabelList(RowList):
    """Shows thousands of rows without a widget each; ``chosen`` is told the row that was picked."""

    def __init__(self, theme: Theme, chosen: Callable[[int], None]) -> None:
        super().__init__("Episodes of the queue")
        self._rows = _Rows(self)
        self.draw_rows(self._rows, _TitleAndChip(theme, self))
        self.setMinimumWidth(170)
        self.clicked.connect(self._on_clicked)
        self._chosen = chosen

    def show_rows(self, rows: Sequence[LabelRow]) -> None:
        """Show another queue."""
        self._rows.show(rows)

    def show_row(self, at: int, row: LabelRow) -> None:
        """Show one row anew."""
        if self._rows.rows[at] != row:
            # Not told by ``dataChanged``: a list would lay out all of its rows anew.
            self._rows.rows[at] = row
            self.update(self._rows.index(at))

    def rows(self) -> Sequence[LabelRow]:
        """Return what is shown."""
        return self._rows.rows

    def choose(self, at: int) -> None:
        """Mark a row as the present one, in sight."""
        index = self._rows.index(at)
        self.setCurrentIndex(index)
        self.scrollTo(index)

    def _on_clicked(self, index: QModelIndex) -> None:
        self._chosen(index.row())


class _Rows(QAbstractListModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[LabelRow] = []

    def rowCount(self, parent: Index = ROOT) -> int:
        return 0 if parent.isValid() else len(self.rows)

    def data(self, index: Index, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        if not 0 <= index.row() < len(self.rows):
            return None
        row = self.rows[index.row()]
        if role == Qt.ItemDataRole.DisplayRole:
            return row
        if role in (Qt.ItemDataRole.AccessibleTextRole, Qt.ItemDataRole.ToolTipRole):
            return ", ".join((row.title, row.detail, row.state, *row.badges))
        return None

    def show(self, rows: Sequence[LabelRow]) -> None:
        self.beginResetModel()
        self.rows = list(rows)
        self.endResetModel()


class _TitleAndChip(RowPainter):
    """Two lines: title and chip, then detail and badges."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: Index) -> QSize:
        line = QFontMetrics(ui_font(self.theme.scale)).height()
        return QSize(160, round(2.3 * line) + 8)

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: Index) -> None:
        row = index.data()
        if not isinstance(row, LabelRow):
            return
        painter.save()
        text, muted = self.colours(painter, option)
        line = painter.fontMetrics().height()
        inner = QRectF(option.rect).adjusted(8, 4, -8, -4)
        chip_width = self._chip(painter, inner, row.state, line)
        painter.setFont(ui_font(self.theme.scale, 1.0, 500))
        draw_line(painter, inner.adjusted(0, 0, -chip_width - 6, 0), row.title, text)
        painter.setFont(ui_font(self.theme.scale, 0.88))
        second = inner.adjusted(0, 1.15 * line, 0, 0)
        words = " \N{MIDDLE DOT} ".join((*row.badges, row.detail))
        draw_line(painter, second, words, muted)
        painter.restore()

    def _chip(self, painter: QPainter, inner: QRectF, state: str, line: float) -> float:
        fill, text = CHIPS[state]
        t = self.theme.tokens
        painter.setFont(ui_font(self.theme.scale, 0.8, 600))
        width = painter.fontMetrics().horizontalAdvance(state) + 12
        chip = QRectF(inner.right() - width, inner.top(), width, line + 1)
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour(fill))
        painter.drawRoundedRect(chip.adjusted(0.5, 0.5, -0.5, -0.5), 4, 4)
        painter.setPen(t.colour(text))
        painter.drawText(chip, int(Qt.AlignmentFlag.AlignCenter), state)
        return float(width)
