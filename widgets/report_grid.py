"""One table of a report: a value large, what belongs to it in small lines below."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QModelIndex, QPersistentModelIndex, QRect, QSize, Qt
from PySide6.QtGui import QFont, QFontMetrics, QPainter, QResizeEvent
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractItemView,
    QHeaderView,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QTableWidget,
    QTableWidgetItem,
)

from widgets.theme import Theme, ui_font

Index = QModelIndex | QPersistentModelIndex
PAD_X, PAD_Y = 9, 6


@dataclass(frozen=True, slots=True)
class CellLook:
    """``value``, then ``lines`` below it; ``trace`` says where it comes from."""

    value: str
    lines: tuple[str, ...] = ()
    trace: str = ""


class ReportGrid(QTableWidget):
    """As high as its rows; wider than its room it scrolls. ``chosen`` is told row and column."""

    def __init__(
        self,
        theme: Theme,
        name: str,
        columns: Sequence[str],
        rows: Sequence[tuple[str, Sequence[CellLook]]],
        chosen: Callable[[int, int], None],
    ) -> None:
        super().__init__(len(rows), len(columns))
        self.setAccessibleName(name)
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionMode(QAbstractItemView.SelectionMode.SingleSelection)
        self.setHorizontalScrollMode(QAbstractItemView.ScrollMode.ScrollPerPixel)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setTabKeyNavigation(False)
        self.setWordWrap(False)
        # Kept here: a view does not own what draws its cells.
        self._painter = _CellPainter(theme, self)
        self.setItemDelegate(self._painter)
        self.setHorizontalHeaderLabels(list(columns))
        self.setVerticalHeaderLabels([title for title, _ in rows])
        left = Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter
        self.verticalHeader().setDefaultAlignment(left)
        for row, (title, cells) in enumerate(rows):
            for column, look in enumerate(cells):
                self.setItem(row, column, _item(look, title, columns[column]))
        for header in (self.horizontalHeader(), self.verticalHeader()):
            header.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
            header.setHighlightSections(False)
            header.setSectionsClickable(False)
        corner = self.findChild(QAbstractButton)
        if corner is not None:
            # It selects all, which is no use here, and has a look of its own.
            corner.hide()
        self.fit_to_theme()
        self.currentCellChanged.connect(lambda row, column, *_: chosen(row, column))

    def fit_to_theme(self) -> None:
        """Take the sizes of another font scale."""
        self.resizeColumnsToContents()
        self.resizeRowsToContents()
        self._be_high()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Leave room for the bar below where the columns are wider than the room."""
        super().resizeEvent(event)
        self._be_high()

    def _be_high(self) -> None:
        across, down = self.horizontalHeader(), self.verticalHeader()
        high = across.sizeHint().height() + down.length() + 2 * self.frameWidth()
        if across.length() + down.sizeHint().width() + 2 * self.frameWidth() > self.width():
            high += self.horizontalScrollBar().sizeHint().height()
        self.setFixedHeight(high)


def _item(look: CellLook, row: str, column: str) -> QTableWidgetItem:
    item = QTableWidgetItem(", ".join(filter(None, (look.value, *look.lines))))
    item.setData(Qt.ItemDataRole.UserRole, look)
    item.setToolTip(look.trace)
    words = f"{row}, {column.replace(chr(10), ' ')}: {item.text() or 'nothing'}"
    item.setData(Qt.ItemDataRole.AccessibleTextRole, words)
    return item


class _CellPainter(QStyledItemDelegate):
    def __init__(self, theme: Theme, parent: ReportGrid) -> None:
        super().__init__(parent)
        self._theme = theme

    def sizeHint(self, option: QStyleOptionViewItem, index: Index) -> QSize:
        look: CellLook = index.data(Qt.ItemDataRole.UserRole)
        value, small = (QFontMetrics(font) for font in self._fonts())
        wide = [value.horizontalAdvance(look.value)]
        wide += [small.horizontalAdvance(line) for line in look.lines]
        high = value.height() + len(look.lines) * small.height()
        return QSize(max(wide) + 2 * PAD_X, high + 2 * PAD_Y)

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: Index) -> None:
        look: CellLook = index.data(Qt.ItemDataRole.UserRole)
        tokens = self._theme.tokens
        on = bool(option.state & QStyle.StateFlag.State_Selected)
        painter.save()
        if on:
            painter.fillRect(option.rect, tokens.colour("selection"))
        room = QRect(option.rect).adjusted(PAD_X, PAD_Y, -PAD_X, -PAD_Y)
        right = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignTop
        for k, text in enumerate((look.value, *look.lines)):
            font = self._fonts()[min(k, 1)]
            painter.setFont(font)
            ink = "selection_text" if on else "muted" if k else "text"
            painter.setPen(tokens.colour(ink))
            painter.drawText(room, int(right), text)
            room.setTop(room.top() + QFontMetrics(font).height())
        painter.restore()

    def _fonts(self) -> tuple[QFont, QFont]:
        scale = self._theme.scale
        return ui_font(scale, weight=600), ui_font(scale, 0.85)
