"""A line for a name: Enter ends it, whatever Enter means on its page."""

from __future__ import annotations

from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QLineEdit

ENTER = (Qt.Key.Key_Return, Qt.Key.Key_Enter)


class NameField(QLineEdit):
    """Claims Enter before the shortcuts of the page do."""

    def event(self, event: QEvent) -> bool:
        """Take Enter as the end of the name."""
        is_key = isinstance(event, QKeyEvent) and event.key() in ENTER
        if is_key and event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return bool(super().event(event))
