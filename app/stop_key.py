"""F12 stops always, Space while something moves: caught before any dialog can swallow them.

A shortcut is dead while a modal dialog is open; an application event filter is not. Only presses
delivered to a window count, so that one press is one stop.
"""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QEvent, QObject, Qt
from PySide6.QtGui import QKeyEvent, QWindow
from PySide6.QtWidgets import QAbstractSpinBox, QApplication, QComboBox, QLineEdit, QPlainTextEdit

_PRESSED = frozenset({QEvent.Type.ShortcutOverride, QEvent.Type.KeyPress})


class StopKey(QObject):
    """Event filter of the application; ``stop`` must return at once."""

    def __init__(
        self, parent: QObject, stop: Callable[[], None], moving: Callable[[], bool]
    ) -> None:
        super().__init__(parent)
        self._stop, self._moving = stop, moving

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Take F12 and, while something moves, Space."""
        # Every event of the window passes here: the cheapest test comes first.
        if not isinstance(event, QKeyEvent) or not isinstance(watched, QWindow):
            return False
        if event.type() not in _PRESSED or not self._wanted(event.key()):
            return False
        # Before a press the same key comes as ShortcutOverride: claimed, so that no shortcut takes
        # it, and no press of its own.
        if event.type() is QEvent.Type.KeyPress and not event.isAutoRepeat():
            self._stop()
        event.accept()
        return True

    def _wanted(self, key: int) -> bool:
        if key == Qt.Key.Key_F12:
            return True
        return key == Qt.Key.Key_Space and self._moving() and not typing()


def typing() -> bool:
    """Return whether an editable text field has the focus."""
    focus = QApplication.focusWidget()
    if isinstance(focus, (QLineEdit, QPlainTextEdit)):
        return not focus.isReadOnly()
    if isinstance(focus, QComboBox):
        return focus.isEditable()
    return isinstance(focus, QAbstractSpinBox)
