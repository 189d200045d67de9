"""Rows of a list that are as high as their wrapped text.

The list's own rows leave the padding of the style out of account when they wrap, so that the last
word of a full line is cut off.
"""

from __future__ import annotations

from PySide6.QtCore import QModelIndex, QPersistentModelIndex, QRect, QSize, Qt
from PySide6.QtWidgets import QListWidget, QStyledItemDelegate, QStyleOptionViewItem

PAD_X, PAD_Y = 12, 7
"""Padding of the style and the margin that the style keeps round a text, px."""


class WrappedItems(QStyledItemDelegate):
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
