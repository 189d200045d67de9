"""What one device says of itself, field by field; not modal, so that nothing waits for it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtCore import QPoint, Qt
from PySide6.QtWidgets import (
    QDialog,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from widgets.panel import label, rule

Rows = Sequence[tuple[str, str]]


class DeviceInspector(QDialog):
    """A table of (field, value) that follows one device."""

    def __init__(self, parent: QWidget, on_reconnect: Callable[[], None]) -> None:
        super().__init__(parent)
        self.setModal(False)
        self.key = ""
        self.reconnect = QPushButton("Reconnect")
        self.reconnect.setToolTip("Close the connection and open it again; nothing is let go")
        self.reconnect.clicked.connect(on_reconnect)
        self._head = label("", "head")
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(28)
        self._grid.setVerticalSpacing(6)
        self._grid.setColumnStretch(1, 1)
        self._values: dict[str, QLabel] = {}
        self._close = QPushButton("Close")
        self._close.clicked.connect(self.close)
        column = QVBoxLayout(self)
        column.setContentsMargins(18, 14, 18, 14)
        column.setSpacing(10)
        column.addWidget(self._head)
        column.addLayout(self._grid)
        column.addStretch(1)
        column.addWidget(rule())
        buttons = QHBoxLayout()
        buttons.addWidget(self.reconnect)
        buttons.addStretch(1)
        buttons.addWidget(self._close)
        column.addLayout(buttons)
        self.setMinimumWidth(300)

    def open_at(self, key: str, title: str, rows: Rows, below: QPoint) -> None:
        """Show device ``key`` with its upper left corner at ``below`` (global)."""
        self.key = key
        self.setWindowTitle(f"{title}: raw fields")
        self._head.setText(title)
        self.reconnect.setAccessibleName(f"Reconnect {title}")
        self._build(rows)
        self.adjustSize()
        self.move(below)
        self.show()
        self.raise_()

    def show_rows(self, rows: Rows) -> None:
        """Show new values; the table is built anew only if the fields changed."""
        if [field for field, _ in rows] != list(self._values):
            self._build(rows)
            return
        for field, value in rows:
            if self._values[field].text() != value:
                self._values[field].setText(value)

    def rows(self) -> dict[str, str]:
        """Return what is shown, by field."""
        return {field: value.text() for field, value in self._values.items()}

    def _build(self, rows: Rows) -> None:
        while (item := self._grid.takeAt(0)) is not None:
            old = item.widget()
            if old is not None:
                old.deleteLater()
        self._values.clear()
        for row, (field, value) in enumerate(rows):
            shown = label(value)
            shown.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
            shown.setAccessibleName(field)
            self._values[field] = shown
            self._grid.addWidget(label(field, "muted"), row, 0)
            self._grid.addWidget(shown, row, 1)
