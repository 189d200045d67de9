"""A question answered by one key: shown over the page, never modal, Esc takes it back."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QFocusEvent, QKeyEvent
from PySide6.QtWidgets import QFrame, QGridLayout, QPushButton, QVBoxLayout, QWidget

from widgets.panel import label


class ChoiceBar(QFrame):
    """Takes the keyboard until one of its keys, Esc, or the loss of the focus ends it."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setProperty("role", "question")
        self.setAccessibleName("Question")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._title = label("", "title")
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(8)
        self._grid.setVerticalSpacing(6)
        column = QVBoxLayout(self)
        column.setContentsMargins(14, 10, 14, 12)
        column.addWidget(self._title)
        column.addLayout(self._grid)
        self._choices: dict[str, str] = {}
        self._answer: Callable[[str], None] = _nothing
        self._before: QWidget | None = None
        self.hide()

    def ask(
        self, title: str, choices: Sequence[tuple[str, str]], answer: Callable[[str], None]
    ) -> None:
        """Ask; ``choices`` are (key, word), ``answer`` gets the word that was chosen."""
        self._before = self.parentWidget()
        self._choices, self._answer = dict(choices), answer
        self._title.setText(f"{title}  (Esc: leave)")
        self.setAccessibleName(title)
        while self._grid.count():
            item = self._grid.takeAt(0)
            widget = item.widget() if item is not None else None
            if widget is not None:
                widget.deleteLater()
        for at, (key, word) in enumerate(choices):
            button = QPushButton(f"{key}   {word}")
            button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
            button.clicked.connect(lambda _=False, key=key: self.take(key))
            self._grid.addWidget(button, at // 3, at % 3)
        self.adjustSize()
        parent = self.parentWidget()
        if parent is not None:
            self.move((parent.width() - self.width()) // 2, (parent.height() - self.height()) // 3)
        self.show()
        self.raise_()
        self.setFocus()

    def event(self, event: QEvent) -> bool:
        """Claim every key before the shortcuts of the window do."""
        if event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Answer, or leave with Esc."""
        if event.key() == Qt.Key.Key_Escape:
            self.leave()
        else:
            self.take(event.text().upper())

    def focusOutEvent(self, event: QFocusEvent) -> None:
        """Whoever turns to something else has answered nothing."""
        super().focusOutEvent(event)
        if event.reason() is not Qt.FocusReason.ActiveWindowFocusReason:
            self.hide()

    def leave(self) -> None:
        """End without an answer."""
        self.hide()
        if self._before is not None:
            self._before.setFocus()

    def take(self, key: str) -> None:
        """Answer with a key; any other key is no answer."""
        if key in self._choices:
            word, answer = self._choices[key], self._answer
            self.leave()
            answer(word)


def _nothing(_word: str) -> None:
    """Do nothing: nothing was asked."""
