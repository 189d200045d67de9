"""Lists of recordings, labels and history."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from PySide6.QtCore import (
    QAbstractListModel,
    QItemSelection,
    QItemSelectionModel,
    QModelIndex,
    QRectF,
    QSize,
    Qt,
    Signal,
)
from PySide6.QtGui import QFontMetrics, QKeyEvent, QPainter, QPen
from PySide6.QtWidgets import QApplication, QListView, QStyleOptionViewItem, QWidget

from touchdown.widgets import base

PAD_X, PAD_Y = 8, 5


@dataclass(frozen=True, slots=True)
class RecordingRow:
    """One recording: its time as ``title``, its content as ``detail`` ("" while unknown)."""

    title: str
    detail: str = ""

    @property
    def text(self) -> str:
        """Both lines, for search and screen readers."""
        return "\n".join(filter(None, (self.title, self.detail)))

    @property
    def tip(self) -> str:
        """Text of the tool tip."""
        return self.detail or self.title


class _NumberedList(QListView):
    """List of rows of equal height. A row keeps its number however rows are sorted or filtered."""

    def __init__(self, name: str, painter: base.RowPainter) -> None:
        super().__init__()
        # Kept alive here: Qt does not own them.
        self._rows, self._painter = _RowModel(self), painter
        self.setUniformItemSizes(True)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setAccessibleName(base.tr(name))
        self.setModel(self._rows)
        self.setItemDelegate(painter)

    def fit_to_theme(self) -> None:
        """Adapt the row height to the font scale."""
        self._rows.layoutChanged.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Handle keys that move the selection; letters and Space go to the page."""
        if event.text() and event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)

    def show_row(self, number: int, row: Any) -> None:
        if self._rows.rows[number] != row:
            # ``dataChanged`` would lay out all rows again.
            self._rows.rows[number] = row
            self.update(self.index_of(number))

    def rows(self) -> Sequence[Any]:
        return self._rows.rows

    def index_of(self, number: int) -> QModelIndex:
        """Return the place of a row, an invalid one if it is not shown."""
        order = self._rows.order
        return self._rows.index(order.index(number)) if number in order else QModelIndex()


class RecordingList(_NumberedList):
    """List that can filter and sort its rows; ``chosen`` gets the number of the selected row.

    The number of a row is its index in ``take``. The tool tip shows a detail too long for its line.
    """

    def __init__(self, theme: base.Theme, name: str, chosen: Callable[[int], None]) -> None:
        super().__init__(name, _RecordingPainter(theme))
        self._chosen = chosen
        self.current = -1  # number of the selected row, -1 for none; kept while it is filtered out
        self._telling = True
        self.setMinimumHeight(60)
        self.selectionModel().selectionChanged.connect(lambda *_: self._on_selected())

    def take(self, rows: Sequence[RecordingRow]) -> None:
        """Replace all rows: none is selected, none shown until ``show_order``."""
        self.current = -1
        self._rows.rows = list(rows)
        self.show_order([])

    def show_order(self, order: Sequence[int]) -> None:
        """Show the rows of these numbers, in this order; the selection is kept."""
        if list(order) == self._rows.order:
            return
        self._telling = False
        self._rows.show(order)
        self.choose(self.current)

    def choose(self, number: int) -> None:
        """Select a recording without calling ``chosen``."""
        self._telling = False
        self.current = number
        if number in self._rows.order:
            self.setCurrentIndex(self.index_of(number))
        self._telling = True

    def shown(self) -> list[RecordingRow]:
        """Return the visible rows in their order."""
        return [self._rows.rows[number] for number in self._rows.order]

    def _on_selected(self) -> None:
        # Selection, not the current index: a list that only gets the focus has a current row too.
        found = self.selectedIndexes()
        if self._telling and found:
            self.current = self._rows.order[found[0].row()]
            self._chosen(self.current)


class RowsOnDemand(Sequence[Any]):
    """``count`` rows, each made by ``make`` from its number when it is first read."""

    def __init__(self, count: int, make: Callable[[int], Any]) -> None:
        self._count, self._make = count, make
        self._made: dict[int, Any] = {}

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, at: Any) -> Any:
        place = range(self._count)[at]
        if isinstance(place, range):
            return [self[number] for number in place]
        if place not in self._made:
            self._made[place] = self._make(place)
        return self._made[place]

    def __setitem__(self, at: int, row: Any) -> None:
        self._made[at] = row


class _RowModel(QAbstractListModel):
    """Some of ``rows``, in the order of their numbers in ``order``."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.rows: list[Any] | RowsOnDemand = []
        self.order: list[int] = []

    def rowCount(self, parent: base.ModelIndex = base.ROOT) -> int:
        return 0 if parent.isValid() else len(self.order)

    def data(self, index: base.ModelIndex, role: int = Qt.ItemDataRole.DisplayRole) -> Any:
        if not 0 <= index.row() < len(self.order):
            return None
        row = self.rows[self.order[index.row()]]
        if role == Qt.ItemDataRole.DisplayRole:
            return row.text
        if role in (Qt.ItemDataRole.AccessibleTextRole, Qt.ItemDataRole.ToolTipRole):
            return row.tip
        return row if role == Qt.ItemDataRole.UserRole else None

    def show(self, order: Sequence[int]) -> None:
        self.beginResetModel()
        self.order = list(order)
        self.endResetModel()


class _RecordingPainter(base.RowPainter):
    """Two lines of equal height: title and detail."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: base.ModelIndex) -> QSize:
        line = QFontMetrics(base.ui_font(self.theme.scale)).height()
        return QSize(160, 2 * line + 2 * PAD_Y)

    def draw(self, painter: QPainter, option: QStyleOptionViewItem, row: RecordingRow) -> None:
        text, _ = self.colours(painter, option)
        painter.setFont(base.ui_font(self.theme.scale))
        inner = QRectF(option.rect).adjusted(PAD_X, PAD_Y, -PAD_X, -PAD_Y)
        for at, words in enumerate((row.title, row.detail)):
            line = inner.adjusted(0, at * painter.fontMetrics().height(), 0, 0)
            base.draw_elided_line(painter, line, words, text)


# fill and text colour of the chip of each label state
STATE_COLOURS: dict[str, tuple[str, str]] = {
    "unlabelled": ("pill_grey", "on_dark"),
    "draft": ("pill_yellow", "on_light"),
    "submitted": ("pill_blue", "on_dark"),
    "approved": ("pill_green", "on_light"),
    "rejected": ("pill_red", "on_dark"),
    "superseded": ("pill_grey", "on_dark"),
}


@dataclass(frozen=True, slots=True)
class LabelListRow:
    """One episode of the queue. ``badges``: short words such as "flag" or "model 4.2 sigma"."""

    uuid: str
    title: str
    detail: str
    state: str
    badges: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """All words of the row, for search and screen readers."""
        return ", ".join((self.title, self.detail, base.tr(self.state), *self.badges))

    tip = text


class LabelList(_NumberedList):
    """List of thousands of episodes; ``chosen`` gets the index of the clicked row.

    Clicks with Ctrl or Shift select several rows and choose none.
    """

    selection_changed = Signal()

    def __init__(self, theme: base.Theme, chosen: Callable[[int], None]) -> None:
        super().__init__("Episodes of the queue", _LabelPainter(theme))
        self._choose, self._chosen = chosen, 0
        self.setSelectionMode(self.SelectionMode.ExtendedSelection)
        self.setMinimumWidth(170)
        self.clicked.connect(self._on_clicked)
        self.selectionModel().selectionChanged.connect(lambda *_: self.selection_changed.emit())

    def show_rows(self, rows: Sequence[LabelListRow]) -> None:
        """Replace all rows."""
        self._rows.rows = rows if isinstance(rows, RowsOnDemand) else list(rows)
        self._rows.show(range(len(rows)))

    def choose(self, at: int) -> None:
        """Select one row and scroll to it."""
        self._chosen = at
        # ``setCurrentIndex`` of the view would take the Ctrl of a command for that of a click.
        only = QItemSelectionModel.SelectionFlag.ClearAndSelect
        self.selectionModel().setCurrentIndex(self._rows.index(at), only)
        self.scrollTo(self.currentIndex())

    def selected(self) -> list[int]:
        """Return the selected rows in order."""
        return sorted(index.row() for index in self.selectedIndexes())

    def extend(self, by: int) -> None:
        """Select the rows from the chosen one to ``by`` rows after the present end."""
        end = self._rows.index(self.currentIndex().row() + by)
        if end.isValid():
            flag = QItemSelectionModel.SelectionFlag
            rows = QItemSelection(*sorted((self._rows.index(self._chosen), end)))
            self.selectionModel().select(rows, flag.ClearAndSelect)
            self.selectionModel().setCurrentIndex(end, flag.NoUpdate)
            self.scrollTo(end)

    def _on_clicked(self, index: QModelIndex) -> None:
        several = Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier
        if not QApplication.keyboardModifiers() & several:
            self._choose(index.row())


class _LabelPainter(base.RowPainter):
    """Two lines: title and chip, then detail and badges."""

    def sizeHint(self, _option: QStyleOptionViewItem, _index: base.ModelIndex) -> QSize:
        line = QFontMetrics(base.ui_font(self.theme.scale)).height()
        return QSize(160, round(2.3 * line) + 8)

    def draw(self, painter: QPainter, option: QStyleOptionViewItem, row: LabelListRow) -> None:
        text, muted = self.colours(painter, option)
        line = painter.fontMetrics().height()
        inner = QRectF(option.rect).adjusted(8, 4, -8, -4)
        chip_width = self._chip(painter, inner, row.state, line)
        painter.setFont(base.ui_font(self.theme.scale, 1.0, 500))
        base.draw_elided_line(painter, inner.adjusted(0, 0, -chip_width - 6, 0), row.title, text)
        painter.setFont(base.ui_font(self.theme.scale, 0.88))
        second = inner.adjusted(0, 1.15 * line, 0, 0)
        words = " \N{MIDDLE DOT} ".join((*row.badges, row.detail))
        base.draw_elided_line(painter, second, words, muted)

    def _chip(self, painter: QPainter, inner: QRectF, state: str, line: float) -> float:
        (fill, text), state = STATE_COLOURS[state], base.tr(state)
        t = self.theme.tokens
        painter.setFont(base.ui_font(self.theme.scale, 0.8, 600))
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
    """One revision in words. ``head``: in force. ``difference``: to the revision before."""

    rev_uuid: str
    number: int
    what: str
    who: str
    difference: str
    head: bool


class HistoryList(QWidget):
    """List of revisions; ``restore`` gets the id of the one to restore."""

    def __init__(self, restore: Callable[[str], None]) -> None:
        super().__init__()
        self._rows: list[HistoryRow] = []
        self.list = base.KeylessList("Versions of the label")
        tip = "Make a new version with the content of the chosen one"
        self.restore = base.push_button("Restore", tip)
        self.count = base.label("", "small")
        foot = base.hbox((self.count, 1), self.restore)
        base.vbox((self.list, 1), foot, parent=self, margins=(0, 0, 0, 0), spacing=6)
        self.list.currentRowChanged.connect(self._choose)
        self.restore.clicked.connect(lambda: restore(self._rows[self.list.currentRow()].rev_uuid))
        self.show_rows([])

    def show_rows(self, rows: Sequence[HistoryRow]) -> None:
        """Replace all revisions, newest first."""
        self._rows = list(rows)
        self.list.clear()
        self.list.addItems([revision_text(row) for row in rows])
        self.count.setText(base.count_noun(len(rows), "version"))
        self._choose(-1)

    def choose(self, at: int) -> None:
        """Select a revision."""
        self.list.setCurrentRow(at)

    def _choose(self, at: int) -> None:
        self.restore.setEnabled(0 <= at < len(self._rows) and not self._rows[at].head)


def revision_text(row: HistoryRow) -> str:
    """Return the text of a revision."""
    holds = base.tr(", holds") if row.head else ""
    lines = (f"{row.number}. {row.what}{holds}", row.who, row.difference)
    return "\n".join(lines).removesuffix("\n")
