"""The striped sign that this bench is simulated: nothing here moves a real robot."""

from __future__ import annotations

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.theme import Theme, ui_font


class SimulatedBanner(QWidget):
    """Diagonal stripes with the word on a plain ground."""

    def __init__(self, theme: Theme, word: str = "SIMULATED BENCH") -> None:
        super().__init__()
        self._theme, self._word = theme, word
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.setAccessibleName("Simulated bench: no hardware is connected")
        self.setToolTip("No hardware is connected. Everything you see is computed.")

    def sizeHint(self) -> QSize:
        """Return room for the word and some stripes on either side."""
        self.setFont(ui_font(self._theme.scale, 0.86, 600))
        metrics = self.fontMetrics()
        return QSize(metrics.horizontalAdvance(self._word) + 84, metrics.height() + 6)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw stripes and word."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t = self._theme.tokens
        painter.fillRect(self.rect(), t.colour("pill_yellow"))
        painter.setPen(Qt.PenStyle.NoPen)
        painter.setBrush(t.colour("on_light"))
        height = self.height()
        for x in range(-height, self.width() + height, 14):
            xs = ((x, height), (x + 7, height), (x + 7 + height, 0), (x + height, 0))
            painter.drawPolygon(QPolygonF([QPointF(*corner) for corner in xs]))
        plate = QRectF(30, 2, self.width() - 60, height - 4)
        painter.setBrush(t.colour("pill_yellow"))
        painter.drawRect(plate)
        painter.setPen(QPen(t.colour("on_light")))
        painter.setFont(ui_font(self._theme.scale, 0.86, 600))
        painter.drawText(plate, int(Qt.AlignmentFlag.AlignCenter), self._word)
