"""What lists of many rows have in common: one painter for all, letters left to the page."""

from __future__ import annotations

from PySide6.QtCore import QAbstractListModel, QModelIndex, QPersistentModelIndex, QRectF, Qt
from PySide6.QtGui import QColor, QKeyEvent, QPainter
from PySide6.QtWidgets import QListView, QStyle, QStyledItemDelegate, QStyleOptionViewItem, QWidget

from widgets.theme import Theme

Index = QModelIndex | QPersistentModelIndex
ROOT = QModelIndex()


class RowPainter(QStyledItemDelegate):
    """Draws the rows in the colours of the theme."""

    def __init__(self, theme: Theme, parent: QWidget) -> None:
        super().__init__(parent)
        self.theme = theme

    def colours(self, painter: QPainter, option: QStyleOptionViewItem) -> tuple[QColor, QColor]:
        """Fill the row where it is chosen; return the colours of text and of muted text there."""
        tokens = self.theme.tokens
        if option.state & QStyle.StateFlag.State_Selected:
            painter.fillRect(QRectF(option.rect), tokens.colour("selection"))
            return tokens.colour("selection_text"), tokens.colour("selection_text")
        return tokens.colour("text"), tokens.colour("muted")


class RowList(QListView):
    """Rows of one height; ``model`` and ``painter`` are kept here: a view does not own them."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.setUniformItemSizes(True)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setAccessibleName(name)

    def draw_rows(self, model: QAbstractListModel, painter: RowPainter) -> None:
        """Take what holds the rows and what draws them."""
        self._rows_of, self._painter = model, painter
        self.setModel(model)
        self.setItemDelegate(painter)

    def fit_to_theme(self) -> None:
        """Take the row height of another font scale."""
        self._rows_of.layoutChanged.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Keep only what moves the choice: letters and Space are the page's."""
        if event.text() and event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)


def draw_line(painter: QPainter, box: QRectF, words: str, colour: QColor) -> None:
    """Write ``words`` at the top left of ``box``, cut where it ends."""
    painter.setPen(colour)
    metrics = painter.fontMetrics()
    cut = metrics.elidedText(words, Qt.TextElideMode.ElideRight, int(box.width()))
    painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop), cut)
