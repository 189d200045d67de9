"""One tactile image with marker arrows: the picture dimmed, arrows from the rest positions."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import (
    QColor,
    QFont,
    QFontMetrics,
    QPainter,
    QPaintEvent,
    QPen,
    QPixmap,
    QResizeEvent,
)
from PySide6.QtWidgets import QSizePolicy, QWidget

from backend.core.flow import Finger, FloatArray, MarkerField, MarkerState, TactileFrame
from widgets import arrows
from widgets.dimmed import DimmedPicture
from widgets.freshness import Age
from widgets.magnitude import magnitude_picture, magnitude_scale
from widgets.overlay import draw_message, draw_stale
from widgets.strokes import Strokes
from widgets.theme import Theme, ui_font

IMAGE_W, IMAGE_H = 320, 240
LEAST = QSize(160, 120)
BRIGHTNESS = 0.7
"""Dark marker blobs under the arrow tails would hide small motion on an undimmed picture."""
PENS = tuple(QPen(QColor(colour), 2) for colour in arrows.BIN_COLOURS)


Look = Literal["both", "image", "arrows", "magnitude"]
LOOKS: tuple[tuple[Look, str], ...] = (
    ("both", "Both"),
    ("image", "Image"),
    ("arrows", "Arrows"),
    ("magnitude", "Magnitude"),
)


class TactileView(QWidget):
    """Shows the newest frame of one finger and its marker field."""

    def __init__(self, theme: Theme, finger: Finger) -> None:
        super().__init__()
        self._theme = theme
        self._frame: TactileFrame | None = None
        self._field: MarkerField | None = None
        self._age, self._age_s, self._reason = Age.NEVER, 0.0, ""
        self._picture, self._strokes = DimmedPicture(), Strokes()
        self._legend: QPixmap | None = None
        self._legend_key: tuple[object, ...] = ()
        self.look: Look = "both"
        self.paints = 0
        self.setAccessibleName(f"Tactile image, {finger} finger")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self.setMinimumSize(LEAST)
        self._limit_px = self.maximumHeight()
        self.never, self.gone = "No camera yet", "No live picture"
        """What is said where there is nothing to show."""
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return the image's own size."""
        return QSize(IMAGE_W, IMAGE_H)

    def limit_height(self, limit_px: int) -> None:
        """Grow no taller than ``limit_px``: a very wide window must leave room below."""
        self._limit_px = limit_px
        self._fit_height()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Follow every change of width, also those that no resize of the window caused."""
        self._fit_height()

    def _fit_height(self) -> None:
        height = max(min(self.width() * IMAGE_H // IMAGE_W, self._limit_px), LEAST.height())
        if height != self.minimumHeight() or height != self.maximumHeight():
            self.setFixedHeight(height)

    def show_frame(self, frame: TactileFrame, field: MarkerField | None) -> None:
        """Show this frame and, if there is one, the newest marker field."""
        self._frame = frame
        self._field = field
        self.update()

    def show_look(self, look: Look) -> None:
        """Choose what is drawn."""
        self.look = look
        self.update()

    def show_age(self, age: Age, age_s: float, reason: str) -> None:
        """Say how old the picture is; beyond 2 s the picture is removed and ``reason`` shown."""
        if age is Age.FRESH and self._age is Age.FRESH:
            return
        tenth = f"{age_s:.1f}" != f"{self._age_s:.1f}"
        if age is not self._age or reason != self._reason or tenth:
            self._age, self._age_s, self._reason = age, age_s, reason
            self.update()

    def seen(self) -> tuple[int, int]:
        """Return (markers seen, markers)."""
        if self._field is None:
            return 0, 0
        return int((self._field.state == MarkerState.SEEN).sum()), len(self._field.state)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw image, arrows, legend and age."""
        self.paints += 1
        painter = QPainter(self)
        painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
        if self._frame is None or self._age in (Age.NEVER, Age.GONE):
            text = self.never if self._frame is None else self.gone
            draw_message(painter, self.rect(), self._theme, text, self._reason)
            return
        target = self._target()
        self._draw_picture(painter, target, self._frame)
        painter.save()
        painter.setClipRect(target)
        painter.translate(target.topLeft())
        scale = target.width() / IMAGE_W
        if self._field is not None and self.look in ("both", "arrows"):
            _draw_markers(painter, self._field, scale, self._strokes)
        painter.restore()
        if self.look != "image":
            self._draw_legend(painter, target)
        if self._age is Age.STALE:
            draw_stale(painter, target, self._theme, self._age_s)

    def _draw_picture(self, painter: QPainter, target: QRectF, frame: TactileFrame) -> None:
        """Draw what is under the arrows: the gel, dimmed under arrows; nothing; or sizes."""
        ratio = self.devicePixelRatioF()
        if self.look == "arrows":
            # The arrows' colours are made for the dark gel, in every theme.
            painter.fillRect(target, QColor("#14181C"))
        elif self.look == "magnitude" and self._field is not None:
            sizes = magnitude_picture(self._field, "cividis")
            self._picture.draw(painter, target, sizes, ratio, 1.0)
        else:
            bright = BRIGHTNESS if self.look == "both" else 1.0
            self._picture.draw(painter, target, frame.image, ratio, bright)

    def _draw_legend(self, painter: QPainter, target: QRectF) -> None:
        sizes, ratio = self.look == "magnitude", self.devicePixelRatioF()
        key = (target.width(), self._theme.scale, ratio, sizes)
        if self._legend is None or key != self._legend_key:
            font = ui_font(self._theme.scale, 0.85)
            drawn = magnitude_scale(font, ratio) if sizes else _legend(target.width(), font, ratio)
            self._legend, self._legend_key = drawn, key
        size = self._legend.deviceIndependentSize()
        at = target.bottomRight() - QPointF(size.width() + 4, size.height() + 4)
        painter.drawPixmap(at, self._legend)

    def _target(self) -> QRectF:
        scale = min(self.width() / IMAGE_W, self.height() / IMAGE_H)
        width, height = IMAGE_W * scale, IMAGE_H * scale
        return QRectF((self.width() - width) / 2, (self.height() - height) / 2, width, height)


def _draw_markers(painter: QPainter, field: MarkerField, scale: float, strokes: Strokes) -> None:
    displacement, state = field.displacement_px, field.state
    both = field.position_px + displacement
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(both).all(axis=1), dtype=np.bool_)
    rest = field.position_px - displacement
    shown = np.flatnonzero(finite & (state != MarkerState.LOST))
    bins = arrows.bins_of(displacement[shown])
    order = np.argsort(bins, kind="stable")
    shown, bins = shown[order], bins[order]
    strokes.take((arrows.segments(rest[shown], displacement[shown]) * scale).reshape(-1, 4))
    ends = (3 * np.searchsorted(bins, np.arange(len(PENS) + 1))).tolist()
    for pen, start, end in zip(PENS, ends[:-1], ends[1:], strict=True):
        if end > start:
            painter.setPen(pen)
            strokes.draw(painter, start, end)
    if (state != MarkerState.SEEN).any():
        _draw_uncertain(painter, field, rest * scale, finite)


def _draw_uncertain(
    painter: QPainter, field: MarkerField, rest: FloatArray, finite: NDArray[np.bool_]
) -> None:
    """Inferred markers: a hollow ring on the rest position; lost ones: a cross."""
    painter.setPen(QPen(QColor("#FFFFFF"), 1))
    painter.setBrush(Qt.BrushStyle.NoBrush)
    for x, y in rest[finite & (field.state == MarkerState.INFERRED)].tolist():
        painter.drawEllipse(QPointF(x, y), 5, 5)
    for x, y in rest[finite & (field.state == MarkerState.LOST)].tolist():
        painter.drawLine(QPointF(x - 4, y - 4), QPointF(x + 4, y + 4))
        painter.drawLine(QPointF(x - 4, y + 4), QPointF(x + 4, y - 4))


def _legend(width_px: float, font: QFont, ratio: float) -> QPixmap:
    """Draw the arrow of 1 mm and its name for an image of this width."""
    scale = width_px / IMAGE_W
    length = arrows.GAIN / arrows.MM_PER_PX * scale
    metrics = QFontMetrics(font)
    text, high = metrics.horizontalAdvance("1 mm") + 14, max(metrics.height() + 6, 22)
    size = QSize(round(length) + text + 8, high)
    drawn = QPixmap(size * ratio)
    drawn.setDevicePixelRatio(ratio)
    drawn.fill(QColor(0, 0, 0, 150))
    painter = QPainter(drawn)
    try:
        painter.setPen(QPen(QColor("#FFFFFF"), 2))
        start = np.array([[text, high / 2]]) / scale
        stroke = np.array([[length, 0.0]]) / scale / arrows.GAIN
        lines = Strokes()
        lines.take((arrows.segments(start, stroke) * scale).reshape(-1, 4))
        lines.draw(painter, 0, 3)
        painter.setFont(font)
        flags = Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft
        painter.drawText(QRectF(6, 0, size.width(), high), int(flags), "1 mm")
    finally:
        painter.end()
    return drawn
