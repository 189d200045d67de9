"""Bring into sight what asks for an answer: a page with large text scrolls."""

from __future__ import annotations

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QScrollArea, QWidget


def bring_in_sight(widget: QWidget) -> None:
    """Scroll the page to ``widget``, once it has got its place."""

    def scroll() -> None:
        ancestor = widget.parentWidget()
        while ancestor is not None and not isinstance(ancestor, QScrollArea):
            ancestor = ancestor.parentWidget()
        if ancestor is not None and widget.isVisible():
            ancestor.ensureWidgetVisible(widget)

    QTimer.singleShot(0, widget, scroll)
