"""A question inside a panel: one sentence, yes or no; hidden while nothing is asked."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QFrame, QHBoxLayout, QPushButton

from widgets.panel import label


class QuestionRow(QFrame):
    """The no is the first answer and does nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.setProperty("role", "question")
        self.text = label("", "title", wrap=True)
        self.no, self.yes = QPushButton("No"), QPushButton("Yes")
        self._act: Callable[[], None] | None = None
        row = QHBoxLayout(self)
        row.addWidget(self.text, 1)
        for button in (self.no, self.yes):
            button.setAutoDefault(False)
            row.addWidget(button)
        self.no.clicked.connect(self.withdraw)
        self.yes.clicked.connect(self._accept)
        self.hide()

    def ask(self, text: str, no: str, yes: str, act: Callable[[], None]) -> None:
        """Ask; ``act`` is done on the yes."""
        self._act = act
        self.text.setText(text)
        for button, word in ((self.no, no), (self.yes, yes)):
            button.setText(word)
            button.setAccessibleName(f"{word}: {text}")
        self.show()

    def withdraw(self) -> None:
        """Ask no more."""
        self._act = None
        self.hide()

    def _accept(self) -> None:
        act = self._act
        self.withdraw()
        if act is not None:
            act()
