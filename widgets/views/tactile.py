"""Tactile image with markers and arrows."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QFont, QFontMetrics, QImage, QPainter, QPen, QPixmap, QResizeEvent
from PySide6.QtWidgets import QSizePolicy

from touchdown.backend.core import (
    Finger,
    FloatArray,
    ImageArray,
    MarkerField,
    MarkerState,
    TactileFrame,
)
from touchdown.widgets.base import Age, MapName, Theme, colour_table, map_colours, tr, ui_font
from touchdown.widgets.plots import (
    LineBuffer,
    PictureView,
    PlotArea,
    draw_message,
    draw_stale_overlay,
)


class DimmedPicture:
    """Draws images with reused buffers."""

    def __init__(self) -> None:
        self._dimmed: ImageArray = np.empty((0, 0, 3), np.uint8)
        self._padded: ImageArray = np.empty((0, 0, 4), np.uint8)
        self._scaled: ImageArray = np.empty((0, 0, 4), np.uint8)

    def draw(
        self, painter: QPainter, target: QRectF, image: ImageArray, ratio: float, bright: float
    ) -> None:
        """Draw ``image`` (BGR) over ``target``; ``ratio``: device pixels per pixel.

        Dimming and adding the fourth channel before enlarging takes a quarter of the time of the
        other order.
        """
        width = max(round(target.width() * ratio), 1)
        height = max(round(target.height() * ratio), 1)
        if self._dimmed.shape != image.shape:
            self._dimmed = np.empty(image.shape, np.uint8)
            self._padded = np.empty((*image.shape[:2], 4), np.uint8)
        if self._scaled.shape[:2] != (height, width):
            self._scaled = np.empty((height, width, 4), np.uint8)
        cv2.convertScaleAbs(image, self._dimmed, alpha=bright)
        cv2.cvtColor(self._dimmed, cv2.COLOR_BGR2BGRA, self._padded)
        cv2.resize(self._padded, (width, height), self._scaled, interpolation=cv2.INTER_LINEAR)
        drawn = QImage(self._scaled.data, width, height, 4 * width, QImage.Format.Format_RGB32)
        drawn.setDevicePixelRatio(ratio)
        painter.drawImage(target.topLeft(), drawn)


MM_PER_PX = 18.6 / 320.0  # field of view of the sensor 18.6 mm over 320 px (data sheet)
GAIN = 3.0  # magnification of the arrows, in all views
BIN_EDGES_PX = np.array([0.5, 1.5, 3.0, 5.0, 8.0])  # displacements at which the colour changes
# Colour map plasma from 0.60 to 1.00: contrast of at least 3.1 : 1 on the dark gel.
BIN_COLOURS = ("#E76E5A", "#F1834B", "#F99A3D", "#FDB32F", "#FCCD25", "#F5EA26")
HEAD_SHARE, HEAD_MIN_PX, HEAD_MAX_PX = 0.35, 2.0, 7.0


def colour_bins(displacement_px: FloatArray) -> NDArray[np.intp]:
    """Return the (n,) colour bins 0..5 of (n, 2) displacements."""
    return np.asarray(np.digitize(np.hypot(*displacement_px.T), BIN_EDGES_PX))


def arrow_segments(rest_px: FloatArray, displacement_px: FloatArray) -> FloatArray:
    """Return (n, 3, 4) shafts and head strokes (x1 y1 x2 y2) of n arrows."""
    vector = displacement_px * GAIN
    tip = rest_px + vector
    length = np.hypot(vector[:, 0], vector[:, 1])[:, None]
    direction = np.divide(vector, length, out=np.zeros_like(vector), where=length > 1e-9)
    head = np.clip(HEAD_SHARE * length, HEAD_MIN_PX, HEAD_MAX_PX) * (length > 1e-9)
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    strokes = np.empty((len(rest_px), 3, 4))
    strokes[:, 0, :2], strokes[:, :, 2:] = rest_px, tip[:, None, :]
    strokes[:, 1, :2] = tip - head * direction + 0.5 * head * across
    strokes[:, 2, :2] = tip - head * direction - 0.5 * head * across
    return strokes


ROWS, COLUMNS = 7, 9
FULL_PX = 12.0  # displacement at the end of the colour map (0.7 mm)
IMAGE_W, IMAGE_H = 320, 240
SCALE_PX = 64
LEGEND_MM, LEGEND_PX = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01), 200.0


def magnitude_px(field: MarkerField) -> FloatArray:
    """Return the (7, 9) displacement sizes.

    A lost marker takes the mean of the others, so that no false peak appears.
    """
    size = np.hypot(*field.displacement_px.T)
    unknown = ~np.isfinite(size) | (field.state == MarkerState.LOST)
    known = size[~unknown]
    filled = np.where(unknown, float(known.mean()) if len(known) else 0.0, size)
    return np.asarray(filled.reshape(ROWS, COLUMNS))


def magnitude_picture(field: MarkerField, map_name: MapName) -> ImageArray:
    """Return (240, 320, 3) BGR, bilinear between rest positions, constant beyond the outer ones."""
    rest = (field.position_px - field.displacement_px).reshape(ROWS, COLUMNS, 2)
    across, down = np.nanmean(rest[:, :, 0], axis=0), np.nanmean(rest[:, :, 1], axis=1)
    u = np.interp(np.arange(IMAGE_W), across, np.arange(COLUMNS)).astype(np.float32)
    v = np.interp(np.arange(IMAGE_H), down, np.arange(ROWS)).astype(np.float32)
    grid = np.clip(magnitude_px(field) / FULL_PX, 0.0, 1.0).astype(np.float32)
    smooth = cv2.remap(grid, *np.meshgrid(u, v), cv2.INTER_LINEAR)
    picture = map_colours(np.asarray(smooth, dtype=np.float64), map_name)
    return np.ascontiguousarray(picture[:, :, ::-1])


def _plate(size: QSize, ratio: float) -> QPixmap:
    drawn = QPixmap(size * ratio)
    drawn.setDevicePixelRatio(ratio)
    drawn.fill(QColor(0, 0, 0, 150))
    return drawn


def magnitude_scale(font: QFont, ratio: float, map_name: MapName = "cividis") -> QPixmap:
    """Return a colour bar labelled in mm; ``ratio``: device pixels per pixel."""
    metrics = QFontMetrics(font)
    low, high = "0", f"{FULL_PX * MM_PER_PX:.1f} mm"
    left, tall = metrics.horizontalAdvance(low) + 12, max(metrics.height() + 6, 22)
    size = QSize(left + SCALE_PX + metrics.horizontalAdvance(high) + 12, tall)
    drawn = _plate(size, ratio)
    with QPainter(drawn) as painter:
        shades = colour_table(map_name)
        for at in range(SCALE_PX):
            shade = QColor(*shades[255 * at // (SCALE_PX - 1)].tolist())
            painter.fillRect(QRectF(left + at, tall / 2 - 4, 1.5, 8), shade)
        painter.setFont(font)
        painter.setPen(QColor("#FFFFFF"))
        middle = Qt.AlignmentFlag.AlignVCenter
        painter.drawText(QRectF(6, 0, left, tall), int(middle), low)
        painter.drawText(QRectF(left + SCALE_PX + 6, 0, size.width(), tall), int(middle), high)
    return drawn


MIN_SIZE = QSize(160, 120)
BRIGHTNESS = 0.7  # dims the image, so that dark markers do not hide short arrows
PENS = tuple(QPen(QColor(colour), 2) for colour in BIN_COLOURS)


Look = Literal["both", "image", "arrows", "magnitude"]
LOOKS: tuple[tuple[Look, str], ...] = (
    ("both", "Both"),
    ("image", "Image"),
    ("arrows", "Arrows"),
    ("magnitude", "Magnitude"),
)


class TactileView(PictureView):
    """Newest image and marker field of one finger."""

    unit = "px"

    def __init__(self, theme: Theme, finger: Finger) -> None:
        name, least_px = tr("Tactile image, {} finger", tr(finger)), MIN_SIZE.toTuple()
        super().__init__(theme, name, least_px, (IMAGE_W, IMAGE_H))
        self._frame: TactileFrame | None = None
        self._field: MarkerField | None = None
        self._age, self._age_s, self._reason = Age.NEVER, 0.0, ""
        self._picture, self._strokes = DimmedPicture(), LineBuffer()
        self._legend: QPixmap | None = None
        self._legend_key: tuple[object, ...] = ()
        self.look: Look = "both"
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        self._limit_px = self.maximumHeight()
        self.never, self.gone = "No camera yet", "No live picture"  # titles of the empty view

    def limit_height(self, limit_px: int) -> None:
        """Limit the height, so that a wide window leaves room below."""
        self._limit_px = limit_px
        self._fit_height()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Follow changes of the width."""
        self._fit_height()

    def _fit_height(self) -> None:
        if self.enlarged is None:
            usual = min(self.width() * IMAGE_H // IMAGE_W, self._limit_px)
            self.setFixedHeight(max(usual, MIN_SIZE.height()))

    def show_frame(self, frame: TactileFrame, field: MarkerField | None) -> None:
        """Show this frame with the newest marker field, if any."""
        self._frame, self._field = frame, field
        self.update()

    def show_look(self, look: Look) -> None:
        """Choose the layers to draw."""
        self.look = look
        self.update()

    def show_age(self, age: Age, age_s: float, reason: str) -> None:
        """Set the age of the image; beyond 2 s it is replaced by ``reason``."""
        if age is Age.FRESH and self._age is Age.FRESH:
            return
        tenth = f"{age_s:.1f}" != f"{self._age_s:.1f}"
        if age is not self._age or reason != self._reason or tenth:
            self._age, self._age_s, self._reason = age, age_s, reason
            self.update()

    def seen(self) -> tuple[int, int]:
        """Return (visible markers, markers)."""
        if self._field is None:
            return 0, 0
        return int((self._field.state == MarkerState.SEEN).sum()), len(self._field.state)

    def area(self) -> PlotArea:
        """Return the visible part of the image in its pixels, y downwards."""
        return self.zoom.of(PlotArea(self._target(), 0, IMAGE_W, IMAGE_H, 0))

    def reading(self, x: float, y: float) -> str:
        """Return the place, and the displacement of the nearest marker."""
        text, field = super().reading(x, y), self._field
        if field is None:
            return text
        far = np.hypot(*(field.position_px - (x, y)).T)
        near = int(np.argmin(np.where(np.isfinite(far), far, np.inf)))
        shift = float(np.hypot(*field.displacement_px[near]))
        return f"{text}; " + tr("marker {:.1f} px, {:.2f} mm", shift, shift * MM_PER_PX)

    def paint(self, painter: QPainter) -> None:
        """Draw image, arrows, legend and age."""
        painter.fillRect(self.rect().adjusted(0, 0, 1, 1), self._theme.tokens.colour("bg"))
        if self._frame is None or self._age in (Age.NEVER, Age.GONE):
            text = self.never if self._frame is None else self.gone
            draw_message(painter, self.rect(), self._theme, text, self._reason)
            return
        area = self.area()
        target, scale = area.rect, area.rect.width() / (area.x1 - area.x0)
        painter.save()
        painter.setClipRect(target)
        self._draw_picture(painter, area, self._frame)
        painter.translate(area.place(0, 0))
        if self._field is not None and self.look in ("both", "arrows"):
            _draw_markers(painter, self._field, scale, self._strokes)
        painter.restore()
        if self.look != "image":
            self._draw_legend(painter, target, scale)
        if self._age is Age.STALE:
            draw_stale_overlay(painter, target, self._theme, self._age_s)

    def _draw_picture(self, painter: QPainter, area: PlotArea, frame: TactileFrame) -> None:
        """Draw the layer below the arrows: the image, a plain ground or the magnitudes."""
        ratio = self.devicePixelRatioF()
        if self.look == "arrows":
            # Dark in every theme, as the colours of the arrows require.
            painter.fillRect(area.rect, QColor("#14181C"))
            return
        image, bright = frame.image, BRIGHTNESS if self.look == "both" else 1.0
        if self.look == "magnitude" and self._field is not None:
            image = magnitude_picture(self._field, "cividis")
        # Only the visible pixels are enlarged.
        left, top = max(int(area.x0), 0), max(int(area.y1), 0)
        seen = image[top : math.ceil(area.y0), left : math.ceil(area.x1)]
        end = area.place(left + seen.shape[1], top + seen.shape[0])
        target = QRectF(area.place(left, top), end)
        self._picture.draw(painter, target, seen, ratio, bright)

    def _draw_legend(self, painter: QPainter, target: QRectF, scale: float) -> None:
        sizes, ratio = self.look == "magnitude", self.devicePixelRatioF()
        key = (scale, self._theme.scale, ratio, sizes)
        if self._legend is None or key != self._legend_key:
            font = ui_font(self._theme.scale, 0.85)
            drawn = magnitude_scale(font, ratio) if sizes else _legend(scale, font, ratio)
            self._legend, self._legend_key = drawn, key
        size = self._legend.deviceIndependentSize()
        at = target.bottomRight() - QPointF(size.width() + 4, size.height() + 4)
        painter.drawPixmap(at, self._legend)

    def _target(self) -> QRectF:
        scale = min(self.width() / IMAGE_W, self.height() / IMAGE_H)
        width, height = IMAGE_W * scale, IMAGE_H * scale
        return QRectF((self.width() - width) / 2, (self.height() - height) / 2, width, height)


def _draw_markers(painter: QPainter, field: MarkerField, scale: float, strokes: LineBuffer) -> None:
    displacement, state = field.displacement_px, field.state
    both = field.position_px + displacement
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(both).all(axis=1))
    rest = field.position_px - displacement
    shown = np.flatnonzero(finite & (state != MarkerState.LOST))
    bins = colour_bins(displacement[shown])
    order = np.argsort(bins, kind="stable")
    shown, bins = shown[order], bins[order]
    strokes.take((arrow_segments(rest[shown], displacement[shown]) * scale).reshape(-1, 4))
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
    """Draw inferred markers as rings and lost ones as crosses, at their rest position."""
    painter.setPen(QPen(QColor("#FFFFFF"), 1))
    painter.setBrush(Qt.BrushStyle.NoBrush)
    for x, y in rest[finite & (field.state == MarkerState.INFERRED)].tolist():
        painter.drawEllipse(QPointF(x, y), 5, 5)
    for x, y in rest[finite & (field.state == MarkerState.LOST)].tolist():
        painter.drawLine(QPointF(x - 4, y - 4), QPointF(x + 4, y + 4))
        painter.drawLine(QPointF(x - 4, y + 4), QPointF(x + 4, y - 4))


def _legend(scale: float, font: QFont, ratio: float) -> QPixmap:
    """Return an arrow of 1 mm with its label, of less in an image drawn at a large scale."""
    length_mm = next(mm for mm in LEGEND_MM if mm * GAIN / MM_PER_PX * scale <= LEGEND_PX)
    length = length_mm * GAIN / MM_PER_PX * scale
    metrics, words = QFontMetrics(font), f"{length_mm:g} mm"
    text, high = metrics.horizontalAdvance(words) + 14, max(metrics.height() + 6, 22)
    size = QSize(round(length) + text + 8, high)
    drawn = _plate(size, ratio)
    with QPainter(drawn) as painter:
        painter.setPen(QPen(QColor("#FFFFFF"), 2))
        start = np.array([[text, high / 2]]) / scale
        stroke = np.array([[length, 0.0]]) / scale / GAIN
        lines = LineBuffer()
        lines.take((arrow_segments(start, stroke) * scale).reshape(-1, 4))
        lines.draw(painter, 0, 3)
        painter.setFont(font)
        flags = Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft
        painter.drawText(QRectF(6, 0, size.width(), high), int(flags), words)
    return drawn
