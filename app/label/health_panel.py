"""What is out of order in the dataset, kind by kind; a click opens the episodes as a queue."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtWidgets import QListWidget, QPushButton, QVBoxLayout, QWidget

from widgets.panel import label
from widgets.wrapped_items import WrappedItems


class HealthPanel(QWidget):
    """``look`` is asked for a look through the dataset, ``choose`` gets the row of a finding."""

    def __init__(self, look: Callable[[], None], choose: Callable[[int], None]) -> None:
        super().__init__()
        self.said = label("Nothing was looked through yet.", "muted", wrap=True)
        self.list = QListWidget()
        self.list.setAccessibleName("Findings of the dataset")
        WrappedItems(self.list)
        self.look = QPushButton("Look through the dataset")
        self.look.setToolTip("Look for what is out of order in all episodes (Ctrl+H)")
        self.look.clicked.connect(look)
        self.list.itemClicked.connect(lambda item: choose(self.list.row(item)))
        self.list.itemActivated.connect(lambda item: choose(self.list.row(item)))
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.said)
        column.addWidget(self.list, 1)
        column.addWidget(self.look)

    def show_findings(self, said: str, lines: Sequence[str]) -> None:
        """Show one line a kind, and one sentence on the whole."""
        self.said.setText(said)
        self.list.clear()
        self.list.addItems(list(lines))
