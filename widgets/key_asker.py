"""Asks for a key by having it pressed; shows at once whether it can be had."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QEvent, QKeyCombination, Qt
from PySide6.QtGui import QKeyEvent, QKeySequence
from PySide6.QtWidgets import QDialog, QHBoxLayout, QPushButton, QVBoxLayout, QWidget

from widgets.panel import label

_ALONE = frozenset({Qt.Key.Key_Control, Qt.Key.Key_Shift, Qt.Key.Key_Alt, Qt.Key.Key_Meta,
                    Qt.Key.Key_AltGr})  # fmt: skip


class KeyAsker(QDialog):
    """``change`` tries a key ("" for none) and returns "" or why it cannot be had."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._change: Callable[[str], str] = str
        self.setWindowTitle("Change a key")
        self.setModal(False)
        self.head, self.said = label("", "head", wrap=True), label("", wrap=True)
        none, close = QPushButton("No key"), QPushButton("Close")
        none.setToolTip("The command stays in the palette")
        for button in (none, close):
            button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        none.clicked.connect(self._take_none)
        close.clicked.connect(self.close)
        row = QHBoxLayout()
        row.addStretch(1)
        row.addWidget(none)
        row.addWidget(close)
        column = QVBoxLayout(self)
        column.setContentsMargins(18, 14, 18, 14)
        column.setSpacing(10)
        column.addWidget(self.head)
        column.addWidget(self.said)
        column.addLayout(row)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)

    def ask(self, text: str, key: str, change: Callable[[str], str]) -> None:
        """Ask for a key for the command ``text``, which has ``key`` now."""
        self._change = change
        self.head.setText(text)
        self.said.setText(f"Its key is {key}. Press another." if key else "Press a key for it.")
        self.setMinimumWidth(26 * self.fontMetrics().height())
        self.show()
        self.activateWindow()
        self.setFocus()

    def event(self, event: QEvent) -> bool:
        """Have every key for itself, also those that are shortcuts of the window."""
        if event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Try the key that was pressed."""
        key = Qt.Key(event.key())
        if key in _ALONE or event.isAutoRepeat():
            return
        if key is Qt.Key.Key_Escape and not event.modifiers().value:
            self.close()
            return
        modifiers = event.modifiers() & ~Qt.KeyboardModifier.KeypadModifier
        pressed = QKeySequence(QKeyCombination(modifiers, key))
        self._try(pressed.toString(QKeySequence.SequenceFormat.PortableText))

    def _take_none(self) -> None:
        self._try("")

    def _try(self, key: str) -> None:
        reason = self._change(key)
        if reason:
            self.said.setText(reason)
        else:
            self.said.setText(f"The key is {key} now." if key else "It has no key now.")
