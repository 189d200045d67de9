"""Card of the tour."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QPoint, QRect, QSize, Qt
from PySide6.QtGui import QColor, QKeyEvent, QPainter, QPaintEvent, QPen, QRegion
from PySide6.QtWidgets import QFrame, QPushButton, QWidget

from touchdown.widgets.base import ENTER, Theme, hbox, label, push_button, tr, vbox

DIM = 110
MARGIN_PX, RING_PX = 12, 4


@dataclass(frozen=True, slots=True)
class TourStop:
    """One stop. ``workspace`` is shown first ("": any); ``place`` returns the highlighted widget.

    ``place`` is called after the workspace is shown, because its page may not exist before.
    """

    workspace: str
    place: Callable[[], QWidget]
    title: str
    text: str


class Spotlight(QWidget):
    """Dims the window except for one rectangle and the cards; mouse events pass through."""

    def __init__(self, theme: Theme, window: QWidget) -> None:
        super().__init__(window)
        self._theme, self._window = theme, window
        self.hole, self._cards = QRect(), QRect()
        self.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.hide()

    def show_hole(self, hole: QRect, cards: QRect) -> None:
        """Highlight ``hole`` with a ring; ``cards`` stay bright too unless empty."""
        self.hole, self._cards = hole, cards
        self.setGeometry(self._window.rect())
        self.show()
        self.raise_()
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw shade and ring."""
        painter = QPainter(self)
        painter.save()
        bright = QRegion(self.hole).united(QRegion(self._cards))
        painter.setClipRegion(QRegion(self.rect()).subtracted(bright))
        painter.fillRect(self.rect(), QColor(0, 0, 0, DIM))
        painter.restore()
        if not self._cards.isEmpty():
            painter.setClipRegion(QRegion(self.rect()).subtracted(QRegion(self._cards)))
        painter.setPen(QPen(self._theme.tokens.colour("focus"), 3))
        painter.drawRect(self.hole.adjusted(-1, -1, 1, 1))


class TourCard(QFrame):
    """Text of a stop with Back, Next and End."""

    def __init__(
        self, window: QWidget, turn: Callable[[int], None], end: Callable[[], None]
    ) -> None:
        super().__init__(window)
        self.setProperty("role", "question")
        self._window, self._end = window, end
        self.title, self.text = label("", "head", wrap=True), label("", wrap=True)
        self.count = label("", "small")
        self.back, self.next = push_button("Back"), push_button("Next", role="primary")
        tip = "Start it again from the palette: Ctrl+K, tour (Esc)"
        self.end = push_button("End the tour", tip)
        self.back.clicked.connect(lambda: turn(-1))
        self.next.clicked.connect(lambda: turn(1))
        self.end.clicked.connect(end)
        row = hbox(self.count, 1, self.end, self.back, self.next)
        vbox(self.title, self.text, row, parent=self, margins=(14, 10, 12, 12), spacing=8)
        self.hide()

    def show_stop(self, stop: TourStop, at: int, count: int) -> None:
        """Show the texts of stop ``at`` of ``count``."""
        self.title.setText(tr(stop.title))
        self.text.setText(tr(stop.text))
        self.count.setText(tr("{} of {}", at + 1, count))
        self.back.setEnabled(at > 0)
        self.next.setText(tr("Done" if at == count - 1 else "Next"))
        self.setAccessibleName(tr("Tour: {}. {}", self.title.text(), self.text.text()))
        self.show()
        self.raise_()
        self.next.setFocus()

    def fit(self, hole: QRect, top: int, bottom: int) -> None:
        """Place the card beside the highlight, between ``top`` (STOP stays free) and ``bottom``."""
        em = self.fontMetrics().height()
        width = min(24 * em, self._window.width() - 2 * MARGIN_PX)
        width = max(width, self.minimumSizeHint().width())  # of the buttons
        self.setFixedWidth(width)
        high = max(self.heightForWidth(width), self.minimumSizeHint().height())
        self.resize(width, high)
        corner = card_position(hole, self.size(), self._window.rect())
        self.move(corner.x(), max(min(corner.y(), bottom - high - MARGIN_PX), top))

    def event(self, event: QEvent) -> bool:
        """Claim Enter and Esc before the shortcuts of the page."""
        is_key = isinstance(event, QKeyEvent) and event.key() in (*ENTER, Qt.Key.Key_Escape)
        if is_key and event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """End with Esc; press the focused button with Enter."""
        focus = self.focusWidget()
        if event.key() == Qt.Key.Key_Escape:
            self._end()
        elif event.key() in ENTER and isinstance(focus, QPushButton):
            focus.click()
        else:
            super().keyPressEvent(event)


def card_position(hole: QRect, card: QSize, window: QRect) -> QPoint:
    """Return the card position right, left, below or above ``hole``, else inside it."""
    gap = MARGIN_PX
    y = min(max(hole.top(), gap), window.height() - card.height() - gap)
    x = min(max(hole.left(), gap), window.width() - card.width() - gap)
    for corner in (
        QPoint(hole.right() + gap, y),
        QPoint(hole.left() - gap - card.width(), y),
        QPoint(x, hole.bottom() + gap),
        QPoint(x, hole.top() - gap - card.height()),
    ):
        if window.contains(QRect(corner, card)):
            return corner
    return QPoint(x, y)
