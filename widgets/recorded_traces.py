"""The six wrench curves of one recorded probe: any of them on one axis, one cursor for all.

Of two units the first is read on the left, the second on the right. The cursor is a time,
not an index: curves and pictures with other rates stand at the same instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from PySide6.QtCore import QPointF, QSize, Qt
from PySide6.QtGui import QImage, QMouseEvent, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QSizePolicy, QWidget

from backend.core.flow import FloatArray
from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea
from widgets.theme import Theme, ui_font
from widgets.trace_sheet import TraceSheet, WrenchTrace, paper_of

NAMES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
NOTHING = "No wrench was recorded"
Drawn = tuple[TraceSheet, QImage]
"""A sheet that was drawn ahead, and its picture."""

FONTS, GAP_PX = (0.85, 0.75, 0.68), 8
"""Sizes of the readings at the cursor: the first for which there is room."""


class RecordedTraces(QWidget):
    """Draws the chosen channels on one plot; ``seek`` is told the time that was clicked."""

    def __init__(self, theme: Theme, channels: tuple[int, ...], seek: Callable[[float], None]):
        super().__init__()
        self._theme, self._seek = theme, seek
        self.channels = channels
        self.trace: WrenchTrace | None = None
        self.cursor_s = 0.0
        self._why_empty = NOTHING
        self._drawn: Drawn | None = None
        self.setAccessibleName("Force and moment of the probe")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(200, 84)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a flat rectangle."""
        return QSize(420, 130)

    def show_trace(
        self, trace: WrenchTrace | None, drawn: Drawn | None = None, why: str = NOTHING
    ) -> None:
        """Show another probe, or ``why`` there is nothing; ``drawn`` is used if it fits."""
        self.trace, self._drawn, self._why_empty = trace, drawn, why
        self.update()

    def sheet(self) -> TraceSheet:
        """Return what is drawn on now."""
        return TraceSheet(paper_of(self, self._theme), self.channels)

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
        return self.sheet().units

    def area(self, unit: str) -> PlotArea:
        """Where the curves of ``unit`` are drawn."""
        return self.sheet().area(self.trace, unit)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Copy the curves, then draw cursor and readings."""
        painter = QPainter(self)
        if self.trace is None or len(self.trace.t_s) < 2:
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, self._why_empty)
            return
        sheet = self.sheet()
        if self._drawn is None or self._drawn[0] != sheet:
            self._drawn = sheet, sheet.draw(self.trace)
        painter.drawImage(0, 0, self._drawn[1])
        self._draw_cursor(painter, sheet, self.trace)

    def _draw_cursor(self, painter: QPainter, sheet: TraceSheet, trace: WrenchTrace) -> None:
        t, area = self._theme.tokens, sheet.area(trace, sheet.units[0])
        x = area.x(min(max(self.cursor_s, area.x0), area.x1))
        painter.setPen(QPen(t.colour("text"), 1))
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
        return f"{NAMES[channel]} none"
    decimals = 1 if channel < 3 else 3
    text = f"{value:+.{decimals}f}".replace("-", "\N{MINUS SIGN}")
    return f"{NAMES[channel]} {text}"
