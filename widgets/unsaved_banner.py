"""A label that could not be saved: said where nobody can miss it, until saved or discarded."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QFrame, QHBoxLayout, QPushButton

from widgets.in_sight import bring_in_sight
from widgets.panel import label


class UnsavedBanner(QFrame):
    """Shown only while something is unsaved."""

    def __init__(self, again: Callable[[], None], discard: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "fault")
        self.setAccessibleName("Unsaved label")
        self.text = label("", wrap=True)
        self.again, self.discard = QPushButton("Save again (Enter)"), QPushButton("Discard (Esc)")
        row = QHBoxLayout(self)
        row.setContentsMargins(12, 8, 10, 8)
        row.addWidget(self.text, 1)
        row.addWidget(self.again)
        row.addWidget(self.discard)
        self.again.clicked.connect(again)
        self.discard.clicked.connect(discard)
        self.hide()

    def show_trouble(self, what: str, *, waits: bool = False) -> None:
        """Say why; "" hides the banner. ``waits``: it is tried again without anybody's doing."""
        self.text.setText(f"Not saved: {what}" if what else "")
        for button in (self.again, self.discard):
            button.setVisible(not waits)
        appears = bool(what) and self.isHidden()
        self.setVisible(bool(what))
        if appears:
            bring_in_sight(self)
