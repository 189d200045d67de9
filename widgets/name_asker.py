"""Asks for a name and says at once why it cannot be had; not modal."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtWidgets import QDialog, QHBoxLayout, QLineEdit, QPushButton, QVBoxLayout, QWidget

from widgets.panel import label


class NameAsker(QDialog):
    """``take`` is given the name and returns "" or why it cannot be had."""

    def __init__(self, parent: QWidget, title: str) -> None:
        super().__init__(parent)
        self._take: Callable[[str], str] = str
        self._taken: Sequence[str] = ()
        self.setWindowTitle(title)
        self.setModal(False)
        self.head, self.said = label("", "head"), label("", "small", wrap=True)
        self.field = QLineEdit()
        self.save, close = QPushButton("Save"), QPushButton("Close")
        self.save.setDefault(True)
        self.save.clicked.connect(self._try)
        close.clicked.connect(self.close)
        self.field.textChanged.connect(self._say)
        row = QHBoxLayout()
        row.addStretch(1)
        row.addWidget(close)
        row.addWidget(self.save)
        column = QVBoxLayout(self)
        column.setContentsMargins(18, 14, 18, 14)
        column.setSpacing(10)
        for widget in (self.head, self.field, self.said):
            column.addWidget(widget)
        column.addLayout(row)

    def ask(self, what: str, taken: Sequence[str], take: Callable[[str], str]) -> None:
        """Ask for ``what``; a name in ``taken`` will be replaced, and that is said."""
        self._take, self._taken = take, taken
        self.head.setText(what)
        self.field.setAccessibleName(what)
        self.field.clear()
        self._say("")
        self.setMinimumWidth(22 * self.fontMetrics().height())
        self.show()
        self.activateWindow()
        self.field.setFocus()

    def _say(self, text: str) -> None:
        known = text.strip() in self._taken
        self.said.setText("This name exists: its layout is replaced." if known else "")

    def _try(self) -> None:
        reason = self._take(self.field.text())
        if reason:
            self.said.setText(reason)
        else:
            self.close()
