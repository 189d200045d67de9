"""The form of a change to many labels."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QComboBox, QHBoxLayout, QPushButton, QVBoxLayout, QWidget

from app.label.entry import Entry
from widgets.panel import label

KINDS: tuple[tuple[str, str, str], ...] = (
    ("shift", "Shift the origin", "x,y in mm"),
    ("rotate", "Rotate the frame", "angle in degrees"),
    ("geometry", "Use the present sizes of the pieces", ""),
    ("accept", "Accept", ""),
    ("approve", "Approve", ""),
    ("reject", "Reject", "reason"),
)


class BulkForm(QWidget):
    """What to change, a preview in words, and the button that does it.

    ``entered``: Enter in the line, ``leave``: Esc.
    """

    def __init__(
        self,
        preview: Callable[[], None],
        apply: Callable[[], None],
        entered: Callable[[], None],
        leave: Callable[[], None],
    ) -> None:
        super().__init__()
        self.kind = QComboBox()
        self.value = Entry("By how much, or why", "", lambda _: entered(), leave)
        self.kind.setAccessibleName("Change")
        for name, text, _ in KINDS:
            self.kind.addItem(text, name)
        self.preview, self.apply = QPushButton("Preview"), QPushButton("Apply")
        self.found = label("Changes every label of the queue that is shown.", "muted", wrap=True)
        buttons = QHBoxLayout()
        for button in (self.preview, self.apply):
            buttons.addWidget(button)
        buttons.addStretch(1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(5)
        for part in (self.kind, self.value):
            column.addWidget(part)
        column.addLayout(buttons)
        column.addWidget(self.found)
        column.addStretch(1)
        self.preview.clicked.connect(preview)
        self.apply.clicked.connect(apply)
        self.kind.currentIndexChanged.connect(self._kind_chosen)
        self.value.textChanged.connect(self._changed)
        self._kind_chosen(0)

    def _kind_chosen(self, at: int) -> None:
        hint = KINDS[at][2]
        self.value.setPlaceholderText(hint)
        self.value.setEnabled(bool(hint))
        self._changed()

    def _changed(self) -> None:
        self.apply.setEnabled(False)
