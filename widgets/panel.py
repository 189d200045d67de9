"""A titled card: name on the left, live details on the right, the view below."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QFrame, QHBoxLayout, QLabel, QVBoxLayout, QWidget

from widgets.elided import ElidedLabel

HEADER_PX = 28
"""Least height of every header, the room of its tools: the titles of neighbours are in line."""


class Panel(QFrame):
    """Frame round one view. ``detail`` is the right-hand text of the header."""

    def __init__(self, title: str, body: QWidget | None = None) -> None:
        super().__init__()
        self.setProperty("role", "card")
        self.setAccessibleName(title)
        self._title = label(title, "title")
        self.detail = ElidedLabel("small")
        self.detail.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        header = QHBoxLayout()
        header.addStrut(HEADER_PX)
        header.addWidget(self._title)
        header.addWidget(self.detail, 1)
        self.header = header
        self.column = QVBoxLayout(self)
        self.column.setContentsMargins(10, 2, 10, 10)
        self.column.setSpacing(6)
        self.column.addLayout(header)
        if body is not None:
            self.column.addWidget(body, 1)

    def rename(self, title: str) -> None:
        """Give the panel another title."""
        if title != self._title.text():
            self._title.setText(title)
            self.setAccessibleName(title)


class Captioned(QWidget):
    """A view under a line with its name and, at the right, live details."""

    def __init__(self, title: str, body: QWidget) -> None:
        super().__init__()
        self.detail = ElidedLabel("small")
        self.detail.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        line = QHBoxLayout()
        line.addWidget(label(title, "muted"))
        line.addWidget(self.detail, 1)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        column.addLayout(line)
        column.addWidget(body, 1)


def label(text: str, role: str = "", *, wrap: bool = False) -> QLabel:
    """Return a plain-text label with a role of the style sheet."""
    made = QLabel(text)
    made.setTextFormat(Qt.TextFormat.PlainText)
    made.setWordWrap(wrap)
    if role:
        made.setProperty("role", role)
    return made


def rule() -> QFrame:
    """Return a thin horizontal line."""
    line = QFrame()
    line.setProperty("role", "rule")
    return line


def set_property(widget: QWidget, name: str, value: str) -> None:
    """Set a style-sheet property and restyle, only if it changed."""
    if widget.property(name) == value:
        return
    widget.setProperty(name, value)
    widget.style().unpolish(widget)
    widget.style().polish(widget)
