"""All keys on one sheet (F1); not modal, so that nothing waits for it."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QDialog,
    QFrame,
    QGridLayout,
    QHBoxLayout,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from widgets.panel import label, rule

Row = tuple[str, str, str]
"""Where the key acts, the key, what it does."""
Groups = list[tuple[str, list[Row]]]
COLUMN_EM = 34
TOP_EM = 8
"""Left free above and below, all together: the bar with STOP stays in sight."""


class KeySheet(QDialog):
    """Keys, grouped by where they act, in two columns where they fit; scrolls if it must."""

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
        groups = [(title, [row for row in group if row[1]])
                  for title, group in groupby(rows, key=lambda row: row[0])]  # fmt: skip
        em = self.fontMetrics().height()
        columns = 2 if 2 * COLUMN_EM * em < self._window.width() else 1
        body = QWidget()
        row = QHBoxLayout(body)
        row.setSpacing(round(1.5 * em))
        for part in _shared_out(groups, columns):
            row.addLayout(_table(part), 1)
        self._scroll.setWidget(body)
        most = self._window.height() - round(TOP_EM * em)
        high = body.heightForWidth(columns * COLUMN_EM * em) + 110
        self.resize(columns * COLUMN_EM * em, min(high, most))
        self.show()
        self.raise_()


def _shared_out(groups: Groups, columns: int) -> list[Groups]:
    """Share whole groups out to columns of about the same height."""
    lengths = [1 + len(rows) for _, rows in groups]
    parts: list[Groups] = [[] for _ in range(columns)]
    before = 0
    for group, length in zip(groups, lengths, strict=True):
        middle = (before + length / 2) / max(sum(lengths), 1)
        parts[min(int(columns * middle), columns - 1)].append(group)
        before += length
    return [part for part in parts if part]


def _table(groups: Groups) -> QGridLayout:
    """Return the rows of some groups, each below its title."""
    grid = QGridLayout()
    grid.setHorizontalSpacing(24)
    grid.setVerticalSpacing(7)
    grid.setColumnStretch(1, 1)
    line = 0
    for title, rows in groups:
        grid.addWidget(label(title, "head"), line, 0, 1, 2)
        for _, key, text in rows:
            line += 1
            grid.addWidget(label(key, "title"), line, 0, Qt.AlignmentFlag.AlignTop)
            grid.addWidget(label(text, wrap=True), line, 1)
        line += 1
    grid.setRowStretch(line, 1)
    return grid
