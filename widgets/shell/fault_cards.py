"""Fault cards."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QObject, QSize, Qt
from PySide6.QtGui import QGuiApplication, QKeyEvent, QResizeEvent
from PySide6.QtWidgets import (
    QApplication,
    QBoxLayout,
    QFrame,
    QPlainTextEdit,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QWidget,
)

from touchdown.widgets import base

MAX_CARDS = 4
LEAST_EM = 46  # width of a card with its buttons beside the text, in heights of the font
ANSWER_EM = 9  # least width of an answer, so that each has its place
QUESTION_PX = 260  # least width of a question beside its answers
STOPPED = "STOPPED"  # code of the card of a stop, always on top


@dataclass(frozen=True, slots=True)
class CardText:
    """Texts and behaviour of one card.

    ``reset``: belongs to the stop latch, only Reset removes it. ``passing``: a refused command,
    removed by the next accepted one. ``notice``: shown once; a different text under the same code
    is another card. A notice is never removed to make room. ``obstacle``: a run waits for its
    removal; the card goes when the run resumes. ``offer``: label and action of a button for the
    next step.
    """

    code: str
    what: str
    consequence: str
    next_step: str
    details: str = ""
    reset: bool = True
    at: str = ""
    passing: bool = False
    notice: bool = False
    obstacle: bool = False
    offer: tuple[str, Callable[[], None]] | None = None

    @property
    def role(self) -> str:
        """Style of the card: "fault", or "notice" if nothing was stopped."""
        return "notice" if self.notice or self.obstacle or self.passing else "fault"

    @property
    def key(self) -> str:
        """Identity of the card; equal keys are counted as repetitions."""
        return f"{self.code} {self.what}" if self.notice else self.code


@dataclass(frozen=True, slots=True)
class CardQuestion:
    """Non-blocking question: text and (label, action) per answer; the first one changes nothing."""

    text: str
    answers: tuple[tuple[str, Callable[[], object]], ...]


class FaultCard(QFrame):
    """One card; repetitions of its code are counted."""

    def __init__(
        self, text: CardText, on_button: Callable[[CardText], None], on_fold: Callable[[], None]
    ) -> None:
        super().__init__()
        self.text, self.count = text, 1
        self.setProperty("role", text.role)
        self._title = base.label("", "head", wrap=True)
        self._then, self._foot = base.label("", wrap=True), base.label("", "small")
        self._details = QPlainTextEdit(text.details or self._plain())
        self._details.setReadOnly(True)
        self._details.setAccessibleName(base.tr("Details of the fault"))
        self._details.setMaximumHeight(140)
        self._details.hide()
        self._on_button = on_button
        self.more = QPushButton()
        self.more.hide()
        self.fold = self._button("Fold", on_fold)
        self.fold.setToolTip(base.tr("Fold the cards into one line, to see the page below"))
        self._arrange()
        self._show_count()

    def again(self, text: CardText) -> None:
        """Count a repetition and show the newest text."""
        before, self.text = self.text, text
        self.count += 1
        if (text.details or text) != (before.details or before):
            # The layout of a document is slow, and repetitions can come with every frame.
            self._details.setPlainText(text.details or self._plain())
        self._show_count()

    def _show_count(self) -> None:
        times = f" (\N{MULTIPLICATION SIGN}{self.count})" if self.count > 1 else ""
        self._title.setText(base.tr(self.text.what) + times)
        then = f"{base.tr(self.text.consequence)} {base.tr(self.text.next_step)}".strip()
        self._then.setText(then)
        self._then.setVisible(bool(then))
        self._foot.setText(f"[{self.text.code}]  {self.text.at}")
        self.setAccessibleName(self._plain())

    def _plain(self) -> str:
        t = self.text
        texts = (base.tr(text) for text in (t.what, t.consequence, t.next_step))
        return f"{' '.join(texts)} [{t.code}]"

    def _arrange(self) -> None:
        words = base.vbox(self._title, self._then, self._foot, spacing=2)
        shown = self._details
        details = self._button("Details", lambda: shown.setVisible(shown.isHidden()))
        row = base.hbox(1, self.more, self.fold, details, self._button("Copy", self._copy))
        if self.text.offer is not None:
            self.offer = self._button(self.text.offer[0], self._accept)
            self.offer.setProperty("role", "primary")
            row.addWidget(self.offer)
        last = "Reset" if self.text.reset else "Dismiss"
        end = self._button(last, self._act)
        if self.text.reset:
            end.setProperty("role", "reset")
            end.setToolTip(base.tr("Clear latched faults and the stop. Nothing starts to move."))
        row.addWidget(end)
        self._line = QBoxLayout(QBoxLayout.Direction.LeftToRight)
        base.add_items(self._line, (words, 1), row)
        base.vbox(self._line, self._details, parent=self, margins=(12, 8, 10, 8))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Put the buttons below the text of a narrow card."""
        super().resizeEvent(event)
        way = QBoxLayout.Direction
        wide = self.width() > LEAST_EM * self.fontMetrics().height()
        self._line.setDirection(way.LeftToRight if wide else way.TopToBottom)

    def _button(self, text: str, slot: Callable[[], None]) -> QPushButton:
        button = QPushButton(base.tr(text))
        button.setAccessibleName(f"{base.tr(text)}: {base.tr(self.text.what)}")
        button.clicked.connect(slot)
        return button

    def _copy(self) -> None:
        QGuiApplication.clipboard().setText(f"{self._plain()}\n{self._details.toPlainText()}")

    def _accept(self) -> None:
        assert self.text.offer is not None
        act = self.text.offer[1]
        self._act()
        act()

    def _act(self) -> None:
        self._on_button(self.text)


class FoldedCards(QFrame):
    """One line in the foot of the window with the first card and buttons to show or reset all."""

    def __init__(
        self, parent: QWidget, on_show: Callable[[], None], on_reset: Callable[[], None]
    ) -> None:
        super().__init__(parent)
        self.setProperty("role", "fault")
        self._words = base.ElidedLabel("title")
        self._words.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Preferred)
        self.show_all, self.reset = QPushButton(base.tr("Show")), QPushButton(base.tr("Reset"))
        self.reset.setProperty("role", "reset")
        for button in (self.show_all, self.reset):
            button.setProperty("low", "yes")
        self.show_all.clicked.connect(on_show)
        self.reset.clicked.connect(on_reset)
        base.hbox((self._words, 1), self.show_all, self.reset, parent=self, margins=(8, 0, 0, 0))
        self.hide()

    def show_first(self, text: CardText, count: int) -> None:
        """Show the first of ``count`` cards."""
        what = base.tr(text.what)
        self._words.setText(f"{what} (+{count - 1})" if count > 1 else what)
        self._words.setToolTip(what)
        self.show_all.setAccessibleName(base.tr("Show: {}", what))
        self.reset.setAccessibleName(base.tr("Reset: {}", what))
        self.reset.setVisible(text.reset)
        base.set_property(self, "role", text.role)
        self.show()


class _CardScroll(QScrollArea):
    """Cards at their full height, which scroll in a low window."""

    def __init__(self, cards: QWidget) -> None:
        super().__init__()
        self._cards = cards
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setWidget(cards)
        policy = QSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)
        policy.setHeightForWidth(True)
        self.setSizePolicy(policy)

    def heightForWidth(self, width: int, /) -> int:
        return self._cards.heightForWidth(width)

    def sizeHint(self) -> QSize:
        return self._cards.sizeHint()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Follow the height of the cards."""
        if event.type() is QEvent.Type.LayoutRequest and watched is self._cards:
            self.updateGeometry()
        return super().eventFilter(watched, event)


class FaultCards(QWidget):
    """Queue of cards with at most one question; takes no room while empty.

    The newest of question and latched cards is in front. Answers of questions stand at the left,
    buttons of cards at the right, so that no button takes the place of one with another meaning.
    """

    def __init__(self, on_reset: Callable[[], None]) -> None:
        super().__init__()
        self.reset = on_reset
        self._cards: dict[str, FaultCard] = {}
        self._question: QFrame | None = None
        self.asks: CardQuestion | None = None  # the present question
        self._asked_last = False  # the question is newer than the latched cards
        self._more: QPushButton | None = None  # of the question
        self._unfolded = False
        self.folded = False  # True while the cards are one line in the foot of the window
        self.strip = FoldedCards(self, self._unfold_line, on_reset)
        inside = QWidget()
        self._column = base.vbox(parent=inside, margins=(10, 0, 10, 8), spacing=6)
        base.vbox(_CardScroll(inside), parent=self, margins=(0, 0, 0, 0))
        self.hide()

    @property
    def codes(self) -> tuple[str, ...]:
        """Codes of the cards shown, oldest first."""
        return tuple(card.text.code for card in self._cards.values())

    @property
    def obstacles(self) -> tuple[str, ...]:
        """Codes of the cards that a run waits for."""
        return tuple(card.text.code for card in self._cards.values() if card.text.obstacle)

    def card(self, code: str) -> FaultCard:
        """Return the newest card of ``code``; raises KeyError if there is none."""
        for card in reversed(self._cards.values()):
            if card.text.code == code:
                return card
        raise KeyError(code)

    def show_card(self, text: CardText) -> None:
        """Add a card, or count a repetition of the same code."""
        if text.key in self._cards:
            card = self._cards[text.key] = self._cards.pop(text.key)
            card.again(text)
        else:
            old = [card.text.key for card in self._ranked() if not card.text.notice]
            if len(old) >= MAX_CARDS:
                self._remove(old[-1])
            self.folded = False  # a new card must be read
            card = FaultCard(text, self._pressed, self.fold)
            card.more.clicked.connect(self._unfold)
            self._cards[text.key] = card
        self._asked_last = self._asked_last and not text.reset
        self._lay_out()

    def ask(self, question: CardQuestion, *, front: bool = True) -> None:
        """Show a question in place of the former one; a focus on that moves to the new one.

        ``front``: False leaves the question behind newer cards.
        """
        focus = QGuiApplication.focusObject()
        focused = self._question is not None and focus in self._question.children()
        self.withdraw()
        frame = QFrame()
        frame.setProperty("role", "question")
        self._more = QPushButton()
        self._more.clicked.connect(self._unfold)
        buttons = []
        for text, action in question.answers:
            answer = QPushButton(base.tr(text))
            answer.setMinimumWidth(ANSWER_EM * self.fontMetrics().height())
            answer.clicked.connect(lambda _=False, action=action: self._answer(action))
            answer.setAccessibleName(f"{base.tr(text)}: {base.tr(question.text)}")
            buttons.append(answer)
        words = base.label(question.text, "title", wrap=True), QUESTION_PX
        base.FlowLayout(*buttons, self._more, words, parent=frame, margins=(9, 9, 9, 9), spacing=6)
        self._question, self.asks = frame, question
        self._asked_last = front or self._asked_last
        self.folded = self.folded and not front
        QApplication.instance().installEventFilter(self)  # type: ignore[union-attr]
        self._lay_out()
        if focused:
            frame.findChildren(QPushButton)[0].setFocus()

    def _answer(self, action: Callable[[], object]) -> None:
        self.withdraw()
        action()

    def withdraw(self) -> None:
        """Remove the question."""
        if self._question is not None:
            self._question.hide()
            self._question.deleteLater()
            self._question = self._more = self.asks = None
            QApplication.instance().removeEventFilter(self)  # type: ignore[union-attr]
        self._lay_out()

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Give the first answer with Esc while a question is in front."""
        asked = self.asks
        if not isinstance(event, QKeyEvent) or event.key() != Qt.Key.Key_Escape or asked is None:
            return False
        mine = watched is self.window().windowHandle() and self._question is not None
        if not mine or self._question.isHidden():  # type: ignore[union-attr]
            return False
        if event.type() is QEvent.Type.KeyPress and not event.isAutoRepeat():
            self._answer(asked.answers[0][1])
        event.accept()
        return True

    def fold(self) -> None:
        """Fold all cards into one line in the foot of the window."""
        self.folded = True
        self._lay_out()

    def show_offer(self, code: str, on: bool) -> None:
        """Show or hide the button for the next step on the card of ``code``."""
        for card in self._cards.values():
            if card.text.code == code and card.text.offer is not None:
                card.offer.setVisible(on)

    def pass_on(self) -> None:
        """Remove the cards of refused commands after an accepted one."""
        self.clear([card.text.code for card in self._cards.values() if card.text.passing])

    def clear(self, codes: Sequence[str] | None = None) -> None:
        """Remove the latched cards, or those of ``codes``."""
        for key, card in list(self._cards.items()):
            if card.text.reset if codes is None else card.text.code in codes:
                self._remove(key)
        self._lay_out()

    def _pressed(self, text: CardText) -> None:
        if text.reset:
            self.reset()
        else:
            self._remove(text.key)
            self._lay_out()

    def _remove(self, key: str) -> None:
        card = self._cards.pop(key)
        self._column.removeWidget(card)
        card.hide()
        card.deleteLater()

    def _ranked(self) -> list[FaultCard]:
        """Return the cards from the top: STOP, others that wait for Reset, then the newest."""
        newest = reversed(self._cards.values())
        return sorted(newest, key=lambda c: (c.text.code != STOPPED, not c.text.reset))

    def _unfold(self) -> None:
        self._unfolded = not self._unfolded
        self._lay_out()

    def _unfold_line(self) -> None:
        self.folded = False
        self._lay_out()

    def _lay_out(self) -> None:
        """Show what is in front, everything if unfolded, or one line if folded."""
        ranked = self._ranked()
        self._unfolded = self._unfolded and len(ranked) + (self._question is not None) > 1
        self.folded = self.folded and bool(ranked)
        if self.folded:
            self.strip.show_first(ranked[0].text, len(ranked))
        else:
            self.strip.hide()
        front = self._question is not None and (self._asked_last or not ranked)
        waiting = len(ranked) + (self._question is not None) - 1
        for place, card in enumerate(ranked):
            self._column.removeWidget(card)
            self._column.addWidget(card)
            first = place == 0 and not front
            card.setVisible(not self.folded and (first or self._unfolded))
            card.more.setVisible(first and waiting > 0)
        if self._question is not None and self._more is not None:
            self._column.insertWidget(0 if front else -1, self._question)
            self._question.setVisible(front or self._unfolded)
            self._more.setVisible(front and waiting > 0)
        text = base.tr("Fewer") if self._unfolded else base.tr("{} more", waiting)
        for more in filter(None, (self._more, *(card.more for card in ranked[:1]))):
            more.setText(text)
            more.setAccessibleName(base.tr("{}: the other cards", text))
        shown = bool(ranked) and not self.folded
        self.setVisible(shown or self._question is not None)


class UnsavedBanner(QFrame):
    """Banner shown while a label is unsaved."""

    def __init__(self, again: Callable[[], None], discard: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "fault")
        self.setAccessibleName(base.tr("Unsaved label"))
        self.text = base.label("", wrap=True)
        self.again = QPushButton(base.tr("Save again (Enter)"))
        self.discard = QPushButton(base.tr("Discard (Esc)"))
        base.hbox((self.text, 1), self.again, self.discard, parent=self, margins=(12, 8, 10, 8))
        self.again.clicked.connect(again)
        self.discard.clicked.connect(discard)
        self.hide()

    def show_trouble(self, what: str, *, waits: bool = False, saved: bool = False) -> None:
        """Show the reason; "" hides the banner. ``waits``: saving is retried automatically.

        ``saved``: the label is saved, but its second copy in the journal or the backup is not.
        """
        second = base.tr("The label is saved, but has no second copy: {}", what)
        self.text.setText((second if saved else base.tr("Not saved: {}", what)) if what else "")
        for button in (self.again, self.discard):
            button.setVisible(not waits)
        appears = bool(what) and self.isHidden()
        self.setVisible(bool(what))
        if appears:
            base.scroll_into_view(self)
