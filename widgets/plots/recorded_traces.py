"""Plots of recorded signals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QMouseEvent, QPainter, QPen
from PySide6.QtWidgets import QSizePolicy

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import Theme, signed, tr, ui_font
from touchdown.widgets.plots.axes import (
    GridPainter,
    PictureCache,
    PlotArea,
    draw_message,
    finite_runs,
    nice_step,
    thin_buckets,
    tick_text,
    ticks,
)
from touchdown.widgets.plots.pictures import PictureView

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


def min_max_per_column(
    t_s: FloatArray, values: FloatArray, columns: int
) -> tuple[FloatArray, FloatArray]:
    """Reduce to minimum and maximum per group: at most two points per pixel column."""
    if len(t_s) <= POINTS_PER_COLUMN * columns:
        return t_s, values
    starts_s, low, high = thin_buckets(t_s, values, values, columns)
    return np.repeat(starts_s, 2), np.stack([low, high], axis=1).ravel()


LEAST_NM = 0.02
MOST_POINTS = 400
CHANNEL_NAMES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
NO_WRENCH = "No wrench was recorded"
FONTS, GAP_PX = (0.85, 0.75, 0.68), 8  # font scales of the read-outs; the first that fits is used


class _RecordedPlot(PictureView):
    """Plot of a recorded trace, which is cached, and of a cursor."""

    unit = ""
    trace: WrenchTrace | None = None
    cursor_s = 0.0
    why_empty = NO_WRENCH

    def __init__(
        self, theme: Theme, name: str, least_px: tuple[int, int], usual_px: tuple[int, int]
    ) -> None:
        super().__init__(theme, name, least_px, usual_px)
        self._curves = PictureCache(self, theme)

    def show_trace(self, trace: WrenchTrace | None, why: str | None = None) -> None:
        """Show another probe, or the reason ``why`` there is none."""
        self.trace = trace
        self.why_empty = type(self).why_empty if why is None else why
        self._curves.clear()
        self.update()

    def show_cursor(self, t_s: float) -> None:
        self.cursor_s = t_s
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw the cached curves and what depends on the cursor."""
        trace = self.trace
        if trace is None or not self.can_show(trace):
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, self.why_empty)
            return
        picture = self._curves.picture(lambda on: self.draw_curves(on, trace), self.zoom)
        painter.drawPixmap(0, 0, picture)
        self.draw_cursor(painter, trace)

    def can_show(self, trace: WrenchTrace) -> bool:
        return len(trace.t_s) >= 2

    def draw_curves(self, painter: QPainter, trace: WrenchTrace) -> None:
        raise NotImplementedError

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        raise NotImplementedError


class RecordedTraces(_RecordedPlot):
    """Plot of the chosen channels; ``seek`` gets the clicked time."""

    editable = True

    def __init__(self, theme: Theme, channels: tuple[int, ...], seek: Callable[[float], None]):
        super().__init__(theme, "Force and moment of the probe", (200, 84), (420, 130))
        self._seek, self.channels = seek, channels

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the chosen channels, left axis first."""
        return tuple(dict.fromkeys(unit_of(c) for c in self.channels))

    def show_channels(self, channels: tuple[int, ...]) -> None:
        """Choose the channels."""
        self.channels = channels
        self._curves.clear()
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        super().show_cursor(t_s)
        self.setAccessibleDescription(self.summary())

    def at_cursor(self, t_s: float | None = None) -> FloatArray:
        """Return the (6,) newest sample until ``t_s``, by default the cursor; NaN without one."""
        if self.trace is None:
            return np.full(6, np.nan)
        t_s = self.cursor_s if t_s is None else t_s
        index = int(np.searchsorted(self.trace.t_s, t_s, side="right")) - 1
        return self.trace.values[index] if index >= 0 else np.full(6, np.nan)

    def summary(self) -> str:
        """Return the values at the cursor in words."""
        values = self.at_cursor()
        return ", ".join(_reading(c, values[c]) for c in self.channels)

    def reading(self, x: float, y: float) -> str:
        """Return the time and the values of the curves then."""
        values = self.at_cursor(x)
        return f"{signed(x)} s: {', '.join(_reading(c, values[c]) for c in self.channels)}"

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Move the cursor to the pressed time."""
        super().mousePressEvent(event)
        self.mouseMoveEvent(event)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Move the cursor to the dragged time."""
        super().mouseMoveEvent(event)
        left = event.buttons() & Qt.MouseButton.LeftButton
        if self.trace is not None and left and self._grip is None:
            area = self.area()
            self._seek(min(max(area.at(event.position())[0], area.x0), area.x1))

    def area(self, unit: str = "") -> PlotArea:
        """Return the plot area of ``unit``, by default that of the left axis."""
        em, trace = self.fontMetrics().height(), self.trace
        right = 3.4 * em if len(self.units) > 1 else 0.6 * em
        rect = QRectF(3.0 * em, 1.5 * em, self.width() - 3.0 * em - right, self.height() - 2.9 * em)
        if trace is None or not len(trace.t_s):
            return PlotArea(rect, 0.0, 2.0, -1.0, 1.0)
        low, high = self._range(trace, unit or self.units[0])
        return self.zoom.of(PlotArea(rect, float(trace.t_s[0]), float(trace.t_s[-1]), low, high))

    def _range(self, trace: WrenchTrace, unit: str) -> tuple[float, float]:
        values = trace.values[:, [c for c in self.channels if unit_of(c) == unit]]
        finite = values[np.isfinite(values)]
        least = LEAST[unit]
        low = min(float(finite.min()), -least) if len(finite) else -least
        high = max(float(finite.max()), least) if len(finite) else least
        room = 0.06 * (high - low)
        return low - room, high + room

    def _colour(self, channel: int) -> QColor:
        """Return the axis colour; two channels always get different colours."""
        pair = len(self.channels) == 2
        axis = "xz"[self.channels.index(channel)] if pair else "xyz"[channel % 3]
        return self._theme.tokens.colour(f"axis_{axis}")

    def draw_curves(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw axes and curves."""
        t, area = self._theme.tokens, self.area()
        painter.fillRect(area.rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        for side, unit in enumerate(self.units):
            self._draw_scale(painter, self.area(unit), unit, right=side == 1)
        step = min(nice_step(area.x1 - area.x0, 5), 0.5)
        for value in ticks(area.x0, area.x1, 5):
            GridPainter(painter, area, t).column(value, f"{tick_text(value, step)} s")
        for channel in self.channels:
            area = self.area(unit_of(channel))
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self._colour(channel), 1))
            first, last = np.searchsorted(trace.t_s, (area.x0, area.x1)).tolist()
            seen = slice(max(first - 1, 0), last + 1)
            t_s, values = min_max_per_column(
                trace.t_s[seen], trace.values[seen, channel], int(area.rect.width())
            )
            for start, end in finite_runs(values):
                painter.drawPolyline(area.polygon(t_s[start:end], values[start:end]))

    def _draw_scale(self, painter: QPainter, area: PlotArea, unit: str, *, right: bool) -> None:
        t, rect = self._theme.tokens, area.rect
        height = painter.fontMetrics().height()
        # Low plots get fewer labels.
        count = min(max(int(rect.height() / (1.4 * height)), 1), 4)
        step = nice_step(area.y1 - area.y0, count)
        for value in ticks(area.y0, area.y1, count):
            text = tick_text(value, step)
            if right:
                painter.setPen(t.colour("muted"))
                painter.drawText(QPointF(rect.right() + 5, area.y(value) + 0.35 * height), text)
            else:
                line = "border" if value == 0 else "grid"
                GridPainter(painter, area, t).row(value, text, line)
        place = QRectF(0, rect.top() - height - 3, rect.left() - 5, height)
        if right:
            place.moveLeft(rect.right() + 5)
        side = Qt.AlignmentFlag.AlignLeft if right else Qt.AlignmentFlag.AlignRight
        painter.drawText(place, int(side), unit)

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw the cursor and the read-outs."""
        area = self.area()
        x = area.x(min(max(self.cursor_s, float(trace.t_s[0])), float(trace.t_s[-1])))
        painter.setPen(QPen(self._theme.tokens.colour("text"), 1))
        if area.rect.left() - 1 <= x <= area.rect.right() + 1:
            painter.drawLine(QPointF(x, area.rect.top()), QPointF(x, area.rect.bottom()))
        values, left = self.at_cursor(), area.rect.left()
        texts = [_reading(channel, values[channel]) for channel in self.channels]
        room = self.width() - left - GAP_PX * len(texts)
        for size in FONTS:
            painter.setFont(ui_font(self._theme.scale, size, 500))
            if sum(painter.fontMetrics().horizontalAdvance(text) for text in texts) <= room:
                break
        for channel, text in zip(self.channels, texts, strict=True):
            painter.setPen(self._colour(channel))
            painter.drawText(QPointF(left, area.rect.top() - 5), text)
            left += painter.fontMetrics().horizontalAdvance(text) + GAP_PX


def _reading(channel: int, value: float) -> str:
    if math.isnan(value):
        return tr("{} none", CHANNEL_NAMES[channel])
    return f"{CHANNEL_NAMES[channel]} {signed(value, 1 if channel < 3 else 3)}"


class PhasePlot(_RecordedPlot):
    """Plot of the path (Tx, Ty): strong up to the cursor, faint after it."""

    why_empty = "No moments"

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Moment Tx over moment Ty", (140, 110), (150, 150))
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)

    def can_show(self, trace: WrenchTrace) -> bool:
        """Return True if the trace has a path to draw."""
        return bool(np.isfinite(trace.values[:, 3:5]).all(axis=1).any())

    def _square(self, trace: WrenchTrace) -> PlotArea:
        em = self.fontMetrics().height()
        side = max(min(self.width() - 3.2 * em, self.height() - 3.0 * em), 30.0)
        moments = trace.values[:, 3:5]
        moments = moments[np.isfinite(moments).all(axis=1)]
        low, high = moments.min(axis=0), moments.max(axis=0)
        half = 0.55 * max(float((high - low).max()), LEAST_NM)
        x, y = ((low + high) / 2).tolist()
        rect = QRectF(2.9 * em, 1.4 * em, side, side)
        return PlotArea(rect, x - half, x + half, y - half, y + half)

    def _draw_path(self, painter: QPainter, trace: WrenchTrace, area: PlotArea, end: int) -> None:
        """Draw the path until sample ``end``, with a limited number of samples."""
        step = max(len(trace.t_s) // MOST_POINTS, 1)
        x, y = trace.values[:end:step, 3], trace.values[:end:step, 4]
        painter.setClipRect(area.rect)
        painter.drawPolyline(area.polygon(x, y))

    def draw_curves(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw axes and path, faint."""
        area, t = self._square(trace), self._theme.tokens
        painter.fillRect(area.rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.8))
        height = painter.fontMetrics().height()
        GridPainter(painter, area, t).grid(4, line="")
        above = QRectF(0, area.rect.top() - height - 3, self.width(), height)
        painter.drawText(above, int(Qt.AlignmentFlag.AlignLeft), tr("Ty over Tx (N·m)"))
        painter.setPen(QPen(t.colour("border"), 1))
        self._draw_path(painter, trace, area, len(trace.t_s))

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw the path up to the cursor and the present point."""
        area, t = self._square(trace), self._theme.tokens
        until = int(np.searchsorted(trace.t_s, self.cursor_s, side="right"))
        painter.setPen(QPen(t.colour("axis_x"), 1))
        self._draw_path(painter, trace, area, until)
        if until:
            x, y = trace.values[until - 1, 3:5].tolist()
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setPen(QPen(t.colour("text"), 2))
            painter.setBrush(t.colour("bg"))
            painter.drawEllipse(area.place(x, y), 4, 4)
