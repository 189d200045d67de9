"""Wrapped words that take the lines they need, as far as there is room: the rest scrolls."""

from __future__ import annotations

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QFrame, QScrollArea, QSizePolicy

from widgets.panel import label

LEAST_LINES = 2


class Notes(QScrollArea):
    """A label in a scroll area; never over its neighbours."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self._label = label("", "small", wrap=True)
        self._label.setAlignment(Qt.AlignmentFlag.AlignTop)
        self._label.setAccessibleName(name)
        self.setWidget(self._label)
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Preferred)

    def text(self) -> str:
        """Return the words."""
        return self._label.text()

    def setText(self, text: str) -> None:
        """Show these words; their beginning stays in sight."""
        if text != self.text():
            self._label.setText(text)
            self.setToolTip(text)
            self.verticalScrollBar().setValue(0)
            self._fit()

    def sizeHint(self) -> QSize:
        """Return the room of all lines at the present width."""
        return QSize(120, self._needed())

    def minimumSizeHint(self) -> QSize:
        """Return the room of the first lines."""
        least = LEAST_LINES * self._label.fontMetrics().lineSpacing() + 2
        return QSize(60, min(least, self._needed()))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Take the lines of the new width."""
        super().resizeEvent(event)
        if event.size().width() != event.oldSize().width():
            self._fit()

    def _needed(self) -> int:
        if not self.text():
            return 0
        return max(self._label.heightForWidth(max(self.viewport().width(), 60)), 0) + 2

    def _fit(self) -> None:
        self.setMaximumHeight(self._needed())
        self.updateGeometry()
