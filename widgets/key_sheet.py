"""All keys on one sheet (F1); not modal, so that nothing waits for it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from PySide6.QtCore import QSize, Qt
from PySide6.QtWidgets import (
    QDialog,
    QFrame,
    QGridLayout,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from widgets.panel import label, rule

Row = tuple[str, str, str]
"""Where the key acts, the key, what it does."""


class KeySheet(QDialog):
    """A table of keys, grouped by where they act; scrolls where there is little room."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._window = parent
        self.setWindowTitle("Keys")
        self.setModal(False)
        self._scroll = QScrollArea()
        self._scroll.setWidgetResizable(True)
        self._scroll.setFrameShape(QFrame.Shape.NoFrame)
        self._scroll.setAccessibleName("Keys and what they do")
        close = QPushButton("Close")
        close.clicked.connect(self.close)
        column = QVBoxLayout(self)
        column.setContentsMargins(20, 16, 20, 16)
        column.setSpacing(12)
        column.addWidget(self._scroll, 1)
        column.addWidget(rule())
        column.addWidget(close, 0, Qt.AlignmentFlag.AlignRight)

    def show_rows(self, rows: Sequence[Row]) -> None:
        """Show the keys as they are now; a command without a key is left to the palette."""
        body = QWidget()
        grid = QGridLayout(body)
        grid.setHorizontalSpacing(24)
        grid.setVerticalSpacing(7)
        grid.setColumnStretch(1, 1)
        line = 0
        for title, group in groupby(rows, key=lambda row: row[0]):
            grid.addWidget(label(title, "head"), line, 0, 1, 2)
            for _, key, text in group:
                if key:
                    line += 1
                    grid.addWidget(label(key, "title"), line, 0, Qt.AlignmentFlag.AlignTop)
                    grid.addWidget(label(text, wrap=True), line, 1)
            line += 1
        grid.setRowStretch(line, 1)
        self._scroll.setWidget(body)
        most = self._window.height() - 60
        want = body.sizeHint() + QSize(70, 110)
        self.resize(max(want.width(), 34 * self.fontMetrics().height()), min(want.height(), most))
        self.show()
        self.raise_()
