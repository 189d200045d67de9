"""Rows of labels and wrapped items."""

from __future__ import annotations

from typing import Any

from PySide6.QtCore import QMargins, QModelIndex, QPersistentModelIndex, QRect, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QKeyEvent, QPainter, QPaintEvent, QPalette
from PySide6.QtWidgets import (
    QListWidget,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QTableView,
    QWidget,
)

from touchdown.widgets.base.panel import tr
from touchdown.widgets.base.theme import Theme

ModelIndex = QModelIndex | QPersistentModelIndex
ROOT = QModelIndex()
ENTER = (Qt.Key.Key_Return, Qt.Key.Key_Enter)


def open_over(dialog: QWidget, window: QWidget, most: tuple[int, int], edge_px: int) -> None:
    """Show a dialog over most of a window: at most ``most`` px, at least ``edge_px`` smaller."""
    room = window.size().shrunkBy(QMargins(0, 0, edge_px, edge_px))
    dialog.resize(room.boundedTo(QSize(*most)))
    dialog.show()
    dialog.raise_()
    dialog.activateWindow()


def plain_table(table: QTableView, name: str) -> None:
    """Set up a read-only table without lines and row headers."""
    table.setAccessibleName(tr(name))
    table.setEditTriggers(QTableView.EditTrigger.NoEditTriggers)
    table.setShowGrid(False)
    table.setWordWrap(False)
    table.setTabKeyNavigation(False)
    table.verticalHeader().hide()
    table.horizontalHeader().setHighlightSections(False)


class RowPainter(QStyledItemDelegate):
    """Delegate that draws rows in the colours of the theme."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self.theme = theme

    def colours(self, painter: QPainter, option: QStyleOptionViewItem) -> tuple[QColor, QColor]:
        """Fill the background of a selected row; return the colours of normal and muted text."""
        tokens = self.theme.tokens
        if option.state & QStyle.StateFlag.State_Selected:
            painter.fillRect(QRectF(option.rect), tokens.colour("selection"))
            return tokens.colour("selection_text"), tokens.colour("selection_text")
        return tokens.colour("text"), tokens.colour("muted")

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: ModelIndex) -> None:
        """Draw the row of ``index``, if there is one."""
        row = index.data(Qt.ItemDataRole.UserRole)
        if row is not None:
            painter.save()
            self.draw(painter, option, row)
            painter.restore()

    def draw(self, painter: QPainter, option: QStyleOptionViewItem, row: Any) -> None:
        """Draw one row; subclasses override this."""


def true_minus(text: str) -> str:
    """Return a text of numbers with minus signs in place of hyphens."""
    return text.replace("-", "\N{MINUS SIGN}")


def signed(value: float, digits: int = 2) -> str:
    """Return a number with its sign and ``digits`` decimals; zero is never negative."""
    return true_minus(f"{value:+z.{digits}f}")


def draw_elided_line(painter: QPainter, box: QRectF, words: str, colour: QColor) -> None:
    """Draw ``words`` at the top left of ``box``, elided to its width."""
    painter.setPen(colour)
    metrics = painter.fontMetrics()
    cut = metrics.elidedText(words, Qt.TextElideMode.ElideRight, int(box.width()))
    painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop), cut)


PAD_X, PAD_Y = 12, 7  # padding of the style plus its text margin, px


class WrappedItemDelegate(QStyledItemDelegate):
    """Delegate that wraps texts at the present width of ``view``, less its scroll bar."""

    def __init__(self, view: QListWidget) -> None:
        super().__init__(view)
        self._view = view
        view.setWordWrap(True)
        view.setResizeMode(QListWidget.ResizeMode.Adjust)
        view.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        view.setItemDelegate(self)
        # Rows differ in height: scrolling by rows would leave empty space below the last one.
        view.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)

    def sizeHint(self, _option: QStyleOptionViewItem, index: ModelIndex) -> QSize:
        """Return the height of the wrapped text."""
        width = max(self._view.viewport().width() - 2 * PAD_X, 1)
        text = str(index.data(Qt.ItemDataRole.DisplayRole))
        room = QRect(0, 0, width, 10_000)
        wrap = int(Qt.TextFlag.TextWordWrap)
        drawn = self._view.fontMetrics().boundingRect(room, wrap, text)
        return QSize(2 * PAD_X, drawn.height() + 2 * PAD_Y)


class KeylessList(QListWidget):
    """A list that passes letters and Space to its page. ``nothing`` is shown while it is empty."""

    def __init__(self, name: str, nothing: str = "") -> None:
        super().__init__()
        self._nothing = tr(nothing)
        self.setAccessibleName(tr(name))
        WrappedItemDelegate(self)

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the lines, or the text of an empty list."""
        super().paintEvent(event)
        if self.count() == 0 and self._nothing:
            painter = QPainter(self.viewport())
            painter.setPen(self.palette().color(QPalette.ColorRole.PlaceholderText))
            where = self.viewport().rect().adjusted(8, 8, -8, -8)
            flags = Qt.AlignmentFlag.AlignCenter | Qt.TextFlag.TextWordWrap
            painter.drawText(where, int(flags), self._nothing)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Handle only keys that move the selection."""
        if event.text() and event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)
