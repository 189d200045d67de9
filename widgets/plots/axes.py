"""Axes, ticks, overlays and strokes of plots."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from PySide6.QtCore import QLineF, QMarginsF, QPointF, QRect, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QPainter, QPainterPath, QPen, QPixmap, QPolygonF
from PySide6.QtWidgets import QWidget
from shiboken6 import Shiboken, VoidPtr

from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import rings_of
from touchdown.widgets.base import Theme, Tokens, tr, true_minus, ui_font


def nice_step(span: float, count: int) -> float:
    """Return a tick step of 1, 2 or 5 times a power of ten for about ``count`` ticks."""
    raw = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    return float(next(m * power for m in (1.0, 2.0, 5.0, 10.0) if raw <= m * power * (1 + 1e-9)))


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return the round values within [low, high]."""
    step = nice_step(high - low, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 10) for k in range(first, last + 1)]


def tick_text(value: float, step: float) -> str:
    """Format a tick with the decimals of its step and a true minus sign."""
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return true_minus(f"{value:z.{decimals}f}")


@dataclass(frozen=True, slots=True)
class PlotArea:
    """Linear map of [x0, x1] x [y0, y1] to the pixels of ``rect`` (y up)."""

    rect: QRectF
    x0: float
    x1: float
    y0: float
    y1: float

    def x(self, value: float) -> float:
        """Return the pixel column of a value."""
        return self.rect.left() + (value - self.x0) / (self.x1 - self.x0) * self.rect.width()

    def y(self, value: float) -> float:
        """Return the pixel row of a value."""
        return self.rect.bottom() - (value - self.y0) / (self.y1 - self.y0) * self.rect.height()

    def columns(self, x: FloatArray) -> FloatArray:
        """Return the pixel columns of an array of any shape."""
        return self.rect.left() + (x - self.x0) * (self.rect.width() / (self.x1 - self.x0))

    def rows(self, y: FloatArray) -> FloatArray:
        """Return the pixel rows of an array of any shape."""
        return self.rect.bottom() - (y - self.y0) * (self.rect.height() / (self.y1 - self.y0))

    def place(self, x: float, y: float) -> QPointF:
        """Return the pixel position of a point."""
        return QPointF(self.x(x), self.y(y))

    def at(self, place: QPointF) -> tuple[float, float]:
        """Return the values (x, y) at a pixel position."""
        x = self.x0 + (place.x() - self.rect.left()) / self.rect.width() * (self.x1 - self.x0)
        y = self.y1 - (place.y() - self.rect.top()) / self.rect.height() * (self.y1 - self.y0)
        return x, y

    def polygon(self, x: FloatArray, y: FloatArray) -> QPolygonF:
        """Map values of shape (n,) and (n,) to a polyline."""
        return polygon_of(self.points(x, y))

    def points(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Map values of shape (n,) and (n,) to pixel positions (n, 2)."""
        points = np.empty((len(x), 2))
        points[:, 0], points[:, 1] = self.columns(x), self.rows(y)
        return points


def centred_square(size: QSize, margins: QMarginsF, least: float) -> QRectF:
    """Return the largest square within ``margins`` of a widget, with sides of ``least`` or more."""
    width = size.width() - margins.left() - margins.right()
    height = size.height() - margins.top() - margins.bottom()
    side = max(min(width, height), least)
    left, top = margins.left() + (width - side) / 2, margins.top() + (height - side) / 2
    return QRectF(left, top, side, side)


def polygon_of(points: FloatArray) -> QPolygonF:
    """Copy (n, 2) pixel positions into a Qt polygon."""
    polygon = QPolygonF()
    if len(points) == 0:
        return polygon
    polygon.resize(len(points))
    address: Any = polygon.data()
    memory: Any = VoidPtr(address, points.size * 8, True)  # type: ignore[call-arg]
    np.frombuffer(memory, dtype=np.float64)[:] = points.ravel()
    return polygon


def draw_rings(painter: QPainter, points: FloatArray) -> None:
    """Draw closed rings of pixel positions (n, 2), separated by rows of NaN; holes stay empty."""
    path = QPainterPath()
    for ring in rings_of(points):
        path.addPolygon(polygon_of(ring))
        path.closeSubpath()
    painter.drawPath(path)


def spread_labels(wanted: list[float], gap: float, low: float, high: float) -> list[float]:
    """Move labels apart by at least ``gap`` within [low, high]."""
    known = [low if math.isnan(y) else min(max(y, low), high) for y in wanted]
    order = sorted(range(len(wanted)), key=known.__getitem__)
    placed = [known[i] for i in order]
    for k in range(1, len(placed)):
        placed[k] = max(placed[k], placed[k - 1] + gap)
    overshoot = placed[-1] - high
    if overshoot > 0:
        placed[-1] = high
        for k in range(len(placed) - 2, -1, -1):
            placed[k] = min(placed[k], placed[k + 1] - gap)
    result = [0.0] * len(wanted)
    for k, i in enumerate(order):
        result[i] = placed[k]
    return result


class TraceBuckets:
    """Ring buffer of the minimum and maximum of every channel per time bucket.

    It covers the newest ``span_s`` of signal time. Buckets without a sample are NaN, so that a gap
    is drawn as a gap. A jump back in time (a new trial) clears the ring.
    """

    def __init__(self, channels: int, span_s: float = 10.0, buckets: int = 500) -> None:
        self.span_s, self.buckets, self.channels = span_s, buckets, channels
        self._width_s = span_s / buckets
        self.clear()

    @property
    def empty(self) -> bool:
        """True while no sample has arrived."""
        return self._newest < 0

    def clear(self) -> None:
        """Remove all samples."""
        self._low = np.full((self.buckets, self.channels), np.nan)
        self._high = self._low.copy()
        self._newest = -1
        self.last: FloatArray = np.full(self.channels, np.nan)

    def add(self, t_s: FloatArray, values: FloatArray) -> None:
        """Add samples: ``t_s`` (n,) ascending, ``values`` (n, channels)."""
        if len(t_s) == 0:
            return
        index = np.floor(t_s / self._width_s + 1e-9).astype(np.int64)
        if index[0] < self._newest - 1:
            self.clear()
        oldest = index[-1] - self.buckets
        if index[0] <= oldest:
            keep = index > oldest
            index, values = index[keep], values[keep]
        self._advance(int(index[-1]))
        starts = np.concatenate(([0], np.flatnonzero(index[1:] != index[:-1]) + 1))
        slots = index[starts] % self.buckets
        low = np.fmin.reduceat(values, starts, axis=0)
        high = np.fmax.reduceat(values, starts, axis=0)
        self._low[slots] = np.fmin(self._low[slots], low)
        self._high[slots] = np.fmax(self._high[slots], high)
        self.last = values[-1].copy()

    def _advance(self, newest: int) -> None:
        if self._newest >= 0:
            count = min(newest - self._newest, self.buckets)
            fresh = (self._newest + 1 + np.arange(count)) % self.buckets
            self._low[fresh] = np.nan
            self._high[fresh] = np.nan
        self._newest = max(newest, self._newest)

    def ordered(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (age in s <= 0, low, high), oldest first; (n,), (n, channels), (n, channels)."""
        order = (self._newest + 1 + np.arange(self.buckets)) % self.buckets
        age_s = (np.arange(self.buckets) - self.buckets + 1) * self._width_s
        return np.asarray(age_s, dtype=np.float64), self._low[order], self._high[order]

    def largest(self) -> float:
        """Return the largest magnitude, 0 if empty."""
        both = np.stack([self._low, self._high])
        finite = np.abs(both[np.isfinite(both)])
        return float(finite.max()) if len(finite) else 0.0


def finite_runs(values: FloatArray) -> list[tuple[int, int]]:
    """Return the stretches (start, end) without a gap of ``values`` (n,)."""
    if len(values) and np.isfinite(values).all():
        return [(0, len(values))]
    edges = np.diff(np.isfinite(values).astype(np.int8), prepend=0, append=0)
    return [(start, end) for start, end in np.flatnonzero(edges).reshape(-1, 2).tolist()]


def thin_buckets(
    t_s: FloatArray, low: FloatArray, high: FloatArray, columns: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Merge neighbouring samples or buckets to at most ``columns``."""
    starts = np.arange(0, len(t_s), max(-(-len(t_s) // max(columns, 1)), 1))
    return t_s[starts], np.fmin.reduceat(low, starts), np.fmax.reduceat(high, starts)


LINE_GAP_PX = 5


def draw_message(
    painter: QPainter, rect: QRect | QRectF, theme: Theme, text: str, detail: str = ""
) -> None:
    """Draw an empty state centred in ``rect``, wrapped to its width."""
    both = int(Qt.AlignmentFlag.AlignHCenter | Qt.TextFlag.TextWordWrap)
    area = QRectF(rect).adjusted(8, 0, -8, 0)
    parts = [(tr(text), "text", ui_font(theme.scale, 1.1, 500)),
             (tr(detail), "muted", ui_font(theme.scale, 0.92))]  # fmt: skip
    boxes = []
    for words, token, font in parts:
        painter.setFont(font)
        high = painter.boundingRect(area, both, words).height() if words else 0.0
        boxes.append((words, token, font, high))
    if sum(high for *_, high in boxes) + LINE_GAP_PX > area.height():
        boxes.pop()  # no room for the detail
    top = area.center().y() - (sum(high for *_, high in boxes) + LINE_GAP_PX) / 2
    for words, token, font, high in boxes:
        if words:
            painter.setFont(font)
            painter.setPen(theme.tokens.colour(token))
            painter.drawText(QRectF(area.left(), top, area.width(), high), both, words)
            top += high + LINE_GAP_PX


def draw_stale_overlay(
    painter: QPainter, rect: QRectF, theme: Theme, age_s: float, into: QColor | None = None
) -> None:
    """Fade ``rect`` by half into ``into`` (default black) and print the age."""
    veil = QColor(0, 0, 0) if into is None else QColor(into)
    veil.setAlpha(128)
    painter.fillRect(rect, veil)
    painter.setFont(ui_font(theme.scale, 1.0, 600))
    text = tr("STALE {:.1f} s", age_s)
    metrics = painter.fontMetrics()
    width = metrics.horizontalAdvance(text) + 16
    badge = QRectF(rect.center().x() - width / 2, rect.top() + 8, width, metrics.height() + 6)
    painter.fillRect(badge, theme.tokens.colour("pill_yellow"))
    painter.setPen(theme.tokens.colour("on_light"))
    painter.drawText(badge, int(Qt.AlignmentFlag.AlignCenter), text)


class PictureCache:
    """Picture of a widget, rendered again only if the key, the size or the theme changes."""

    def __init__(self, widget: QWidget, theme: Theme) -> None:
        self._widget, self._theme = widget, theme
        self._picture: QPixmap | None = None
        self._key: tuple[object, ...] = ()

    def clear(self) -> None:
        """Render the picture again at the next call."""
        self._picture = None

    def picture(self, draw: Callable[[QPainter], None], *key: object) -> QPixmap:
        """Return the picture; ``draw`` renders it on a ground in the panel colour."""
        size, theme = self._widget.size(), self._theme
        whole = (size.toTuple(), theme.tokens.name, theme.scale, *key)
        if self._picture is None or whole != self._key:
            ratio = self._widget.devicePixelRatioF()
            self._picture, self._key = QPixmap(size * ratio), whole
            self._picture.setDevicePixelRatio(ratio)
            self._picture.fill(theme.tokens.colour("panel"))
            # Qt aborts if a pixmap is destroyed while it is painted on.
            with QPainter(self._picture) as painter:
                draw(painter)
        return self._picture


BYTES = 4 * 8  # a QLineF is four doubles: x1, y1, x2, y2


class LineBuffer:
    """Reusable QLineF objects over one array: only their coordinates change per frame."""

    def __init__(self) -> None:
        self._memory: FloatArray = np.zeros((0, 4))
        self._lines: list[QLineF] = []

    def take(self, lines: FloatArray) -> None:
        """Set the lines, (n, 4) in pixels of the painter."""
        if len(lines) > len(self._lines):
            # Release the lines before the memory they point to.
            self._lines = []
            self._memory = np.zeros((len(lines), 4))
            start = self._memory.ctypes.data
            places = range(start, start + BYTES * len(lines), BYTES)
            self._lines = [cast("QLineF", Shiboken.wrapInstance(at, QLineF)) for at in places]
        self._memory[: len(lines)] = lines

    def draw(self, painter: QPainter, start: int, end: int) -> None:
        """Draw the lines ``start`` to ``end``, exclusive."""
        if end > start:
            painter.drawLines(self._lines[start:end])


@dataclass(frozen=True, slots=True)
class GridPainter:
    """Draws grid lines in ``area`` and labels outside; ``line`` "" leaves out the lines."""

    painter: QPainter
    area: PlotArea
    tokens: Tokens

    def row(self, value: float, text: str, line: str = "grid") -> None:
        """Draw a line across the area and its label at the left."""
        rect, y = self.area.rect, self.area.y(value)
        self._line(QPointF(rect.left(), y), QPointF(rect.right(), y), line)
        height = self.painter.fontMetrics().height()
        box = QRectF(0, y - height / 2, rect.left() - 5, height)
        self.painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), text)

    def column(self, value: float, text: str, line: str = "grid", gap: float = 2.0) -> None:
        """Draw a line down the area and its label below."""
        rect, x = self.area.rect, self.area.x(value)
        self._line(QPointF(x, rect.top()), QPointF(x, rect.bottom()), line)
        height = self.painter.fontMetrics().height()
        box = QRectF(x - 3 * height, rect.bottom() + gap, 6 * height, height)
        self.painter.drawText(box, int(Qt.AlignmentFlag.AlignHCenter), text)

    def grid(self, count: int, line: str = "grid", gap: float = 2.0) -> None:
        """Draw about ``count`` lines each way with their values, fewer where they would touch."""
        area, metrics = self.area, self.painter.fontMetrics()
        while True:
            step = nice_step(area.x1 - area.x0, count)
            texts = {value: tick_text(value, step) for value in ticks(area.x0, area.x1, count)}
            widest = max(map(metrics.horizontalAdvance, texts.values()), default=0)
            room = step / (area.x1 - area.x0) * area.rect.width()
            if count == 1 or room >= widest + metrics.averageCharWidth():
                break
            count -= 1
        for value, text in texts.items():
            self.column(value, text, line, gap)
        for value in ticks(area.y0, area.y1, count):
            self.row(value, tick_text(value, step), line)

    def _line(self, start: QPointF, end: QPointF, token: str) -> None:
        if token:
            self.painter.setPen(QPen(self.tokens.colour(token), 1))
            self.painter.drawLine(start, end)
        self.painter.setPen(self.tokens.colour("muted"))


def draw_mm_grid(
    painter: QPainter, area: PlotArea, theme: Theme, count: int = 6, *, outside: bool = False
) -> None:
    """Draw a grid of about ``count`` lines each way; axis names inside, or ``outside`` as ticks."""
    painter.fillRect(area.rect, theme.tokens.colour("bg"))
    GridPainter(painter, area, theme.tokens).grid(count, gap=3)
    corner, font = area.rect.adjusted(6, 4, -6, -4), painter.fontMetrics()
    if outside:
        beside = font.horizontalAdvance("x (mm)") + 10
        corner = area.rect.adjusted(0, -font.height(), beside, font.height() + 3)
    low, right = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignRight
    painter.drawText(corner, int(low | right), "x (mm)")
    painter.drawText(corner, int(Qt.AlignmentFlag.AlignLeft), "y (mm)")
