"""Live plot of wrench and width."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QPainter, QPen, QPolygonF, QStaticText
from PySide6.QtWidgets import QWidget

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import Age, Panel, Theme, flat_button, signed, tr, true_minus, ui_font
from touchdown.widgets.plots import axes
from touchdown.widgets.plots.pictures import PictureView

AXES = ("x", "y", "z")
BUCKETS = 360
ROW_EM = 1.4  # distance of the read-outs in text heights
SPANS_S = (10.0, 30.0, 60.0)


class TracePlot(PictureView):
    """Three traces of one unit. The range grows in round steps and shrinks only with ``fit``."""

    unit = ""

    def __init__(self, theme: Theme, name: str, symbol: str, unit: str, limit: float) -> None:
        self._name, self._symbol, self._unit = tr(name), symbol, unit
        super().__init__(theme, tr("{} traces", self._name), (240, 110))
        self._least = self.limit = limit
        self.buckets = axes.TraceBuckets(3, buckets=BUCKETS)
        self._age, self._age_s, self._reason = Age.NEVER, 0.0, ""
        self._note = ""
        self._ground = axes.PictureCache(self, theme)
        self.points_drawn = 0

    def add(self, t_s: FloatArray, values: FloatArray) -> None:
        """Add samples: ``t_s`` (n,), ``values`` (n, 3)."""
        self.buckets.add(t_s, values)
        finite = values[np.isfinite(values)]
        if len(finite):
            self._grow(float(np.abs(finite).max()))
        self.update()

    def show_span(self, span_s: float) -> None:
        """Set the time span; this removes all samples."""
        self.buckets = axes.TraceBuckets(3, span_s, buckets=BUCKETS)
        self._ground.clear()
        self.update()

    def clear(self) -> None:
        """Remove all samples."""
        self.buckets.clear()
        self._age = Age.NEVER
        self.update()

    def fit(self) -> None:
        """Set the range to the shown samples."""
        self.limit = self._least / 100
        self._grow(max(self.buckets.largest(), self._least / 10))
        self.update()

    def show_age(self, age: Age, age_s: float, reason: str) -> None:
        """Set the age of the newest sample."""
        if age is Age.FRESH and self._age is Age.FRESH:
            return
        self._age, self._age_s, self._reason = age, age_s, reason
        self.update()

    def show_note(self, note: str) -> None:
        """Show a sensor figure beside the title, such as its drift."""
        if note != self._note:
            self._note = note
            self._ground.clear()
            self.update()

    def summary(self) -> str:
        """Return the newest values in words, for screen readers."""
        if self.buckets.empty:
            return tr("{}: waiting for data", self._name)
        parts = (
            f"{self._symbol}{a} {v:z.2f}" for a, v in zip(AXES, self.buckets.last, strict=True)
        )
        span = f"{self.buckets.span_s:.0f} s"
        note = f"; {self._note}" if self._note else ""
        largest = tr("largest {:.2f} in {}", self.buckets.largest(), span)
        return f"{', '.join(parts)} {self._unit}; {largest}{note}"

    def _grow(self, magnitude: float) -> None:
        if magnitude * 1.05 > self.limit:
            self.limit = axes.nice_step(magnitude * 1.05, 1)

    def area(self) -> axes.PlotArea:
        """Return the area of the traces."""
        em = self.fontMetrics().height()
        top = 1.7 * em
        rect = QRectF(2.9 * em, top, self.width() - 8.9 * em, self.height() - top - 1.6 * em)
        return self.zoom.of(axes.PlotArea(rect, -self.buckets.span_s, 0.0, -self.limit, self.limit))

    def reading(self, x: float, y: float) -> str:
        """Return the time and the values of the traces then."""
        age_s, low, high = self.buckets.ordered()
        values = (low + high)[int(np.argmin(np.abs(age_s - x)))] / 2
        texts = (signed(value, 1 if self._unit == "N" else 3) for value in values)
        said = (f"{self._symbol}{name} {text}" for name, text in zip(AXES, texts, strict=True))
        return f"{signed(x)} s: {', '.join(said)} {self._unit}"

    def paint(self, painter: QPainter) -> None:
        """Draw the cached background and the traces."""
        area, ground = self.area(), self._draw_background
        painter.drawPixmap(0, 0, self._ground.picture(ground, self.limit, self.zoom))
        if self.buckets.empty:
            axes.draw_message(painter, area.rect, self._theme, "Waiting for data", self._reason)
            return
        self._draw_traces(painter, area)
        self._draw_end_labels(painter, area)
        if self._age in (Age.STALE, Age.GONE):
            panel = self._theme.tokens.colour("panel")
            axes.draw_stale_overlay(painter, area.rect, self._theme, self._age_s, panel)

    def _draw_traces(self, painter: QPainter, area: axes.PlotArea) -> None:
        lines = _polylines(
            area, *axes.thin_buckets(*self.buckets.ordered(), int(area.rect.width()))
        )
        painter.setClipRect(area.rect)
        self.points_drawn = 0
        for name, stretches in zip(AXES, lines, strict=True):
            painter.setPen(QPen(self._theme.tokens.colour(f"axis_{name}"), 1))
            for line in stretches:
                self.points_drawn = max(self.points_drawn, line.size())
                painter.drawPolyline(line)
        painter.setClipping(False)

    def _draw_end_labels(self, painter: QPainter, area: axes.PlotArea) -> None:
        font = ui_font(self._theme.scale, 0.92, 500)
        painter.setFont(font)
        height = painter.fontMetrics().height()
        # Fixed rows: read-outs that follow the curves would jump while they are read.
        top = area.rect.center().y() - (ROW_EM + 0.5) * height
        decimals = 1 if self.limit >= 5 else 3
        left, right = area.rect.right() + 8, self.width() - 2.0
        for row, (name, value) in enumerate(zip(AXES, self.buckets.last.tolist(), strict=True)):
            painter.setPen(self._theme.tokens.colour(f"axis_{name}"))
            y = top + ROW_EM * height * row
            symbol = _laid_out(f"{self._symbol}{name}", self._theme.scale)
            text = _laid_out(f"{value:+z.{decimals}f}", self._theme.scale)
            painter.drawStaticText(QPointF(left, y), symbol)
            painter.drawStaticText(QPointF(right - text.size().width(), y), text)

    def _draw_background(self, painter: QPainter) -> None:
        t, area = self._theme.tokens, self.area()
        rect = area.rect
        painter.fillRect(rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        height = painter.fontMetrics().height()
        # Low plots label only the middle and the ends.
        count = 4 if rect.height() >= 7 * height else 2
        step = axes.nice_step(area.y1 - area.y0, count)
        for value in axes.ticks(area.y0, area.y1, count):
            y = area.y(value)
            painter.setPen(QPen(t.colour("border" if value == 0 else "grid"), 1))
            painter.drawLine(QPointF(rect.left(), y), QPointF(rect.right(), y))
            painter.setPen(t.colour("muted"))
            # Keeps the lowest label clear of the first one of the time axis.
            y = min(y, rect.bottom() - 0.35 * height)
            box = QRectF(0, y - height / 2, rect.left() - 6, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), axes.tick_text(value, step))
        widest = painter.fontMetrics().horizontalAdvance(f"{axes.tick_text(-60, 1)} s")
        count = 5 if rect.width() >= 7 * widest else 2
        step = axes.nice_step(area.x1 - area.x0, count)
        for at_s in axes.ticks(area.x0, area.x1, count):
            text = tr("now") if at_s == 0 else f"{axes.tick_text(at_s, step)} s"
            axes.GridPainter(painter, area, t).column(at_s, text, gap=3)
        painter.setPen(t.colour("muted"))
        painter.setFont(ui_font(self._theme.scale, 0.85, 500))
        name = f"{self._name} ({self._unit})"
        painter.drawText(QPointF(rect.left(), rect.top() - 0.5 * height), name)
        painter.setFont(ui_font(self._theme.scale, 0.85))
        left = painter.fontMetrics().horizontalAdvance(f"{name}   ")
        # Up to the right edge: the values begin lower.
        right = self.width() - 0.5 * height
        note = painter.fontMetrics().elidedText(
            self._note, Qt.TextElideMode.ElideRight, int(right - rect.left() - left)
        )
        width = painter.fontMetrics().horizontalAdvance(note)
        painter.drawText(QPointF(right - width, rect.top() - 0.5 * height), note)


def _polylines(
    area: axes.PlotArea, age_s: FloatArray, low: FloatArray, high: FloatArray
) -> list[list[QPolygonF]]:
    """Return per axis one polyline for each stretch without a gap; a bucket adds two points."""
    points = np.empty((low.shape[1], len(age_s), 2, 2))
    points[..., 0] = area.columns(age_s)[:, None]
    room = area.y1 - area.y0
    for end, values in enumerate((low, high)):
        points[:, :, end, 1] = area.rows(np.clip(values, area.y0 - room, area.y1 + room)).T
    return [
        [axes.polygon_of(axis[start:end].reshape(-1, 2)) for start, end in axes.finite_runs(values)]
        for axis, values in zip(points, low.T, strict=True)
    ]


@lru_cache(maxsize=256)
def _laid_out(text: str, scale: float) -> QStaticText:
    """Return a read-out with cached text layout; most values recur."""
    made = QStaticText(true_minus(text))
    made.setTextFormat(Qt.TextFormat.PlainText)
    made.prepare(font=ui_font(scale, 0.92, 500))
    return made


class TracesPanel(Panel):
    """Panel of the force and the moment plot; ``tools`` precede *Fit* in the header."""

    def __init__(
        self, title: str, force: TracePlot, moment: TracePlot, tools: Sequence[QWidget] = ()
    ) -> None:
        super().__init__(title)
        self._plots = force, moment
        self.column.setSpacing(2)
        for plot in self._plots:
            self.column.addWidget(plot, 1)
        fit = flat_button("Fit", "Set both ranges to what is shown now (Ctrl+F)")
        fit.clicked.connect(self.fit)
        for widget in (*tools, fit):
            self.header.addWidget(widget)

    def fit(self) -> None:
        """Fit the ranges of both plots."""
        for plot in self._plots:
            plot.fit()
