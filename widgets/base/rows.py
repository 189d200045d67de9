"""Rows of labels and wrapped items."""

from __future__ import annotations

from PySide6.QtCore import (
    QAbstractListModel,
    QModelIndex,
    QPersistentModelIndex,
    QRect,
    QRectF,
    QSize,
    Qt,
)
from PySide6.QtGui import QColor, QKeyEvent, QPainter
from PySide6.QtWidgets import (
    QListView,
    QListWidget,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QWidget,
)

from touchdown.widgets.base.theme import Theme

ModelIndex = QModelIndex | QPersistentModelIndex
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


def draw_elided_line(painter: QPainter, box: QRectF, words: str, colour: QColor) -> None:
    """Write ``words`` at the top left of ``box``, cut where it ends."""
    painter.setPen(colour)
    metrics = painter.fontMetrics()
    cut = metrics.elidedText(words, Qt.TextElideMode.ElideRight, int(box.width()))
    painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignTop), cut)


PAD_X, PAD_Y = 12, 7
"""Padding of the style and the margin that the style keeps round a text, px."""


class WrappedItemDelegate(QStyledItemDelegate):
    """Measures rows for the width that ``view`` has now, beside its scroll bar."""

    def __init__(self, view: QListWidget) -> None:
        super().__init__(view)
        self._view = view
        view.setWordWrap(True)
        view.setResizeMode(QListWidget.ResizeMode.Adjust)
        view.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        view.setItemDelegate(self)
        # By whole rows, of which some are higher, the end of a short list left its room empty.
        view.setVerticalScrollMode(QListWidget.ScrollMode.ScrollPerPixel)

    def sizeHint(
        self, option: QStyleOptionViewItem, index: QModelIndex | QPersistentModelIndex
    ) -> QSize:
        """Return the height of the text where it is drawn."""
        width = max(self._view.viewport().width() - 2 * PAD_X, 1)
        text = str(index.data(Qt.ItemDataRole.DisplayRole))
        room = QRect(0, 0, width, 10_000)
        metrics = self._view.fontMetrics()
        drawn = metrics.boundingRect(room, int(Qt.TextFlag.TextWordWrap), text)
        return QSize(2 * PAD_X, drawn.height() + 2 * PAD_Y)
