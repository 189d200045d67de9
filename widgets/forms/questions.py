"""Questions with a row of answers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtCore import QEvent, QKeyCombination, Qt
from PySide6.QtGui import QFocusEvent, QKeyEvent, QKeySequence
from PySide6.QtWidgets import QDialog, QFrame, QGridLayout, QLineEdit, QPushButton, QWidget

from touchdown.widgets.base import ENTER, hbox, label, scroll_into_view, tr, vbox

COLUMNS = 3
LONG = 18  # answers longer than this, in letters, are laid out two to a row
ACTIVE_DURING_QUESTION = "beside"  # property of actions whose keys stay active during a question


class ChoiceBar(QFrame):
    """Question that takes the keyboard until it is answered, left with Esc, or loses the focus.

    ``ask`` has a key for each answer. ``offer`` has none, so that a letter or digit typed for
    something else is no answer: Tab selects, Enter accepts. Keys of actions with the property
    ``ACTIVE_DURING_QUESTION``, such as zoom, stay active.
    """

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self.setProperty("role", "question")
        self.setAccessibleName(tr("Question"))
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self._title = label("", "title", wrap=True)
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(8)
        self._grid.setVerticalSpacing(6)
        vbox(self._title, self._grid, parent=self, margins=(14, 10, 14, 12))
        self._choices: dict[str, str] = {}
        self._offered: list[str] = []
        self._buttons: list[QPushButton] = []
        self._marked = 0
        self._answer: Callable[[str], None] = _nothing
        self._typed: Callable[[str], None] = _nothing
        self._page = parent
        self.hide()

    def ask(
        self, title: str, choices: Sequence[tuple[str, str]], answer: Callable[[str], None]
    ) -> None:
        """Ask; ``choices`` are (key, word), ``answer`` gets the chosen word."""
        self._choices, self._offered = dict(choices), []
        self._answer, self._typed = answer, _nothing
        title = tr(title)
        texts = [f"{key}   {tr(word)}" for key, word in choices]
        self._show(tr("{}  (Esc: cancel)", title), title, texts, [word for _, word in choices])

    def offer(
        self,
        title: str,
        words: Sequence[str],
        marked: int,
        answer: Callable[[str], None],
        typed: Callable[[str], None],
    ) -> None:
        """Offer ``words`` with one of them selected; ``typed`` gets the first character of a
        number.

        A repeated call keeps the selection of the open question.
        """
        self._answer, self._typed, title = answer, typed, tr(title)
        if self.isVisible() and self.accessibleName() == title and self._offered == list(words):
            self.setFocus()
            return
        self._choices, self._offered, self._marked = {}, list(words), marked
        self._show(tr("{}  (Enter: accept, Tab: next, Esc: cancel)", title), title, words, words)
        self._mark(marked)

    @property
    def marked(self) -> str:
        """The word accepted by Enter, "" if each answer has its own key."""
        return self._offered[self._marked] if self._offered else ""

    def event(self, event: QEvent) -> bool:
        """Claim keys before the shortcuts of the window, except ``ACTIVE_DURING_QUESTION``."""
        if event.type() is QEvent.Type.ShortcutOverride and isinstance(event, QKeyEvent):
            if event.text().upper() in self._choices or not self._acts_beside(event):
                event.accept()
                return True
            return False
        return super().event(event)

    def _acts_beside(self, event: QKeyEvent) -> bool:
        keypad = Qt.KeyboardModifier.KeypadModifier
        pressed = QKeySequence(QKeyCombination(event.modifiers() & ~keypad, Qt.Key(event.key())))
        return any(
            action.property(ACTIVE_DURING_QUESTION)
            and action.isEnabled()
            and action.shortcut() == pressed
            for action in self.window().actions()
        )

    def focusNextPrevChild(self, forward: bool) -> bool:
        """Select the next answer with Tab, the previous one with Shift+Tab."""
        if self._offered:
            self._mark((self._marked + (1 if forward else -1)) % len(self._offered))
        return True

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Answer, or leave with Esc."""
        if event.key() == Qt.Key.Key_Escape:
            self.leave()
        elif event.key() in ENTER and self._offered:
            # Auto-repeat: the key was pressed for the previous question.
            if not event.isAutoRepeat():
                self._take(self.marked)
        else:
            self.take(event.text())

    def focusOutEvent(self, event: QFocusEvent) -> None:
        """Close without an answer, except when the window loses the focus."""
        super().focusOutEvent(event)
        if event.reason() is not Qt.FocusReason.ActiveWindowFocusReason:
            self.hide()

    def leave(self) -> None:
        """Close without an answer."""
        self.hide()
        self._page.setFocus()

    def take(self, text: str) -> None:
        """Answer by key, or pass on the start of a number; ignore anything else."""
        word = self._choices.get(text.upper())
        if word is not None:
            self._take(word)
        elif self._offered and text and text in "0123456789.,-+":
            self.leave()
            self._typed(text)

    def _take(self, word: str) -> None:
        answer = self._answer
        self.leave()
        answer(word)

    def _mark(self, at: int) -> None:
        self._marked = at
        for index, button in enumerate(self._buttons):
            button.setCheckable(True)
            button.setChecked(index == at)

    def _show(self, title: str, name: str, texts: Sequence[str], words: Sequence[str]) -> None:
        self._title.setText(tr(title))
        self.setAccessibleName(name)
        for button in self._buttons:
            self._grid.removeWidget(button)
            # Until it is deleted it would be drawn below the new answers.
            button.hide()
            button.deleteLater()
        self._buttons = [QPushButton(tr(text)) for text in texts]
        columns = COLUMNS if max(map(len, texts), default=0) <= LONG else 2
        for at, (button, word) in enumerate(zip(self._buttons, words, strict=True)):
            button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
            button.clicked.connect(lambda _=False, word=word: self._take(word))
            self._grid.addWidget(button, at // columns, at % columns)
        self.show()
        self.setFocus()
        scroll_into_view(self)


def _nothing(_word: str) -> None: ...


class NameDialog(QDialog):
    """Dialog for a name; ``take`` gets it and returns "" or an error."""

    def __init__(self, parent: QWidget, title: str) -> None:
        super().__init__(parent)
        self._take: Callable[[str], str] = str
        self._taken: Sequence[str] = ()
        self.setWindowTitle(tr(title))
        self.head, self.said = label("", "head"), label("", "small", wrap=True)
        self.field = QLineEdit()
        self.field.setAccessibleName(tr("Name or note"))
        self.save, close = QPushButton(tr("Save")), QPushButton(tr("Close"))
        self.save.setDefault(True)
        self.save.clicked.connect(self._try)
        close.clicked.connect(self.close)
        self.field.textChanged.connect(self._say)
        row = hbox(1, close, self.save)
        vbox(self.head, self.field, self.said, row, parent=self, margins=(18, 14, 18, 14),
             spacing=10)  # fmt: skip

    def ask(
        self, what: str, taken: Sequence[str], take: Callable[[str], str], text: str = ""
    ) -> None:
        """Ask for ``what``, first ``text``; warns that a name in ``taken`` will be replaced."""
        self._take, self._taken = take, taken
        self.head.setText(tr(what))
        self.field.setAccessibleName(tr(what))
        self.field.setText(text)
        self._say("")
        self.setMinimumWidth(22 * self.fontMetrics().height())
        self.show()
        self.activateWindow()
        self.field.setFocus()

    def _say(self, text: str) -> None:
        known = text.strip() in self._taken
        self.said.setText(tr("This name exists. Saving replaces its layout." if known else ""))

    def _try(self) -> None:
        reason = self._take(self.field.text())
        if reason:
            self.said.setText(tr(reason))
        else:
            self.close()


class NameField(QLineEdit):
    """Line edit that claims Enter before the shortcuts of the page."""

    def event(self, event: QEvent) -> bool:
        """Handle Enter as the end of the name."""
        is_key = isinstance(event, QKeyEvent) and event.key() in ENTER
        if is_key and event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return bool(super().event(event))
