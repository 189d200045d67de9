"""Keeps one widget over the top of another, so that nothing below it has to move."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QObject
from PySide6.QtWidgets import QWidget

_CHANGED = frozenset({QEvent.Type.LayoutRequest, QEvent.Type.Show})


class OnTop(QObject):
    """``cover`` is as wide as ``base`` and as high as it needs."""

    def __init__(self, cover: QWidget, base: QWidget) -> None:
        super().__init__(base)
        self._cover, self._base = cover, base
        cover.setParent(base)
        base.installEventFilter(self)
        cover.installEventFilter(self)
        cover.setVisible(False)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Follow the base, and the content of the cover."""
        kind = event.type()
        if (watched is self._base and kind is QEvent.Type.Resize) or (
            watched is self._cover and kind in _CHANGED
        ):
            self._place()
        return False

    def _place(self) -> None:
        cover, width = self._cover, self._base.width()
        layout = cover.layout()
        high = cover.sizeHint().height()
        if layout is not None and layout.hasHeightForWidth():
            high = layout.totalHeightForWidth(width)
        cover.setGeometry(0, 0, width, min(high, self._base.height()))
        cover.raise_()
