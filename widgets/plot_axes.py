"""Scales of the hand-drawn plots: round ticks and the mapping from values to pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from PySide6.QtCore import QRectF
from PySide6.QtGui import QPolygonF
from shiboken6 import VoidPtr

from backend.core.flow import FloatArray


def nice_step(span: float, count: int) -> float:
    """Return a step of 1, 2 or 5 times a power of ten that gives about ``count`` ticks."""
    raw = span / max(count, 1)
    power = 10.0 ** math.floor(math.log10(raw))
    return float(next(m * power for m in (1.0, 2.0, 5.0, 10.0) if raw <= m * power * (1 + 1e-9)))


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return round values within [low, high]."""
    step = nice_step(high - low, count)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(k * step, 10) for k in range(first, last + 1)]


def tick_text(value: float, step: float) -> str:
    """Write a tick with as many decimals as its step needs and a true minus sign."""
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return f"{value:.{decimals}f}".replace("-", "\N{MINUS SIGN}")


@dataclass(frozen=True, slots=True)
class PlotArea:
    """Maps values in [x0, x1] x [y0, y1] to ``rect`` (y up)."""

    rect: QRectF
    x0: float
    x1: float
    y0: float
    y1: float

    def x(self, value: float) -> float:
        """Pixel column of a value."""
        return self.rect.left() + (value - self.x0) / (self.x1 - self.x0) * self.rect.width()

    def y(self, value: float) -> float:
        """Pixel row of a value."""
        return self.rect.bottom() - (value - self.y0) / (self.y1 - self.y0) * self.rect.height()

    def columns(self, x: FloatArray) -> FloatArray:
        """Pixel columns of values of any shape."""
        return self.rect.left() + (x - self.x0) * (self.rect.width() / (self.x1 - self.x0))

    def rows(self, y: FloatArray) -> FloatArray:
        """Pixel rows of values of any shape."""
        return self.rect.bottom() - (y - self.y0) * (self.rect.height() / (self.y1 - self.y0))

    def polygon(self, x: FloatArray, y: FloatArray) -> QPolygonF:
        """Map (n,) and (n,) to a polyline without a Python loop."""
        points = np.empty((len(x), 2))
        points[:, 0], points[:, 1] = self.columns(x), self.rows(y)
        return polygon_of(points)


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


def spread(wanted: list[float], gap: float, low: float, high: float) -> list[float]:
    """Move labels apart so that neighbours are ``gap`` away and all stay within [low, high]."""
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
