"""What each measurement leaves over, as bars against the limit."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.overlay import draw_message
from widgets.theme import Theme, ui_font

MOST_BARS = 126


class ResidualBars(QWidget):
    """Sizes of the residuals; the dashed line is the limit of the figure that counts."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._sizes: tuple[float, ...] = ()
        self._limit, self._unit, self._counts = 1.0, "", ""
        self.empty = ""
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setAccessibleName("Residuals")

    def sizeHint(self) -> QSize:
        """Return a comfortable size."""
        em = round(10 * self._theme.scale)
        return QSize(36 * em, 11 * em)

    def minimumSizeHint(self) -> QSize:
        """Return the least size in which bars can be told apart."""
        return QSize(200, 80)

    def show_residuals(
        self, residuals: Sequence[float], limit: float, unit: str, counts: str
    ) -> None:
        """Show signed ``residuals`` by size; ``counts``: the figure that the limit is for."""
        self._sizes = tuple(abs(value) for value in residuals[:MOST_BARS])
        self._limit, self._unit, self._counts = limit, unit, counts
        largest = max(self._sizes, default=0.0)
        self.setAccessibleDescription(f"largest {largest:.3g} {unit}, limit {limit:g} {unit}")
        self.update()

    def show_empty(self, text: str) -> None:
        """Show ``text`` while there is nothing to draw."""
        if text != self.empty:
            self.empty = text
            if not self._sizes:
                self.setAccessibleDescription(text)
            self.update()

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the bars."""
        painter = QPainter(self)
        try:
            painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
            painter.setFont(ui_font(self._theme.scale, 0.85))
            if not self._sizes:
                draw_message(
                    painter, self.rect(), self._theme, "Not measured since the start", self.empty
                )
                return
            self._draw(painter)
        finally:
            painter.end()

    def _draw(self, painter: QPainter) -> None:
        tokens, metrics = self._theme.tokens, painter.fontMetrics()
        line = metrics.height()
        area = QRectF(self.rect()).adjusted(8, line + 6, -8, -(line + 6))
        top = 1.15 * max(self._limit, *self._sizes)
        step = area.width() / len(self._sizes)
        for index, size in enumerate(self._sizes):
            high = area.height() * size / top
            bar = QRectF(
                area.left() + index * step + 0.12 * step, area.bottom() - high, 0.76 * step, high
            )
            beyond = self._counts == "largest" and size > self._limit
            painter.fillRect(bar, tokens.colour("bad" if beyond else "axis_x"))
        y = area.bottom() - area.height() * self._limit / top
        painter.setPen(QPen(tokens.colour("text"), 1.5, Qt.PenStyle.DashLine))
        painter.drawLine(area.left(), y, area.right(), y)  # type: ignore[call-overload]
        painter.setPen(tokens.colour("muted"))
        painter.drawLine(area.bottomLeft(), area.bottomRight())
        painter.drawText(8, line, f"limit of the {self._counts}: {self._limit:g} {self._unit}")
        painter.drawText(8, self.height() - 5, f"{len(self._sizes)} residuals")
