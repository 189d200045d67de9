"""One line of time: what happened when, and the cursor that all views follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QMouseEvent, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme, blend, ui_font


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened; ``strong`` ones are a full line with their word."""

    t_s: float
    word: str
    strong: bool = False


@dataclass(frozen=True, slots=True)
class TimeScene:
    """Span of the line, where signals were recorded, and what happened, in order of time."""

    span_s: tuple[float, float] = (0.0, 0.0)
    recorded_s: tuple[tuple[float, float], ...] = ()
    marks: tuple[Mark, ...] = ()


class TimeLine(QWidget):
    """Draws a ``TimeScene``; ``seek`` is told the time that was pressed or dragged to."""

    def __init__(self, theme: Theme, seek: Callable[[float], None]) -> None:
        super().__init__()
        self._theme, self._seek = theme, seek
        self.scene, self.cursor_s = TimeScene(), 0.0
        self.setAccessibleName("Time line")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return three lines of text."""
        return QSize(400, round(3.6 * self.fontMetrics().height()))

    def show_scene(self, scene: TimeScene) -> None:
        """Show another span."""
        self.scene = scene
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self.cursor_s = t_s
        self.setAccessibleDescription(f"{t_s:.2f} s of {self.scene.span_s[1]:.2f} s")
        self.update()

    def area(self) -> PlotArea:
        """Where times are drawn; a span without length gets one second."""
        em = self.fontMetrics().height()
        low, high = self.scene.span_s
        rect = QRectF(10, 1.3 * em, max(self.width() - 20.0, 10.0), self.height() - 2.6 * em)
        return PlotArea(rect, low, max(high, low + 1.0), 0.0, 1.0)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Move the cursor to where the line was pressed."""
        self._go_to(event)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Move the cursor along."""
        self._go_to(event)

    def _go_to(self, event: QMouseEvent) -> None:
        if event.buttons() & Qt.MouseButton.LeftButton:
            area, (low, high) = self.area(), self.scene.span_s
            share = (event.position().x() - area.rect.left()) / area.rect.width()
            self._seek(min(max(area.x0 + share * (area.x1 - area.x0), low), high))

    # -- drawing ----------------------------------------------------------------------------------

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw recorded spans, marks with the words that fit, times, and the cursor."""
        painter, t, area = QPainter(self), self._theme.tokens, self.area()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.fillRect(self.rect(), t.colour("panel"))
        painter.setFont(ui_font(self._theme.scale, 0.8))
        painter.fillRect(area.rect, t.colour("bg"))
        shade = blend(t.colour("bg"), t.colour("axis_x"), 0.4)
        for start, end in self.scene.recorded_s:
            left = area.x(start)
            painter.fillRect(
                QRectF(left, area.rect.top(), max(area.x(end) - left, 2.0), area.rect.height()),
                shade,
            )
        painter.setPen(QPen(t.colour("border"), 1))
        painter.drawRect(area.rect)
        self._draw_marks(painter, area)
        self._draw_times(painter, area)
        x = area.x(self.cursor_s)
        painter.setPen(QPen(t.colour("focus"), 2.5))
        painter.drawLine(QPointF(x, area.rect.top() - 5), QPointF(x, area.rect.bottom() + 5))

    def _draw_marks(self, painter: QPainter, area: PlotArea) -> None:
        t, free = self._theme.tokens, area.rect.left() - 1.0
        metrics = painter.fontMetrics()
        for mark in self.scene.marks:
            x, half = area.x(mark.t_s), 0.5 * area.rect.height()
            painter.setPen(QPen(t.colour("text" if mark.strong else "muted"), 1.4))
            top = area.rect.top() if mark.strong else area.rect.top() + half
            painter.drawLine(QPointF(x, top), QPointF(x, area.rect.bottom()))
            width = metrics.horizontalAdvance(mark.word) + 4.0
            left = min(max(x - width / 2, area.rect.left()), area.rect.right() - width)
            if mark.strong and left >= free:
                free = left + width + 4
                box = QRectF(left, 0, width, area.rect.top() - 1)
                painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), mark.word)

    def _draw_times(self, painter: QPainter, area: PlotArea) -> None:
        painter.setPen(self._theme.tokens.colour("muted"))
        step = nice_step(area.x1 - area.x0, 8)
        top, height = area.rect.bottom() + 2, painter.fontMetrics().height()
        for value in ticks(area.x0, area.x1, 8):
            text = f"{tick_text(value, step)} s"
            width = painter.fontMetrics().horizontalAdvance(text) + 2.0
            # The outermost times stay whole inside the widget.
            left = min(max(area.x(value) - width / 2, 0.0), self.width() - width)
            box = QRectF(left, top, width, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignHCenter), text)
