"""The sign of the bench: striped where nothing moves a real robot, plain where hardware does."""

from __future__ import annotations

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.theme import Theme, ui_font


class BenchBanner(QWidget):
    """Diagonal stripes with the word on a plain ground; without stripes for real devices."""

    def __init__(self, theme: Theme, word: str = "SIMULATED BENCH") -> None:
        super().__init__()
        self._theme, self._word, self._striped = theme, word, True
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        self.show_bench(word, "No hardware is connected. Everything you see is computed.", True)

    def show_bench(self, word: str, tip: str, striped: bool) -> None:
        """Call the bench ``word``; ``striped``: no hardware moves."""
        self._word, self._striped = word, striped
        self.setAccessibleName(f"{word}: {tip}")
        self.setToolTip(tip)
        self.updateGeometry()
        self.update()

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
        painter.setFont(ui_font(self._theme.scale, 0.86, 600))
        if not self._striped:
            painter.setPen(QPen(t.colour("border")))
            painter.drawRect(self.rect().adjusted(0, 0, -1, -1))
            painter.setPen(QPen(t.colour("text")))
            painter.drawText(self.rect(), int(Qt.AlignmentFlag.AlignCenter), self._word)
            return
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
        painter.drawText(plate, int(Qt.AlignmentFlag.AlignCenter), self._word)
