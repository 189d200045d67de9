"""The ground of the maps in mm: lines, figures and names of the axes."""

from __future__ import annotations

from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QPainter, QPen

from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme


def draw_mm_grid(painter: QPainter, area: PlotArea, theme: Theme, count: int = 6) -> None:
    """Draw about ``count`` lines each way, with figures outside and names inside of the square."""
    t, rect = theme.tokens, area.rect
    painter.fillRect(rect, t.colour("bg"))
    height = painter.fontMetrics().height()
    step = nice_step(area.x1 - area.x0, count)
    for value in ticks(area.x0, area.x1, count):
        x, y = area.x(value), area.y(value)
        painter.setPen(QPen(t.colour("grid"), 1))
        painter.drawLine(QPointF(x, rect.top()), QPointF(x, rect.bottom()))
        painter.drawLine(QPointF(rect.left(), y), QPointF(rect.right(), y))
        painter.setPen(t.colour("muted"))
        text = tick_text(value, step)
        painter.drawText(QRectF(x - 30, rect.bottom() + 3, 60, height),
                         int(Qt.AlignmentFlag.AlignHCenter), text)  # fmt: skip
        painter.drawText(QRectF(rect.left() - 46, y - height / 2, 41, height),
                         int(Qt.AlignmentFlag.AlignRight), text)  # fmt: skip
    corner = rect.adjusted(6, 4, -6, -4)
    low, right = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignRight
    painter.drawText(corner, int(low | right), "x (mm)")
    painter.drawText(corner, int(Qt.AlignmentFlag.AlignLeft), "y (mm)")
