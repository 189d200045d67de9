"""The six wrench curves of one recorded probe: any of them on one axis, one cursor for all.

Of two units the first is read on the left, the second on the right. The cursor is a time,
not an index: curves and pictures with other rates stand at the same instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QMouseEvent, QPainter, QPaintEvent, QPen, QPixmap
from PySide6.QtWidgets import QSizePolicy, QWidget

from backend.core.flow import FloatArray
from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme, ui_font

NAMES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
LEAST = {"N": 1.0, "N·m": 0.02}
POINTS_PER_COLUMN = 2


@dataclass(frozen=True, slots=True)
class WrenchTrace:
    """``t_s`` (n,) after the contact onset; ``values`` (n, 6): forces in N, moments in N·m."""

    t_s: FloatArray
    values: FloatArray


def unit_of(channel: int) -> str:
    """Return the unit of channel 0..5."""
    return "N" if channel < 3 else "N·m"


class RecordedTraces(QWidget):
    """Draws the chosen channels on one plot; ``seek`` is told the time that was clicked."""

    def __init__(self, theme: Theme, channels: tuple[int, ...], seek: Callable[[float], None]):
        super().__init__()
        self._theme, self._seek = theme, seek
        self.channels = channels
        self.trace: WrenchTrace | None = None
        self.cursor_s = 0.0
        self._drawn: QPixmap | None = None
        self._key: tuple[object, ...] = ()
        self.setAccessibleName("Force and moment of the probe")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(200, 84)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a flat rectangle."""
        return QSize(420, 130)

    def show_trace(self, trace: WrenchTrace | None) -> None:
        """Show another probe."""
        self.trace, self._drawn = trace, None
        self.update()

    def show_channels(self, channels: tuple[int, ...]) -> None:
        """Choose what is drawn."""
        self.channels, self._drawn = channels, None
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self.cursor_s = t_s
        self.setAccessibleDescription(self.summary())
        self.update()

    def at_cursor(self) -> FloatArray:
        """(6,) newest sample not later than the cursor; NaN before the first."""
        if self.trace is None:
            return np.full(6, np.nan)
        index = int(np.searchsorted(self.trace.t_s, self.cursor_s, side="right")) - 1
        return self.trace.values[index] if index >= 0 else np.full(6, np.nan)

    def summary(self) -> str:
        """Return the values at the cursor in words."""
        values = self.at_cursor()
        return ", ".join(_reading(c, values[c]) for c in self.channels)

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Move the cursor to where the plot was pressed."""
        self._go_to(event)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Move the cursor along."""
        self._go_to(event)

    def _go_to(self, event: QMouseEvent) -> None:
        if self.trace is None or not event.buttons() & Qt.MouseButton.LeftButton:
            return
        area = self.area("N")
        share = (event.position().x() - area.rect.left()) / area.rect.width()
        self._seek(area.x0 + min(max(share, 0.0), 1.0) * (area.x1 - area.x0))

    # -- drawing ----------------------------------------------------------------------------------

    def units(self) -> tuple[str, ...]:
        """Units of the chosen channels, left axis first."""
        return tuple(dict.fromkeys(unit_of(c) for c in self.channels))

    def area(self, unit: str) -> PlotArea:
        """Where the curves of ``unit`` are drawn; needs a trace."""
        em = self.fontMetrics().height()
        right = 3.4 * em if len(self.units()) > 1 else 0.6 * em
        rect = QRectF(3.0 * em, 1.5 * em, self.width() - 3.0 * em - right,
                      self.height() - 2.9 * em)  # fmt: skip
        if self.trace is None or not len(self.trace.t_s):
            return PlotArea(rect, 0.0, 2.0, -1.0, 1.0)
        low, high = self._range(unit)
        return PlotArea(rect, float(self.trace.t_s[0]), float(self.trace.t_s[-1]), low, high)

    def _range(self, unit: str) -> tuple[float, float]:
        assert self.trace is not None
        chosen = [c for c in self.channels if unit_of(c) == unit]
        values = self.trace.values[:, chosen]
        finite = values[np.isfinite(values)]
        least = LEAST[unit]
        low = min(float(finite.min()), -least) if len(finite) else -least
        high = max(float(finite.max()), least) if len(finite) else least
        room = 0.06 * (high - low)
        return low - room, high + room

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Copy the curves, then draw cursor and readings."""
        painter = QPainter(self)
        if self.trace is None or len(self.trace.t_s) < 2:
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, "No wrench was recorded")
            return
        painter.drawPixmap(0, 0, self._curves(self.trace))
        self._draw_cursor(painter)

    def _draw_cursor(self, painter: QPainter) -> None:
        t, area = self._theme.tokens, self.area("N")
        x = area.x(min(max(self.cursor_s, area.x0), area.x1))
        painter.setPen(QPen(t.colour("text"), 1))
        painter.drawLine(QPointF(x, area.rect.top()), QPointF(x, area.rect.bottom()))
        painter.setFont(ui_font(self._theme.scale, 0.85, 500))
        values, left = self.at_cursor(), area.rect.left()
        for channel in self.channels:
            text = _reading(channel, values[channel])
            painter.setPen(self._colour(channel))
            painter.drawText(QPointF(left, area.rect.top() - 5), text)
            left += painter.fontMetrics().horizontalAdvance(text) + 8

    def _colour(self, channel: int) -> QColor:
        """Return the colour of the axis; of a pair each has its own, whatever its axis."""
        pair = len(self.channels) == 2
        axis = "xz"[self.channels.index(channel)] if pair else "xyz"[channel % 3]
        return self._theme.tokens.colour(f"axis_{axis}")

    def _curves(self, trace: WrenchTrace) -> QPixmap:
        key = (self.size().toTuple(), self._theme.tokens.name, self._theme.scale)
        if self._drawn is None or key != self._key:
            ratio = self.devicePixelRatioF()
            self._drawn, self._key = QPixmap(self.size() * ratio), key
            self._drawn.setDevicePixelRatio(ratio)
            self._drawn.fill(self._theme.tokens.colour("panel"))
            painter = QPainter(self._drawn)
            try:
                self._draw_axes(painter)
                self._draw_curves(painter, trace)
            finally:
                painter.end()
        return self._drawn

    def _draw_axes(self, painter: QPainter) -> None:
        t, area = self._theme.tokens, self.area("N")
        painter.fillRect(area.rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        height = painter.fontMetrics().height()
        for side, unit in enumerate(self.units()):
            self._draw_scale(painter, self.area(unit), unit, right=side == 1)
        for value in ticks(area.x0, area.x1, 5):
            x = area.x(value)
            painter.setPen(QPen(t.colour("grid"), 1))
            painter.drawLine(QPointF(x, area.rect.top()), QPointF(x, area.rect.bottom()))
            painter.setPen(t.colour("muted"))
            text = f"{tick_text(value, 0.5)} s"
            painter.drawText(QRectF(x - 40, area.rect.bottom() + 2, 80, height),
                             int(Qt.AlignmentFlag.AlignHCenter), text)  # fmt: skip

    def _draw_scale(self, painter: QPainter, area: PlotArea, unit: str, *, right: bool) -> None:
        t, rect = self._theme.tokens, area.rect
        height = painter.fontMetrics().height()
        step = nice_step(area.y1 - area.y0, 4)
        for value in ticks(area.y0, area.y1, 4):
            y = area.y(value)
            if not right:
                painter.setPen(QPen(t.colour("border" if value == 0 else "grid"), 1))
                painter.drawLine(QPointF(rect.left(), y), QPointF(rect.right(), y))
            painter.setPen(t.colour("muted"))
            text = tick_text(value, step)
            if right:
                painter.drawText(QPointF(rect.right() + 5, y + 0.35 * height), text)
            else:
                box = QRectF(0, y - height / 2, rect.left() - 5, height)
                painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), text)
        place = QRectF(0, rect.top() - height - 3, rect.left() - 5, height)
        if right:
            place.moveLeft(rect.right() + 5)
        side = Qt.AlignmentFlag.AlignLeft if right else Qt.AlignmentFlag.AlignRight
        painter.drawText(place, int(side), unit)

    def _draw_curves(self, painter: QPainter, trace: WrenchTrace) -> None:
        for channel in self.channels:
            area = self.area(unit_of(channel))
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self._colour(channel), 1))
            t_s, values = extremes(trace.t_s, trace.values[:, channel], int(area.rect.width()))
            good = np.isfinite(values)
            edges = np.flatnonzero(np.diff(good.astype(np.int8), prepend=0, append=0))
            for start, end in edges.reshape(-1, 2).tolist():
                painter.drawPolyline(area.polygon(t_s[start:end], values[start:end]))
        painter.setClipping(False)


def extremes(t_s: FloatArray, values: FloatArray, columns: int) -> tuple[FloatArray, FloatArray]:
    """Return least and greatest of each group of samples: at most two points per pixel column."""
    group = -(-len(t_s) // max(columns, 1))
    if group <= POINTS_PER_COLUMN:
        return t_s, values
    starts = np.arange(0, len(t_s), group)
    low, high = np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)
    both = np.stack([low, high], axis=1).ravel()
    return np.repeat(t_s[starts], 2), both


def _reading(channel: int, value: float) -> str:
    if math.isnan(value):
        return f"{NAMES[channel]} none"
    decimals = 1 if channel < 3 else 3
    text = f"{value:+.{decimals}f}".replace("-", "\N{MINUS SIGN}")
    return f"{NAMES[channel]} {text}"
