"""Plots of recorded signals."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QImage, QMouseEvent, QPainter, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import Theme, Tokens, signed, ui_font
from touchdown.widgets.plots.axes import (
    GridPainter,
    PlotArea,
    draw_message,
    finite_runs,
    nice_step,
    thin_buckets,
    tick_text,
    ticks,
)
from touchdown.widgets.plots.pictures import WHOLE, PictureView, Zoom

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


@dataclass(frozen=True, slots=True)
class SheetStyle:
    """Style of a plot: size and line height in px, device pixels per px, tokens, font scale."""

    width: int
    height: int
    ratio: float
    em: int
    tokens: Tokens
    scale: float

    def blank(self) -> QImage:
        """Return an image of this size in the panel colour."""
        size = round(self.width * self.ratio), round(self.height * self.ratio)
        image = QImage(*size, QImage.Format.Format_RGB32)
        image.setDevicePixelRatio(self.ratio)
        image.fill(self.tokens.colour("panel"))
        return image


def sheet_style(widget: QWidget, theme: Theme) -> SheetStyle:
    """Return the present style of ``widget``."""
    return SheetStyle(widget.width(), widget.height(), widget.devicePixelRatioF(),
                 widget.fontMetrics().height(), theme.tokens, theme.scale)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TraceSheet:
    """Axes and curves of the chosen ``channels``; equal sheets draw the same picture."""

    paper: SheetStyle
    channels: tuple[int, ...]
    zoom: Zoom = WHOLE

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the chosen channels, left axis first."""
        return tuple(dict.fromkeys(unit_of(c) for c in self.channels))

    def colour(self, channel: int) -> QColor:
        """Return the axis colour; two channels always get different colours."""
        pair = len(self.channels) == 2
        axis = "xz"[self.channels.index(channel)] if pair else "xyz"[channel % 3]
        return self.paper.tokens.colour(f"axis_{axis}")

    def area(self, trace: WrenchTrace | None, unit: str) -> PlotArea:
        """Return the plot area of ``unit``."""
        em = self.paper.em
        right = 3.4 * em if len(self.units) > 1 else 0.6 * em
        rect = QRectF(3.0 * em, 1.5 * em, self.paper.width - 3.0 * em - right,
                      self.paper.height - 2.9 * em)  # fmt: skip
        if trace is None or not len(trace.t_s):
            return PlotArea(rect, 0.0, 2.0, -1.0, 1.0)
        low, high = self._range(trace, unit)
        return self.zoom.of(PlotArea(rect, float(trace.t_s[0]), float(trace.t_s[-1]), low, high))

    def _range(self, trace: WrenchTrace, unit: str) -> tuple[float, float]:
        values = trace.values[:, [c for c in self.channels if unit_of(c) == unit]]
        finite = values[np.isfinite(values)]
        least = LEAST[unit]
        low = min(float(finite.min()), -least) if len(finite) else -least
        high = max(float(finite.max()), least) if len(finite) else least
        room = 0.06 * (high - low)
        return low - room, high + room

    def draw(self, trace: WrenchTrace) -> QImage:
        """Return a picture of axes and curves."""
        image = self.paper.blank()
        with QPainter(image) as painter:
            areas = {unit: self.area(trace, unit) for unit in self.units}
            self._draw_axes(painter, areas)
            self._draw_curves(painter, trace, areas)
        return image

    def _draw_axes(self, painter: QPainter, areas: dict[str, PlotArea]) -> None:
        t, area = self.paper.tokens, areas[self.units[0]]
        painter.fillRect(area.rect, t.colour("bg"))
        painter.setFont(ui_font(self.paper.scale, 0.85))
        for side, unit in enumerate(self.units):
            self._draw_scale(painter, areas[unit], unit, right=side == 1)
        step = min(nice_step(area.x1 - area.x0, 5), 0.5)
        for value in ticks(area.x0, area.x1, 5):
            GridPainter(painter, area, t).column(value, f"{tick_text(value, step)} s")

    def _draw_scale(self, painter: QPainter, area: PlotArea, unit: str, *, right: bool) -> None:
        t, rect = self.paper.tokens, area.rect
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

    def _draw_curves(
        self, painter: QPainter, trace: WrenchTrace, areas: dict[str, PlotArea]
    ) -> None:
        for channel in self.channels:
            area = areas[unit_of(channel)]
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self.colour(channel), 1))
            first, last = np.searchsorted(trace.t_s, (area.x0, area.x1)).tolist()
            seen = slice(max(first - 1, 0), last + 1)
            t_s, values = min_max_per_column(
                trace.t_s[seen], trace.values[seen, channel], int(area.rect.width())
            )
            for start, end in finite_runs(values):
                painter.drawPolyline(area.polygon(t_s[start:end], values[start:end]))
        painter.setClipping(False)


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


@dataclass(frozen=True, slots=True)
class PhaseSheet:
    """Static part of the phase plot: axes and the whole path, faint. Safe in any thread."""

    paper: SheetStyle

    def area(self, trace: WrenchTrace | None) -> PlotArea:
        """Return the drawn square, centred on the path."""
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
        """Return a picture of axes and path of a trace with moments."""
        image, area = self.paper.blank(), self.area(trace)
        with QPainter(image) as painter:
            self._draw_axes(painter, area)
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self.paper.tokens.colour("border"), 1))
            step = step_of(trace)
            painter.drawPolyline(area.polygon(trace.values[::step, 3], trace.values[::step, 4]))
        return image

    def _draw_axes(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self.paper.tokens, area.rect
        painter.fillRect(rect, t.colour("bg"))
        painter.setFont(ui_font(self.paper.scale, 0.8))
        height = painter.fontMetrics().height()
        GridPainter(painter, area, t).grid(4, line="")
        above = QRectF(0, rect.top() - height - 3, self.paper.width, height)
        painter.drawText(above, int(Qt.AlignmentFlag.AlignLeft), "Ty over Tx (N·m)")


def has_moments(trace: WrenchTrace) -> bool:
    """Return True if there is a path to draw."""
    return bool(np.isfinite(trace.values[:, 3:5]).all(axis=1).any())


def step_of(trace: WrenchTrace) -> int:
    """Return the stride of the drawn samples."""
    return max(len(trace.t_s) // MOST_POINTS, 1)


CHANNEL_NAMES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
NO_WRENCH = "No wrench was recorded"
Sheet = TraceSheet | PhaseSheet
Drawn = tuple[Sheet, QImage]  # a sheet and its picture, drawn in advance

FONTS, GAP_PX = (0.85, 0.75, 0.68), 8  # font scales of the read-outs; the first that fits is used


class _SheetPlot(PictureView):
    """Plot of a recorded trace and a cursor. The sheet below the cursor may be drawn in advance."""

    unit = ""
    trace: WrenchTrace | None = None
    cursor_s = 0.0
    why_empty = NO_WRENCH
    _drawn: Drawn | None = None

    def show_trace(
        self, trace: WrenchTrace | None, drawn: Drawn | None = None, why: str | None = None
    ) -> None:
        """Show another probe, or the reason ``why`` there is none; uses ``drawn`` if it fits."""
        self.trace, self._drawn = trace, drawn
        self.why_empty = type(self).why_empty if why is None else why
        self.update()

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor."""
        self.cursor_s = t_s
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw the cached sheet and what depends on the cursor."""
        trace, sheet = self.trace, self.sheet()
        if trace is None or not self.can_show(trace):
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, self.why_empty)
            return
        if self._drawn is None or self._drawn[0] != sheet:
            self._drawn = sheet, sheet.draw(trace)
        painter.drawImage(0, 0, self._drawn[1])
        self.draw_cursor(painter, trace)

    def sheet(self) -> Sheet:
        """Return the present sheet."""
        raise NotImplementedError

    def can_show(self, trace: WrenchTrace) -> bool:
        """Return True if the trace has two samples to connect."""
        return len(trace.t_s) >= 2

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw what depends on the cursor."""
        raise NotImplementedError


class RecordedTraces(_SheetPlot):
    """Plot of the chosen channels; ``seek`` gets the clicked time."""

    editable = True

    def __init__(self, theme: Theme, channels: tuple[int, ...], seek: Callable[[float], None]):
        super().__init__(theme, "Force and moment of the probe", (200, 84), (420, 130))
        self._seek, self.channels = seek, channels

    def sheet(self) -> TraceSheet:
        """Return the present sheet."""
        return TraceSheet(sheet_style(self, self._theme), self.channels, self.zoom)

    def show_channels(self, channels: tuple[int, ...]) -> None:
        """Choose the channels."""
        self.channels, self._drawn = channels, None
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
        return self.sheet().area(self.trace, unit or self.sheet().units[0])

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw the cursor and the read-outs."""
        t, sheet = self._theme.tokens, self.sheet()
        area = sheet.area(trace, sheet.units[0])
        x = area.x(min(max(self.cursor_s, float(trace.t_s[0])), float(trace.t_s[-1])))
        painter.setPen(QPen(t.colour("text"), 1))
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
            painter.setPen(sheet.colour(channel))
            painter.drawText(QPointF(left, area.rect.top() - 5), text)
            left += painter.fontMetrics().horizontalAdvance(text) + GAP_PX


def _reading(channel: int, value: float) -> str:
    if math.isnan(value):
        return f"{CHANNEL_NAMES[channel]} none"
    return f"{CHANNEL_NAMES[channel]} {signed(value, 1 if channel < 3 else 3)}"


class PhasePlot(_SheetPlot):
    """Plot of the path (Tx, Ty): strong up to the cursor, faint after it."""

    why_empty = "No moments"

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Moment Tx over moment Ty", (140, 110), (150, 150))
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Expanding)

    def sheet(self) -> PhaseSheet:
        """Return the present sheet."""
        return PhaseSheet(sheet_style(self, self._theme))

    def can_show(self, trace: WrenchTrace) -> bool:
        """Return True if the trace has a path to draw."""
        return has_moments(trace)

    def draw_cursor(self, painter: QPainter, trace: WrenchTrace) -> None:
        """Draw the path up to the cursor and the present point."""
        area = self.sheet().area(trace)
        painter.setClipRect(area.rect)
        until = int(np.searchsorted(trace.t_s, self.cursor_s, side="right"))
        x, y, step = trace.values[:, 3], trace.values[:, 4], step_of(trace)
        t = self._theme.tokens
        painter.setPen(QPen(t.colour("axis_x"), 1))
        painter.drawPolyline(area.polygon(x[:until:step], y[:until:step]))
        if until:
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setPen(QPen(t.colour("text"), 2))
            painter.setBrush(t.colour("bg"))
            painter.drawEllipse(QPointF(area.x(x[until - 1]), area.y(y[until - 1])), 4, 4)
