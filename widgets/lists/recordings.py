"""Lists of recordings, labels and history."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import QAbstractListModel, QModelIndex, QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QKeyEvent, QPainter, QPen
from PySide6.QtWidgets import (
    QHBoxLayout,
    QListWidget,
    QPushButton,
    QStyleOptionViewItem,
    QVBoxLayout,
    QWidget,
)

from touchdown.widgets.base import (
    ROOT,
    ModelIndex,
    RowList,
    RowPainter,
    Theme,
    WrappedItemDelegate,
    draw_elided_line,
    label,
    ui_font,
)

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
        self._rows, self._chosen = _RecordingModel(self), chosen
        self.current = -1
        """Number of the chosen row, -1 for none; it stays chosen while it is left out."""
        self._telling = True
        self.draw_rows(self._rows, _RecordingPainter(theme, self))
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


class _RecordingModel(QAbstractListModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[RecordingRow] = []
        self.order: list[int] = []

    def rowCount(self, parent: ModelIndex = ROOT) -> int:
        return 0 if parent.isValid() else len(self.order)

    def data(self, index: ModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
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


class _RecordingPainter(RowPainter):
    """Of one height: the title, and below it what the recording was."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: ModelIndex) -> QSize:
        line = QFontMetrics(ui_font(self.theme.scale)).height()
        return QSize(160, 2 * line + 2 * PAD_Y)

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: ModelIndex) -> None:
        row = index.data(Qt.ItemDataRole.UserRole)
        if not isinstance(row, RecordingRow):
            return
        painter.save()
        text, _ = self.colours(painter, option)
        painter.setFont(ui_font(self.theme.scale))
        inner = QRectF(option.rect).adjusted(PAD_X, PAD_Y, -PAD_X, -PAD_Y)
        for at, words in enumerate((row.title, row.detail)):
            line = inner.adjusted(0, at * painter.fontMetrics().height(), 0, 0)
            draw_elided_line(painter, line, words, text)
        painter.restore()


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
class LabelListRow:
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
        self._rows = _LabelRows(self)
        self.draw_rows(self._rows, _LabelPainter(theme, self))
        self.setMinimumWidth(170)
        self.clicked.connect(self._on_clicked)
        self._chosen = chosen

    def show_rows(self, rows: Sequence[LabelListRow]) -> None:
        """Show another queue."""
        self._rows.show(rows)

    def show_row(self, at: int, row: LabelListRow) -> None:
        """Show one row anew."""
        if self._rows.rows[at] != row:
            # Not told by ``dataChanged``: a list would lay out all of its rows anew.
            self._rows.rows[at] = row
            self.update(self._rows.index(at))

    def rows(self) -> Sequence[LabelListRow]:
        """Return what is shown."""
        return self._rows.rows

    def choose(self, at: int) -> None:
        """Mark a row as the present one, in sight."""
        index = self._rows.index(at)
        self.setCurrentIndex(index)
        self.scrollTo(index)

    def _on_clicked(self, index: QModelIndex) -> None:
        self._chosen(index.row())


class _LabelRows(QAbstractListModel):
    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[LabelListRow] = []

    def rowCount(self, parent: ModelIndex = ROOT) -> int:
        return 0 if parent.isValid() else len(self.rows)

    def data(self, index: ModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        if not 0 <= index.row() < len(self.rows):
            return None
        row = self.rows[index.row()]
        if role == Qt.ItemDataRole.DisplayRole:
            return row
        if role in (Qt.ItemDataRole.AccessibleTextRole, Qt.ItemDataRole.ToolTipRole):
            return ", ".join((row.title, row.detail, row.state, *row.badges))
        return None

    def show(self, rows: Sequence[LabelListRow]) -> None:
        self.beginResetModel()
        self.rows = list(rows)
        self.endResetModel()


class _LabelPainter(RowPainter):
    """Two lines: title and chip, then detail and badges."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: ModelIndex) -> QSize:
        line = QFontMetrics(ui_font(self.theme.scale)).height()
        return QSize(160, round(2.3 * line) + 8)

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: ModelIndex) -> None:
        row = index.data()
        if not isinstance(row, LabelListRow):
            return
        painter.save()
        text, muted = self.colours(painter, option)
        line = painter.fontMetrics().height()
        inner = QRectF(option.rect).adjusted(8, 4, -8, -4)
        chip_width = self._chip(painter, inner, row.state, line)
        painter.setFont(ui_font(self.theme.scale, 1.0, 500))
        draw_elided_line(painter, inner.adjusted(0, 0, -chip_width - 6, 0), row.title, text)
        painter.setFont(ui_font(self.theme.scale, 0.88))
        second = inner.adjusted(0, 1.15 * line, 0, 0)
        words = " \N{MIDDLE DOT} ".join((*row.badges, row.detail))
        draw_elided_line(painter, second, words, muted)
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


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """One revision in words. ``head``: it is the one that holds; ``difference`` to the former."""

    rev_uuid: str
    number: int
    what: str
    who: str
    difference: str
    head: bool


class HistoryList(QWidget):
    """Lists revisions; ``restore`` is told the one that was asked back."""

    def __init__(self, restore: Callable[[str], None]) -> None:
        super().__init__()
        self._restore = restore
        self._rows: list[HistoryRow] = []
        self.list = _KeylessListWidget()
        self.list.setAccessibleName("Versions of the label")
        WrappedItemDelegate(self.list)
        self.restore = QPushButton("Restore")
        self.restore.setToolTip("Make a new version with the content of the chosen one")
        self.count = label("", "small")
        foot = QHBoxLayout()
        foot.addWidget(self.count, 1)
        foot.addWidget(self.restore)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(6)
        column.addWidget(self.list, 1)
        column.addLayout(foot)
        self.list.currentRowChanged.connect(self._choose)
        self.restore.clicked.connect(self._restore_chosen)
        self.show_rows([])

    def show_rows(self, rows: Sequence[HistoryRow]) -> None:
        """Show the revisions of another episode, newest first."""
        self._rows = list(rows)
        self.list.clear()
        self.list.addItems([revision_text(row) for row in rows])
        self.count.setText("1 version" if len(rows) == 1 else f"{len(rows)} versions")
        self._choose(-1)

    def choose(self, at: int) -> None:
        """Mark a revision."""
        self.list.setCurrentRow(at)

    def _choose(self, at: int) -> None:
        self.restore.setEnabled(0 <= at < len(self._rows) and not self._rows[at].head)

    def _restore_chosen(self) -> None:
        at = self.list.currentRow()
        if 0 <= at < len(self._rows):
            self._restore(self._rows[at].rev_uuid)


def revision_text(row: HistoryRow) -> str:
    """Return a revision as the list shows it."""
    holds = ", holds" if row.head else ""
    lines = [f"{row.number}. {row.what}{holds}", row.who]
    return "\n".join([*lines, row.difference] if row.difference else lines)


class _KeylessListWidget(QListWidget):
    """Leaves letters and digits to the page."""

    def keyPressEvent(self, event: QKeyEvent) -> None:
        if event.text() and event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)
