"""The drawn part of the recorded wrench: axes and curves on one sheet, by any thread.

A sheet is a value: whoever reads an episode ahead can draw it before it is shown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QImage, QPainter, QPen
from PySide6.QtWidgets import QWidget

from backend.core.flow import FloatArray
from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme, Tokens, ui_font

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
class Paper:
    """What a plot is drawn on: size and line height in px, device pixels per px, and the looks."""

    width: int
    height: int
    ratio: float
    em: int
    tokens: Tokens
    scale: float

    def blank(self) -> QImage:
        """Return an image of this size on the ground of a panel."""
        size = round(self.width * self.ratio), round(self.height * self.ratio)
        image = QImage(*size, QImage.Format.Format_RGB32)
        image.setDevicePixelRatio(self.ratio)
        image.fill(self.tokens.colour("panel"))
        return image


def paper_of(widget: QWidget, theme: Theme) -> Paper:
    """Return what ``widget`` is drawn on now."""
    return Paper(widget.width(), widget.height(), widget.devicePixelRatioF(),
                 widget.fontMetrics().height(), theme.tokens, theme.scale)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TraceSheet:
    """Axes of the chosen ``channels`` for one ``trace``; sheets are equal if they look alike."""

    paper: Paper
    channels: tuple[int, ...]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the chosen channels, left axis first."""
        return tuple(dict.fromkeys(unit_of(c) for c in self.channels))

    def colour(self, channel: int) -> QColor:
        """Return the colour of the axis; of a pair each has its own, whatever its axis."""
        pair = len(self.channels) == 2
        axis = "xz"[self.channels.index(channel)] if pair else "xyz"[channel % 3]
        return self.paper.tokens.colour(f"axis_{axis}")

    def area(self, trace: WrenchTrace | None, unit: str) -> PlotArea:
        """Where the curves of ``unit`` are drawn."""
        em = self.paper.em
        right = 3.4 * em if len(self.units) > 1 else 0.6 * em
        rect = QRectF(3.0 * em, 1.5 * em, self.paper.width - 3.0 * em - right,
                      self.paper.height - 2.9 * em)  # fmt: skip
        if trace is None or not len(trace.t_s):
            return PlotArea(rect, 0.0, 2.0, -1.0, 1.0)
        low, high = self._range(trace, unit)
        return PlotArea(rect, float(trace.t_s[0]), float(trace.t_s[-1]), low, high)

    def _range(self, trace: WrenchTrace, unit: str) -> tuple[float, float]:
        values = trace.values[:, [c for c in self.channels if unit_of(c) == unit]]
        finite = values[np.isfinite(values)]
        least = LEAST[unit]
        low = min(float(finite.min()), -least) if len(finite) else -least
        high = max(float(finite.max()), least) if len(finite) else least
        room = 0.06 * (high - low)
        return low - room, high + room

    def draw(self, trace: WrenchTrace) -> QImage:
        """Return axes and curves."""
        image = self.paper.blank()
        painter = QPainter(image)
        try:
            areas = {unit: self.area(trace, unit) for unit in self.units}
            self._draw_axes(painter, areas)
            self._draw_curves(painter, trace, areas)
        finally:
            painter.end()
        return image

    def _draw_axes(self, painter: QPainter, areas: dict[str, PlotArea]) -> None:
        t, area = self.paper.tokens, areas[self.units[0]]
        painter.fillRect(area.rect, t.colour("bg"))
        painter.setFont(ui_font(self.paper.scale, 0.85))
        height = painter.fontMetrics().height()
        for side, unit in enumerate(self.units):
            self._draw_scale(painter, areas[unit], unit, right=side == 1)
        for value in ticks(area.x0, area.x1, 5):
            x = area.x(value)
            painter.setPen(QPen(t.colour("grid"), 1))
            painter.drawLine(QPointF(x, area.rect.top()), QPointF(x, area.rect.bottom()))
            painter.setPen(t.colour("muted"))
            text = f"{tick_text(value, 0.5)} s"
            painter.drawText(QRectF(x - 40, area.rect.bottom() + 2, 80, height),
                             int(Qt.AlignmentFlag.AlignHCenter), text)  # fmt: skip

    def _draw_scale(self, painter: QPainter, area: PlotArea, unit: str, *, right: bool) -> None:
        t, rect = self.paper.tokens, area.rect
        height = painter.fontMetrics().height()
        # No more numbers than there is room for: low plots name two or three.
        count = min(max(int(rect.height() / (1.4 * height)), 1), 4)
        step = nice_step(area.y1 - area.y0, count)
        for value in ticks(area.y0, area.y1, count):
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

    def _draw_curves(
        self, painter: QPainter, trace: WrenchTrace, areas: dict[str, PlotArea]
    ) -> None:
        for channel in self.channels:
            area = areas[unit_of(channel)]
            painter.setClipRect(area.rect)
            painter.setPen(QPen(self.colour(channel), 1))
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
