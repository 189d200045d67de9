"""State of bench and editor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import (
    QAccessible,
    QAccessibleAnnouncementEvent,
    QColor,
    QFontMetrics,
    QPainter,
    QPaintEvent,
    QPen,
    QPolygonF,
)
from PySide6.QtWidgets import QSizePolicy, QWidget

from touchdown.widgets.base import Theme, tr, ui_font
from touchdown.widgets.lists import STATE_COLOURS

Colour = Literal["grey", "blue", "green", "yellow", "red"]
Shape = Literal["ring", "disc", "play", "bars", "square", "triangle", "diamond", "bang"]
DARK_TEXT: frozenset[Colour] = frozenset({"green", "yellow"})


@dataclass(frozen=True, slots=True)
class PillState:
    """Content of the pill; ``note`` is a small second line. Each state has its own shape."""

    word: str
    shape: Shape
    colour: Colour
    note: str = ""


class StatePill(QWidget):
    """Filled rounded box with a shape and a word."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self.state = PillState("NO DEVICES", "ring", "grey")
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.setAccessibleName(tr("State: NO DEVICES"))

    def show_state(self, state: PillState) -> None:
        """Show a state and announce it to screen readers."""
        if state == self.state:
            return
        told, self.state = self.state.word, state
        self.setAccessibleName(tr("State: {}", tr(state.word)))
        self.setAccessibleDescription(tr(state.note))
        if state.word != told and QAccessible.isActive():
            QAccessible.updateAccessibility(QAccessibleAnnouncementEvent(self, tr(state.word)))
        self.updateGeometry()
        self.update()

    def sizeHint(self) -> QSize:
        """Return room for the longest common word, so that the bar does not jump."""
        word = QFontMetrics(ui_font(self._theme.scale, 1.0, 600))
        note = QFontMetrics(ui_font(self._theme.scale, 0.78))
        width = max(word.horizontalAdvance(tr(w)) for w in (self.state.word, "CANCELLING"))
        width = max(width, note.horizontalAdvance(tr("simulated, reference")))
        return QSize(width + self._left_px() + 16, 2 * note.height() + 8)

    def _left_px(self) -> int:
        """Return the left edge of the text; the mark before it scales with the font."""
        return round(24 + 12 * max(self._theme.scale, 1.0))

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw box, shape and word."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t = self._theme.tokens
        ink = t.colour("on_light" if self.state.colour in DARK_TEXT else "on_dark")
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour(f"pill_{self.state.colour}"))
        painter.drawRoundedRect(QRectF(self.rect()).adjusted(0.5, 0.5, -0.5, -0.5), 6, 6)
        left = self._left_px()
        size = (left - 24) / 2
        draw_shape(painter, self.state.shape, QPointF(14 + size, self.height() / 2), ink, size)
        painter.setPen(ink)
        painter.setFont(ui_font(self._theme.scale, 1.0, 600))
        middle = self.height() / 2 if self.state.note else self.height()
        box = QRectF(left, 0, self.width() - left - 4, middle + 3 * bool(self.state.note))
        low, centre = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignVCenter
        painter.drawText(box, int(low if self.state.note else centre), tr(self.state.word))
        if self.state.note:
            painter.setFont(ui_font(self._theme.scale, 0.78))
            box = QRectF(left, middle + 1, self.width() - left - 4, middle)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignTop), tr(self.state.note))


def draw_shape(
    painter: QPainter,
    shape: Shape,
    at: QPointF,
    ink: QColor,
    size: float = 6,
    rim: QColor | None = None,
) -> None:
    """Draw a state icon of half size ``size`` centred at ``at``; ``rim``: colour of its outline."""
    painter.setPen(QPen(rim or ink, 1.3 if rim else 2))
    painter.setBrush(ink)
    x, y, s = at.x(), at.y(), size
    if shape == "ring":
        painter.setBrush(Qt.BrushStyle.NoBrush)
        painter.drawEllipse(at, s - 1, s - 1)
    elif shape == "disc":
        painter.drawEllipse(at, s - 1.5, s - 1.5)
    elif shape == "bars":
        painter.drawRect(QRectF(x - s + 1, y - s + 1, 2, 2 * s - 2))
        painter.drawRect(QRectF(x + s - 4, y - s + 1, 2, 2 * s - 2))
    elif shape == "bang":
        painter.drawRect(QRectF(x - 1, y - s + 1, 2, 1.2 * s))
        painter.drawEllipse(QPointF(x, y + s - 1.5), 1.0, 1.0)
    elif shape == "square":
        painter.drawRect(QRectF(x - s + 1.5, y - s + 1.5, 2 * s - 3, 2 * s - 3))
    else:
        corners = {
            "play": ((-s + 2, -s + 1), (-s + 2, s - 1), (s - 1, 0)),
            "triangle": ((0, -s + 1), (s - 1, s - 2), (-s + 1, s - 2)),
            "diamond": ((0, -s), (s, 0), (0, s), (-s, 0)),
        }[shape]
        painter.drawPolygon(QPolygonF([QPointF(x + dx, y + dy) for dx, dy in corners]))


class StateStrip(QWidget):
    """Chips at the left, time of saving at the right."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self.state, self.badges, self.saved = "", tuple[str, ...](), ""
        self.warns = False
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:
        """Return one line of text."""
        return QSize(200, round(1.6 * self.fontMetrics().height()))

    def show_label(
        self, state: str, badges: Sequence[str], saved: str, *, warns: bool = False
    ) -> None:
        """Show a label; ``warns``: its first badge is a warning."""
        self.state, self.badges, self.saved, self.warns = state, tuple(badges), saved, warns
        self.setAccessibleName(", ".join(filter(None, (tr(state), *badges, saved))))
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw chips and text."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(ui_font(self._theme.scale, 0.9))
        saved_width = painter.fontMetrics().horizontalAdvance(self.saved)
        painter.setPen(self._theme.tokens.colour("muted"))
        right = int(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        painter.drawText(QRectF(self.rect()), right, self.saved)
        room = self.width() - saved_width - 10
        left = 0.0
        painter.setFont(ui_font(self._theme.scale, 0.85, 600))
        if self.state:
            left = self._chip(painter, left, self.state, *STATE_COLOURS[self.state])
        for number, badge in enumerate(self.badges):
            colours = ("pill_yellow", "on_light") if self.warns and not number else ("raised", "")
            if left + painter.fontMetrics().horizontalAdvance(badge) + 20 <= room:
                left = self._chip(painter, left, badge, *colours)

    def _chip(self, painter: QPainter, left: float, word: str, fill: str, text: str) -> float:
        t = self._theme.tokens
        word = tr(word)
        width = painter.fontMetrics().horizontalAdvance(word) + 16
        box = QRectF(left + 0.5, 1.5, width, self.height() - 3)
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour(fill))
        painter.drawRoundedRect(box, 5, 5)
        painter.setPen(t.colour(text or "text"))
        painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), word)
        return left + width + 6
