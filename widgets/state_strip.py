"""One line about one label: its state on a chip, badges, and when it was saved."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.label_list import CHIPS
from widgets.theme import Theme, ui_font


class StateStrip(QWidget):
    """Chips on the left, what was saved on the right."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self.state, self.badges, self.saved = "", tuple[str, ...](), ""
        self.warns = False
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def sizeHint(self) -> QSize:
        """Return one line."""
        return QSize(200, round(1.6 * self.fontMetrics().height()))

    def show_label(
        self, state: str, badges: Sequence[str], saved: str, *, warns: bool = False
    ) -> None:
        """Show another label; ``warns``: the first badge is a warning."""
        self.state, self.badges, self.saved, self.warns = state, tuple(badges), saved, warns
        self.setAccessibleName(", ".join(filter(None, (state, *badges, saved))))
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
            left = self._chip(painter, left, self.state, *CHIPS[self.state])
        for number, badge in enumerate(self.badges):
            colours = ("pill_yellow", "on_light") if self.warns and not number else ("raised", "")
            if left + painter.fontMetrics().horizontalAdvance(badge) + 20 <= room:
                left = self._chip(painter, left, badge, *colours)

    def _chip(self, painter: QPainter, left: float, word: str, fill: str, text: str) -> float:
        t = self._theme.tokens
        width = painter.fontMetrics().horizontalAdvance(word) + 16
        box = QRectF(left + 0.5, 1.5, width, self.height() - 3)
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour(fill))
        painter.drawRoundedRect(box, 5, 5)
        painter.setPen(t.colour(text or "text"))
        painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), word)
        return left + width + 6
