"""Tx over Ty of one probe: how the line of force wanders over the face while pressing."""

from __future__ import annotations

import numpy as np
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.recorded_traces import WrenchTrace
from widgets.theme import Theme, ui_font

LEAST_NM = 0.02


class PhasePlot(QWidget):
    """Draws the path of (Tx, Ty) up to the cursor strongly, the rest faintly."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._trace: WrenchTrace | None = None
        self._cursor_s = 0.0
        self.setAccessibleName("Moment Tx over moment Ty")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(140, 110)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a square."""
        return QSize(150, 150)

    def show_trace(self, trace: WrenchTrace | None) -> None:
        """Show another probe."""
        self._trace = trace
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self._cursor_s = t_s
        self.update()

    def area(self) -> PlotArea:
        """Return the square that is drawn, centred on the path."""
        em = self.fontMetrics().height()
        side = max(min(self.width() - 3.2 * em, self.height() - 1.9 * em), 30.0)
        rect = QRectF(2.9 * em, 0.3 * em, side, side)
        if self._trace is None:
            return PlotArea(rect, -1.0, 1.0, -1.0, 1.0)
        moments = self._trace.values[:, 3:5]
        moments = moments[np.isfinite(moments).all(axis=1)]
        low, high = moments.min(axis=0), moments.max(axis=0)
        half = 0.55 * max(float((high - low).max()), LEAST_NM)
        x, y = ((low + high) / 2).tolist()
        return PlotArea(rect, x - half, x + half, y - half, y + half)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw axes, path and the present place."""
        painter = QPainter(self)
        painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
        trace = self._trace
        if trace is None or not np.isfinite(trace.values[:, 3:5]).all(axis=1).any():
            draw_message(painter, self.rect(), self._theme, "No moments")
            return
        area = self.area()
        self._draw_axes(painter, area)
        painter.setClipRect(area.rect)
        until = int(np.searchsorted(trace.t_s, self._cursor_s, side="right"))
        x, y = trace.values[:, 3], trace.values[:, 4]
        step = max(len(x) // 400, 1)
        t = self._theme.tokens
        painter.setPen(QPen(t.colour("border"), 1))
        painter.drawPolyline(area.polygon(x[::step], y[::step]))
        painter.setPen(QPen(t.colour("axis_x"), 1))
        painter.drawPolyline(area.polygon(x[:until:step], y[:until:step]))
        if until:
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setPen(QPen(t.colour("text"), 2))
            painter.setBrush(t.colour("bg"))
            painter.drawEllipse(QPointF(area.x(x[until - 1]), area.y(y[until - 1])), 4, 4)

    def _draw_axes(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self._theme.tokens, area.rect
        painter.fillRect(rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.8))
        height = painter.fontMetrics().height()
        step = nice_step(area.x1 - area.x0, 3)
        painter.setPen(t.colour("muted"))
        for value in ticks(area.x0, area.x1, 3):
            box = QRectF(area.x(value) - 30, rect.bottom() + 2, 60, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignHCenter), tick_text(value, step))
        for value in ticks(area.y0, area.y1, 3):
            box = QRectF(0, area.y(value) - height / 2, rect.left() - 5, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), tick_text(value, step))
        corner = rect.adjusted(5, 3, -5, -3)
        low, right = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignRight
        painter.drawText(corner, int(low | right), "Tx (N·m)")
        painter.drawText(corner, int(Qt.AlignmentFlag.AlignLeft), "Ty")
