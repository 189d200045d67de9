"""Tx over Ty of one probe: how the line of force wanders over the face while pressing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QImage, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme, ui_font
from widgets.trace_sheet import Paper, WrenchTrace, paper_of

LEAST_NM = 0.02
MOST_POINTS = 400


@dataclass(frozen=True, slots=True)
class PhaseSheet:
    """The drawn part: axes, and the whole path faintly; by any thread."""

    paper: Paper

    def area(self, trace: WrenchTrace | None) -> PlotArea:
        """Return the square that is drawn, centred on the path."""
        em = self.paper.em
        side = max(min(self.paper.width - 3.2 * em, self.paper.height - 3.0 * em), 30.0)
        rect = QRectF(2.9 * em, 1.4 * em, side, side)
        if trace is None:
            return PlotArea(rect, -1.0, 1.0, -1.0, 1.0)
        moments = trace.values[:, 3:5]
        moments = moments[np.isfinite(moments).all(axis=1)]
        low, high = moments.min(axis=0), moments.max(axis=0)
        half = 0.55 * max(float((high - low).max()), LEAST_NM)
        x, y = ((low + high) / 2).tolist()
        return PlotArea(rect, x - half, x + half, y - half, y + half)

    def draw(self, trace: WrenchTrace) -> QImage:
        """Return axes and path of a trace with moments."""
        image, area = self.paper.blank(), self.area(trace)
        painter = QPainter(image)
        try:
            self._draw_axes(painter, area)
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self.paper.tokens.colour("border"), 1))
            step = step_of(trace)
            painter.drawPolyline(area.polygon(trace.values[::step, 3], trace.values[::step, 4]))
        finally:
            painter.end()
        return image

    def _draw_axes(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self.paper.tokens, area.rect
        painter.fillRect(rect, t.colour("bg"))
        painter.setFont(ui_font(self.paper.scale, 0.8))
        height = painter.fontMetrics().height()
        step = nice_step(area.x1 - area.x0, 4)
        painter.setPen(t.colour("muted"))
        for value in ticks(area.x0, area.x1, 4):
            box = QRectF(area.x(value) - 30, rect.bottom() + 2, 60, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignHCenter), tick_text(value, step))
        for value in ticks(area.y0, area.y1, 4):
            box = QRectF(0, area.y(value) - height / 2, rect.left() - 5, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), tick_text(value, step))
        above = QRectF(0, rect.top() - height - 3, self.paper.width, height)
        painter.drawText(above, int(Qt.AlignmentFlag.AlignLeft), "Ty over Tx (N·m)")


PhaseDrawn = tuple[PhaseSheet, QImage]


def has_moments(trace: WrenchTrace) -> bool:
    """Whether there is a path to draw."""
    return bool(np.isfinite(trace.values[:, 3:5]).all(axis=1).any())


def step_of(trace: WrenchTrace) -> int:
    """Return which samples are drawn: every so many."""
    return max(len(trace.t_s) // MOST_POINTS, 1)


class PhasePlot(QWidget):
    """Draws the path of (Tx, Ty) up to the cursor strongly, the rest faintly."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._trace: WrenchTrace | None = None
        self._cursor_s = 0.0
        self._why_empty = "No moments"
        self._drawn: PhaseDrawn | None = None
        self.setAccessibleName("Moment Tx over moment Ty")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(140, 110)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a square."""
        return QSize(150, 150)

    def show_trace(
        self, trace: WrenchTrace | None, drawn: PhaseDrawn | None = None, why: str = "No moments"
    ) -> None:
        """Show another probe, or ``why`` there is nothing; ``drawn`` is used if it fits."""
        self._trace, self._drawn, self._why_empty = trace, drawn, why
        self.update()

    def sheet(self) -> PhaseSheet:
        """Return what is drawn on now."""
        return PhaseSheet(paper_of(self, self._theme))

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self._cursor_s = t_s
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Copy axes and path, then draw what was until now and the present place."""
        painter = QPainter(self)
        trace = self._trace
        if trace is None or not has_moments(trace):
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, self._why_empty)
            return
        sheet = self.sheet()
        if self._drawn is None or self._drawn[0] != sheet:
            self._drawn = sheet, sheet.draw(trace)
        painter.drawImage(0, 0, self._drawn[1])
        area = sheet.area(trace)
        painter.setClipRect(area.rect)
        until = int(np.searchsorted(trace.t_s, self._cursor_s, side="right"))
        x, y, step = trace.values[:, 3], trace.values[:, 4], step_of(trace)
        t = self._theme.tokens
        painter.setPen(QPen(t.colour("axis_x"), 1))
        painter.drawPolyline(area.polygon(x[:until:step], y[:until:step]))
        if until:
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setPen(QPen(t.colour("text"), 2))
            painter.setBrush(t.colour("bg"))
            painter.drawEllipse(QPointF(area.x(x[until - 1]), area.y(y[until - 1])), 4, 4)
