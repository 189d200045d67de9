"""All versions of one label, newest first: who, when, from what source, and what changed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QHBoxLayout, QListWidget, QPushButton, QVBoxLayout, QWidget

from widgets.panel import label
from widgets.wrapped_items import WrappedItems


@dataclass(frozen=True, slots=True)
class HistoryRow:
    """One revision in words. ``head``: it is the one that holds; ``difference`` to the former."""

    rev_uuid: str
    number: int
    what: str
    who: str
    difference: str
    head: bool


class HistoryList(QWidget):
    """Lists revisions; ``restore`` is told the one that was asked back."""

    def __init__(self, restore: Callable[[str], None]) -> None:
        super().__init__()
        self._restore = restore
        self._rows: list[HistoryRow] = []
        self.list = _Quiet()
        self.list.setAccessibleName("Versions of the label")
        WrappedItems(self.list)
        self.restore = QPushButton("Restore")
        self.restore.setToolTip("Make a new version with the content of the chosen one")
        self.count = label("", "small")
        foot = QHBoxLayout()
        foot.addWidget(self.count, 1)
        foot.addWidget(self.restore)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(6)
        column.addWidget(self.list, 1)
        column.addLayout(foot)
        self.list.currentRowChanged.connect(self._choose)
        self.restore.clicked.connect(self._restore_chosen)
        self.show_rows([])

    def show_rows(self, rows: Sequence[HistoryRow]) -> None:
        """Show the revisions of another episode, newest first."""
        self._rows = list(rows)
        self.list.clear()
        self.list.addItems([in_words(row) for row in rows])
        self.count.setText("1 version" if len(rows) == 1 else f"{len(rows)} versions")
        self._choose(-1)

    def choose(self, at: int) -> None:
        """Mark a revision."""
        self.list.setCurrentRow(at)

    def _choose(self, at: int) -> None:
        self.restore.setEnabled(0 <= at < len(self._rows) and not self._rows[at].head)

    def _restore_chosen(self) -> None:
        at = self.list.currentRow()
        if 0 <= at < len(self._rows):
            self._restore(self._rows[at].rev_uuid)


def in_words(row: HistoryRow) -> str:
    """Return a revision as the list shows it."""
    holds = ", holds" if row.head else ""
    lines = [f"{row.number}. {row.what}{holds}", row.who]
    return "\n".join([*lines, row.difference] if row.difference else lines)


class _Quiet(QListWidget):
    """Leaves letters and digits to the page."""

    def keyPressEvent(self, event: QKeyEvent) -> None:
        if event.text() and event.text().isprintable():
            event.ignore()
        else:
            super().keyPressEvent(event)
